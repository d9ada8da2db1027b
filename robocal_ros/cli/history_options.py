"""Options of ``robocal history``."""

import argparse
from pathlib import Path

from robocal_ros.cli.arguments import count, text
from robocal_ros.ground.files import quoted
from robocal_ros.ground.proposals import HEALTHY_TOOL, MANDREL, THERMAL, TOOL, hand_eye_kind

_PREVIOUS = "previous"
_NOMINAL = "nominal"
_KINDS = (THERMAL, "reference", TOOL, HEALTHY_TOOL, MANDREL)


def add_history(action: argparse.ArgumentParser) -> None:
    """Declare which history is meant."""
    action.add_argument(
        "--robot-serial",
        type=text,
        metavar="S",
        help="robot serial; may be left out where only one robot has a history",
    )
    action.add_argument(
        "--state",
        type=Path,
        metavar="DIR",
        help="folder of the histories, default $ROBOCAL_STATE or ~/.local/state/robocal",
    )


def add_rollback_target(action: argparse.ArgumentParser) -> None:
    """Declare what a rollback returns to."""
    action.add_argument(
        "--to",
        type=_target,
        default=None,
        metavar="ID",
        help="an accepted calibration, 'nominal', or 'previous' (default): the one in force "
        "before the present one",
    )
    action.add_argument(
        "--kind",
        type=_kind,
        metavar="KIND",
        default=THERMAL,
        help=f"{', '.join(_KINDS)} or {hand_eye_kind('SENSOR')}; default {THERMAL}",
    )


def _kind(value: str) -> str:
    """A kind of calibration; each sensor has its own."""
    start = hand_eye_kind("")
    if value not in _KINDS and (not value.startswith(start) or value == start):
        known = ", ".join((*_KINDS, hand_eye_kind("SENSOR")))
        raise argparse.ArgumentTypeError(f"'{value}' is none of {known}")
    return value


def _target(value: str) -> int | None:
    if value == _PREVIOUS:
        return None
    if value == _NOMINAL:
        return 0
    try:
        return count(value)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(
            f"{quoted(value)} is neither an id of the list nor {_NOMINAL!r} nor {_PREVIOUS!r}"
        ) from error
