# SPDX-License-Identifier: Apache-2.0
"""What the stated bound of the drift is made of: many robots, at the pace of their cycles."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.closed_loop import setting
from bench.closed_loop.earlier import seen, taught
from bench.measured_shifts import PERIOD_S, DriftPlan
from bench.tables import Goal, Table
from robocal_ros.cell_sim.cell import DUTY, kr150_cell, poses
from robocal_ros.cell_sim.robot import TrueRobot, Warmth
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.accuracy import AccuracyForecast, LearnedProcess, Work
from robocal_ros.thermal.drift_following import default_process
from robocal_ros.thermal.tracking import DriftTracker

Array = NDArray[np.float64]

PLAN = DriftPlan(((4.0, 1.0),), DUTY)
EVERY = 4  # cycles
BELOW = 0.95
TIP = np.array(setting.THERMAL.tip_m)
MM = 1e3


@dataclass(frozen=True)
class Way:
    """A way to state the bound: so long after a cycle, with one visit's scatter or without."""

    work: Work
    after_s: float = PERIOD_S
    scatter: bool = True

    def bound_m(self, tracker: DriftTracker, in_force: SerialArm, time_s: float) -> float:
        """What it says of a model in force since the cycle at a time."""
        if not self.scatter:
            tracker = copy(tracker)
            tracker.sigma_m = 0.0
        forecast = AccuracyForecast(tracker, in_force, self.work)
        return forecast.at(time_s + self.after_s).bound_m


AT_WORK = Work(poses("work"), TIP)
WAYS = {
    "whole workspace, the target": Way(Work()),
    "whole workspace, the tip": Way(Work(None, TIP)),
    "working poses, the target": Way(Work(poses("work"))),
    "working poses, the tip": Way(AT_WORK),
    "the same, right after the cycle": Way(AT_WORK, after_s=0.0),
    "the same, drift alone": Way(AT_WORK, scatter=False),
}


def drift_bound_table(seeds: Sequence[int]) -> Table:
    """Errors of the drift alone, and what can be said of them."""
    table = Table(
        "closed_loop_drift_bound",
        f"What the bound of ~/accuracy is made of: {len(seeds)} robots, four hours from cold",
        ("prior", "stated for", "mean 95 % bound, mm", "errors below it, %", "goal",
         "p95 of the errors, mm"),
        "Simulated at the pace of the cycles, one in five minutes; no tool, no scatter of the "
        "visits. Errors at the 27 working poses just before the next cycle. Learned: with motor "
        "temperatures, from three earlier shifts of the same robot, in the same six poses.",
    )  # fmt: skip
    made: dict[str, list[tuple[Array, Array]]] = {"default": [], "learned": []}
    nominal = load_robot("kr150_r3100")
    for seed in seeds:
        robot = kr150_cell(nominal, seed).robot
        default = default_process(nominal, setting.THERMAL.sigma_m)
        made["default"].append(_judged(nominal, robot, default, seed))
        made["learned"].append(_judged(nominal, robot, taught(nominal, robot, seed), seed))
    for prior, parts in made.items():
        error, bounds = (np.concatenate(part) for part in zip(*parts, strict=True))
        for i, (name, way) in enumerate(WAYS.items()):
            below = 100.0 * float(np.mean(error < bounds[:, i, None]))
            said = way == WAYS["working poses, the tip"]
            table.add(
                prior, name, MM * float(np.mean(bounds[:, i])), below,
                Goal(below, 100.0 * BELOW, at_least=True) if said else None,
                MM * float(np.quantile(error, 0.95)),
            )  # fmt: skip
    return table


def _judged(
    nominal: SerialArm, robot: TrueRobot, expected: LearnedProcess, seed: int
) -> tuple[Array, Array]:
    """Lengths of the errors (t, k) before every fourth cycle, and each way's bound (t, w)."""
    rng = np.random.default_rng([seed, 3])
    shift = seen(nominal, robot, PLAN, rng)
    tracker, rows = expected.tracker(shift.spots), AT_WORK.rows(shift.spots)
    cold, errors, bounds = shift.spots.cell.arm, [], []
    moved = _truth(robot)
    for i, (cycle, time_s) in enumerate(zip(shift.cycles, shift.time_s.tolist(), strict=True)):
        if expected.gains is not None and shift.temperature is not None:
            tracker.read_temperatures(shift.temperature[i], time_s)
        tracker.take(cycle, time_s)
        if i % EVERY or i + 1 == len(moved):
            continue
        drift, _ = tracker.drift(time_s)
        in_force = cold.with_mdh(cold.parameters.add(cold.mdh, drift))
        errors.append(np.linalg.norm(moved[i + 1] - rows @ drift, axis=1))
        bounds.append([way.bound_m(tracker, in_force, time_s) for way in WAYS.values()])
    return np.array(errors), np.array(bounds)


def _truth(robot: TrueRobot) -> Array:
    """True displacement (t, k, 3) of the tip at the working poses, by each cycle."""
    cold = robot.point(poses("work"), Warmth.cold(robot.nominal.n), TIP)
    return np.array([robot.point(poses("work"), state, TIP) - cold for _, state in PLAN.warmths()])
