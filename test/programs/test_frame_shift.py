# SPDX-License-Identifier: Apache-2.0
"""Frames shifted and programs corrected for a robot that warms up: how much of its work is right.

Five robots stand on docs/programs.md, by `bench programs`; one of them is looked at here.
"""

from dataclasses import replace

import numpy as np
import pytest
from long_form import more

from bench.programs import (
    OF_BEST,
    OF_PROGRAM,
    T_FLANGE_TOOL,
    measured_shift,
    program_share,
    shift_shares,
)
from bench.robot_programs import NOMINAL, drifted, postures
from robocal_ros.ground import frames
from robocal_ros.kinematics.arm import inverse
from robocal_ros.programs.frame_shift import best_shift, shifted_joints
from robocal_ros.programs.postures import CorrectionModels


@pytest.mark.parametrize("seed", [1, *more(8)])
def test_a_shift_of_frames_does_nearly_what_any_could(seed):
    shares = shift_shares(measured_shift(seed))
    assert shares.as_taught == pytest.approx(0.45, abs=0.03)
    assert shares.shifted >= OF_BEST * shares.best


@pytest.mark.parametrize("seed", [1, *more(8)])
def test_of_a_corrected_program_98_percent_is_right(seed):
    shift = measured_shift(seed)
    assert 100.0 * program_share(shift, range(1, len(shift.arms), 4)) >= OF_PROGRAM


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
