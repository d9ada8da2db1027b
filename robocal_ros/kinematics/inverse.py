"""Bounded inverse kinematics: joints that follow a path of poses, or a refusal that names where.

Newton's method with the geometric Jacobian, each pose from the one before, so that the arm keeps
its posture. Nothing is returned that passes a joint limit, jumps, or comes near a singularity.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground.errors import LimitError
from robocal_ros.kinematics.arm import SerialArm

Array = NDArray[np.float64]

# No joint moves further from one pose to the next (rad; prismatic: m): else it is no path.
LONGEST_STEP = 0.2
# Of the flange's geometric Jacobian, a turn counted as the way of a point 1 m off, m/rad. At this
# bound a joint may turn by 20 rad per metre of the flange's way: 1 rad/s at 50 mm/s.
SMALLEST_SINGULAR_VALUE = 0.05

_UNREACHED = "it is out of reach, or the arm would have to jump"
_WHAT_TO_DO = "Move the station, or begin in another posture"


@dataclass(frozen=True, eq=False)
class JointDerivatives:
    """Joints (m, n), rad (prismatic: m), and their first two derivatives by time."""

    q: Array
    qd: Array
    qdd: Array


def inverse(arm: SerialArm, T_base_flange: ArrayLike, q_near: ArrayLike) -> Array:
    """Joints (m, n) that reach flange poses (m, 4, 4) in turn, the first of them near (n,).

    Raises
    ------
    LimitError
        As `follow`.
    """
    T = np.asarray(T_base_flange, dtype=np.float64)
    still = np.zeros((len(T), 6))
    return follow(arm, T, still, still, q_near).q


def follow(
    arm: SerialArm,
    T_base_point: Array,
    twist: Array,
    twist_rate: Array,
    q_near: ArrayLike,
    p_flange: ArrayLike = (0.0, 0.0, 0.0),
) -> JointDerivatives:
    """Joints that carry a point of the flange along a path.

    Parameters
    ----------
    T_base_point : (m, 4, 4) poses of the flange, but with the point as their origin.
    twist, twist_rate : (m, 6) velocity [v; w] of the point, base, and its derivative.
    q_near : (n,) joints from which the first pose is sought.
    p_flange : (3,) the point, m.

    Raises
    ------
    LimitError
        Where a joint limit is passed, a singularity is near (`SMALLEST_SINGULAR_VALUE`), a pose
        is out of reach, or a joint would have to move by more than `LONGEST_STEP` at once.
    """
    from robocal_ros.kinematics import newton

    goals = np.array(T_base_point, dtype=np.float64, order="C")
    near = np.array(q_near, dtype=np.float64)
    if goals.shape[1:] != (4, 4) or near.shape != (arm.n,) or not len(goals):
        raise ValueError(f"poses {goals.shape}, joints {near.shape}: expected (m, 4, 4), (n,)")
    if not (np.all(np.isfinite(goals)) and np.all(np.isfinite(near))):
        raise LimitError("poses or joints are not finite: check where they come from")
    ends = np.stack([arm.T_base_root, np.eye(4)])
    ends[1, :3, 3] = p_flange
    path = JointDerivatives(*(np.zeros((len(goals), arm.n)) for _ in range(3)))
    reached, outcome = newton.follow_batch(
        goals,
        np.array(twist, dtype=np.float64, order="C"),
        np.array(twist_rate, dtype=np.float64, order="C"),
        near,
        arm.links,
        ends,
        LONGEST_STEP,
        path.q,
        path.qd,
        path.qdd,
    )
    require_within_limits(arm, path.q[:reached])
    require_regular(arm, path.q[:reached])
    if outcome != newton.REACHED:
        why = "the arm is singular there" if outcome == newton.SINGULAR else _UNREACHED
        raise LimitError(f"{_pose(goals, reached)}: {why}. {_WHAT_TO_DO}")
    return path


def require_within_limits(arm: SerialArm, q: Array) -> None:
    """Raise LimitError where joints (m, n) pass the arm's limits."""
    outside = (q < arm.lower) | (q > arm.upper)
    if np.any(outside):
        pose, joint = np.argwhere(outside)[0]
        unit, scale = ("mm", 1e3) if arm.prismatic[joint] else ("deg", 180.0 / np.pi)
        raise LimitError(
            f"{arm.joint_names[joint]} would be at {scale * q[pose, joint]:.3f} {unit} (pose "
            f"{pose + 1} of {len(q)}), its limits are {scale * arm.lower[joint]:.3f} to "
            f"{scale * arm.upper[joint]:.3f} {unit}: begin in another posture"
        )


def require_regular(arm: SerialArm, q: Array) -> None:
    """Raise LimitError where an arm at joints (m, n) is near a singularity."""
    smallest = np.linalg.svd(arm.jacobian(q), compute_uv=False)[:, -1]
    if np.any(smallest < SMALLEST_SINGULAR_VALUE):
        pose = int(np.argmax(smallest < SMALLEST_SINGULAR_VALUE))
        raise LimitError(
            f"{_pose(arm.fk(q), pose)}: near a singularity, smallest singular value of the "
            f"Jacobian {smallest[pose]:.4f}, at least {SMALLEST_SINGULAR_VALUE:g} is needed. "
            + _WHAT_TO_DO
        )


def _pose(T: Array, index: int) -> str:
    x, y, z = 1e3 * T[index, :3, 3]
    return f"pose {index + 1} of {len(T)} at ({x:.1f}, {y:.1f}, {z:.1f}) mm"
