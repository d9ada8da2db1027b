# SPDX-License-Identifier: Apache-2.0
"""Shifts of a robot at the pace of its measuring cycles, and what earlier ones have taught."""

from dataclasses import replace

import numpy as np

from bench.measured_shifts import PLANS, DriftingCell, DriftPlan, record
from bench.thermal_shifts import Measured
from robocal_ros.cell_sim.cell import poses
from robocal_ros.cell_sim.robot import TrueRobot
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.accuracy import EarlierShift, LearnedProcess, learn_gains


def seen(
    nominal: SerialArm, robot: TrueRobot, plan: DriftPlan, rng: np.random.Generator
) -> EarlierShift:
    """What the six measuring poses of the cell show of a shift; how noisy it is not told."""
    cycle = poses("cycle")
    shift = record(DriftingCell(robot, (plan,), cycle, cycle, ()), plan, rng)
    measured = Measured.of(nominal, shift, range(len(cycle)))
    cycles = [replace(one, sigma=None) for one in measured.cycles]
    return EarlierShift(measured.spots, cycles, measured.time_s, shift.temperature)


def taught(nominal: SerialArm, robot: TrueRobot, seed: int) -> LearnedProcess:
    """Learn as ``thermal_node`` does with ``prior: learned``, from three shifts of other work.

    Each motor's duty is drawn anew for each shift; of what will be judged nothing is used.
    """
    rng = np.random.default_rng([seed, 2])
    plans = [replace(course, duty=rng.uniform(0.3, 1.0, nominal.n)) for course in PLANS]
    return learn_gains([seen(nominal, robot, plan, rng) for plan in plans])
