"""Whose history a node keeps, and where."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robocal_ros.ground.errors import WrongRobotError
from robocal_ros.ground.files import StateFile
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_file import acknowledge, damage_notice, history_path, state_folder
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import robot_file_hash
from robocal_ros.ros.base import NO_SERIAL
from robocal_ros.ros.endpoints import WARN, Health
from robocal_ros.ros.parameters import Setting

STATE_DIR = Setting(
    "state_dir", "", "Folder of the histories; empty: $ROBOCAL_STATE, else the XDG folder"
)


def open_history(
    settings: Mapping[str, Any], nominal: SerialArm, sole_user: str = "", *, owner: bool = True
) -> tuple[str, CalibrationHistory]:
    """The serial in use and its history; ``sole_user``: a node of which a robot has one at most.

    ``owner``: a damaged history is set aside; who only adds to it is refused.

    Raises
    ------
    RobocalError
        As `CalibrationHistory.open`; also where no serial is set and the history was begun with
        another robot file: nothing else tells two robots of one type apart.
    """
    serial, state_dir = settings["serial"] or NO_SERIAL, _folder(settings)
    history = CalibrationHistory.open(
        serial,
        model_hash=nominal.model_hash,
        state_dir=state_dir,
        sole_user=sole_user,
        owner=owner,
    )
    if serial == NO_SERIAL:
        try:
            _require_robot_file(history, nominal, settings["robot"])
        except BaseException:
            history.close()
            raise
    return serial, history


def _require_robot_file(history: CalibrationHistory, nominal: SerialArm, robot: str) -> None:
    """Refuse a nameless history that was begun with another robot file than this one."""
    kept = StateFile(history.path, "robot_file")
    own, known = {"robot": nominal.name, "robot_file_hash": robot_file_hash(robot)}, kept.load()
    if known is None:
        kept.save(own)
    elif known != own:
        raise WrongRobotError(
            f"no serial is set, and {history.path} was begun with another robot file (hash "
            f"{known.get('robot_file_hash')} of robot '{known.get('robot')}', this is "
            f"{own['robot_file_hash']} of '{nominal.name}'): set the serial of each robot; if it "
            f"is the same robot with its file changed, remove the folder {kept.path.parent}"
        )


def history_notice(settings: Mapping[str, Any]) -> str:
    """Tell of a damaged history that nobody has acknowledged; empty without one.

    For a node that does not hold the history open.
    """
    folder = _folder(settings) or state_folder()
    return damage_notice(history_path(settings["serial"] or NO_SERIAL, folder))


def acknowledge_history(settings: Mapping[str, Any], by: str) -> None:
    """Write down that somebody knows of a damaged history.

    Raises
    ------
    StorageError
        When it cannot be written.
    """
    folder = _folder(settings) or state_folder()
    acknowledge(history_path(settings["serial"] or NO_SERIAL, folder), by, time.time_ns())


def _folder(settings: Mapping[str, Any]) -> Path | None:
    folder = settings[STATE_DIR.name]
    return Path(folder) if folder else None


def warn_of_history(health: Health, history: CalibrationHistory) -> None:
    """Tell of a damaged history that nobody has acknowledged, and that no serial is set."""
    if notice := damage_notice(history.path):
        health.worsen(WARN, notice)
    if history.serial == NO_SERIAL:
        health.worsen(
            WARN,
            f"no serial is set: the history is kept as '{NO_SERIAL}', and only the robot file "
            "tells this robot from another one of its type",
        )
