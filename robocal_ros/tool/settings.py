"""Parameters of the tool node."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.kinematics import SerialArm
from robocal_ros.ros.parameters import Setting, given_pose, length, pose_settings
from robocal_ros.ros.session_node import STATE_DIR
from robocal_ros.tool.crossed_model import RobotNoise
from robocal_ros.tool.crossed_run import TraitLimits
from robocal_ros.tool.edges import InputRule
from robocal_ros.tool.judging import ToolLimits
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.measuring_plan import MeasuringMotion
from robocal_ros.tool.quick_check import CheckRule
from robocal_ros.tool.run import ToolConfig, rows_of

PROGRAM, TRAJECTORY = "program", "trajectory"


def _speed(name: str, default: float, what: str, high: float) -> Setting:
    return Setting(name, default, what, unit="mm/s", low=0.1, high=high)


SETTINGS = (
    Setting("robot", "ur10", "Robot type (config/robots) or path of a robot file"),
    STATE_DIR,
    *pose_settings(
        "taught",
        "Taught tool in the flange frame; as the quaternion at its default: the robot file's",
        "Its orientation: z from flange to tip",
    ),
    *pose_settings(
        "mandrel",
        "End of the mandrel in the flange frame; as the quaternion at its default: there is none",
        "Its orientation: z along its axis to its end",
    ),
    Setting("laser", "", "Laser file of the station, as 'robocal tool beams' writes it"),
    Setting("base_frame", "base", "Name of the robot's base frame"),
    Setting("flange_frame", "tool0", "Name of the flange frame; it is never modified"),
    Setting("tool_frame", "tool", "Name of the tool frame, a child of the flange's"),
    Setting("beams", ["x", "y"], "Names of the x- and the y-beam in beam_events"),
    Setting(
        "motion",
        PROGRAM,
        "Who moves: the robot's program, or this node",
        choices=(PROGRAM, TRAJECTORY),
    ),
    Setting(
        "input_period_ms",
        0.0,
        "How often the input is read; 0: by interrupt",
        unit="ms",
        low=0.0,
        high=100.0,
    ),
    Setting("input_jitter_ms", 0.02, "Scatter of an edge's stamp", unit="ms", low=1e-4, high=10.0),
    Setting(
        "debounce_ms",
        0.5,
        "Edges nearer than this are one contact",
        unit="ms",
        low=0.0,
        high=20.0,
    ),
    length("repeatability_mm", 0.03, "Scatter of a motion in each axis", 0.0, 2.0),
    length("edge_noise_mm", 0.01, "Further scatter of the robot at each edge", 0.0, 2.0),
    length(
        "circle_radius_mm", 12.0, "Radius of the circles; wider than the largest bend", 2.0, 100.0
    ),
    _speed("circle_speed_mm_s", 50.0, "Speed on the circles", 250.0),
    length("circle_height_mm", 50.0, "Between both circles that give the axis", 5.0, 300.0),
    length(
        "above_tip_mm",
        5.0,
        "Height above the tip at which the lower circles are driven",
        0.5,
        100.0,
    ),
    length("plunge_depth_mm", 7.0, "Depth of a plunge, half of it below the beams", 1.0, 50.0),
    _speed("plunge_speed_mm_s", 10.0, "Speed of a plunge", 50.0),
    Setting(
        "spin_deg",
        0.0,
        "Turn of the flange about the laser's z",
        unit="deg",
        low=-360.0,
        high=360.0,
    ),
    Setting(
        "taper",
        0.0,
        "Growth of the tool's radius per length above the tip",
        low=-2.0,
        high=2.0,
    ),
    length("quick_limit_mm", 0.2, "Deviation of the tip that a quick check passes", 0.01, 10.0),
    length("lever_mm", 150.0, "From where a bent tool bends to its tip", 1.0, 2000.0),
    length("sigma_limit_mm", 0.2, "A tip that is known less well is refused", 0.01, 10.0),
    length(
        "change_limit_mm",
        10.0,
        "Largest change of the tip from the taught one; no more than joint_correction_node's "
        "tool_tcp_mm",
        0.1,
        100.0,
    ),
    Setting(
        "tilt_limit_deg",
        4.0,
        "Largest change of the axis; no more than its tool_tcp_deg",
        unit="deg",
        low=0.1,
        high=45.0,
    ),
    length("trait_radius_mm", 0.05, "Change of its radius that is no fault yet; 0: any", 0.0, 5.0),
    Setting(
        "trait_latency_ms",
        5.0,
        "Change of the edges' delay that is no fault yet; 0: any",
        unit="ms",
        low=0.0,
        high=1000.0,
    ),
    Setting(
        "trait_lost",
        0.05,
        "Share of the joint readings that may be lost; 0: any",
        low=0.0,
        high=1.0,
    ),
    Setting(
        "step_timeout_s",
        30.0,
        "A run ends when a step has no edge for so long",
        unit="s",
        low=1.0,
        high=3600.0,
    ),
    Setting(
        "joint_silence_s",
        0.5,
        "A run ends when joint states are silent for so long",
        unit="s",
        low=0.02,
        high=10.0,
    ),
)


def taught_tool(settings: Mapping[str, Any], nominal: SerialArm) -> NDArray[np.float64]:
    """T_flange_tool (4, 4) as taught: by the parameters, else by the robot file.

    Raises
    ------
    InputError
        When the quaternion is not of unit length.
    """
    given = given_pose(settings, "taught")
    return nominal.T_flange_tool if given is None else given


def session_config(
    settings: Mapping[str, Any], laser: LaserFrame, station: str, taught: NDArray[np.float64]
) -> ToolConfig:
    """Settings of the session, in SI.

    Raises
    ------
    InputError
        When a length or speed is out of range.
    """
    return ToolConfig(
        points_m=rows_of(laser.points),
        taught=rows_of(taught),
        mandrel=None if (T := given_pose(settings, "mandrel")) is None else rows_of(T),
        laser_sigma_m=laser.sigma_m,
        reach_m=(float(laser.reach[0]), float(laser.reach[1])),
        station=station,
        beams=tuple(settings["beams"]),
        taper=settings["taper"],
        spin_rad=float(np.radians(settings["spin_deg"])),
        step_timeout_s=settings["step_timeout_s"],
        motion=MeasuringMotion(
            radius_m=settings["circle_radius_mm"] * 1e-3,
            speed_m_s=settings["circle_speed_mm_s"] * 1e-3,
            height_m=settings["circle_height_mm"] * 1e-3,
            above_tip_m=settings["above_tip_mm"] * 1e-3,
            plunge_depth_m=settings["plunge_depth_mm"] * 1e-3,
            plunge_speed_m_s=settings["plunge_speed_mm_s"] * 1e-3,
        ),
        input=InputRule(
            jitter_s=settings["input_jitter_ms"] * 1e-3,
            sample_period_s=settings["input_period_ms"] * 1e-3,
            debounce_s=settings["debounce_ms"] * 1e-3,
        ),
        noise=RobotNoise(settings["repeatability_mm"] * 1e-3, settings["edge_noise_mm"] * 1e-3),
        check=CheckRule(settings["quick_limit_mm"] * 1e-3, settings["lever_mm"] * 1e-3),
        limits=ToolLimits(
            settings["sigma_limit_mm"] * 1e-3,
            settings["change_limit_mm"] * 1e-3,
            float(np.radians(settings["tilt_limit_deg"])),
        ),
        traits=TraitLimits(
            settings["trait_radius_mm"] * 1e-3,
            settings["trait_latency_ms"] * 1e-3,
            settings["trait_lost"],
        ),
    )
