"""What a measuring motion may demand of robot and tool."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics import SerialArm
from robocal_ros.motion.plan import JointPlan

# ---- what a measuring motion may demand of robot and tool ---------------------------------------


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


# ---- stops after a fault: how long they take is known before ------------------------------------


# A controller lags or leads its readings by some of its cycles: a shorter stop would throw it back.
SHORTEST_STOP_S = 0.12


def stop_time(arm: SerialArm, limits: MotionLimits, qd: Array) -> Array:
    """Duration (...,) of stops from velocities (..., n), s."""
    _, _, deceleration = limits.of_joints(arm)
    return np.asarray(np.maximum(np.max(np.abs(qd) / deceleration, axis=-1), SHORTEST_STOP_S))


def stop(
    arm: SerialArm,
    limits: MotionLimits,
    q: ArrayLike,
    qd: ArrayLike,
    shortest_s: float = SHORTEST_STOP_S,
) -> JointPlan:
    """From measured joints and velocities (n,) to rest.

    All joints slow down evenly and come to rest together, so that the way goes on in its
    direction: q(t) = q + qd (t - t^2 / 2 T). T is `stop_time`: the joint that needs longest slows
    down by ``stop_deceleration``. Where a joint would pass its limit on that way, T is what the
    limit leaves, and all slow down harder; but never in less than ``shortest_s``. A joint that
    would still pass its limit begins slower: no stop leads beyond one.

    Raises
    ------
    InputError
        When a value is not finite: then only a hold or the controller's own stop is left.
    """
    here, velocity = np.asarray(q, dtype=np.float64), np.asarray(qd, dtype=np.float64)
    if here.shape != (arm.n,) or velocity.shape != (arm.n,):
        raise ValueError(f"q {here.shape} and qd {velocity.shape}: expected ({arm.n},) each")
    if not (np.all(np.isfinite(here)) and np.all(np.isfinite(velocity))):
        raise InputError("joints or velocities are not finite: let the controller stop by itself")
    room = np.where(velocity > 0.0, arm.upper - here, here - arm.lower)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        left = np.where(velocity != 0.0, 2.0 * room / np.abs(velocity), np.inf)
    needed = float(np.max(np.abs(velocity) / limits.of_joints(arm)[2]))
    duration = max(min(max(needed, shortest_s), float(np.min(left))), shortest_s)
    most = 2.0 * np.maximum(room, 0.0) / duration
    velocity = np.clip(velocity, -most, most)
    slowing = -velocity / duration
    return JointPlan(
        np.array([0.0, duration]),
        np.stack([here, here + 0.5 * duration * velocity]),
        np.stack([velocity, np.zeros(arm.n)]),
        np.stack([slowing, slowing]),
    )
