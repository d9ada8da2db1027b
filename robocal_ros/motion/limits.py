"""What a measuring motion may demand of robot and tool."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]
# How far from where a step begins each joint may stand.
START_NEAR_RAD = float(np.radians(0.02))
START_NEAR_M = 5e-5  # prismatic


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """Largest values; those of joints for all, or (n,) for each.

    Attributes
    ----------
    joint_velocity, joint_acceleration : rad/s and rad/s^2 (prismatic: m/s and m/s^2).
    stop_deceleration : of a stop after a fault, rad/s^2 (prismatic: m/s^2).
    tcp_speed_m_s, tcp_acceleration_m_s2 : of the tool's tip along its path, on every way.
    plunge_speed_m_s, plunge_depth_m : of a plunge.
    """

    joint_velocity: ArrayLike = 1.0
    joint_acceleration: ArrayLike = 5.0
    stop_deceleration: ArrayLike = 10.0
    tcp_speed_m_s: float = 0.05
    tcp_acceleration_m_s2: float = 1.2
    plunge_speed_m_s: float = 0.01
    plunge_depth_m: float = 0.02

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            numbers = np.array(value, dtype=np.float64)
            if not np.all((numbers > 0.0) & (numbers < np.inf)):
                raise InputError(f"{name} = {value}: must be positive and finite")

    def of_joints(self, arm: SerialArm) -> tuple[Array, Array, Array]:
        """Velocity, acceleration and stop deceleration, (n,) each.

        Raises
        ------
        InputError
            When one is given for another number of joints.
        """
        found = []
        for name in ("joint_velocity", "joint_acceleration", "stop_deceleration"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if values.shape not in ((), (1,), (arm.n,)):
                raise InputError(
                    f"{name} has {values.size} values: give one for all joints or {arm.n}"
                )
            found.append(np.broadcast_to(values, (arm.n,)))
        return found[0], found[1], found[2]


def start_near(arm: SerialArm) -> Array:
    """How far (n,) from where a motion begins each joint may stand, rad (m)."""
    return np.where(arm.prismatic, START_NEAR_M, START_NEAR_RAD)
