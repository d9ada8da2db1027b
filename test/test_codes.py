# SPDX-License-Identifier: Apache-2.0
"""The tables of codes, states and refusals must say what enumerations and messages say."""

import re
from pathlib import Path

import pytest

from robocal_ros.correction.interface import Reason
from robocal_ros.ground.errors import Code

ROOT = Path(__file__).parents[1]
CODES = {code.name: int(code) for code in Code}


def rows_of(page, first):
    """The cells of each row of the table of a page whose first row begins so."""
    text = (ROOT / "docs" / page).read_text()
    table = text[text.index(f"| {first} |") :].split("\n\n")[0]
    return [
        [cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]
    ]


def constants_of(message):
    """Constants of a message's first enumeration: those from NONE on to the next empty line."""
    text = (ROOT / "msg_defs" / "msg" / f"{message}.msg").read_text()
    first = text[text.index("uint8 NONE=0") :].split("\n\n")[0]
    return {
        name: int(number)
        for name, number in re.findall(r"^uint8\s+([A-Z_]+)\s*=\s*(\d+)", first, re.M)
    }


def test_documented_table():
    rows = rows_of("codes.md", "number")
    numbers = [int(row[0]) for row in rows]
    assert numbers == sorted(numbers)
    assert {row[1]: int(row[0]) for row in rows} == CODES
    assert all(len(row) == 5 and all(row) for row in rows)


@pytest.mark.parametrize(
    ("page", "first", "giver"),
    [("tcf_node.md", "ends with", "tcf_node"), ("plc.md", "`code`", "maintenance_node")],
)
def test_a_code_of_a_node_says_what_to_do_there_and_in_the_table(page, first, giver):
    givers = {}
    for _, name, by, *_ in rows_of("codes.md", "number"):
        givers.setdefault(name, []).append(by)
    for row in rows_of(page, first):
        assert row[-1], row
        for name in set(re.findall(r"[A-Z_]{4,}", " ".join(row[:2]))) & CODES.keys() - {"NONE"}:
            assert re.search(rf"{giver}|every call", " ".join(givers[name])), (name, givers[name])


def test_message_constants():
    assert constants_of("CalibrationQuality") == CODES


@pytest.mark.parametrize(
    ("page", "first", "message"),
    [
        ("codes.md", "maintenance", "MaintenanceStatus"),
        ("codes.md", "correction", "CorrectionStatus"),
        ("plc.md", "state", "AccuracyState"),
    ],
)
def test_each_state_has_its_number_and_what_to_do(page, first, message):
    rows = rows_of(page, first)
    sent = {name: number for name, number in constants_of(message).items() if name != "NONE"}
    assert {row[0]: int(row[1]) for row in rows} == sent
    assert all(len(row) == 4 and all(row) for row in rows)


def test_each_refusal_of_the_correction_says_what_to_do():
    rows = rows_of("codes.md", "reason")
    assert [row[0] for row in rows] == [reason.value for reason in Reason]
    assert all(len(row) == 2 and all(row) for row in rows)


def test_numbers_are_never_reused():
    assert {
        "NONE": 0, "ACCEPT": 1, "WORSE_THAN_CURRENT": 2, "NO_SIGNIFICANT_GAIN": 3,
        "RANK_DEFICIENT": 4, "TOO_FEW_SAMPLES": 5, "RESIDUAL_TOO_LARGE": 6,
        "POSES_NOT_INFORMATIVE": 7, "STALE": 8, "WRONG_ROBOT": 9, "LIMIT_EXCEEDED": 10,
        "BAD_INPUT": 11, "CONFLICT": 12, "STORAGE_FAILED": 13, "SENSOR_OR_ROBOT_MOVED": 14,
        "BEAM_EDGES_WRONG": 15, "WRONG_TOOL": 16, "CLOCK_WRONG": 17,
    }.items() <= CODES.items()  # fmt: skip
