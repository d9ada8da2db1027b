# SPDX-License-Identifier: Apache-2.0
"""Planned poses: their error is what the design says, and less than that of random ones."""

import numpy as np
import pytest
from bent_robot import LOWER, UPPER, BentRobot
from long_form import amount

from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.identification import planning
from robocal_ros.identification.full_model import identify_full
from robocal_ros.identification.planning import plan_poses

CANDIDATES = np.random.default_rng(3).uniform(LOWER, UPPER, (600, 6))


@pytest.fixture(scope="module")
def plan():
    return plan_poses(BentRobot(0).nominal, CANDIDATES, CANDIDATES[:200], 120)


def test_errors_are_those_of_the_whole_information(plan):
    """Against one inverse of all information, instead of an update for each pose."""
    design = planning._design(BentRobot(0).nominal, CANDIDATES, CANDIDATES[:200])
    root = np.linalg.cholesky(design.prior + 1e-16 * np.eye(len(design.prior)))
    for count in (1, 20, 120):
        H = np.concatenate([planning._dense(design, i) for i in plan.chosen[:count]])
        H = H @ root / planning.NOISE_M
        left = root @ np.linalg.inv(np.eye(len(root)) + H.T @ H) @ root.T
        told = np.sqrt(np.trace(design.weight @ left))
        assert plan.predicted_rms_m[count - 1] == pytest.approx(told, rel=1e-3)


def test_each_pose_is_the_best_next_one(plan):
    design = planning._design(BentRobot(0).nominal, CANDIDATES, CANDIDATES[:200])
    others = np.setdiff1d(np.arange(600), plan.chosen[:20])[:40]
    for other in others:
        assert planning._after(design, np.append(plan.chosen[:19], other)) >= (
            plan.predicted_rms_m[19] * (1.0 - 1e-6)
        )


def test_planned_poses_leave_less_than_random_ones(plan):
    assert plan.predicted_rms_m[-1] < 0.9 * plan.random_rms_m
    assert len(np.unique(plan.chosen)) == 120
    squares = {"planned": [], "random": []}
    for seed in range(amount(2, 4)):
        robot = BentRobot(20 + seed)
        check = robot.measured(robot.poses(300), 0.0)
        draws = {"planned": plan.q, "random": robot.rng.permutation(CANDIDATES)[:120]}
        for name, q in draws.items():
            found = identify_full(robot.nominal, robot.measured(q))
            squares[name].append(np.mean(np.sum(found.cell.residual(check) ** 2, axis=1)))
    assert np.mean(squares["planned"]) < np.mean(squares["random"])


def test_what_cannot_be_planned_is_refused():
    arm = BentRobot(0).nominal
    with pytest.raises(TooFewSamplesError, match="10 candidates for 12 poses"):
        plan_poses(arm, CANDIDATES[:10], CANDIDATES[:10], 12)
    with pytest.raises(InputError, match="where no candidate has it"):
        plan_poses(arm, CANDIDATES, CANDIDATES + 1.0, 12)
