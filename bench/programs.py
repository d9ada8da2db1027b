# SPDX-License-Identifier: Apache-2.0
"""Frames shifted and programs corrected for a robot that warms up: how much of its work is right.

The robot is the simulator's (`cell_sim.robot`): elastic, with gears that err, its drift of the
published size. What corrects it knows only what a sphere sensor measured, six poses a cycle.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from bench.measured_shifts import MEASURING, TOOL, DriftingCell, Warmth, record
from bench.robot_programs import NOMINAL, T_BASE_FRAME, krl, poses_in
from bench.robot_programs import T_FLANGE_TOOL as T_FLANGE_TAUGHT
from bench.tables import Goal, Table
from bench.thermal_shifts import SEEDS, Array, Measured, cell_of
from robocal_ros.cell_sim.robot import Effects
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import inverse
from robocal_ros.programs.correcting import ProgramCorrection, dialect_of
from robocal_ros.programs.frame_shift import best_shift, shifted_joints
from robocal_ros.programs.postures import CorrectionModels
from robocal_ros.thermal.accuracy import EarlierShift, learn_process
from robocal_ros.thermal.screening import share_within

ROBOTS = SEEDS[:5]
OF_BEST, OF_PROGRAM = 0.95, 98.0  # goals: of the best shift's share; %
T_FLANGE_TOOL = frames.transform(np.eye(3), TOOL)
COLD = Warmth.cold(NOMINAL.n)
SOME = slice(3, None, 6)  # of the 90 cycles of a shift


@dataclass(frozen=True)
class MeasuredShift:
    """A cell, and of some cycles of a shift the warmth and the arm that was identified then."""

    cell: DriftingCell
    states: list[Warmth]
    arms: list[SerialArm]

    def error(self, k: int, q: Array) -> Array:
        """Where the tool stands at commanded joints (m, n), from where the cold robot's stood."""
        robot, meant = self.cell.robot, self.cell.check
        return robot.point(q, self.states[k], TOOL) - robot.point(meant, COLD, TOOL)


@cache
def measured_shift(seed: int) -> MeasuredShift:
    """A shift of one robot, its drift followed as thermal_node does."""
    cell = cell_of(seed, Effects())
    shifts = [record(cell, cell.plans[i], np.random.default_rng([seed, i])) for i in (0, 2)]
    teacher = Measured.of(NOMINAL, shifts[1], range(len(cell.sphere)))
    taught = [replace(cycle, sigma=None) for cycle in teacher.cycles]
    process = learn_process([EarlierShift(teacher.spots, taught, teacher.time_s)])
    seen, arms = Measured.of(NOMINAL, shifts[0], MEASURING), []
    tracker = process.tracker(seen.spots)
    for cycle, time_s in zip(seen.cycles, seen.time_s.tolist(), strict=True):
        tracker.take(replace(cycle, sigma=None), time_s)
        drift = tracker.drift(time_s)[0]
        arms.append(NOMINAL.with_mdh(NOMINAL.parameters.add(NOMINAL.mdh, drift)))
    states = [state for _, state in cell.plans[0].warmths()]
    return MeasuredShift(cell, states[SOME], arms[SOME])


def true_best(shift: MeasuredShift, k: int) -> Array:
    """The error (c, 3) that the best shift leaves, by the truth: linear least squares.

    A tool's turn does not move its tip: nine numbers.
    """
    T, error = NOMINAL.fk(shift.cell.check) @ T_FLANGE_TOOL, shift.error(k, shift.cell.check)
    moved = [
        np.concatenate([np.eye(3), -frames.skew(one[:3, 3]), one[:3, :3]], axis=1) for one in T
    ]
    A = np.concatenate(moved)
    return error - (A @ np.linalg.lstsq(A, error.ravel(), rcond=None)[0]).reshape(-1, 3)


@dataclass(frozen=True)
class ShiftShares:
    """Shares of the error's coordinates within 0.1 mm, over the cycles of a shift."""

    as_taught: float
    shifted: float
    best: float


def shift_shares(shift: MeasuredShift) -> ShiftShares:
    """Both frames shifted in each cycle.

    Raises `ValueError` where the robot cannot follow a shift.
    """
    q, left, best, without = shift.cell.check, [], [], []
    for k, arm in enumerate(shift.arms):
        models = CorrectionModels(NOMINAL, arm, NOMINAL)
        found = best_shift(models, q, T_FLANGE_TOOL)
        moved, there = shifted_joints(
            models, q, T_FLANGE_TOOL, found.T_base_shift, found.T_tool_shift
        )
        if not np.all(there):
            raise ValueError(f"cycle {k}: {np.count_nonzero(~there)} poses are not reached")
        left.append(shift.error(k, moved))
        best.append(true_best(shift, k))
        without.append(shift.error(k, q))
    return ShiftShares(*(share_within(np.array(e)) for e in (without, left, best)))


def program_share(shift: MeasuredShift, cycles: Sequence[int]) -> float:
    """The share of a program that is corrected in some of the cycles.

    Its text goes through the file: corrected, read by a controller of our own, driven by the robot.

    Raises `ValueError` where a point is not corrected.
    """
    q, left = shift.cell.check, []
    text = krl(q, np.empty((0, 6)))
    known = {"TOOL_DATA[3]": T_FLANGE_TAUGHT, "BASE_DATA[5]": T_BASE_FRAME}
    for k in cycles:
        models = CorrectionModels(NOMINAL, shift.arms[k], NOMINAL)
        done = ProgramCorrection(dialect_of(".dat"), models, known).correct(text)
        if len(done.points) != len(q) or any(one.reason for one in done.points):
            raise ValueError(f"cycle {k}: {[one.reason for one in done.points]}")
        told = poses_in("kuka", done.text)[0]
        commanded = [inverse(NOMINAL, T[None], near)[0] for T, near in zip(told, q, strict=True)]
        left.append(shift.error(k, np.array(commanded)))
    return share_within(np.array(left))


def tables() -> list[Table]:
    """One table, a row for each robot."""
    count = len(measured_shift(ROBOTS[0]).cell.check)
    table = Table(
        "frame_shift",
        f"Simulated shift of a KR 150 that warms up, {count} poses: coordinates within 0.1 mm",
        (
            "robot",
            "as taught, %",
            "frames shifted, %",
            "best shift by the truth, %",
            "shifted of best",
            "program corrected, %",
            "goal",
        ),
        "Frames shifted, program corrected: by what the sphere sensor measured, in every sixth of "
        "the 90 cycles. The best shift is found with the true robot.",
    )
    for seed in ROBOTS:
        shift = measured_shift(seed)
        shares = shift_shares(shift)
        program = 100.0 * program_share(shift, range(len(shift.arms)))
        table.add(
            seed,
            100.0 * shares.as_taught,
            100.0 * shares.shifted,
            100.0 * shares.best,
            Goal(shares.shifted / shares.best, OF_BEST, at_least=True),
            program,
            Goal(program, OF_PROGRAM, at_least=True),
        )
    return [table]
