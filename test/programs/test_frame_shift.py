# SPDX-License-Identifier: Apache-2.0
"""Frames shifted and programs corrected for a robot that warms up: how much of its work is right.

The robot is the simulator's (`cell_sim.robot`): elastic, with gears that err, its drift of the
published size. What corrects it knows only what a sphere sensor measured, six poses a cycle.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from robot_programs import NOMINAL, T_BASE_FRAME, drifted, krl, poses_in, postures
from robot_programs import T_FLANGE_TOOL as TAUGHT

from bench.measured_shifts import MEASURING, TOOL, DriftingCell, Warmth, record
from bench.thermal_shifts import Measured, cell_of
from robocal_ros.cell_sim.robot import Effects
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import inverse
from robocal_ros.programs.correcting import CorrectionModels, ProgramCorrection, dialect_of
from robocal_ros.programs.frame_shift import best_shift, shifted_joints
from robocal_ros.thermal.accuracy import EarlierShift, learn_process
from robocal_ros.thermal.screening import share_within

T_FLANGE_TOOL = frames.transform(np.eye(3), TOOL)
COLD = Warmth.cold(NOMINAL.n)
SOME = slice(3, None, 6)  # of the 90 cycles of a shift


@dataclass(frozen=True)
class MeasuredShift:
    """A cell, and of some cycles of a shift the warmth and the arm that was identified then."""

    cell: DriftingCell
    states: list[Warmth]
    arms: list[SerialArm]

    def error(self, k: int, q: np.ndarray) -> np.ndarray:
        """Where the tool stands at commanded joints (m, n), from where the cold robot's stood."""
        robot, meant = self.cell.robot, self.cell.check
        return robot.point(q, self.states[k], TOOL) - robot.point(meant, COLD, TOOL)


@cache
def measured_shift(seed: int) -> MeasuredShift:
    cell = cell_of(seed, Effects())
    shifts = [record(cell, cell.plans[i], np.random.default_rng([seed, i])) for i in (0, 2)]
    teacher = Measured.of(NOMINAL, shifts[1], range(len(cell.sphere)))
    taught = [replace(cycle, sigma=None) for cycle in teacher.cycles]
    process = learn_process([EarlierShift(teacher.spots, taught, teacher.time_s)])
    seen, arms = Measured.of(NOMINAL, shifts[0], MEASURING), []
    tracker = process.tracker(seen.spots)  # as thermal_node follows a drift
    for cycle, time_s in zip(seen.cycles, seen.time_s.tolist(), strict=True):
        tracker.take(replace(cycle, sigma=None), time_s)
        drift = tracker.drift(time_s)[0]
        arms.append(NOMINAL.with_mdh(NOMINAL.parameters.add(NOMINAL.mdh, drift)))
    states = [state for _, state in cell.plans[0].warmths()]
    return MeasuredShift(cell, states[SOME], arms[SOME])


def true_best(shift: MeasuredShift, k: int) -> np.ndarray:
    """The error (c, 3) that the best shift leaves, by the truth: linear least squares.

    A tool's turn does not move its tip: nine numbers.
    """
    T, error = NOMINAL.fk(shift.cell.check) @ T_FLANGE_TOOL, shift.error(k, shift.cell.check)
    moved = [
        np.concatenate([np.eye(3), -frames.skew(one[:3, 3]), one[:3, :3]], axis=1) for one in T
    ]
    A = np.concatenate(moved)
    return error - (A @ np.linalg.lstsq(A, error.ravel(), rcond=None)[0]).reshape(-1, 3)


@pytest.mark.parametrize("seed", [1, 8])
def test_a_shift_of_frames_does_nearly_what_any_could(seed):
    shift = measured_shift(seed)
    q, left, best, without = shift.cell.check, [], [], []
    for k, arm in enumerate(shift.arms):
        models = CorrectionModels(NOMINAL, arm, NOMINAL)
        found = best_shift(models, q, T_FLANGE_TOOL)
        moved, there = shifted_joints(
            models, q, T_FLANGE_TOOL, found.T_base_shift, found.T_tool_shift
        )
        assert np.all(there)
        left.append(shift.error(k, moved))
        best.append(true_best(shift, k))
        without.append(shift.error(k, q))
    assert share_within(np.array(without)) == pytest.approx(0.45, abs=0.03)
    assert share_within(np.array(left)) >= 0.95 * share_within(np.array(best))


@pytest.mark.parametrize("seed", [1, 8])
def test_of_a_corrected_program_98_percent_is_right(seed):
    """Its text goes through the file: corrected, read by a controller, driven by the robot."""
    shift, left = measured_shift(seed), []
    q = shift.cell.check
    text = krl(q, np.empty((0, 6)))
    assert len(dialect_of(".dat").read(text).points) == len(q)
    known = {"TOOL_DATA[3]": TAUGHT, "BASE_DATA[5]": T_BASE_FRAME}
    for k in range(1, len(shift.arms), 4):
        models = CorrectionModels(NOMINAL, shift.arms[k], NOMINAL)
        done = ProgramCorrection(dialect_of(".dat"), models, known).correct(text)
        assert not [one.reason for one in done.points if one.reason]
        told = poses_in("kuka", done.text)[0]
        commanded = [inverse(NOMINAL, T[None], near)[0] for T, near in zip(told, q, strict=True)]
        left.append(shift.error(k, np.array(commanded)))
    assert share_within(np.array(left)) >= 0.98


def test_what_is_a_shift_of_frames_is_found_to_nothing():
    """A robot whose base and flange were moved: nothing remains, and the frames say how much."""
    turn = frames.exp_rotation(np.radians([0.02, -0.03, 0.05]))
    T_base = frames.transform(turn, [3e-4, -2e-4, 5e-4])
    q = postures(20, 12)
    moved = replace(NOMINAL, T_base_root=np.linalg.inv(T_base) @ NOMINAL.T_base_root)
    found = best_shift(CorrectionModels(NOMINAL, moved, NOMINAL), q, T_FLANGE_TOOL)
    # up to the weight that holds the frames: 20 poses against one
    assert np.max(np.linalg.norm(found.after[:, :3], axis=1)) < 1e-8
    assert np.median(np.linalg.norm(found.before[:, :3], axis=1)) > 5e-4
    np.testing.assert_allclose(found.T_base_shift, T_base, atol=1e-7)
    np.testing.assert_allclose(found.T_tool_shift, np.eye(4), atol=1e-7)


def test_only_the_frames_that_may_move_do():
    models = CorrectionModels(NOMINAL, drifted(NOMINAL, 1), NOMINAL)
    q = postures(30, 12)
    shifts = [best_shift(models, q, T_FLANGE_TOOL, parts=parts) for parts in (("base",), ("tool",))]
    assert np.array_equal(shifts[0].T_tool_shift, np.eye(4))
    assert np.array_equal(shifts[1].T_base_shift, np.eye(4))
    both = best_shift(models, q, T_FLANGE_TOOL)
    cost = [
        np.sum(one.after[:, :3] ** 2 + (0.1 * one.after[:, 3:]) ** 2) for one in (*shifts, both)
    ]
    assert cost[2] < min(cost[:2]) < np.sum(both.before[:, :3] ** 2)


def test_a_weight_draws_the_shift_to_its_pose():
    models, q = CorrectionModels(NOMINAL, drifted(NOMINAL, 1), NOMINAL), postures(30, 12)
    weight = np.ones(30)
    plain = best_shift(models, q, T_FLANGE_TOOL)
    worst = int(np.argmax(np.linalg.norm(plain.after[:, :3], axis=1)))
    weight[worst] = 1e4
    drawn = best_shift(models, q, T_FLANGE_TOOL, weight=weight)
    size = [np.linalg.norm(one.after[worst, :3]) for one in (plain, drawn)]
    assert size[1] < 0.05 * size[0]


def test_with_one_orientation_base_and_tool_do_not_run_apart():
    """Milling: only the sum of both shifts is told, and neither becomes large."""
    start = np.radians([20.0, -70.0, 80.0, 35.0, 50.0, -60.0])
    T = np.repeat(NOMINAL.fk(start)[None], 12, axis=0)
    T[:, :3, 3] += np.random.default_rng(3).uniform(-0.12, 0.12, (12, 3))
    q = np.array([inverse(NOMINAL, np.linspace(T[0], one, 9), start)[-1] for one in T])
    found = best_shift(CorrectionModels(NOMINAL, drifted(NOMINAL, 1), NOMINAL), q, T_FLANGE_TOOL)
    largest = np.max(np.linalg.norm(found.before[:, :3], axis=1))
    for shift in (found.T_base_shift, found.T_tool_shift):
        point = shift[:3, :3] @ T[0, :3, 3] + shift[:3, 3] - T[0, :3, 3]
        assert min(np.linalg.norm(point), np.linalg.norm(shift[:3, 3])) < 2.0 * largest
    assert np.max(np.linalg.norm(found.after[:, :3], axis=1)) < 0.5 * largest


def test_a_shift_that_no_joints_follow_is_told():
    q, far = postures(2, 12), frames.transform(np.eye(3), [9.0, 0.0, 0.0])
    models = CorrectionModels(NOMINAL, NOMINAL, NOMINAL)
    _, found = shifted_joints(models, q, T_FLANGE_TOOL, far, np.eye(4))
    assert not np.any(found)
