# SPDX-License-Identifier: Apache-2.0
"""The drift of one cycle in closed form: bound, forecasts of each pose from the others, verdict."""

from dataclasses import replace

import numpy as np
import pytest
from drift_cell import SIGMA, cell_of, drifted, postures, visit

from robocal_ros.ground.errors import Code, RankDeficientError, TooFewSamplesError
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.identification import (
    drift_prior,
    identify_cycle,
    identify_subset,
    judge_cycle,
)
from robocal_ros.thermal.reference import ColdSpots


def draw(arm: SerialArm, rng: np.random.Generator) -> np.ndarray:
    return np.sqrt(np.diag(drift_prior(arm))) * rng.standard_normal(len(arm.parameters))


def test_error_is_what_the_covariance_says(arm):
    cell, q, prior = cell_of(arm), postures(6), drift_prior(arm)
    runs, k, squared, within = 300, len(arm.parameters), 0.0, []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        spots = ColdSpots.of(cell, visit(cell, q, rng))
        drift = draw(arm, rng)
        found = identify_cycle(
            spots, visit(drifted(cell, drift), q, rng),
            prior_covariance=prior, sigma_m=SIGMA, setup_sigma_m=1e-9,
        )  # fmt: skip
        miss = found.drift - drift
        squared += float(miss @ np.linalg.solve(found.covariance, miss))
        within.append(np.mean(np.sum(found.left_out**2, axis=1) / found.left_out_sigma**2))
    # One run in a thousand may lose a sample, which does not show here.
    assert squared == pytest.approx(runs * k, abs=4.0 * np.sqrt(2.0 * runs * k))
    assert np.mean(within) == pytest.approx(1.0, abs=4.0 * np.std(within) / np.sqrt(runs))


def test_a_pose_left_out_is_a_pose_not_used(arm):
    cell, q, prior = cell_of(arm), postures(6), drift_prior(arm)
    rng = np.random.default_rng(1)
    spots = ColdSpots.of(cell, visit(cell, q, rng))
    warm = visit(drifted(cell, draw(arm, rng)), q, rng)
    options = {"prior_covariance": prior, "sigma_m": SIGMA, "setup_sigma_m": 1e-9}
    whole = identify_cycle(spots, warm, **options)
    assert not np.any(whole.rejected)
    for i in range(6):
        others = identify_cycle(spots, warm.take(np.arange(6) != i), **options)
        one = warm.take(np.array([i]))
        A = spots.rows(one.q, spots.target[spots.match(one)])[0][0]
        assert whole.left_out[i] == pytest.approx(spots.drift(one)[0] - A @ others.drift, abs=1e-9)


def test_the_drift_is_linear_enough(arm):
    """0.1 mrad over 3 m: the second order leaves tens of nanometres; noise-free, prior flat."""
    cell, q = cell_of(arm), postures(40)
    drift = draw(arm, np.random.default_rng(2))
    there = drifted(cell, drift)
    found = identify_cycle(
        ColdSpots.of(cell, visit(cell, q)), visit(there, q),
        prior_covariance=1e4 * drift_prior(arm), sigma_m=1e-6, setup_sigma_m=1e-12,
    )  # fmt: skip
    check = postures(50, 9)
    predicted = visit(replace(cell, arm=found.arm), check).position
    assert predicted == pytest.approx(visit(there, check).position, abs=2e-7)


def test_visits_of_one_pose_count_as_one(arm):
    cell, q, prior = cell_of(arm), postures(6), drift_prior(arm)
    rng = np.random.default_rng(3)
    spots = ColdSpots.of(cell, visit(cell, q, rng))
    twice = visit(drifted(cell, draw(arm, rng)), np.vstack([q, q]), rng)
    found = identify_cycle(spots, twice, prior_covariance=prior, sigma_m=SIGMA)
    assert len(found.warm) == 6
    assert found.warm.sigma == pytest.approx(SIGMA / np.sqrt(2.0))
    assert set(found.warm.sample) == {f"{i}+{i + 6}" for i in range(6)}


def test_a_real_drift_is_accepted_and_noise_alone_is_not(arm):
    cell, q, prior = cell_of(arm), postures(8), drift_prior(arm)
    accepted = {True: 0, False: 0}
    for seed in range(40):
        for moved in (True, False):
            rng = np.random.default_rng(seed)
            spots = ColdSpots.of(cell, visit(cell, q, rng))
            there = drifted(cell, 2.0 * draw(arm, rng)) if moved else cell
            found = identify_cycle(
                spots, visit(there, q, rng), prior_covariance=prior, sigma_m=SIGMA
            )
            judged = judge_cycle(found, spots, in_force=arm, sigma_m=SIGMA)
            accepted[moved] += judged.verdict.accept
            if judged.verdict.accept:
                assert judged.candidate.rms_m < judged.current.rms_m
    # A drift displaces each pose at random in three directions: gains like chi-square, 3 of each.
    # The mean of eight then exceeds the t test's limit in 99.7 % of cases (by simulation); more
    # than two failures of 40 have a chance of 3e-4.
    assert accepted[True] >= 38
    assert accepted[False] <= 6  # 5 % of 40, within three standard deviations


def test_check_poses_judge_where_they_are_given(arm):
    cell, q, prior = cell_of(arm), postures(8), drift_prior(arm)
    rng = np.random.default_rng(4)
    check = postures(12, 5)
    spots = ColdSpots.of(cell, visit(cell, np.vstack([q, check]), rng))
    there = drifted(cell, 2.0 * draw(arm, rng))
    found = identify_cycle(spots, visit(there, q, rng), prior_covariance=prior, sigma_m=SIGMA)
    judged = judge_cycle(found, spots, in_force=arm, check=visit(there, check, rng), sigma_m=SIGMA)
    assert judged.candidate.n == 12
    assert judged.verdict.code is Code.ACCEPT
    assert judged.candidate.rms_m < 3.0 * judged.predicted_total_rms_m


def test_one_pose_is_too_few(arm):
    cell, q = cell_of(arm), postures(1)
    spots = ColdSpots.of(cell, visit(cell, q))
    with pytest.raises(TooFewSamplesError, match="one pose"):
        identify_cycle(spots, visit(cell, q), prior_covariance=drift_prior(arm), sigma_m=SIGMA)


NAMES = ("a1_mm", "a2_mm", "d4_mm", "beta2_deg")


def test_a_subset_is_exact_where_only_it_drifts(arm):
    cell, q = cell_of(arm), postures(6)
    drift = np.where([name in NAMES for name in arm.parameters.names], 1e-4, 0.0)
    drift = np.where(arm.parameters.is_length, drift, drift * 0.1)
    spots = ColdSpots.of(cell, visit(cell, q))
    found = identify_subset(spots, visit(drifted(cell, drift), q), NAMES, sigma_m=SIGMA)
    assert found.drift == pytest.approx(drift, abs=1e-7)


def test_a_subset_forecasts_a_pose_as_its_fit_without_it(arm):
    cell, q, rng = cell_of(arm), postures(8), np.random.default_rng(6)
    spots = ColdSpots.of(cell, visit(cell, q, rng))
    warm = visit(drifted(cell, draw(arm, rng)), q, rng)
    whole = identify_subset(spots, warm, NAMES, sigma_m=SIGMA)
    for i in range(8):
        others = identify_subset(spots, warm.take(np.arange(8) != i), NAMES, sigma_m=SIGMA)
        one = warm.take(np.array([i]))
        A = spots.rows(one.q, spots.target[spots.match(one)])[0][0]
        assert whole.left_out[i] == pytest.approx(spots.drift(one)[0] - A @ others.drift, abs=1e-12)


def test_parameters_that_poses_do_not_show_are_refused(arm):
    q = np.tile(postures(1), (6, 1))
    q[:, 5] += np.linspace(-1.0, 1.0, 6)
    cell = cell_of(arm)
    spots = ColdSpots.of(cell, visit(cell, q))
    names, words = ("d1_mm", "a1_mm", "a2_mm", "theta1_deg"), set()
    for given in (names, names[::-1]):
        with pytest.raises(RankDeficientError, match="not determined by these poses") as refused:
            identify_subset(spots, visit(cell, q), given, sigma_m=SIGMA)
        words.add(str(refused.value))
    assert len(words) == 1  # whatever the order of the names
