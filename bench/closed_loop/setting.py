# SPDX-License-Identifier: Apache-2.0
"""Settings of the sessions, as a configured KR 150 cell has them."""

import numpy as np

from bench.cell_samples import SPIN_RAD
from bench.measured_fixture import LIMITS as FIXTURE_LIMITS
from bench.measured_fixture import fixture_poses
from bench.measured_runs import point_sigma
from robocal_ros.cell_sim.beams import CYLINDER_M
from robocal_ros.cell_sim.cell import T_BASE_LASER, TAUGHT, CellPlan, known_laser, poses
from robocal_ros.cell_sim.fixture import FRAME as FEATURE_FRAME
from robocal_ros.cell_sim.fixture import PLATE
from robocal_ros.fixture.files import fixture_document
from robocal_ros.fixture.session import FixtureConfig
from robocal_ros.maintenance.accuracy import AcceptBounds, MaintenanceConfig, Times
from robocal_ros.motion.cell import DrivingConfig, Housing
from robocal_ros.motion.plan import MotionLimits
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.tool.laser_frame import LaserFrame, calibrate_laser
from robocal_ros.tool.run import ToolConfig, rows_of

SERIAL = "SIM-KR150"
STATION, FRAME, TARGET = "station", "sensor", "ball"
FLANGE, TOOL = "tool0", "tool"
TOLERANCE_M = 3e-4

THERMAL = ThermalConfig(
    measuring_frame=FRAME,
    target=TARGET,
    tolerance_m=TOLERANCE_M,
    work_poses=rows_of(poses("work")),
    tip_m=tuple(TAUGHT[:3, 3].tolist()),
)
HOUSING = Housing(clear_radius_m=0.06, top_m=0.03, floor_m=-0.12, retract_m=0.10, reach_m=0.3)
LIMITS = MotionLimits(tcp_speed_m_s=0.25)
DRIVING = DrivingConfig(HOUSING, 0.1, 0.01, 0.06, LIMITS)  # pin, its radius with a bend, flange
STALE_S = 0.5  # of the heartbeat gap_open
TRAVEL_M_S = 1.0
TIMES = Times(check_s=20.0, full_s=35.0, tool_home_s=10.0)
BOUNDS = AcceptBounds(automatic=True, tool_m=3e-3)
HOME_NEAR_RAD = float(np.radians(2.0))  # the corrected home of a bent tool is as far from home


def laser_of(plan: CellPlan) -> LaserFrame:
    """The beams as this robot places them while it is cold."""
    rng = np.random.default_rng([plan.seed, 1])
    points = known_laser(plan, T_BASE_LASER, poses("tool")[0], rng)
    return calibrate_laser(points, point_sigma(plan.station), CYLINDER_M)


def tool_config(laser: LaserFrame) -> ToolConfig:
    """Of the tool session."""
    return ToolConfig(
        points_m=rows_of(laser.points),
        laser_sigma_m=laser.sigma_m,
        reach_m=(float(laser.reach[0]), float(laser.reach[1])),
        taught=rows_of(TAUGHT),
        station=STATION,
        spin_rad=SPIN_RAD,
    )


def fixture_config() -> FixtureConfig:
    """Of the fixture session."""
    return FixtureConfig(fixture_document(PLATE), sensor_frame=FEATURE_FRAME, limits=FIXTURE_LIMITS)


def maintenance_config(laser: LaserFrame, fixture: bool = False) -> MaintenanceConfig:
    """Of the maintenance; ``fixture``: it measures one, too."""
    return MaintenanceConfig(
        home=poses("home")[0],
        poses=poses("cycle"),
        T_flange_tool=TAUGHT,
        driving=DRIVING,
        T_base_laser=laser.T_base_laser,
        fixture_poses=fixture_poses() if fixture else None,
        travel_speed_m_s=TRAVEL_M_S,
        home_near=HOME_NEAR_RAD,
        tolerance_m=TOLERANCE_M,
        times=TIMES,
        bounds=BOUNDS,
    )
