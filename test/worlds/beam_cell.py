# SPDX-License-Identifier: Apache-2.0
"""A UR10 at a beam station, for the tests of tool frames."""

from functools import cache

import numpy as np

from bench.measured_runs import (
    BETA_RAD,
    GAP_M,
    NO_NOISE,
    PERFECT,
    Q_NEAR,
    T_BASE_LASER,
    RunPlan,
    ToolCell,
    laser_of,
)
from robocal_ros.cell_sim.beams import BeamStation, TrueInput, TrueNoise, beams_of
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.tool.crossed_model import RobotNoise

SILENT = RobotNoise(1e-7, 1e-7)


@cache
def ur10() -> SerialArm:
    return load_robot("ur10")


def make_cell(
    *,
    exact: bool = True,
    source: TrueInput = PERFECT,
    noise: TrueNoise = NO_NOISE,
    T_base_laser: np.ndarray = T_BASE_LASER,
    plan: RunPlan | None = None,
) -> ToolCell:
    """A cell whose robot knows its lasers exactly."""
    station = BeamStation(beams_of(T_base_laser, BETA_RAD, GAP_M), source, noise)
    robot = SILENT if exact else RobotNoise(noise.step_m, noise.edge_m)
    return ToolCell(ur10(), station, laser_of(station), Q_NEAR, plan or RunPlan(), robot)
