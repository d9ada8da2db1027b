"""A pose as two parameters: millimetres and a quaternion."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ros.parameters import Setting

ORIGIN, UNTURNED = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]


def count_fault(length: int) -> Callable[[list[float]], str | None]:
    """A check that a list has so many numbers."""
    return lambda values: None if len(values) == length else f"{length} numbers are wanted"


def pose_settings(name: str, place: str, turn: str) -> tuple[Setting, Setting]:
    """``<name>_xyz_mm`` and ``<name>_quat_xyzw`` with their descriptions."""
    return (
        Setting(
            f"{name}_xyz_mm",
            ORIGIN,
            place,
            unit="mm",
            low=-5000.0,
            high=5000.0,
            check=count_fault(3),
        ),
        Setting(f"{name}_quat_xyzw", UNTURNED, turn, low=-1.0, high=1.0, check=count_fault(4)),
    )


def given_pose(settings: Mapping[str, Any], name: str) -> NDArray[np.float64] | None:
    """The pose (4, 4), m; None where both parameters are at their default.

    Raises
    ------
    InputError
        When the quaternion is not of unit length.
    """
    xyz_mm, quat = settings[f"{name}_xyz_mm"], settings[f"{name}_quat_xyzw"]
    if xyz_mm == ORIGIN and quat == UNTURNED:
        return None
    norm = float(np.linalg.norm(quat))
    if abs(norm - 1.0) > 1e-3:
        raise InputError(f"{name}_quat_xyzw has length {norm:.6g}, not 1")
    return frames.transform_from_quat(1e-3 * np.array(xyz_mm), np.array(quat) / norm)
