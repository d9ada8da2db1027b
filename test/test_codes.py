"""The table of codes, the enumeration and the message must say the same."""

import re
from pathlib import Path

from robocal_ros.core.codes import Code

ROOT = Path(__file__).parents[1]
CODES = {code.name: int(code) for code in Code}


def test_documented_table():
    rows = re.findall(r"^\| (\d+) \| ([A-Z_]+) \|", (ROOT / "docs" / "codes.md").read_text(), re.M)
    assert len(rows) == len(CODES)
    assert {name: int(number) for number, name in rows} == CODES


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
