"""What a robot's earlier shifts have taught: at the pace of its measuring cycles, quickly."""

from dataclasses import replace

import numpy as np

from bench.thermal_shifts import Measured
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.thermal.process_learning import EarlierShift, LearnedProcess, learn_gains
from robocal_ros.sim.drift import PLANS, DriftingCell, record
from robocal_ros.sim.kr150_cell import poses
from robocal_ros.sim.robot import TrueRobot

SHIFTS = 3


def taught(nominal: SerialArm, robot: TrueRobot, seed: int) -> LearnedProcess:
    """Learn as ``thermal_node`` does with ``prior: learned``, from shifts of other work.

    Each motor's duty is drawn anew for each shift; of what will be judged nothing is used.
    """
    rng, cycle = np.random.default_rng([seed, 2]), poses("cycle")
    cell = DriftingCell(replace(robot, nominal=nominal), PLANS, cycle, cycle, ())
    shifts = []
    for course in PLANS[:SHIFTS]:
        plan = replace(course, duty=rng.uniform(0.3, 1.0, nominal.n))
        shift = record(cell, plan, rng)
        seen = Measured.of(nominal, shift, range(len(cycle)))
        cycles = [replace(one, sigma=None) for one in seen.cycles]  # how noisy it is not told
        shifts.append(EarlierShift(seen.spots, cycles, seen.time_s, shift.temperature))
    return learn_gains(shifts)
