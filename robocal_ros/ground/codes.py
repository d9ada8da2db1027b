"""The one table of codes for JSON, services and PLC (see docs/codes.md)."""

from enum import IntEnum


class Code(IntEnum):
    """Verdict or status of a calibration step.

    The numbers equal the constants of ``CalibrationQuality.msg`` and are never reused.
    0 is no verdict, so that an empty PLC register cannot be read as approval.
    """

    NONE = 0
    ACCEPT = 1
    WORSE_THAN_CURRENT = 2
    NO_SIGNIFICANT_GAIN = 3
    RANK_DEFICIENT = 4
    TOO_FEW_SAMPLES = 5
    RESIDUAL_TOO_LARGE = 6
    POSES_NOT_INFORMATIVE = 7
    STALE = 8
    WRONG_ROBOT = 9
    LIMIT_EXCEEDED = 10
    BAD_INPUT = 11
    CONFLICT = 12
    STORAGE_FAILED = 13
    SENSOR_OR_ROBOT_MOVED = 14
    BEAM_EDGES_WRONG = 15
    WRONG_TOOL = 16
    CLOCK_WRONG = 17
    STATION_MOVED = 18
