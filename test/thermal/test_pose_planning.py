# SPDX-License-Identifier: Apache-2.0
"""Planned poses: reachable, seen, and the best of their candidates."""

from itertools import combinations

import numpy as np
import pytest
from drift_cell import SIGMA, cell_of, drifted, postures, visit

from robocal_ros.cell_sim import kr150
from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError, TooFewSamplesError
from robocal_ros.identification.cell_model import CellModel
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.cell_setup import (
    Design,
    SensorField,
    candidate_poses,
    choose,
    plan_poses,
    shortest_way,
)
from robocal_ros.thermal.identification import drift_prior, identify_cycle
from robocal_ros.thermal.reference import SETUP_SIGMA_M, ColdSpots

FIELD = SensorField()


@pytest.fixture(scope="module")
def candidates(arm: SerialArm) -> np.ndarray:
    return candidate_poses(cell_of(arm), FIELD, 200, np.random.default_rng(0))


def design_of(arm: SerialArm, candidates: np.ndarray, cell: CellModel | None = None) -> Design:
    return Design.of(
        cell or cell_of(arm),
        candidates,
        postures(40, 5),
        kr150.TOOL,
        drift_prior(arm),
        SIGMA,
        1,
    )


def test_candidates_are_reachable_and_seen(arm, candidates):
    assert np.all(candidates >= arm.lower)
    assert np.all(candidates <= arm.upper)
    cell = cell_of(arm)
    sphere = cell.predict(candidates, np.zeros(200, dtype=np.int64))[:, :3, 3]
    assert np.all(FIELD.holds(sphere))
    stem = (cell.T_frame_base @ arm.fk(candidates))[:, :3, 3] - sphere
    cosine = np.sum(stem * -sphere, axis=1)
    cosine /= np.linalg.norm(stem, axis=1) * np.linalg.norm(sphere, axis=1)
    assert cosine.max() <= np.cos(np.radians(60.0))
    assert np.ptp(np.degrees(candidates[:, 3:]), axis=0).min() > 90.0  # the wrist is varied


def test_the_same_draw_gives_the_same_candidates(arm):
    draws = [candidate_poses(cell_of(arm), FIELD, 20, np.random.default_rng(3)) for _ in range(2)]
    assert np.array_equal(*draws)


def test_a_sensor_out_of_reach_is_said(arm):
    far = frames.transform(np.eye(3), [0.0, 0.0, 20.0])
    cell = cell_of(arm)
    away = CellModel(arm, far @ cell.T_frame_base, cell.targets, cell.T_flange_target)
    with pytest.raises(LimitError, match="where the sensor stands"):
        candidate_poses(away, FIELD, 20, np.random.default_rng(0))


def test_the_choice_is_the_best_of_all(arm, candidates):
    """Exchange from several starts against every subset of four of twelve."""
    for start in range(0, 60, 12):
        design = design_of(arm, candidates[start : start + 12])
        best = min(design.error(list(subset)) for subset in combinations(range(12), 4))
        assert design.error(list(choose(design, 4))) == pytest.approx(best, rel=1e-9)


def test_gains_are_what_one_more_visit_brings(arm, candidates):
    design = design_of(arm, candidates[:20])
    chosen = [2, 7]
    gains = design.gains(design.covariance(chosen))
    for i in (0, 5, 11):
        expected = design.error(chosen) ** 2 - design.error([*chosen, i]) ** 2
        assert gains[i] == pytest.approx(expected, rel=1e-9)


def test_planned_poses_beat_random_ones_by_a_third(arm, candidates):
    plan = plan_poses(design_of(arm, candidates), candidates, 6, np.random.default_rng(1))
    assert plan.predicted_rms_m <= 2.0 / 3.0 * plan.random_rms_m
    assert plan.predicted_rms_m < plan.before_rms_m
    assert len(plan.q) == 6
    assert {*map(tuple, plan.q)} <= {*map(tuple, candidates)}


def test_the_predicted_error_is_the_achieved_one(arm, candidates):
    """Drifts drawn from the prior, the set-up still within its allowance: mean squared errors."""
    cell, prior = cell_of(arm), drift_prior(arm)
    design = design_of(arm, candidates)
    chosen = list(choose(design, 6))
    q, working, squared = candidates[chosen], postures(40, 5), []
    J = arm.parameter_jacobian(working, kr150.TOOL)[:, :3]
    for seed in range(300):
        rng = np.random.default_rng(seed)
        drift = np.sqrt(np.diag(prior)) * rng.standard_normal(len(prior))
        shift = SETUP_SIGMA_M * rng.standard_normal(6)
        cold, warm = visit(cell, q, rng), visit(drifted(cell, drift), q, rng)
        spots = ColdSpots.of(cell, cold)
        warm.position[:] += np.einsum(
            "mij,j->mi", spots.rows(q, np.zeros(6, dtype=np.int64))[1], shift
        )
        found = identify_cycle(spots, warm, prior_covariance=prior, sigma_m=SIGMA)
        squared.append(np.mean(np.sum((J @ (found.drift - drift)) ** 2, axis=1)))
    spread = np.std(squared) / np.sqrt(len(squared))
    assert np.mean(squared) == pytest.approx(design.error(chosen) ** 2, abs=4.0 * spread)


def test_moving_the_sensor_frame_changes_nothing(arm, candidates):
    cell = cell_of(arm)
    turned = frames.transform(frames.exp_rotation([0.3, 1.0, -0.2]), [1.0, 2.0, 3.0])
    moved = CellModel(arm, turned @ cell.T_frame_base, cell.targets, cell.T_flange_target)
    here, there = design_of(arm, candidates), design_of(arm, candidates, moved)
    # Which they are: of starts that end at the same ones, rounding picks, and with it the order.
    assert sorted(choose(here, 4)) == sorted(choose(there, 4))
    assert here.error([1, 2, 3]) == pytest.approx(there.error([1, 2, 3]), rel=1e-9)


def test_the_way_is_the_shortest():
    q = np.array([[0.0], [3.0], [1.0], [2.0]])
    assert shortest_way(q) in ((0, 2, 3, 1), (1, 3, 2, 0))


def test_too_few_candidates_are_said(arm, candidates):
    with pytest.raises(TooFewSamplesError, match="3 candidates for 6 poses"):
        choose(design_of(arm, candidates[:3]), 6)
