# SPDX-License-Identifier: Apache-2.0
"""Joints that reach a pose: all postures of an arm, and the one that a program's point means.

An inverse for any serial arm: Newton steps, damped where they would be long (Levenberg and
Marquardt), from many starts at once, each within what the point says of its joints. Starts are
drawn alike every time, so that a program is corrected alike every time.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.ground.frames import Array, Mask
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import SMALLEST_SINGULAR_VALUE
from robocal_ros.programs.points import EDGE, Posture, Stance

# Where 4 % of the starts lead to a posture, it is missed by these once in 50 times, then never.
STARTS = 96, 600
STEPS = 40
LONGEST_STEP = 0.5  # of a joint, rad (prismatic: m)
REACHED = 1e-9  # m, rad
SAME = 1e-5  # of joints, rad (prismatic: m)
# What the digits of a point leave of its joints' signs, near a singularity as well.
SLACK = np.radians(0.05)
WITHOUT_LIMIT = 2.0 * np.pi


@dataclass(frozen=True, eq=False)
class CorrectionModels:
    """The arms of one robot by which programs and frames are corrected, and how far.

    ``largest_m``: of the flange; ``largest_rad``: of a joint (prismatic: `largest_m`).
    """

    nominal: SerialArm
    actual: SerialArm
    reference: SerialArm
    largest_m: float = 5e-3
    largest_rad: float = float(np.radians(1.0))


def reach(arm: SerialArm, T_base_flange: Array, start: Array) -> tuple[Array, Mask]:
    """Joints (m, n) by Newton steps from ``start`` (m, n), and where they reach poses (m, 4, 4)."""
    from robocal_ros.kinematics import newton

    goals = np.array(T_base_flange, dtype=np.float64, order="C")
    q, left = np.array(arm.turned(start)), np.empty(len(goals))
    near = 0.1 * REACHED
    newton.reach_batch(goals, arm.links, arm.T_base_root, STEPS, LONGEST_STEP, near, q, left)
    reached = left < REACHED
    q[reached] = arm.read(q[reached])
    return q, reached


def postures(arm: SerialArm, T_base_flange: Array, told: Posture) -> Array:
    """The joints (k, n) that reach a pose (4, 4) as its point says, within the arm's limits.

    Raises `LimitError`, saying why, when none do.
    """
    lower, upper = _range(arm, told)
    if np.any(lower >= upper):
        joint = arm.joint_names[int(np.argmax(lower >= upper))]
        raise LimitError(f"its configuration asks of {joint} what its limits forbid")
    rng, low, high = np.random.default_rng(0), np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
    for starts in STARTS:
        start = np.clip(rng.uniform(low, high, (starts, arm.n)), lower, upper)
        q, found = reach(arm, np.broadcast_to(T_base_flange, (starts, 4, 4)), start)
        if not np.any(found):
            raise LimitError("the pose is out of reach")
        reached = _turned(arm, q[found])
        fitting = _distinct(reached[[_fits(arm, one, told) for one in reached]])
        if len(fitting):
            outside = np.array([_outside(one, told) for one in fitting])
            return fitting[outside <= max(EDGE, float(np.min(outside)))]
    if not len(reached):
        raise LimitError("the joints that reach it are beyond their limits")
    raise LimitError("no joints reach it in the configuration that it says")


def _range(arm: SerialArm, told: Posture) -> tuple[Array, Array]:
    lower = np.where(np.isfinite(arm.lower), arm.lower, -WITHOUT_LIMIT)
    upper = np.where(np.isfinite(arm.upper), arm.upper, WITHOUT_LIMIT)
    if told.ranges is not None:
        lower = np.maximum(lower, told.ranges[:, 0] - SLACK)
        upper = np.minimum(upper, told.ranges[:, 1] + SLACK)
    return lower, upper


def _turned(arm: SerialArm, q: Array) -> Array:
    """The joints and what is whole turns away, as far as the limits let them (k, n)."""
    lower, upper = _range(arm, Posture())
    found = []
    for one in _distinct(q):
        choices = []
        for joint in range(arm.n):
            turns = np.array([0.0]) if arm.prismatic[joint] else np.arange(-3.0, 4.0)
            values = one[joint] + 2.0 * np.pi * turns
            choices.append(values[(values >= lower[joint]) & (values <= upper[joint])])
        found += list(product(*choices))
    return np.array(found).reshape(-1, arm.n)


def _distinct(q: Array) -> Array:
    kept = q[:0]
    while len(q):
        kept = np.vstack([kept, q[:1]])
        q = q[np.max(np.abs(q - q[0]), axis=1) >= SAME]
    return kept


def _outside(q: Array, told: Posture) -> float:
    """By how much the joint that is farthest beyond its range is, rad."""
    if told.ranges is None:
        return 0.0
    return max(0.0, float(np.max(np.maximum(told.ranges[:, 0] - q, q - told.ranges[:, 1]))))


def _fits(arm: SerialArm, q: Array, told: Posture, slack: float = SLACK) -> bool:
    if _outside(q, told) > slack:
        return False
    if told.behind is None and told.above is None:
        return True
    stance = stance_of(arm, q)
    return told.behind in (None, stance.behind) and told.above in (None, stance.above)


def chosen_posture(
    arm: SerialArm, T_base_flange: Array, told: Posture, before: Array | None
) -> Array:
    """The joints (n,) that a point means.

    ``before`` (n,): joints of the point before, that one without a configuration is near to.

    Raises `LimitError`, saying why, when there are none, or several that are told apart by nothing.
    """
    near = told.near if told.near is not None else before
    if not told.told and near is None:
        raise LimitError("nothing says in which posture: give --posture-deg")
    if near is not None:  # mostly the next point is a small step away
        q, reached = reach(arm, T_base_flange[None], near[None])
        same = told.ranges is not None or np.max(np.abs(q[0] - near)) < LONGEST_STEP
        inside = np.all((q[0] >= arm.lower) & (q[0] <= arm.upper))
        if reached[0] and inside and same and _fits(arm, q[0], told, EDGE):
            return np.asarray(q[0])
    found = postures(arm, T_base_flange, told)
    if len(found) == 1:
        return np.asarray(found[0])
    if near is None:
        raise LimitError(f"its configuration fits {len(found)} postures")
    away = np.max(np.abs(found - near), axis=1)
    return np.asarray(found[int(np.argmin(away))])


@dataclass(frozen=True, eq=False)
class _Chain:
    """Where axes are at joints q: a point and a direction of each (n, 3), base."""

    point: Array
    axis: Array
    R_first: Array  # (3, 3) how joint 1 has turned the arm


def _chain(arm: SerialArm, q: Array) -> _Chain:
    """Hayati's chain by its definition, see `SerialArm`."""
    T, point, axis = arm.T_base_root, np.empty((arm.n, 3)), np.empty((arm.n, 3))
    for joint, (d, theta, a, ca, sa, cb, sb, sign, slides) in enumerate(arm.links):
        point[joint], axis[joint] = T[:3, 3], T[:3, 2]
        value = sign * q[joint]
        d, theta = (d + value, theta) if slides else (d, theta + value)
        c, s = np.cos(theta), np.sin(theta)
        turn = [[c, -s, 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, d], [0.0, 0.0, 0.0, 1.0]]
        bend = [
            [cb, 0.0, sb, a],
            [sa * sb, ca, -sa * cb, 0.0],
            [-ca * sb, sa, ca * cb, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
        T = T @ np.array(turn) @ np.array(bend)
    return _Chain(point, axis, frames.exp_rotation(axis[0] * arm.sign[0] * q[0]))


def stance_of(arm: SerialArm, q: Array) -> Stance:
    """How an arm of six axes stands at joints (6,), as makers' configurations say it.

    With the arm's forward direction, x of the base turned by axis 1: ``behind``: the centre of the
    wrist, where axes 4 and 5 meet, lies behind axis 1. ``above``: it lies before the line from axis
    2 through axis 3, seen from the side, so that the elbow is up.
    """
    chain = _chain(arm, q)
    forward, aside = chain.R_first[:, 0], chain.R_first[:, 1]
    wrist = _nearest(chain.point[4], chain.axis[4], chain.point[3], chain.axis[3])
    behind = float((wrist - chain.point[0]) @ forward) < 0.0
    upper, lower = chain.point[2] - chain.point[1], wrist - chain.point[2]
    return Stance(q, behind, float(np.cross(upper, lower) @ aside) > 0.0)


def _nearest(point: Array, axis: Array, other: Array, along: Array) -> Array:
    """The point of a line that is nearest to another line."""
    normal = np.cross(axis, along)
    square = float(normal @ normal)
    if square < 1e-12:
        return point
    return point + axis * float(np.cross(other - point, along) @ normal) / square


def singular_value(arm: SerialArm, q: Array) -> float:
    """Smallest singular value of the flange's Jacobian, m/rad: see `SMALLEST_SINGULAR_VALUE`."""
    return float(np.linalg.svd(arm.jacobian(q), compute_uv=False)[-1])


def is_singular(arm: SerialArm, q: Array) -> bool:
    """Whether an arm at joints (n,) is as near to a singularity as no measuring motion may be."""
    return singular_value(arm, q) < SMALLEST_SINGULAR_VALUE
