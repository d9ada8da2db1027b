"""The motions of a measuring step: the way to its start, and the circle or plunge itself."""

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.kinematics import SerialArm
from robocal_ros.motion import tip_path
from robocal_ros.motion.cell import ROUNDING, MotionCell
from robocal_ros.motion.limits import MotionLimits, start_near
from robocal_ros.motion.loading import load_motion
from robocal_ros.motion.plan import JointPlan
from robocal_ros.motion.timing import Ride, ramp_of
from robocal_ros.motion.travel import along, corner_ride, raised_way
from robocal_ros.tool.flange_path import FEWEST_READINGS, JointPath
from robocal_ros.tool.measuring_plan import PlannedStep

Array = NDArray[np.float64]


def start_pose(step: PlannedStep, limits: MotionLimits) -> Array:
    """T_base_flange (4, 4) where a step begins: a circle's run-up lies before its ``start_rad``."""
    T = step.T_base_flange.copy()
    if step.kind == "circle":
        T[:3, 3] += step.R_base_laser @ _on_circle(step, _from_rad(step, limits))
    return T


def approach(
    cell: MotionCell, step: PlannedStep, q_now: ArrayLike, *, after_circle: bool = False
) -> JointPlan:
    """From measured joints (n,) to where a step begins.

    Up along the laser's z, over, where the tool is turned, and down: over the housing at its
    retract height, within its opening at the higher of both ends, so that no beam is broken on the
    way; there from circle to circle straight. Each part is a straight line of the tip from rest to
    rest, as fast as all limits allow.

    Raises
    ------
    LimitError
        Where the way passes a joint limit, the reach, a singularity, or the housing.
    """
    q = _joints(cell, q_now)
    corners = _corners(cell, cell.T_base_tip(q), step, after_circle)
    return along(cell, q, corners, f"way to step {step.name}")


def least_s(cell: MotionCell, corners: list[Array]) -> float:
    """How long `along` takes at the least from pose to pose (4, 4): joints may need longer."""
    return sum(corner_ride(cell, here, there).duration_s for here, there in pairwise(corners))


def measuring(cell: MotionCell, step: PlannedStep, q_now: ArrayLike) -> JointPlan:
    """A step's circle, with run-up and run-out along it, or plunge, from measured joints (n,).

    The circle makes one full turn at constant speed, from its ``start_rad``. It begins exactly
    where the robot stands, so circle or plunge lie off the step's own by as much.

    Raises
    ------
    LimitError
        When the robot does not stand where the step begins; where a limit is broken: of depth,
        speed, acceleration, joints, reach, singularity, or the housing.
    """
    q = _joints(cell, q_now)
    _require_start(cell, step, q)
    limit = cell.limits.tcp_speed_m_s if step.kind == "circle" else cell.limits.plunge_speed_m_s
    _require_step(cell.limits, step, limit)
    plan = cell.joints(_path(cell, step, cell.T_base_tip(q)), q)
    share, reason = cell.demand(plan, limit)
    if share > 1.0 + ROUNDING:
        raise LimitError(
            f"step {step.name}: {reason}. Measure with less speed, or in another posture"
        )
    cell.require_clear(plan, f"step {step.name}")
    return plan


def turn_s(step: PlannedStep, limits: MotionLimits) -> tuple[float, float]:
    """Begin and end of a circle's turn at constant speed, s from the start of its plan."""
    ride = _turn(step, limits)
    return ride.ramp_s, ride.ramp_s + ride.cruise_s


def _joints(cell: MotionCell, q_now: ArrayLike) -> Array:
    q = np.array(q_now, dtype=np.float64)
    if q.shape != (cell.arm.n,):
        raise ValueError(f"q_now has shape {q.shape}, expected ({cell.arm.n},)")
    if not np.all(np.isfinite(q)):
        raise LimitError("the measured joints are not finite: check the joint states")
    return q


def _corners(cell: MotionCell, here: Array, step: PlannedStep, after_circle: bool) -> list[Array]:
    """Where the tip goes in turn; the last is the step's start."""
    there = cell.tip_of(start_pose(step, cell.limits))
    first, last = cell.in_laser(here[:3, 3]), cell.in_laser(there[:3, 3])
    inside = cell.housing.opening_holds(first) and cell.housing.opening_holds(last)
    if inside and after_circle and step.kind == "circle":  # both begin in one quadrant
        return [there]
    return raised_way(cell, here, there, -np.inf if inside else cell.housing.retract_m)


def _turn(step: PlannedStep, limits: MotionLimits) -> Ride:
    """A full turn, with a run-up before and a run-out after it."""
    ramp = ramp_of(step.speed_m_s, limits.tcp_acceleration_m_s2)
    return Ride(2.0 * np.pi * step.radius_m + step.speed_m_s * ramp, step.speed_m_s, ramp)


def _from_rad(step: PlannedStep, limits: MotionLimits) -> float:
    run_up = 0.5 * step.speed_m_s * _turn(step, limits).ramp_s
    return float(step.start_rad - step.direction * run_up / step.radius_m)


def _on_circle(step: PlannedStep, angle: float) -> Array:
    return step.radius_m * np.array([np.cos(angle), np.sin(angle), 0.0])


def _path(cell: MotionCell, step: PlannedStep, T_start: Array) -> tip_path.TipPath:
    if step.kind == "circle":
        return tip_path.circle(
            T_start,
            step.R_base_laser,
            step.radius_m,
            _from_rad(step, cell.limits),
            step.direction,
            _turn(step, cell.limits),
        )
    ride = Ride.within(step.depth_m, step.speed_m_s, cell.limits.tcp_acceleration_m_s2)
    return tip_path.plunge(T_start, step.R_base_laser, ride)


def _require_step(limits: MotionLimits, step: PlannedStep, speed_m_s: float) -> None:
    """Refuse a step that asks for more than is allowed."""
    if step.speed_m_s > speed_m_s:
        raise LimitError(
            f"step {step.name} asks for {step.speed_m_s * 1e3:.1f} mm/s, allowed are "
            f"{speed_m_s * 1e3:.1f} mm/s for a {step.kind}: plan it slower"
        )
    if step.kind == "plunge" and step.depth_m > limits.plunge_depth_m:
        raise LimitError(
            f"step {step.name} plunges {step.depth_m * 1e3:.1f} mm, allowed are "
            f"{limits.plunge_depth_m * 1e3:.1f} mm: plan it less deep"
        )


def _require_start(cell: MotionCell, step: PlannedStep, q: Array) -> None:
    """Refuse joints (n,) that are not where a step begins."""
    arm, T = cell.arm, cell.arm.fk(q)
    goal = start_pose(step, cell.limits)
    turn = frames.log_rotation(goal[:3, :3] @ T[:3, :3].T)
    shift = np.linalg.pinv(arm.jacobian(q)) @ np.concatenate([goal[:3, 3] - T[:3, 3], turn])
    near = start_near(arm)
    joint = int(np.argmax(np.abs(shift) / near))
    if abs(shift[joint]) > near[joint]:
        unit, scale = ("mm", 1e3) if arm.prismatic[joint] else ("deg", 180.0 / np.pi)
        raise LimitError(
            f"the robot does not stand where step {step.name} begins: {arm.joint_names[joint]} is "
            f"off by {scale * abs(shift[joint]):.3f} {unit}, allowed are "
            f"{scale * near[joint]:.3f} {unit}. Approach the start again"
        )


def load_measuring(arm: SerialArm) -> None:
    """The same of measuring a tool in motion: a third of a second."""
    import scipy.special  # noqa: F401

    load_motion(arm)
    time = np.linspace(0.0, 0.1, FEWEST_READINGS)
    JointPath(arm, time, np.full((len(time), arm.n), 0.3)).at(np.array([0.05]))
