# SPDX-License-Identifier: Apache-2.0
"""The centre of a sphere of known radius, from clouds with stem, background and spikes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robocal_ros.cell_sim.sensors import CloudScene, sphere_cloud
from robocal_ros.estimation.sphere import SphereRule, fit_sphere
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, ResidualError, TooFewSamplesError

RADIUS = 0.01905
RULE = SphereRule(RADIUS)
CENTRE = np.array([0.05, -0.03, 0.7])
CLEAN = CloudScene(stem=0.0, background=0.0, spikes=0.0)


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_without_noise_the_centre_is_exact():
    cloud = sphere_cloud(CENTRE, 500, rng(0), replace(CLEAN, noise_m=0.0))
    fit = fit_sphere(cloud, RULE)
    assert fit.centre == pytest.approx(CENTRE, abs=1e-12)
    assert np.all(fit.used)


def test_error_is_what_the_covariance_says():
    """Normalised squared errors of 400 clouds: chi-square of 1200 degrees, within 4 sigma."""
    squared, error = [], []
    for seed in range(400):
        fit = fit_sphere(sphere_cloud(CENTRE, 1000, rng(seed)), RULE)
        miss = fit.centre - CENTRE
        squared.append(miss @ np.linalg.solve(fit.covariance, miss))
        error.append(miss)
    assert np.sum(squared) == pytest.approx(1200.0, abs=4.0 * np.sqrt(2400.0))
    assert np.abs(np.mean(error, axis=0)).max() < 4.0 * np.std(error) / np.sqrt(400.0)


def test_noise_and_radius_are_found():
    fit = fit_sphere(sphere_cloud(CENTRE, 2000, rng(1), CLEAN), RULE)
    assert fit.noise_m == pytest.approx(3e-5, rel=4.0 / np.sqrt(2.0 * 2000.0))
    assert abs(fit.radius_m - RADIUS) < 4.0 * fit.radius_sigma_m
    assert np.degrees(fit.half_angle_rad) == pytest.approx(60.0, abs=3.0)


@pytest.mark.parametrize(
    "scene",
    [
        CloudScene(stem=0.3, background=0.2, spikes=0.05),
        CloudScene(stem=0.05, background=0.85, spikes=0.02),
    ],
)
@pytest.mark.parametrize("seed", range(20))
def test_points_of_stem_and_background_are_left_out(scene, seed):
    cloud = sphere_cloud(CENTRE, 2000, rng(seed), scene)
    fit = fit_sphere(cloud, RULE)
    far = np.abs(np.linalg.norm(cloud - CENTRE, axis=1) - RADIUS) > 3e-4
    assert not np.any(fit.used & far)
    miss = fit.centre - CENTRE
    assert miss @ np.linalg.solve(fit.covariance, miss) < 21.1  # 1e-4 of chi-square with 3


@settings(max_examples=25, deadline=None)
@given(
    st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    st.tuples(*[st.floats(-2.0, 2.0)] * 3),
    st.integers(0, 1000),
)
def test_moving_the_frame_moves_the_centre(turn, shift, seed):
    cloud = sphere_cloud(CENTRE, 800, rng(seed))
    fit = fit_sphere(cloud, RULE)
    R = frames.exp_rotation(np.array(turn))
    moved = fit_sphere(cloud @ R.T + shift, RULE)
    # The same points at the rejection limit may fall otherwise: a hundredth of a sigma.
    near = 0.01 * np.sqrt(np.trace(fit.covariance))
    assert moved.centre == pytest.approx(R @ fit.centre + shift, abs=near)
    spread = R @ fit.covariance @ R.T
    assert np.linalg.norm(moved.covariance - spread) < 0.02 * np.linalg.norm(spread)


def test_missing_points_are_left_out():
    cloud = sphere_cloud(CENTRE, 500, rng(3))
    holes = np.vstack([cloud, np.full((100, 3), np.nan)])
    fit = fit_sphere(holes, RULE)
    assert np.array_equal(fit.centre, fit_sphere(cloud, RULE).centre)
    assert not np.any(fit.used[500:])


REFUSALS = [
    (replace(CLEAN, half_angle_rad=np.radians(12.0)), ResidualError, r"half angle of 1\d deg"),
    (replace(CLEAN, radius_m=0.0200), ResidualError, r"radius of 19\.9\d\d mm.*19\.050 mm"),
    (replace(CLEAN, noise_m=4e-4), ResidualError, r"scatter by 0\.\d+ mm.*allowed 0\.200 mm"),
]


@pytest.mark.parametrize(("scene", "error", "words"), REFUSALS)
def test_a_refusal_names_the_figure_that_failed(scene, error, words):
    with pytest.raises(error, match=words):
        fit_sphere(sphere_cloud(CENTRE, 2000, rng(4), scene), RULE)


def test_a_centre_known_too_badly_is_refused():
    scene = replace(CLEAN, noise_m=1.5e-4)
    with pytest.raises(ResidualError, match=r"centre to 0\.0\d\d mm \(allowed 0\.030 mm\)"):
        fit_sphere(sphere_cloud(CENTRE, 60, rng(5), scene), RULE)


@pytest.mark.parametrize(
    ("cloud", "words"),
    [
        (np.zeros((10, 3)), "10 points"),
        (np.zeros((100, 3)), "no sphere of radius"),
        (1e3 * sphere_cloud(CENTRE, 300, rng(6)), "unit of the cloud"),
    ],
)
def test_what_is_no_sphere_is_said(cloud, words):
    with pytest.raises(TooFewSamplesError, match=words):
        fit_sphere(cloud, RULE)


def test_a_profile_of_a_line_laser_is_no_cap():
    """Its circle is of the sphere, which lies on either side: no radius is wrong there."""
    x = np.linspace(-0.01, 0.01, 400)
    depth = np.sqrt(RADIUS**2 - 0.009**2 - x**2) + 2e-5 * rng(7).standard_normal(len(x))
    profile = np.column_stack([x, 0.0 * x, 0.2 - depth])
    turned = profile @ frames.exp_rotation([0.3, -1.0, 0.5]).T + CENTRE
    no_return = [[1e10, 0.0, 0.0], [3.4e38, 1.0, 0.0]]
    beside = np.vstack([turned, no_return])
    for cloud in (profile, turned.astype(np.float32), beside):
        with pytest.raises(RankDeficientError, match=r"lie in one plane.*a cap must be seen"):
            fit_sphere(cloud, RULE)
