"""What the nodes that move a robot have in common: limits, sizes, and the message of a plan."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from control_msgs.msg import JointTolerance
from numpy.typing import NDArray
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics import SerialArm
from robocal_ros.motion.cell import DrivingConfig, Housing
from robocal_ros.motion.messages import joint_trajectory
from robocal_ros.motion.plan import JointPlan, MotionLimits
from robocal_ros.motion.robot_watch import UNSAID_S
from robocal_ros.ros.parameters import Setting, length

NS = 1_000_000_000
GOAL_TIME_S = 12  # the nodes wait less for a robot that does not come to rest where a motion ends


def _of_joints(name: str, default: float, what: str, unit: str) -> Setting:
    words = f"{what}; one for all joints or one for each"
    return Setting(name, [default], words, unit=unit, low=1e-3, high=1e4)


MOTION = (
    _of_joints("joint_velocity_deg_s", 57.0, "Largest velocity", "deg/s"),
    _of_joints("joint_acceleration_deg_s2", 286.0, "Largest acceleration", "deg/s^2"),
    _of_joints("stop_deceleration_deg_s2", 573.0, "Deceleration of a stop", "deg/s^2"),
    Setting("tcp_speed_mm_s", 50.0, "Largest speed of the tip", unit="mm/s", low=1.0, high=250.0),
    Setting(
        "tcp_acceleration_mm_s2",
        1200.0,
        "Largest acceleration of the tip on its path",
        unit="mm/s^2",
        low=1.0,
        high=10000.0,
    ),
    length("opening_radius_mm", 60.0, "Opening of the housing about the crossing", 5.0, 1e3),
    length("housing_top_mm", 30.0, "Height of the housing above the beams", 0.0, 1e3),
    length("housing_depth_mm", 120.0, "Depth of the opening below the beams", 1.0, 1e3),
    length("housing_reach_mm", 0.0, "Radius of the housing; 0: it never ends", 0.0, 1e4),
    length("retract_mm", 50.0, "Height of the tip above the beams on its way", 1.0, 2e3),
    length("tool_length_mm", 100.0, "Length of the tool along its axis", 1.0, 2e3),
    length("tool_radius_mm", 10.0, "Its radius, with the largest bend to be found", 0.5, 500.0),
    length("flange_radius_mm", 60.0, "Of a ball about the flange", 1.0, 1e3),
    length("deviation_mm", 2.0, "The tip so far from its plan stops the robot", 0.05, 50.0),
    Setting(
        "deviation_deg",
        0.5,
        "A joint so far from its plan stops the robot; the tip, see deviation_mm",
        unit="deg",
        low=0.01,
        high=10.0,
    ),
    Setting(
        "motion_silence_s",
        0.1,
        "Joint states may pause for so long while the robot moves",
        unit="s",
        low=0.02,
        high=0.5,
    ),
    Setting(
        "motion_late_s",
        0.15,
        "The robot lags at most so far behind its trajectory",
        unit="s",
        low=0.01,
        high=1.0,
    ),
)


def driving_config(settings: Mapping[str, Any], **plunge: float) -> DrivingConfig:
    """Settings of what moves, in SI; ``plunge``: further limits of `MotionLimits`.

    Raises
    ------
    InputError
        When sizes contradict each other.
    """
    return DrivingConfig(
        housing=Housing(
            clear_radius_m=settings["opening_radius_mm"] * 1e-3,
            top_m=settings["housing_top_mm"] * 1e-3,
            floor_m=-settings["housing_depth_mm"] * 1e-3,
            retract_m=settings["retract_mm"] * 1e-3,
            reach_m=settings["housing_reach_mm"] * 1e-3 or np.inf,
        ),
        tool_length_m=settings["tool_length_mm"] * 1e-3,
        tool_radius_m=settings["tool_radius_mm"] * 1e-3,
        flange_radius_m=settings["flange_radius_mm"] * 1e-3,
        limits=MotionLimits(
            joint_velocity=np.radians(settings["joint_velocity_deg_s"]),
            joint_acceleration=np.radians(settings["joint_acceleration_deg_s2"]),
            stop_deceleration=np.radians(settings["stop_deceleration_deg_s2"]),
            tcp_speed_m_s=settings["tcp_speed_mm_s"] * 1e-3,
            tcp_acceleration_m_s2=settings["tcp_acceleration_mm_s2"] * 1e-3,
            **plunge,
        ),
        deviation_m=settings["deviation_mm"] * 1e-3,
        deviation_rad=float(np.radians(settings["deviation_deg"])),
        silence_s=settings["motion_silence_s"],
        late_s=settings["motion_late_s"],
    )


def require_limits(arm: SerialArm, config: DrivingConfig) -> None:
    """Refuse to move a robot whose limits are not known.

    Raises
    ------
    InputError
        When a limit is given for another number of joints, or the robot has none.
    """
    config.limits.of_joints(arm)
    if not np.all(np.isfinite([arm.lower, arm.upper])):
        raise InputError(f"{arm.name} has joints without limits: add them to the robot file")


def goal_tolerances(arm: SerialArm, config: DrivingConfig) -> dict[str, Any]:
    """Tolerances of what moves, as fields of a FollowJointTrajectory goal; wider than `RobotWatch`.

    A controller compares places of one instant: a robot that lags as much as is allowed is beside
    its place by that way. They do not go by a plan's speeds, as joint_trajectory_controller 4.42.1
    judges what comes on its topic later by those of the last goal.
    """
    near = np.where(arm.prismatic, config.deviation_m, config.deviation_rad)
    lag = config.limits.of_joints(arm)[0] * (config.late_s + UNSAID_S)

    def of_joints(allowed: NDArray[np.float64]) -> list[JointTolerance]:
        named = zip(arm.joint_names, allowed.tolist(), strict=True)
        return [JointTolerance(name=name, position=position) for name, position in named]

    return {
        "path_tolerance": of_joints(near + lag),
        "goal_tolerance": of_joints(near),
        "goal_time_tolerance": Duration(sec=GOAL_TIME_S),
    }


def trajectory_message(plan: JointPlan, names: Sequence[str]) -> JointTrajectory:
    """A plan for a trajectory controller, which begins when it arrives."""
    return joint_trajectory(names, *plan.points())
