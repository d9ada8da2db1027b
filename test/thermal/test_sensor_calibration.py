# SPDX-License-Identifier: Apache-2.0
"""Sensor and sphere placed from one cold visit: simulated truth, bound, refusals."""

import numpy as np
import pytest
from drift_cell import postures

from robocal_ros.cell_sim import kr150
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, TooFewSamplesError
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.cell_setup import calibrate_sensor, place_sensor, sensor_verdict

SIGMA = 2e-5
T_SENSOR_BASE, BALL = kr150.T_SENSOR_BASE, kr150.BALL


def visit(arm: SerialArm, q: np.ndarray, rng: np.random.Generator | None = None) -> Measurements:
    T = T_SENSOR_BASE @ arm.fk(q)
    p = T[:, :3, :3] @ BALL + T[:, :3, 3]
    if rng is not None:
        p = p + SIGMA * rng.standard_normal(p.shape)
    names = tuple(str(i) for i in range(len(q)))
    return Measurements(
        q=q, position=p, target=("ball",) * len(q), sample=names, sigma=np.full(len(q), SIGMA)
    )


@pytest.mark.parametrize("method", ["ml", "classic"])
def test_without_noise_both_are_exact(arm, method):
    found = calibrate_sensor(arm, visit(arm, postures(9)), method)
    assert found.T_sensor_base == pytest.approx(T_SENSOR_BASE, abs=1e-8)
    assert found.sphere_in_flange == pytest.approx(BALL, abs=1e-8)
    assert found.left_out.max() < 1e-8


def errors(arm: SerialArm, method: str, count: int) -> np.ndarray:
    """Errors (count, 9) in the order of the covariance, the first of them of the same visits."""
    q, rows = postures(9), []
    for seed in range(count):
        cell, _, _ = place_sensor(arm, visit(arm, q, np.random.default_rng(seed)), method)
        turn = frames.log_rotation(cell.T_frame_base[:3, :3] @ T_SENSOR_BASE[:3, :3].T)
        shift = cell.T_frame_base[:3, 3] - T_SENSOR_BASE[:3, 3]
        rows.append(np.concatenate([shift, turn, cell.T_flange_target[0, :3, 3] - BALL]))
    return np.array(rows)


def test_error_reaches_the_bound_and_the_covariance_is_true(arm):
    """The covariance at the truth is the Cramér-Rao bound of this Gaussian problem.

    The classic method is no better.
    """
    error = errors(arm, "ml", 300)
    bound = calibrate_sensor(arm, visit(arm, postures(9)), "ml").covariance
    ratio = np.sqrt(np.mean(error**2, axis=0) / np.diag(bound))
    # A standard deviation from 300 runs scatters by 4 %; the robust method rejects 1 % of visits.
    assert ratio.max() < 1.0 + 4.0 / np.sqrt(600.0)
    assert ratio.min() > 1.0 - 4.0 / np.sqrt(600.0)
    squared = np.einsum("ij,jk,ik->i", error, np.linalg.inv(bound), error)
    assert squared.mean() == pytest.approx(9.0, abs=4.0 * np.sqrt(18.0 / 300.0))
    classic = errors(arm, "classic", 100)
    assert np.mean(classic[:, :3] ** 2) > 0.9 * np.trace(bound[:3, :3]) / 3.0
    assert np.mean(error[:100, :3] ** 2) <= np.mean(classic[:, :3] ** 2)


def test_moving_the_sensor_moves_the_answer(arm):
    data = visit(arm, postures(9), np.random.default_rng(1))
    found = calibrate_sensor(arm, data)
    move = frames.transform(frames.exp_rotation([0.3, -1.0, 0.7]), [1.0, 2.0, -0.5])
    moved = calibrate_sensor(
        arm,
        Measurements(
            q=data.q,
            position=data.position @ move[:3, :3].T + move[:3, 3],
            target=data.target,
            sample=data.sample,
            sigma=data.sigma,
        ),
    )
    assert moved.T_sensor_base == pytest.approx(move @ found.T_sensor_base, abs=1e-9)
    assert moved.sphere_in_flange == pytest.approx(found.sphere_in_flange, abs=1e-9)


@pytest.mark.parametrize("off_m", [1e-3, 0.05])
def test_a_wrong_sample_is_named_and_does_no_harm(arm, off_m):
    """Nor does it to the verdict, which is of the poses that fit."""
    data = visit(arm, postures(12), np.random.default_rng(2))
    data.position[4, 1] += off_m
    found = calibrate_sensor(arm, data)
    assert found.rejected == ("4",)
    assert np.linalg.norm(found.sphere_in_flange - BALL) < 5.0 * np.linalg.norm(found.sigma[6:])
    verdict = sensor_verdict(found)
    assert verdict.accept, verdict.reason
    assert "not fitting: 4" in verdict.reason


@pytest.mark.parametrize("method", ["ml", "classic"])
def test_turns_about_one_axis_are_refused(arm, method):
    q = np.tile(postures(1), (9, 1))
    q[:, 5] += np.linspace(-2.0, 2.0, 9)
    with pytest.raises(RankDeficientError, match="second axis"):
        calibrate_sensor(arm, visit(arm, q), method)


def test_four_poses_are_too_few(arm):
    with pytest.raises(TooFewSamplesError, match="4 poses"):
        calibrate_sensor(arm, visit(arm, postures(4)))
