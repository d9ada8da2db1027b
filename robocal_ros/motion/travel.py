"""Ways between taught poses: straight in the joints, and home from a beam station."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.core.errors import LimitError
from robocal_ros.core.kinematics.inverse import require_within_limits
from robocal_ros.motion.cell import MotionCell
from robocal_ros.motion.measuring import along, raised_way
from robocal_ros.motion.plan import JointPlan, joined
from robocal_ros.motion.timing import Ride

Array = NDArray[np.float64]

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
