"""Files of placed sensors: what ``robocal thermal calibrate-sensor`` writes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import read_made, write_made

Array = NDArray[np.float64]
Document = dict[str, Any]

KEYS = ("T_sensor_base", "sphere_in_flange_mm", "covariance", "robot", "model_hash")
QUATERNION_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class PlacedSensor:
    """A sensor file: ``T_sensor_base`` (4, 4), and ``sphere_in_flange`` (3,), m."""

    T_sensor_base: Array
    sphere_in_flange: Array


def write_sensor(path: Path, document: Document) -> None:
    """Write the parts of a sensor's document that place it; the file appears whole or not."""
    write_made(path, document, KEYS, "thermal calibrate-sensor")


def read_sensor(path: Path, arm: SerialArm) -> PlacedSensor:
    """Read a sensor file for ``arm``.

    Raises
    ------
    InputError
        Naming file and key, when it is not as docs/thermal.md says.
    WrongRobotError
        When it was made for another nominal model.
    """
    top = read_made(path, arm, KEYS, "sensor file", "calibrate the sensor")
    pose = top.below("T_sensor_base")
    quat = np.array(pose.numbers("quat_xyzw", 4))
    if abs(float(np.linalg.norm(quat)) - 1.0) > QUATERNION_TOLERANCE:
        raise InputError("T_sensor_base: the quaternion is not of unit length", file=str(path))
    xyz = np.array(pose.numbers("xyz_mm", 3)) * 1e-3
    sphere = np.array(top.numbers("sphere_in_flange_mm", 3)) * 1e-3
    return PlacedSensor(frames.transform_from_quat(xyz, quat), sphere)
