"""Flange poses and joint values that are a unit apart from what they should be."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]

FARTHEST_M = 20.0  # no arm's flange is farther from its base
NEAREST_M = 0.01  # nor do all poses of one lie so near to it
MOST_TURNS = 4.0  # of a joint: what is beyond is no angle in rad


def flange_unit_fault(position: Array, unit: str = "m") -> tuple[int, str] | None:
    """The flange position (index) of many (m, 3), m, that cannot be one, and why; None without.

    ``unit``: m or mm, in which they were given.
    """
    distance = np.linalg.norm(position, axis=1)
    index = int(np.argmax(distance))
    if distance[index] > FARTHEST_M:
        why = ": mm where m are expected?" if unit == "m" else "?"
        return index, (
            f"the flange is {distance[index]:.4g} m from the base: is it a thousand times too "
            f"far{why}"
        )
    if distance[index] < NEAREST_M:
        why = ", m where mm are expected?" if unit == "mm" else "?"
        return index, (
            f"no flange is farther from the base than {distance[index] * 1e3:.4g} mm: are they a "
            f"thousand times too near{why}"
        )
    return None


def joint_unit_fault(arm: SerialArm, q: Array) -> tuple[int, str] | None:
    """The row of joint values (m, n), rad (prismatic: m), that cannot be some, and why."""
    most = np.where(arm.prismatic, FARTHEST_M, MOST_TURNS * 2.0 * np.pi)
    beyond = np.abs(q) / most
    index, joint = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    if beyond[index, joint] <= 1.0:
        return None
    unit, other = ("m", "mm") if arm.prismatic[joint] else ("rad", "degrees")
    return int(index), (
        f"joint {arm.joint_names[joint]} is at {q[index, joint]:.6g} {unit}: {other} where {unit} "
        "are expected?"
    )
