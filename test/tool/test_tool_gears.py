# SPDX-License-Identifier: Apache-2.0
"""A bent tool beside the healthy one on robots whose joints err as a real UR10's do, with backlash.

Each draw has another robot, its gears set elsewhere, and another bend. The model in force knows
nothing of the gears; what they do at a pose that both runs share cancels; what they do
at others is foretold of robots of that kind.
"""

from dataclasses import replace

import numpy as np
from long_form import amount
from scipy.stats import chi2

from bench.measured_runs import BETA_RAD, GAP_M, Q_NEAR, T_BASE_LASER, TAUGHT, ToolCell, laser_of
from bench.tool_erring import ErringStation, geared
from robocal_ros.cell_sim.beams import RoundTool, TrueInput, TrueNoise, beams_of, bent
from robocal_ros.cell_sim.cell import rigid_robot
from robocal_ros.cell_sim.gears import ur10_gears
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.tool.crossed_model import Held, RobotNoise
from robocal_ros.tool.judging import tip_errors

DRAWS = amount(16, 100)
NOISE = TrueNoise(3e-5, 1e-5)
GEARS_RAD = 3e-4  # rms of a UR10's joints, 240 to 380 urad (docs/simulation.md)
DRAW_ALIKE = 1e-3  # chance of either end of the chi-squares


def change_of_tip(seed: int) -> tuple[float, float, float]:
    """Squared error of a tip's change over what both runs tell of it, and with joints that err.

    Last the square of how many of the sigmas that they tell it is said to be off.
    """
    rng = np.random.default_rng([90, seed])
    true = rigid_robot(load_robot("ur10"), 0.0, rng)
    gears = ur10_gears()
    gears = replace(gears, phase=rng.uniform(-np.pi, np.pi, gears.phase.shape))
    effects = replace(true.effects, gears=True)
    robot = geared(replace(true, gears=gears, effects=effects))
    source = TrueInput(latency_s=0.004, sample_period_s=0.002)
    station = ErringStation(beams_of(T_BASE_LASER, BETA_RAD, GAP_M), source, NOISE, robot)
    cell = ToolCell(
        load_robot("ur10"), station, laser_of(station), Q_NEAR,
        robot=RobotNoise(NOISE.step_m, NOISE.edge_m),
    )  # fmt: skip
    shift, turn = rng.uniform(-1.0, 1.0, 3) * [3e-3, 3e-3, 1.5e-3], rng.uniform(-0.04, 0.04, 2)
    tools = TAUGHT, bent(TAUGHT, shift, [*turn, 0.0])
    runs = [cell.full_run(RoundTool.cylinder(tool, 2.5e-3), TAUGHT, rng) for tool in tools]
    found = [run.estimate(Held()) for run in runs]
    error = (found[1].tip - tools[1][:3, 3]) - (found[0].tip - tools[0][:3, 3])
    covariance = found[0].own_covariance[:3, :3] + found[1].own_covariance[:3, :3]
    before, now = (
        (run.path.q[-1], estimate.tip) for run, estimate in zip(runs, found, strict=True)
    )
    erring = tip_errors(cell.arm, GEARS_RAD, now, before, covariance)
    assert erring is not None
    squares = [
        float(error @ np.linalg.solve(C, error))
        for C in (covariance, covariance + erring.covariance)
    ]
    return squares[0], squares[1], erring.factor**2


def test_with_gears_it_is_off_by_as_many_sigmas_as_is_said():
    """Their part is foretold of the kind of robot, and holds both ways.

    That without gears what the runs tell is enough: test_tool_judging.
    """
    erring = np.array([change_of_tip(seed) for seed in range(DRAWS)])
    runs_alone, with_joints, factor2 = erring.mean(axis=0) / [3.0, 3.0, 1.0]
    print(f"alone {runs_alone:.2f}, said {factor2:.2f}; with them {with_joints:.2f}")
    low, high = chi2.ppf([DRAW_ALIKE, 1.0 - DRAW_ALIKE], 3 * DRAWS) / (3 * DRAWS)
    assert low < with_joints < high
