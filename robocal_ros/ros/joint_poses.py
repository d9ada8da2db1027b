"""Joint poses as parameters: a text of numbers for each, in degrees."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]

MM = 1e-3


def joints_of(arm: SerialArm, numbers: Sequence[float], name: str) -> Array:
    """Joints (n,) in rad (prismatic: m) of degrees (mm).

    Raises
    ------
    InputError
        When there is not one for each joint.
    """
    given = np.array(numbers, dtype=np.float64)
    if given.shape != (arm.n,) or not np.all(np.isfinite(given)):
        raise InputError(
            f"{name} has {given.size} numbers, {arm.name} has {arm.n} joints: teach it"
        )
    return np.where(arm.prismatic, given * MM, np.radians(given))


def joint_poses(arm: SerialArm, texts: Sequence[str], name: str) -> Array:
    """Poses (m, n) in rad (prismatic: m) of a parameter ``name``, a text for each; m may be 0.

    Raises
    ------
    InputError
        When a text is no list of a number for each joint.
    """
    poses = [_pose(arm, text, f"{name}, pose {i}") for i, text in enumerate(texts, start=1)]
    return np.array(poses, dtype=np.float64).reshape(-1, arm.n)


def _pose(arm: SerialArm, text: str, name: str) -> Array:
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError as error:
        raise InputError(f"{name}: '{text}' is no list of numbers") from error
    return joints_of(arm, numbers, name)
