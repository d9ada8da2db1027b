# SPDX-License-Identifier: Apache-2.0
"""A bent tool beside the healthy one on robots whose joints err as a real UR10's do, with backlash.

Each draw has another robot, its gears set elsewhere, and another bend. The model in force knows
nothing of the gears; what they do at a pose that both runs share cancels.
"""

from dataclasses import replace

import numpy as np
import pytest
from long_form import amount
from scipy.stats import chi2

from bench.measured_runs import BETA_RAD, GAP_M, Q_NEAR, T_BASE_LASER, TAUGHT, ToolCell, laser_of
from bench.tool_erring import ErringStation, geared
from robocal_ros.cell_sim.beams import RoundTool, TrueInput, TrueNoise, beams_of, bent
from robocal_ros.cell_sim.cell import rigid_robot
from robocal_ros.cell_sim.gears import ur10_gears
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.tool.crossed_model import Held, RobotNoise

DRAWS = amount(16, 100)
NOISE = TrueNoise(3e-5, 1e-5)
TOLD = 1.6  # docs/simulation.md: how many of its sigmas a tip is off with gears


def change_of_tip(seed: int, with_gears: bool) -> float:
    """Squared error of a tip's change, over what both runs tell of it."""
    rng = np.random.default_rng([90, seed])
    true = rigid_robot(load_robot("ur10"), 0.0, rng)
    gears = ur10_gears()
    gears = replace(gears, phase=rng.uniform(-np.pi, np.pi, gears.phase.shape))
    effects = replace(true.effects, gears=True)
    robot = geared(replace(true, gears=gears, effects=effects)) if with_gears else None
    source = TrueInput(latency_s=0.004, sample_period_s=0.002)
    station = ErringStation(beams_of(T_BASE_LASER, BETA_RAD, GAP_M), source, NOISE, robot)
    cell = ToolCell(
        load_robot("ur10"), station, laser_of(station), Q_NEAR,
        robot=RobotNoise(NOISE.step_m, NOISE.edge_m),
    )  # fmt: skip
    shift, turn = rng.uniform(-1.0, 1.0, 3) * [3e-3, 3e-3, 1.5e-3], rng.uniform(-0.04, 0.04, 2)
    tools = TAUGHT, bent(TAUGHT, shift, [*turn, 0.0])
    found = [
        cell.full_run(RoundTool.cylinder(tool, 2.5e-3), TAUGHT, rng).estimate(Held())
        for tool in tools
    ]
    error = (found[1].tip - tools[1][:3, 3]) - (found[0].tip - tools[0][:3, 3])
    covariance = found[0].own_covariance[:3, :3] + found[1].own_covariance[:3, :3]
    return float(error @ np.linalg.solve(covariance, error))


@pytest.mark.parametrize(("with_gears", "factor"), [(True, TOLD), (False, 1.0)])
def test_the_change_of_a_tip_holds_what_is_told_of_it(with_gears: bool, factor: float):
    """By chi-square of three numbers a draw, of as many sigmas as the page tells at the most."""
    squared = [change_of_tip(seed, with_gears) for seed in range(DRAWS)]
    print(f"gears {with_gears}: {np.mean(squared) / 3:.2f}")
    assert np.sum(squared) / factor**2 < chi2.ppf(1.0 - 1e-3, 3 * DRAWS)
