"""The table of codes, the enumeration and the message must say the same."""

import re
from pathlib import Path

import pytest

from robocal_ros.core.codes import Code

ROOT = Path(__file__).parents[1]
CODES = {code.name: int(code) for code in Code}


def rows_of(page, first):
    """The cells of each row of the table of a page whose first row begins so."""
    text = (ROOT / "docs" / page).read_text()
    table = text[text.index(f"| {first} |") :].split("\n\n")[0]
    return [
        [cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]
    ]


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
    text = (ROOT / "msg_defs" / "msg" / "CalibrationQuality.msg").read_text()
    constants = re.findall(r"^uint8\s+([A-Z_]+)\s*=\s*(\d+)", text, re.M)
    assert {name: int(number) for name, number in constants} == CODES


def test_numbers_are_never_reused():
    assert {
        "NONE": 0, "ACCEPT": 1, "WORSE_THAN_CURRENT": 2, "NO_SIGNIFICANT_GAIN": 3,
        "RANK_DEFICIENT": 4, "TOO_FEW_SAMPLES": 5, "RESIDUAL_TOO_LARGE": 6,
        "POSES_NOT_INFORMATIVE": 7, "STALE": 8, "WRONG_ROBOT": 9, "LIMIT_EXCEEDED": 10,
        "BAD_INPUT": 11, "CONFLICT": 12, "STORAGE_FAILED": 13, "SENSOR_OR_ROBOT_MOVED": 14,
        "BEAM_EDGES_WRONG": 15, "WRONG_TOOL": 16, "CLOCK_WRONG": 17,
    }.items() <= CODES.items()  # fmt: skip
