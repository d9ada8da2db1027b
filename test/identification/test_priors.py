# SPDX-License-Identifier: Apache-2.0
"""The prior's width comes from the data: neither too narrow nor a licence for noise."""

from dataclasses import replace

import numpy as np
import pytest

from robocal_ros.identification import identify
from robocal_ros.identification.solve import (
    SMALLEST_SCALE,
    TOLERANCE_ANGLE_RAD,
    TOLERANCE_LENGTH_M,
    default_prior,
    fitted_prior,
)
from robocal_ros.kinematics.robots import load_robot

NOISE_M = 5e-5


def fitted_sizes(result) -> tuple[float, float]:
    """Spread of lengths, m, and of angles, rad, that the identification found plausible."""
    size = np.sqrt(np.diag(result.prior_covariance))
    lengths = result.nominal.parameters.is_length
    assert np.ptp(size[lengths]) < 1e-12
    assert np.ptp(size[~lengths]) < 1e-12
    return float(size[lengths][0]), float(size[~lengths][0])


@pytest.mark.parametrize(("length_m", "angle_rad"), [(2e-4, 2e-3), (2e-3, 2e-4), (1e-2, 3e-2)])
def test_spread_of_the_robot_is_found(make_cell, length_m, angle_rad):
    """Ten robots; a spread from 9 observable parameters of a kind is known to 24 % at best."""
    found = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        cell = make_cell(seed=seed, length_m=length_m, angle_rad=angle_rad)
        data = cell.measure(cell.postures(40, rng), rng, noise_m=NOISE_M)
        found.append(fitted_sizes(identify(cell.nominal, data)))
    rms = np.sqrt(np.mean(np.square(found), axis=0))
    assert rms == pytest.approx((length_m, angle_rad), rel=0.3)


def test_a_robot_without_deviations_gives_a_narrow_prior(make_cell):
    cell, rng = make_cell(length_m=0.0, angle_rad=0.0), np.random.default_rng(1)
    data = cell.measure(cell.postures(40, rng), rng, noise_m=NOISE_M)
    length, angle = fitted_sizes(identify(cell.nominal, data))
    assert length < 0.05 * TOLERANCE_LENGTH_M
    assert angle < 0.05 * TOLERANCE_ANGLE_RAD
    assert length >= SMALLEST_SCALE * TOLERANCE_LENGTH_M * (1.0 - 1e-12)


def test_data_that_say_nothing_leave_the_tolerances():
    arm = load_robot("kr150_r3100")
    prior = default_prior(arm)
    fitted = fitted_prior(arm, np.zeros(len(prior)), np.diag(prior * (1.0 - 1e-9)))
    np.testing.assert_allclose(fitted, prior, rtol=1e-6)


def test_few_poses_gain_from_it(make_cell):
    """Twelve poses about one posture: error throughout the workspace against the wide prior's."""
    wide, fitted, nominal = 0.0, 0.0, 0.0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        cell = make_cell(seed=seed)
        middle = np.radians([0.0, -80.0, 80.0, 20.0, 40.0, 0.0])
        q = middle + np.radians(15.0) * rng.uniform(-1.0, 1.0, (12, 6))
        data = cell.measure(q, rng, noise_m=NOISE_M)
        everywhere = cell.measure(cell.postures(150, rng), rng)

        def squared(arm, everywhere=everywhere) -> float:
            placed = identify(arm, everywhere, fit=("base", "tool"), robust=False).cell
            return float(np.mean(placed.residual(everywhere) ** 2))

        tolerances = np.diag(default_prior(cell.nominal))
        wide += squared(identify(cell.nominal, data, prior_covariance=tolerances).cell.arm)
        fitted += squared(identify(cell.nominal, data).cell.arm)
        nominal += squared(cell.nominal)
    assert fitted < 0.7 * wide
    assert fitted < nominal


def test_a_given_prior_is_not_touched(make_cell):
    cell, rng = make_cell(), np.random.default_rng(2)
    data = cell.measure(cell.postures(40, rng), rng, noise_m=NOISE_M)
    prior = np.diag(default_prior(cell.nominal))
    result = identify(cell.nominal, data, prior_covariance=prior)
    assert np.array_equal(result.prior_covariance, prior)
    assert identify(cell.nominal, data, method="lsq").prior_covariance is None


def test_sliding_joints_have_a_prior_too(make_cell, known_set_up):
    with pytest.warns(UserWarning, match="joint limits not given"):
        cell = make_cell("p1r2p3", ("p", "q"))
    rng = np.random.default_rng(3)
    data = cell.measure(cell.postures(30, rng), rng, noise_m=NOISE_M)
    result = identify(
        cell.nominal, data, fit=("geometry",), start=replace(known_set_up(cell), arm=cell.nominal)
    )
    assert np.all(np.diag(result.prior_covariance) > 0.0)
    error = result.cell.arm.parameters.read(result.cell.arm.mdh - cell.truth.arm.mdh)
    ratio = np.abs(error) / np.sqrt(np.diag(result.estimate.covariance))
    assert ratio.max() < 4.0
