"""Parameters of the maintenance node."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from robocal_ros.kinematics import SerialArm
from robocal_ros.maintenance import AcceptBounds, MaintenanceConfig, Times
from robocal_ros.motion.driver import CONTROLLER
from robocal_ros.motion.settings import MOTION, driving_config, require_limits
from robocal_ros.ros.conversions import MM, joint_poses, joints_of
from robocal_ros.ros.graph import GAP_BOOL, SHORTEST_STALE_S
from robocal_ros.ros.history_settings import STATE_DIR
from robocal_ros.ros.parameters import Setting, given_pose, length, pose_settings
from robocal_ros.tool.laser_frame import read_laser_for

SHORTEST_SILENCE_S = 2.0


def _time(name: str, default: float, what: str, high: float, low: float = 0.01) -> Setting:
    return Setting(name, default, what, unit="s", low=low, high=high)


def _silence_fault(silent_s: float) -> str | None:
    told = 0.0 < silent_s < SHORTEST_SILENCE_S
    return f"0, or {SHORTEST_SILENCE_S:g} s at least: it is told each second" if told else None


SETTINGS = (
    Setting("robot", "ur10", "Robot type (config/robots) or path of a robot file"),
    STATE_DIR,
    Setting("base_frame", "base", "Name of the robot's base frame, for stamps"),
    *pose_settings(
        "taught",
        "Taught tool in the flange frame; as the quaternion at its default: the robot file's",
        "Its orientation: z from flange to tip",
    ),
    Setting(
        "home_deg",
        [0.0],
        "Taught home pose, a number for each joint (sliding joint: mm)",
        unit="deg",
        low=-1e5,
        high=1e5,
    ),
    Setting(
        "measuring_poses_deg",
        [""],
        "Measuring poses in their order, each a text of numbers as home_deg; none: no thermal "
        "measurement",
    ),
    Setting(
        "laser",
        "",
        "Laser file of the station, as tcf_node's; empty: no tool measurement",
    ),
    Setting(
        "travel_speed_mm_s",
        250.0,
        "Largest speed of the tip between the taught poses",
        unit="mm/s",
        low=1.0,
        high=5000.0,
    ),
    Setting(
        "home_near_deg",
        0.5,
        "The robot is at home with all joints so near (sliding joint: mm)",
        unit="deg",
        low=0.01,
        high=5.0,
    ),
    *MOTION,
    *CONTROLLER,
    _time("default_gap_s", 60.0, "Length of the gap of ~/run_trigger", 86400.0),
    _time(
        "gap_stale_s",
        0.5,
        "gap_open may pause for so long, and so old may the beat be that it echoes",
        0.5,
        SHORTEST_STALE_S,
    ),
    GAP_BOOL,
    _time("rest_s", 1.0, "After a motion's end, until the robot rests where it ends", 10.0, 0.1),
    _time("reserve_s", 1.0, "Kept free before the end of a gap", 60.0),
    Setting("measurements", 1, "So many measurements make a pose measured", low=1, high=1000),
    _time("settle_s", 0.3, "A measurement counts so long after the robot stands", 10.0),
    _time("stay_s", 0.2, "The robot stays so long after the last measurement of a pose", 10.0),
    _time("measure_s", 3.0, "The longest time at a pose", 600.0),
    _time("answer_s", 1.0, "Another node answers within", 60.0, 0.1),
    _time("solve_s", 6.0, "thermal_node ends a cycle within", 600.0, 0.1),
    _time("check_s", 15.0, "A quick check takes at the most", 600.0, 1.0),
    _time("full_s", 30.0, "A full tool measurement takes at the most", 3600.0, 1.0),
    _time("tool_home_s", 10.0, "Kept free for the way home from the beams", 600.0, 0.1),
    _time(
        "resume_within_s",
        600.0,
        "An unfinished thermal cycle goes on when its last pose is no older; a minute shorter than "
        "thermal_node's cycle_timeout_s",
        86400.0,
    ),
    _time("check_every_s", 0.0, "A quick check is due so often; 0: in each gap", 1e7, 0.0),
    _time(
        "full_every_s",
        0.0,
        "A full tool measurement is due so often, when time allows; 0: only when needed",
        1e7,
        0.0,
    ),
    _time("tool_due_s", 7200.0, "Age of a tool check at which accuracy_state is DUE", 1e7),
    _time("tool_expires_s", 28800.0, "Age at which it is EXPIRED", 1e7),
    _time("thermal_silent_s", 5.0, "thermal_node's accuracy may pause for so long", 600.0, 1.0),
    Setting(
        "correction_silent_s",
        5.0,
        "joint_correction_node's status may pause for so long; 0: there is none, the robot's "
        "controller takes model and tool itself",
        unit="s",
        low=0.0,
        high=600.0,
        check=_silence_fault,
    ),
    length("tolerance_mm", 0.3, "Error of the tool that the process allows", 0.001, 100.0),
    Setting("auto_accept", False, "Accept inside the bounds without a person"),
    length(
        "accept_thermal_mm",
        1.0,
        "Largest shift of the tip since commissioning at home and measuring poses",
        0.001,
        100.0,
    ),
    length("accept_tool_mm", 1.0, "Largest distance of the tip from the taught one", 0.001, 100.0),
    Setting(
        "accept_tool_deg",
        1.5,
        "Largest tilt of the axis from the taught one",
        unit="deg",
        low=0.001,
        high=90.0,
    ),
)


def session_config(settings: Mapping[str, Any], arm: SerialArm) -> MaintenanceConfig:
    """Settings of the session, in SI.

    Raises
    ------
    InputError
        When a value makes no sense, or the laser file cannot be read.
    """
    driving = driving_config(settings)
    require_limits(arm, driving)
    laser = settings["laser"]
    taught = given_pose(settings, "taught")
    degree = float(np.radians(1.0))
    return MaintenanceConfig(
        home=joints_of(arm, settings["home_deg"], "home_deg"),
        poses=joint_poses(arm, settings["measuring_poses_deg"], "measuring_poses_deg"),
        T_flange_tool=arm.T_flange_tool if taught is None else taught,
        driving=driving,
        T_base_laser=read_laser_for(Path(laser), arm).laser.T_base_laser if laser else None,
        travel_speed_m_s=settings["travel_speed_mm_s"] * MM,
        home_near=settings["home_near_deg"] * np.where(arm.prismatic, MM, degree),
        measurements=settings["measurements"],
        resume_within_s=settings["resume_within_s"],
        check_every_s=settings["check_every_s"],
        full_every_s=settings["full_every_s"],
        tool_due_s=settings["tool_due_s"],
        tool_expires_s=settings["tool_expires_s"],
        silent_s=settings["thermal_silent_s"],
        correction_silent_s=settings["correction_silent_s"],
        tolerance_m=settings["tolerance_mm"] * MM,
        times=_times(settings),
        bounds=AcceptBounds(
            settings["auto_accept"],
            settings["accept_thermal_mm"] * MM,
            settings["accept_tool_mm"] * MM,
            settings["accept_tool_deg"] * degree,
        ),
    )


def _times(settings: Mapping[str, Any]) -> Times:
    same = {field.name: settings[field.name] for field in fields(Times) if field.name != "stale_s"}
    return Times(stale_s=settings["gap_stale_s"], **same)
