"""Parameters of the hand-eye node."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from robocal_ros.ground.errors import InputError
from robocal_ros.hand_eye.config import HandEyeConfig
from robocal_ros.hand_eye.data import FEATURES, TOPIC_OF
from robocal_ros.hand_eye.results import METHODS, MOUNTS, WITHOUT_FILE
from robocal_ros.hand_eye.target_files import KINDS as DESCRIBED
from robocal_ros.hand_eye.target_files import read_target
from robocal_ros.hand_eye.targets import KIND_OF, Document, target_document
from robocal_ros.ros.parameters import STANDSTILL, Setting, length, pose_settings, standstill_rule
from robocal_ros.ros.session_node import STATE_DIR


def _range_fault(values: list[float]) -> str | None:
    if len(values) != 3:
        return "three lengths are wanted"
    return None if values[0] < values[1] else "the nearest distance must be below the farthest"


SETTINGS = (
    Setting("robot", "ur10", "Robot type (config/robots) or path of a robot file"),
    STATE_DIR,
    Setting("base_frame", "base", "Name of the robot's base frame"),
    Setting("flange_frame", "tool0", "Name of the flange frame; it is never modified"),
    Setting("sensor_frame", "sensor", "Name of the sensor's frame, in its messages and on tf"),
    Setting("target", "sphere", "Target where a call names none", choices=tuple(TOPIC_OF)),
    Setting("target_file", "", "File where a call names none; for the target that it describes"),
    Setting("feature", FEATURES[0], "What a line is in a profile", choices=FEATURES),
    Setting("method", METHODS[0], "Estimator where a call names none", choices=METHODS),
    Setting("mount", MOUNTS[0], "Where the sensor is, where a call does not say", choices=MOUNTS),
    *STANDSTILL,
    Setting(
        "capture_timeout_s",
        10.0,
        "A capture without standstill or without a measurement for so long fails",
        unit="s",
        low=0.5,
        high=600.0,
    ),
    length(
        "robot_sigma_mm", 0.0, "Error of a reported pose in each axis; 0: from the data", 0.0, 10.0
    ),
    Setting(
        "robot_sigma_deg",
        0.0,
        "And of its turn about each axis; 0: robot_sigma_mm over 1 m, of a camera from the data",
        unit="deg",
        low=0.0,
        high=1.0,
    ),
    length("limit_mm", 1.0, "Largest expected error at the working distance", 1e-3, 100.0),
    *pose_settings(
        "rough",
        "About where the sensor sits on the flange, for check_plan before any calibration",
        "Its orientation: x along the laser line, z along the beam",
    ),
    Setting(
        "sensor_range_mm",
        [190.0, 210.0, 60.0],
        "Nearest and farthest distance of the sensor, and its width; for check_plan",
        unit="mm",
        low=1.0,
        high=20000.0,
        check=_range_fault,
    ),
    length("sensor_noise_mm", 0.037, "Noise of a point along the beam; for check_plan", 1e-4, 10.0),
)


def session_config(settings: Mapping[str, Any]) -> HandEyeConfig:
    """Settings of the session, in SI.

    Raises
    ------
    InputError
        When the sensor's frame has no name of its own, or the error of a turn is given alone.
    """
    names = settings["base_frame"], settings["flange_frame"], settings["sensor_frame"]
    if not all(names) or len(set(names)) < len(names):
        told = ", ".join(f"'{name}'" for name in names)
        raise InputError(f"base, flange and sensor need frames of different names, not {told}")
    if settings["robot_sigma_deg"] and not settings["robot_sigma_mm"]:
        turn_deg = settings["robot_sigma_deg"]
        raise InputError(f"robot_sigma_deg is {turn_deg:g}, but robot_sigma_mm is 0: give both")
    return HandEyeConfig(
        base_frame=settings["base_frame"],
        flange_frame=settings["flange_frame"],
        sensor_frame=settings["sensor_frame"],
        standstill=standstill_rule(settings),
        capture_timeout_s=settings["capture_timeout_s"],
        robot_sigma_m=settings["robot_sigma_mm"] * 1e-3 or None,
        robot_sigma_rad=float(np.radians(settings["robot_sigma_deg"])) or None,
        limit_m=settings["limit_mm"] * 1e-3,
    )


def start_arguments(
    settings: Mapping[str, Any],
    kind: str = "",
    file: str = "",
    feature: str = "",
    method: str = "",
    mount: str = "",
) -> dict[str, Any]:
    """Arguments of the command that begins a data set; what is empty comes from the settings.

    The configured file counts for the target that it describes, and for no other.

    Raises
    ------
    InputError
        When the target's file is missing, or describes another target.
    """
    kind = kind or settings["target"]
    return {
        "target": _given(kind, file) if file else _configured(kind, settings["target_file"]),
        "feature": feature or settings["feature"],
        "method": method or settings["method"],
        "mount": mount or settings["mount"],
    }


def _given(kind: str, file: str) -> Document:
    return target_document(kind, read_target(Path(file)))


def _configured(kind: str, file: str) -> Document:
    """The target of the configured file; nothing is known of one that it does not describe."""
    if not file or kind not in DESCRIBED:
        found = ""
    elif (found := KIND_OF[type(target := read_target(Path(file)))]) == kind:
        return target_document(kind, target)
    if kind not in WITHOUT_FILE:
        told = f"'{file}' describes a {found}" if found else "is empty"
        raise InputError(f"target_file {told}: name the file that describes the {kind}")
    return {"kind": kind}
