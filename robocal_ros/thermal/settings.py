"""Parameters of the thermal node."""

from collections.abc import Mapping
from typing import Any

from robocal_ros.estimation.sphere import SphereRule
from robocal_ros.ground.samples import DEFAULT_TARGET
from robocal_ros.kinematics import SerialArm
from robocal_ros.ros.conversions import MM, joint_poses
from robocal_ros.ros.history_settings import STATE_DIR
from robocal_ros.ros.parameters import ORIGIN, STANDSTILL, Setting, count_fault, standstill_rule
from robocal_ros.thermal.config import METHODS, PRIORS, SPHERE_RADIUS_M, ThermalConfig


def _field_fault(field: list[float]) -> str | None:
    if len(field) != 5:
        return "five lengths are wanted"
    return None if field[3] < field[4] else "the nearest distance must be below the farthest"


SETTINGS = (
    Setting("robot", "kr150_r3100", "Robot type (config/robots) or path of a robot file"),
    STATE_DIR,
    Setting("base_frame", "base", "Name of the robot's base frame"),
    Setting("measuring_frame", "", "Frame of the measurements; empty: that of the first one used"),
    Setting("target", DEFAULT_TARGET, "Target where a measurement's frame_id names none"),
    Setting("method", METHODS[0], "Estimator where a call names none", choices=METHODS),
    Setting("prior", PRIORS[0], "Expected drift: by default or as learned", choices=PRIORS),
    Setting(
        "drift_parameters",
        [""],
        "What lsq solves of a drift (a1_mm, beta2_deg, ...); empty: all, which takes many poses",
    ),
    Setting(
        "sigma_mm",
        0.03,
        "Standard deviation of one measured coordinate, sensor and repeatability",
        unit="mm",
        low=1e-4,
        high=10.0,
    ),
    Setting(
        "sphere_radius_mm",
        SPHERE_RADIUS_M * 1e3,
        "Certified radius of the sphere in sphere_cloud",
        unit="mm",
        low=1.0,
        high=200.0,
    ),
    Setting(
        "sphere_tolerance_mm",
        0.1,
        "How far the radius of the points of a cloud may be off",
        unit="mm",
        low=1e-3,
        high=5.0,
    ),
    Setting(
        "sphere_noise_mm",
        0.2,
        "Largest scatter of a cloud's points about the sphere",
        unit="mm",
        low=1e-3,
        high=5.0,
    ),
    Setting(
        "sensor_field_mm",
        [570.0, 430.0, 700.0, 550.0, 850.0],
        "Where the sensor measures: width, height, at what distance; nearest and farthest distance",
        unit="mm",
        low=1.0,
        high=20000.0,
        check=_field_fault,
    ),
    Setting(
        "hold_out",
        0.5,
        "Share of the poses kept to judge a calibration without a reference",
        low=0.1,
        high=0.9,
    ),
    Setting("seed", 0, "Which poses are held out", low=0, high=2**31 - 1),
    *STANDSTILL,
    Setting(
        "cycle_timeout_s",
        660.0,
        "A cycle ends when nothing was measured for so long; a minute longer than "
        "maintenance_node's resume_within_s",
        unit="s",
        low=1.0,
        high=7200.0,
    ),
    Setting(
        "tolerance_mm",
        0.3,
        "Tool error that the process allows; accuracy is judged by it",
        unit="mm",
        low=1e-3,
        high=100.0,
    ),
    Setting(
        "expires_after_s",
        28800.0,
        "A measurement older than this says nothing any more",
        unit="s",
        low=60.0,
        high=7 * 86400.0,
    ),
    Setting(
        "work_poses_deg",
        [""],
        "Working poses at which accuracy is judged, each a text of numbers, one for each joint "
        "(sliding joint: mm); none: throughout the joint limits",
    ),
    Setting(
        "tip_mm",
        ORIGIN,
        "The tool's tip on the flange, which accuracy is about; at its default: the target",
        unit="mm",
        low=-5000.0,
        high=5000.0,
        check=count_fault(3),
    ),
    Setting(
        "lateness_s",
        0.2,
        "Commands on measurements wait for joint readings so much newer than the call",
        unit="s",
        low=0.0,
        high=5.0,
    ),
    Setting(
        "command_timeout_s",
        1.0,
        "They wait at most so long (wall clock), then use what is there",
        unit="s",
        low=0.05,
        high=30.0,
    ),
)


def session_config(settings: Mapping[str, Any], arm: SerialArm) -> ThermalConfig:
    """Settings of the session, in SI.

    Raises
    ------
    InputError
        When a working pose has not a number for each joint.
    """
    poses = joint_poses(arm, settings["work_poses_deg"], "work_poses_deg").tolist()
    tip_mm = settings["tip_mm"]
    return ThermalConfig(
        method=settings["method"],
        prior=settings["prior"],
        sigma_m=settings["sigma_mm"] * MM,
        drift_parameters=tuple(settings["drift_parameters"]),
        hold_out=settings["hold_out"],
        seed=settings["seed"],
        cycle_timeout_s=settings["cycle_timeout_s"],
        tolerance_m=settings["tolerance_mm"] * MM,
        expires_after_s=settings["expires_after_s"],
        work_poses=tuple(tuple(pose) for pose in poses),
        tip_m=() if tip_mm == ORIGIN else tuple(value * MM for value in tip_mm),
        lateness_s=settings["lateness_s"],
        measuring_frame=settings["measuring_frame"],
        target=settings["target"],
        standstill=standstill_rule(settings),
        sphere=SphereRule(
            radius_m=settings["sphere_radius_mm"] * MM,
            radius_tolerance_m=settings["sphere_tolerance_mm"] * MM,
            noise_m=settings["sphere_noise_mm"] * MM,
        ),
    )
