# SPDX-License-Identifier: Apache-2.0
"""Parameters of the joint correction node."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from robocal_ros.correction.bounds import CorrectionConfig, Policy, ShiftBounds
from robocal_ros.correction.limiter import OffsetLimits
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import FULL_SPEED_IN_S, RobotDescription, load_robot
from robocal_ros.motion.driver import HARD_STOP
from robocal_ros.ros.base import NO_SERIAL
from robocal_ros.ros.parameters import (
    ROBOT_SETTINGS,
    Setting,
    advanced,
    given_pose,
    number,
    pose_settings,
)
from robocal_ros.ros.session_node import STATE_DIR

NOMINAL = "nominal"
# Parameters that go to the session as they are.
SAME = ("stream_gap_s", "joint_state_age_s", "flange_frame", "model_age_s", "free_axis", "shadow")


# fmt: off
SETTINGS = (
    *ROBOT_SETTINGS,
    Setting("reference", NOMINAL, "Model that the program was made with: nominal, or path of a "
            "robot file that holds the calibrated cold model of a taught program"),
    *pose_settings(
        "taught",
        "Tool on the flange that the program was made with; as the quaternion at its default: the "
        "robot file's",
        "Its orientation: z from flange to tip",
    ),
    Setting("command_joints", [""], "Joints of joint_commands (Float64MultiArray), in its order; "
            "empty: all joints of the arm, from base to flange"),
    Setting("shadow", False,
            "Compute everything and change nothing: outputs go out as the inputs came in"),
    Setting("policy", Policy.REFUSE.value, "What becomes of a command whose correction exceeds a "
            "bound or leads beyond a limit: refuse it, clamp the correction, or pass it while its "
            "offset goes to zero", choices=tuple(policy.value for policy in Policy)),
    number("model_age_s", 0.0,
           "A model whose stamp is older is no longer used; 0: it may be of any age", 0.0, 1e7),
    Setting("free_axis", False, "The tool may turn about its z axis (drill, sphere, torch): the "
            "joints move as little as they can"),
    number("velocity_limits", [0.0], "Largest speed of each joint after correction, rad/s "
           "(sliding: m/s), one number for each; 0: as the robot file says; without any the "
           "correction cannot be enabled", 0.0, 1e3),
    Setting("tool_child_frame", "", "Child frame that the tools must have; empty: any"),
    Setting("follow_joint_trajectory", "", "Action of the controller that goals of "
            "follow_joint_trajectory go to; empty: no action"),
    HARD_STOP,
    STATE_DIR,
    Setting("enable_on_start", False, "Correct from the start, without a call of ~/enable"),
    number("thermal_tcp_mm", 1.0, "Largest correction of the arm's drift at the tool", 0.0, 20.0),
    number("thermal_tcp_deg", 0.1, "and in orientation", 0.0, 5.0),
    number("tool_tcp_mm", 10.0, "Largest change of the tool that is made up for", 0.0, 100.0),
    number("tool_tcp_deg", 4.0, "and in orientation", 0.0, 30.0),
    *advanced(
        number("thermal_joint_deg", 0.3, "Largest correction of a joint for the arm's drift; near "
               "a singularity less is corrected, so that this holds", 0.001, 5.0),
        number("tool_joint_deg", 5.0, "and for a changed tool; where more is needed, commands are "
               "refused", 0.001, 30.0),
        number("offset_deg_s", 2.0, "Fastest change of what is added to a joint while the program "
               "moves none; its acceleration is 10 times that, and in motion both are larger: 5 "
               "and 100 times that", 0.01, 2.0),
        number("offset_mm_s", 5.0, "and to a sliding joint", 0.01, 5.0),
        number("stream_gap_s", 0.1, "After a longer pause, and one of two periods, a stream of "
               "targets goes on only where the robot can be soon", 0.01, 10.0),
        number("start_deg", 0.02, "How far from where a command begins a joint may stand",
               0.001, 0.5),
        number("start_mm", 0.05, "How far a sliding joint may stand from there", 0.001, 1.0),
        number("joint_state_age_s", 0.2, "Older joint states do not tell where the robot is",
               0.01, 5.0),
    ),
)
# fmt: on


def reference_arm(settings: Mapping[str, Any], nominal: SerialArm) -> SerialArm:
    """The arm that the program was taught with, and its tool; `InputError` of its file."""
    chosen = settings["reference"]
    reference = nominal if chosen == NOMINAL else load_robot(chosen)
    reference = replace(  # a calibrated file does not lift the robot's limits
        reference,
        lower=np.maximum(nominal.lower, reference.lower),
        upper=np.minimum(nominal.upper, reference.upper),
    )
    tool = given_pose(settings, "taught")
    return reference if tool is None else replace(reference, T_flange_tool=tool)


def command_joints(settings: Mapping[str, Any], arm: SerialArm) -> tuple[str, ...]:
    """The joints of ``joint_commands``, in its order.

    Raises `InputError` when one of them is not the arm's, or is named twice.
    """
    names = tuple(settings["command_joints"]) or arm.joint_names
    unknown = [name for name in names if name not in arm.joint_names]
    if unknown or len(set(names)) != len(names):
        fault = f"{', '.join(unknown)} unknown" if unknown else "a joint is named twice"
        raise InputError(
            f"command_joints = {', '.join(names)}: {fault}; the arm has "
            f"{', '.join(arm.joint_names)}"
        )
    return names


def _offset_limits(rate: float) -> OffsetLimits:
    """The limits at rest and in motion that belong to a rate at rest (docs/joint_correction.md)."""
    return OffsetLimits(rate, 10.0 * rate, 5.0 * rate, 100.0 * rate)


def joint_limits(settings: Mapping[str, Any], robot: RobotDescription) -> tuple[Array, Array]:
    """Speeds and accelerations (n,), rad/s (prismatic: m/s) ...; infinite where none is known.

    An acceleration that nobody says is that to full speed in half a second. Raises `InputError`
    when the numbers of joints and of velocity limits differ.
    """
    given, count = np.array(settings["velocity_limits"]), robot.arm.n
    if len(given) != count and given.any():
        raise InputError(f"velocity_limits has {len(given)} numbers, the arm {count} joints")
    file = np.where(np.isfinite(robot.max_velocity), robot.max_velocity, np.inf)
    speed = np.where(given > 0.0, given, file)
    known = np.isfinite(robot.max_acceleration)
    return speed, np.where(known, robot.max_acceleration, speed / FULL_SPEED_IN_S)


def session_config(settings: Mapping[str, Any], robot: RobotDescription) -> CorrectionConfig:
    """Settings of the session, in SI; raises `InputError` as `joint_limits`."""

    def bounds(what: str) -> ShiftBounds:
        degrees = (settings[f"{what}_{where}_deg"] for where in ("tcp", "joint"))
        return ShiftBounds(
            settings[f"{what}_tcp_mm"] * 1e-3, *(float(np.radians(x)) for x in degrees)
        )

    speeds, accelerations = joint_limits(settings, robot)
    nameless = settings["serial"] in ("", NO_SERIAL)
    return CorrectionConfig(
        thermal=bounds("thermal"),
        tool=bounds("tool"),
        turning=_offset_limits(float(np.radians(settings["offset_deg_s"]))),
        sliding=_offset_limits(settings["offset_mm_s"] * 1e-3),
        start_rad=float(np.radians(settings["start_deg"])),
        start_m=settings["start_mm"] * 1e-3,
        tool_frame=settings["tool_child_frame"],
        policy=Policy(settings["policy"]),
        velocity_limits=speeds,
        acceleration_limits=accelerations,
        robot_file_hash=robot.file_hash if nameless else "",
        **{name: settings[name] for name in SAME},
    )
