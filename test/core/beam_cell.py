"""A UR10 at a beam station, for the tests of tool frames."""

import numpy as np

from robocal_ros.core import frames
from robocal_ros.core.tool.crossed_model import RobotNoise
from robocal_ros.core.tool.laser_frame import LaserFrame
from robocal_ros.sim.beams import NO_NOISE, PERFECT, BeamStation, TrueInput, TrueNoise, beams_of
from robocal_ros.sim.tool_cell import RunPlan, ToolCell
from robocal_ros.storage.robots import load_robot

Q_NEAR = np.array([0.047, -2.208, -1.248, 1.885, -1.571, 1.618])
BETA = np.radians(92.2)
GAP = 5.8e-5
T_BASE_LASER = frames.transform(frames.exp_rotation([0.02, -0.04, 0.01]), [0.7994, -0.1263, 0.1945])
TAUGHT = frames.transform(np.eye(3), [0.0, 0.0, 0.15])
SILENT = RobotNoise(1e-7, 1e-7)


def laser_of(station: BeamStation, sigma_m: float = 0.0) -> LaserFrame:
    """The laser frame as it truly is."""
    x, y = station.beams
    return LaserFrame(np.array([x.start, x.end, y.start, y.end]), sigma_m)


def make_cell(
    *,
    exact: bool = True,
    source: TrueInput = PERFECT,
    noise: TrueNoise = NO_NOISE,
    T_base_laser: np.ndarray = T_BASE_LASER,
    plan: RunPlan | None = None,
) -> ToolCell:
    """A cell whose robot knows its lasers exactly."""
    station = BeamStation(beams_of(T_base_laser, BETA, GAP), source, noise)
    robot = SILENT if exact else RobotNoise(noise.step_m, noise.edge_m)
    arm = load_robot("ur10")
    return ToolCell(arm, station, laser_of(station), Q_NEAR, plan or RunPlan(), robot)
