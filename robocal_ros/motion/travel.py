"""Ways between taught poses: straight in the joints, and home from a beam station."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.kinematics.inverse import require_within_limits
from robocal_ros.motion import tip_path
from robocal_ros.motion.cell import MotionCell
from robocal_ros.motion.plan import JointPlan, joined
from robocal_ros.motion.timing import Ride

Array = NDArray[np.float64]

SHORTEST_WAY_M = 1e-6  # a shorter part of an approach is left out
SAME_POSTURE_RAD = 0.05  # as the inverse may end beside the taught pose


def joint_way(cell: MotionCell, q_from: ArrayLike, q_to: ArrayLike) -> JointPlan:
    """From joints to joints (n,), all joints together on a straight line, from rest to rest.

    As fast as the limits of joints and tip allow; nothing of the cell is looked at.

    Raises
    ------
    LimitError
        When an end lies beyond a joint limit.
    """
    start, end = np.array(q_from, dtype=np.float64), np.array(q_to, dtype=np.float64)
    require_within_limits(cell.arm, np.stack([start, end]))
    velocity, acceleration, _ = cell.limits.of_joints(cell.arm)
    way = end - start
    with np.errstate(divide="ignore"):
        fastest, hardest = (np.min(most / np.abs(way)) for most in (velocity, acceleration))
    ride = Ride.within(1.0, float(fastest), float(hardest))
    time = ride.times()
    share, speed, push = (part[:, None] * way for part in ride(time))
    plan = JointPlan(time, start + share, speed, push)
    demanded, _ = cell.demand(plan, cell.limits.tcp_speed_m_s)
    return plan.slower(max(demanded, 1.0))


def departure(cell: MotionCell, q_now: ArrayLike, q_home: ArrayLike) -> JointPlan:
    """From anywhere at a station to the taught home pose (n,), as an approach goes the other way.

    Up along the laser's z, over the housing, down, each a straight line of the tip; then the
    joints go to the taught ones exactly.

    Raises
    ------
    LimitError
        Where the way passes a joint limit, the reach, a singularity or the housing, or ends in
        another posture than the taught one.
    """
    q, home = np.array(q_now, dtype=np.float64), np.array(q_home, dtype=np.float64)
    corners = raised_way(cell, cell.T_base_tip(q), cell.T_base_tip(home), cell.housing.retract_m)
    plan = along(cell, q, corners, "way home")
    beside = np.abs(plan.q[-1] - home)
    joint = int(np.argmax(beside))
    if beside[joint] > SAME_POSTURE_RAD:
        raise LimitError(
            f"the way home ends {np.degrees(beside[joint]):.1f} deg beside the taught home pose in "
            f"{cell.arm.joint_names[joint]}: drive the robot home by hand, and teach a home pose "
            "that the station is approached from in one posture"
        )
    return joined([plan, joint_way(cell, plan.q[-1], home)])


def along(cell: MotionCell, q: Array, corners: list[Array], name: str) -> JointPlan:
    """Straight from pose to pose of the tip (4, 4), from joints (n,), at rest at each.

    Raises
    ------
    LimitError
        Where the way passes a joint limit, the reach, a singularity, or the housing.
    """
    plans: list[JointPlan] = []
    here = cell.T_base_tip(q)
    for number, there in enumerate(corners, start=1):
        plan = cell.joints(tip_path.line(here, there, corner_ride(cell, here, there)), q)
        share, _ = cell.demand(plan, cell.limits.tcp_speed_m_s)
        plan = plan.slower(max(share, 1.0))
        cell.require_clear(plan, f"{name}, part {number}")
        plans.append(plan)
        q, here = plan.q[-1], there
    return joined(plans)


def raised_way(cell: MotionCell, here: Array, there: Array, above_m: float) -> list[Array]:
    """Poses of the tip (4, 4): up along the laser's z to ``above_m`` or the higher end, over, down.

    Parts that are no way are left out; the last pose is ``there``.
    """
    first, last = cell.in_laser(here[:3, 3]), cell.in_laser(there[:3, 3])
    height = max(first[2], last[2], above_m)
    way = [lifted(cell, here, height - first[2]), lifted(cell, there, height - last[2])]
    moves = [
        a for a, b in zip(way, [here, *way], strict=False) if way_m(cell, a, b) > SHORTEST_WAY_M
    ]
    return [*moves, there]


def lifted(cell: MotionCell, T: Array, by_m: float) -> Array:
    """A pose moved along the laser's z."""
    return np.asarray(frames.transform(np.eye(3), by_m * cell.T_base_laser[:3, 2]) @ T)


def way_m(cell: MotionCell, here: Array, there: Array) -> float:
    """No point between tip and flange moves further, m."""
    turn = np.linalg.norm(frames.log_rotation(there[:3, :3] @ here[:3, :3].T))
    reach = np.max(np.linalg.norm(cell.tool.corners - cell.tool.p_tip, axis=1))
    return float(np.linalg.norm(there[:3, 3] - here[:3, 3]) + turn * reach)


def corner_ride(cell: MotionCell, here: Array, there: Array) -> Ride:
    """The fastest within the tip's limits."""
    limits = cell.limits
    return Ride.within(way_m(cell, here, there), limits.tcp_speed_m_s, limits.tcp_acceleration_m_s2)
