# SPDX-License-Identifier: Apache-2.0
"""Drift identification against a simulated truth: recovery, honesty, and what it cannot see."""

import json
from dataclasses import replace

import numpy as np
import pytest
from joint_errors import with_joint_errors

from robocal_ros.estimation.assessment import Judgement
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError, ResidualError
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import CellModel
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.identification import (
    CycleDrift,
    drift_prior,
    identify_cycle,
    judge_cycle,
    learned_prior,
)
from robocal_ros.thermal.reference import (
    COMMISSIONED,
    ColdReference,
    capture_reference,
    commissioned_of,
    reference_document,
    reference_of,
)

SIGMA_M = 2e-5
BALL = np.array([0.10, 0.05, 0.20, 1.0])
T_SENSOR_BASE = frames.transform(frames.exp_rotation([0.3, -0.2, 1.0]), [2.0, 1.0, -0.5])


@pytest.fixture(scope="module")
def cold(nominal: SerialArm) -> SerialArm:
    """The robot as built: off its nominal model by tenths of a mm and hundredths of a degree."""
    rng = np.random.default_rng(5)
    size = np.where(nominal.parameters.is_length, 3e-4, np.radians(0.01))
    return nominal.with_mdh(nominal.parameters.add(nominal.mdh, size * rng.normal(size=len(size))))


def drifted(cold: SerialArm, covariance: np.ndarray, rng: np.random.Generator) -> SerialArm:
    change = np.linalg.cholesky(covariance) @ rng.normal(size=len(covariance))
    return cold.with_mdh(cold.parameters.add(cold.mdh, change))


def postures(arm: SerialArm, count: int, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(np.maximum(arm.lower, -1.6), np.minimum(arm.upper, 1.6), (count, arm.n))


def visit(arm: SerialArm, q: np.ndarray, rng: np.random.Generator, noise: float = SIGMA_M):
    position = (T_SENSOR_BASE @ arm.fk(q) @ BALL)[:, :3]
    return Measurements(
        q=q,
        position=position + noise * rng.normal(size=position.shape),
        target=("ball",) * len(q),
        sample=tuple(str(i) for i in range(len(q))),
    )


def identified(
    reference: ColdReference, warm: Measurements, prior: np.ndarray, *, in_force: SerialArm
) -> tuple[CycleDrift, Judgement]:
    """The set-up stands still here, so nothing is laid to it."""
    spots = reference.spots
    found = identify_cycle(spots, warm, prior_covariance=prior, sigma_m=SIGMA_M, setup_sigma_m=1e-9)
    return found, judge_cycle(found, spots, in_force=in_force, sigma_m=SIGMA_M)


def drift_error(found: SerialArm, reference: SerialArm, warm: SerialArm, cold: SerialArm, q):
    """Error (m, 3) of the ball's identified displacement, base axes."""
    moved = (warm.fk(q) - cold.fk(q)) @ BALL
    return ((found.fk(q) - reference.fk(q)) @ BALL - moved)[:, :3]


def test_a_reference_keeps_the_joint_functions_of_its_arm(nominal, cold):
    arm, rng = with_joint_errors(cold, 1), np.random.default_rng(0)
    q = postures(arm, 20, rng)
    cell = CellModel(arm, T_SENSOR_BASE, ("ball",), frames.transform(np.eye(3), BALL[:3])[None])
    reference = ColdReference(cell, visit(arm, q, rng))
    document = json.loads(json.dumps(reference_document(reference)))
    back = reference_of(document, nominal).cell.arm
    np.testing.assert_array_equal(back.fk(q), arm.fk(q))
    commissioned = commissioned_of(document | {COMMISSIONED: nominal.mdh.tolist()}, nominal)
    np.testing.assert_array_equal(commissioned.fk(q), arm.with_mdh(nominal.mdh).fk(q))


@pytest.mark.parametrize(
    ("seed", "runs", "times", "error_of_mean"), [(11, 150, 1, 0.08), (12, 60, 10, 0.12)]
)
def test_expected_error_is_the_achieved_one(nominal, cold, seed, runs, times, error_of_mean):
    """Truth drawn from the prior: squared errors match the predicted variance.

    The cold model of the session is the true one, so that the statement is about the drift
    alone. Each run gives about 3 effective numbers per check pose, strongly correlated. Ten warm
    visits of each pose share its one cold visit, and do not pass for independent ones.
    """
    rng = np.random.default_rng(seed)
    prior = drift_prior(nominal)
    q, check = postures(nominal, 8, rng), postures(nominal, 40, rng)
    ratio = []
    for _ in range(runs):
        warm = drifted(cold, prior, rng)
        reference = capture_reference(cold, visit(cold, q, rng))
        data = visit(warm, np.tile(q, (times, 1)), rng)
        found, _ = identified(reference, data, prior, in_force=cold)
        error = drift_error(found.arm, cold, warm, cold, check)
        rows = reference.spots.rows(check, np.zeros(len(check), dtype=np.int64))[0]
        predicted = np.einsum("mik,kl,mil->", rows, found.covariance, rows)
        ratio.append(np.sum(error**2) / predicted)
    spread = np.std(ratio) / np.sqrt(len(ratio))
    assert spread < error_of_mean
    assert abs(np.mean(ratio) - 1.0) < 4.0 * spread


def test_drift_is_recovered_and_accepted(nominal, cold):
    rng = np.random.default_rng(2)
    warm = drifted(cold, drift_prior(nominal), rng)
    q = postures(nominal, 12, rng)
    reference = capture_reference(nominal, visit(cold, q, rng))
    found, judged = identified(
        reference, visit(warm, q, rng), drift_prior(nominal), in_force=nominal
    )
    check = postures(nominal, 200, rng)
    error = drift_error(found.arm, nominal, warm, cold, check)
    before = drift_error(nominal, nominal, warm, cold, check)
    assert judged.verdict.code is Code.ACCEPT
    assert np.sqrt(np.mean(error**2)) < 0.4 * np.sqrt(np.mean(before**2))


def test_one_ball_cannot_tell_the_last_joints_parameters_apart(nominal, cold):
    rng = np.random.default_rng(3)
    q = postures(nominal, 20, rng)
    reference = capture_reference(nominal, visit(cold, q, rng))
    found, _ = identified(reference, visit(cold, q, rng), drift_prior(nominal), in_force=nominal)
    assert found.seen.rank == 23
    (words,) = found.unobservable
    named = {name for name in nominal.parameters.names if f" {name}" in f" {words}"}
    assert named <= {"d6_mm", "theta6_deg", "a6_mm", "alpha6_deg"}
    assert len(named) >= 2


def test_no_drift_is_no_gain(nominal, cold):
    """Without any drift, chance must not bring a model into force more often than 1 in 20."""
    rng = np.random.default_rng(4)
    q = postures(nominal, 8, rng)
    accepted = 0
    for _ in range(60):
        reference = capture_reference(nominal, visit(cold, q, rng))
        _, judged = identified(
            reference, visit(cold, q, rng), drift_prior(nominal), in_force=nominal
        )
        accepted += judged.verdict.accept
    assert accepted <= 8  # 99.7 % bound of a binomial with 60 trials at 5 %


def test_static_errors_cancel(nominal, cold):
    """Whatever the robot's static error, the same drift is found (noise-free, linear regime)."""
    rng = np.random.default_rng(6)
    q = postures(nominal, 12, rng)
    prior = drift_prior(nominal)
    change = 0.1 * np.linalg.cholesky(prior) @ rng.normal(size=len(prior))
    moved = []
    for built in (nominal, cold):
        warm = built.with_mdh(built.parameters.add(built.mdh, change))
        reference = capture_reference(nominal, visit(built, q, rng, noise=0.0))
        found, _ = identified(reference, visit(warm, q, rng, noise=0.0), prior, in_force=nominal)
        check = postures(nominal, 50, np.random.default_rng(0))
        moved.append((found.arm.fk(check) - nominal.fk(check)) @ BALL)
    # static errors turn the drift by about 1e-3 rad: a thousandth of 0.05 mm
    assert np.abs(moved[0] - moved[1]).max() < 2e-6


def test_an_outlier_neither_moves_the_model_nor_the_verdict(nominal, cold):
    rng = np.random.default_rng(13)
    warm = drifted(cold, drift_prior(nominal), rng)
    q = postures(nominal, 12, rng)
    reference = capture_reference(nominal, visit(cold, q, rng))
    measured = visit(warm, q, rng)
    measured.position[5] += [0.0, 0.02, 0.0]
    found, judged = identified(reference, measured, drift_prior(nominal), in_force=nominal)
    assert [found.warm.sample[i] for i in np.flatnonzero(found.rejected)] == ["5"]
    assert judged.held_out_rejected == ("5",)
    assert judged.candidate.n == 11
    assert judged.verdict.code is Code.ACCEPT


def test_a_pose_without_cold_visit_is_refused(nominal, cold):
    rng = np.random.default_rng(7)
    q = postures(nominal, 8, rng)
    reference = capture_reference(nominal, visit(cold, q, rng))
    elsewhere = replace(visit(cold, q, rng), q=q + np.radians(2.0))
    with pytest.raises(InputError, match="not measured in the cold reference"):
        identified(reference, elsewhere, drift_prior(nominal), in_force=nominal)


def test_learned_prior_tends_to_the_true_covariance():
    rng = np.random.default_rng(8)
    truth, default = np.diag([4.0, 1.0, 0.25]), np.eye(3)
    drifts = rng.normal(size=(4000, 3)) * np.sqrt(np.diag(truth))
    learned = learned_prior(default, drifts, np.zeros((4000, 3, 3)))
    # a variance from 4000 draws has a relative standard error of sqrt(2/4000) = 2.2 %
    np.testing.assert_allclose(np.diag(learned), np.diag(truth), rtol=0.1)


def test_learned_prior_keeps_the_default_where_nothing_was_seen():
    unseen = np.tile(np.diag([1e-6, 1.0]), (50, 1, 1))
    drifts = np.zeros((50, 2))
    learned = learned_prior(np.eye(2), drifts, unseen)
    assert learned[1, 1] == pytest.approx(1.0)
    assert learned[0, 0] < 0.2


def test_a_cold_visit_of_another_robot_is_no_reference(nominal, cold):
    """A joint that counts the other way is named; what cannot be named is refused by its size."""
    rng = np.random.default_rng(9)
    q = postures(nominal, 20, rng)
    turned = visit(cold, q * np.array([1, 1, 1, -1, 1, 1]), rng)
    with pytest.raises(InputError, match="counts the other way"):
        capture_reference(nominal, replace(turned, q=q))
    noise = visit(cold, q, rng, noise=0.01)
    with pytest.raises(ResidualError, match="mm rms, more than any robot's static error"):
        capture_reference(nominal, noise)


def test_a_cold_sample_that_does_not_fit_is_named(nominal, cold):
    rng = np.random.default_rng(10)
    measured = visit(cold, postures(nominal, 14, rng), rng)
    measured.position[3] += [0.0, 0.05, 0.0]
    assert capture_reference(nominal, measured).rejected == ("3",)
