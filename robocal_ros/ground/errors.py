# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can act on; every message names the thing, the value and what to do."""

from collections.abc import Sequence
from enum import IntEnum

# ---- the one table of codes for JSON, services and PLC (see docs/codes.md) ----------------------


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


# ---- errors -------------------------------------------------------------------------------------


class RobocalError(Exception):
    """The data or the state cannot give what was asked. A caller's bug is a ``ValueError``."""

    code: Code = Code.BAD_INPUT


class InputError(RobocalError):
    """Input that cannot be read or makes no sense.

    ``message``: what is wrong, with the value, and what to do.
    ``file``, ``row``, ``column``: where, as far as that is known; the header is row 1.
    """

    def __init__(
        self,
        message: str,
        *,
        file: str | None = None,
        row: int | None = None,
        column: str | None = None,
    ) -> None:
        place = [str(file)] if file is not None else []
        place += [f"row {row}"] if row is not None else []
        place += [f"column {column}"] if column is not None else []
        super().__init__(f"{', '.join(place)}: {message}" if place else message)
        self.file = None if file is None else str(file)
        self.row = row
        self.column = column


class TooFewSamplesError(RobocalError):
    """Fewer usable samples than the unknowns need."""

    code = Code.TOO_FEW_SAMPLES


class RankDeficientError(RobocalError):
    """The data leave a direction undetermined; ``directions`` names each in words."""

    code = Code.RANK_DEFICIENT

    def __init__(self, message: str, directions: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.directions = tuple(directions)


class StaleError(RobocalError):
    """A result that was solved against a state no longer in force."""

    code = Code.STALE


class WrongRobotError(RobocalError):
    """A result made for another robot or another nominal model."""

    code = Code.WRONG_ROBOT


class LimitError(RobocalError):
    """A value beyond a configured bound."""

    code = Code.LIMIT_EXCEEDED


class ResidualError(RobocalError):
    """Measurements that miss the model by more than any calibration error."""

    code = Code.RESIDUAL_TOO_LARGE


class ConflictError(RobocalError):
    """Another change came first."""

    code = Code.CONFLICT


class StorageError(RobocalError):
    """The history could not be read or written; nothing was half-written."""

    code = Code.STORAGE_FAILED


class StateLostError(StorageError):
    """What was kept is gone, and what it told is forgotten."""
