"""Whose history a node keeps, and where."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.nodes.base import NO_SERIAL
from robocal_ros.nodes.diagnostics import WARN, Health
from robocal_ros.nodes.parameters import Setting
from robocal_ros.storage.calibrations import CalibrationHistory

STATE_DIR = Setting(
    "state_dir", "", "Folder of the histories; empty: $ROBOCAL_STATE, else the XDG folder"
)


def open_history(
    settings: Mapping[str, Any], nominal: SerialArm, sole_user: str = ""
) -> tuple[str, CalibrationHistory]:
    """The serial in use and its history; ``sole_user``: a node of which a robot has one at most.

    Raises
    ------
    RobocalError
        As `CalibrationHistory.open`.
    """
    serial = settings["serial"] or NO_SERIAL
    folder = settings[STATE_DIR.name]
    state_dir = Path(folder) if folder else None
    history = CalibrationHistory.open(
        serial, model_hash=nominal.model_hash, state_dir=state_dir, sole_user=sole_user
    )
    return serial, history


def warn_without_serial(health: Health, serial: str) -> None:
    """Tell that no serial is set, where none is."""
    if serial == NO_SERIAL:
        health.worsen(WARN, f"no serial is set: the history is kept as '{NO_SERIAL}'")
