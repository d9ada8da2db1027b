# SPDX-License-Identifier: Apache-2.0
"""The arc of a sphere in a profile: accuracy, its own estimate of it, and what is refused."""

import numpy as np
import pytest
from long_form import amount, more
from profile_shapes import (
    COLUMNS,
    NOISE_M,
    arc_profile,
    contaminated,
    mean_squares_agree,
    polyline_profile,
    stairs,
)

from robocal_ros.estimation.sphere import ArcFit, ArcRule, fit_arc
from robocal_ros.ground.errors import InputError, ResidualError, TooFewSamplesError

R = 0.02

FORM_M = 3e-5


def circle(rng, r):
    return (rng.uniform(-0.012, 0.012), 0.195 + r + rng.uniform(-0.003, 0.003), r)


def error(fit: ArcFit, truth) -> np.ndarray:
    return np.append(fit.centre, fit.radius_m) - truth


def bound(truth, noise, half_angle):
    """Cramer-Rao bound of (x0, z0, r) with the noise along the normal: every point is used."""
    sine = (COLUMNS - truth[0]) / truth[2]
    sine = sine[np.abs(sine) < np.sin(half_angle)]
    J = np.column_stack([sine, -np.sqrt(1.0 - sine**2), np.ones(len(sine))])
    return np.linalg.inv(J.T @ J) * noise**2


@pytest.mark.parametrize("along", ["normal", "beam"])
@pytest.mark.parametrize("dirty", [False, True])
@pytest.mark.parametrize("r", [0.3 * R, *more(0.6 * R, R)])
def test_the_covariance_holds_and_the_bias_is_small(along, dirty, r):
    rng = np.random.default_rng(11)
    squares, normalised = [], []
    for _ in range(120):
        truth = circle(rng, r)
        points, _ = arc_profile(truth, rng, along=along)
        if dirty:
            points, _ = contaminated(points, rng)
        fit = fit_arc(points, ArcRule(R))
        e = error(fit, truth)
        squares.append(e @ np.linalg.solve(fit.covariance, e))
        normalised.append(e / np.sqrt(np.diag(fit.covariance)))
    assert mean_squares_agree(np.array(squares), 3)
    scatter = 3.3 / np.sqrt(len(normalised))
    assert np.all(np.abs(np.mean(normalised, axis=0)) < 0.1 + scatter)


def test_the_error_is_near_the_bound():
    rng, draws = np.random.default_rng(12), amount(150, 500)
    half_angle = np.radians(60.0)
    ratios = []
    for _ in range(draws):
        truth = circle(rng, R)
        points, _ = arc_profile(truth, rng, half_angle=half_angle)
        e = error(fit_arc(points, ArcRule(R)), truth)
        ratios.append(e @ np.linalg.solve(bound(truth, NOISE_M, half_angle), e) / 3.0)
    # 3.5 standard deviations of the root of a mean of 3 squares for each draw
    assert abs(np.sqrt(np.mean(ratios)) - 1.0) < 3.5 / np.sqrt(2.0 * 3 * draws)


@pytest.mark.parametrize("noise", [5e-6, 1.2e-4])
def test_the_noise_is_estimated(noise):
    rng = np.random.default_rng(2)
    points, on = arc_profile(circle(rng, R), rng, noise=noise)
    fit = fit_arc(points, ArcRule(R))
    assert fit.noise_m == pytest.approx(noise, rel=4.0 / np.sqrt(2.0 * np.sum(on)))


def test_a_noise_free_arc_is_exact():
    truth = (0.004, 0.215, 0.017)
    points, _ = arc_profile(truth, np.random.default_rng(0), noise=0.0)
    assert np.all(np.abs(error(fit_arc(points, ArcRule(R)), truth)) < 1e-8)


def test_the_points_of_the_arc_are_told_from_others():
    rng = np.random.default_rng(3)
    for _ in range(50):
        points, on = arc_profile(circle(rng, 0.8 * R), rng)
        points, left = contaminated(points, rng)
        clean = on[left] & (np.abs(points[:, 1] - arc_height(points, on[left])) < 5e-4)
        used = fit_arc(points, ArcRule(R)).used
        assert np.sum(used & ~clean) <= 2
        # Lost: half a window of 13 columns at either rim, where the table begins, and spikes so
        # small that they are called clean here, 0.6 of 410 points on average (Poisson: seldom 6).
        assert np.sum(~used & clean) <= 2 * 6 + 5


def arc_height(points, on):
    """Heights (n,) of the arc from the median of seven columns: simple, rough and independent."""
    from scipy.ndimage import median_filter

    return np.where(on, median_filter(points[:, 1], 7, mode="nearest"), np.inf)


def test_a_stem_beside_the_sphere_is_no_part_of_it():
    rng = np.random.default_rng(4)
    squares = []
    for _ in range(100):
        truth = circle(rng, 0.7 * R)
        points, _ = arc_profile(truth, rng, half_angle=np.radians(80.0))
        stem = points[:, 0] > truth[0] + 0.85 * truth[2]
        height = truth[1] - 0.6 * truth[2] + 0.1 * points[stem, 0]
        points[stem, 1] = height + rng.normal(scale=NOISE_M, size=np.sum(stem))
        fit = fit_arc(points, ArcRule(R))
        squares.append(error(fit, truth) @ np.linalg.solve(fit.covariance, error(fit, truth)))
    assert mean_squares_agree(np.array(squares), 3)


def test_a_double_reflection_is_no_part_of_the_arc():
    rng = np.random.default_rng(5)
    squares = []
    for _ in range(100):
        truth = circle(rng, R)
        points, on = arc_profile(truth, rng)
        start = rng.choice(np.flatnonzero(on)[:-60])
        points[start : start + 60, 1] += 0.004 + 0.1 * (points[start : start + 60, 0] - truth[0])
        fit = fit_arc(points, ArcRule(R))
        squares.append(error(fit, truth) @ np.linalg.solve(fit.covariance, error(fit, truth)))
    assert mean_squares_agree(np.array(squares), 3)


def test_a_small_part_of_the_profile_is_enough():
    rng = np.random.default_rng(6)
    for _ in range(50):
        truth = (rng.uniform(-0.03, 0.03), 0.2, 0.003)
        points, on = arc_profile(truth, rng)
        assert np.sum(on) < 0.07 * len(points)
        fit = fit_arc(points, ArcRule(0.005))
        assert np.all(np.abs(error(fit, truth)) < 5.0 * np.sqrt(np.diag(fit.covariance)))


def test_columns_without_a_return_and_their_order_change_nothing():
    rng = np.random.default_rng(7)
    points, _ = arc_profile(circle(rng, R), rng)
    fit = fit_arc(points, ArcRule(R))
    holed = np.insert(points, 300, np.nan, axis=0)
    again = fit_arc(holed, ArcRule(R))
    assert np.array_equal(np.delete(again.used, 300), fit.used)
    assert not again.used[300]
    assert np.array_equal(again.centre, fit.centre)
    back = fit_arc(points[::-1], ArcRule(R))
    assert np.allclose(back.centre, fit.centre, atol=0.2 * np.sqrt(fit.covariance[0, 0]))


def test_an_arc_larger_than_the_sphere_is_refused():
    rng = np.random.default_rng(8)
    points, _ = arc_profile(circle(rng, R), rng)
    with pytest.raises(ResidualError, match=r"radius (19\.9|20\.0).*15\.000 mm"):
        fit_arc(points, ArcRule(0.015))


@pytest.mark.parametrize(("given", "word"), [(20.0, "large"), (2e-5, "small")])
def test_a_radius_in_another_unit_is_named(given, word):
    rng = np.random.default_rng(9)
    points, _ = arc_profile(circle(rng, 0.9 * R), rng)
    said = f"1000 times too {word} for this arc: check its unit"
    with pytest.raises(InputError, match=said):
        fit_arc(points, ArcRule(given))


def test_a_short_arc_is_refused():
    rng = np.random.default_rng(10)
    points, _ = arc_profile(circle(rng, R), rng, half_angle=np.radians(8.0), table=False)
    with pytest.raises(ResidualError, match="too short"):
        fit_arc(points, ArcRule(R))


@pytest.mark.parametrize(
    "vertices",
    [np.array([[-0.05, 0.2], [0.05, 0.205]]), stairs(4, np.radians(45.0)), stairs(3, 0.6)],
    ids=["table", "stairs", "tilted stairs"],
)
def test_a_profile_without_a_sphere_is_refused(vertices):
    rng = np.random.default_rng(13)
    for _ in range(20):
        points, _ = contaminated(polyline_profile(vertices, rng), rng)
        with pytest.raises((ResidualError, TooFewSamplesError)):
            fit_arc(points, ArcRule(R))


def test_much_noise_is_refused():
    rng = np.random.default_rng(14)
    points, _ = arc_profile(circle(rng, R), rng, noise=3e-4)
    with pytest.raises(ResidualError, match=r"scatter by 0\.[23]"):
        fit_arc(points, ArcRule(R))


def test_a_smooth_form_has_its_share_of_the_covariance():
    """Real profiles differ from a circle by more than they scatter, by a smooth function."""
    rng = np.random.default_rng(21)
    squares, forms = [], []
    for _ in range(80):
        truth = circle(rng, R)
        points, _ = arc_profile(truth, rng, noise=6e-6, table=False)
        x = np.linspace(-1.0, 1.0, len(points))
        size = FORM_M * np.sqrt(2 * np.arange(7) + 1.0) / np.sqrt(7.0)
        shape = np.polynomial.legendre.legval(x, size * rng.standard_normal(7))
        normal = points - np.array(truth[:2])
        points += shape[:, None] * normal / np.linalg.norm(normal, axis=1)[:, None]
        fit = fit_arc(points, ArcRule(R, radius_tolerance_m=1e-3))
        squares.append(error(fit, truth) @ np.linalg.solve(fit.covariance, error(fit, truth)))
        forms.append(fit.form_m)
    # How large the 7 degrees are is known from 4 of them: the median of 3 F(3, 4) is 2.8, and
    # that of 80 runs scatters by 0.3.
    assert 2.0 < float(np.median(squares)) < 4.0
    seen = FORM_M * np.sqrt(4.0 / 7.0)
    assert abs(float(np.sqrt(np.mean(np.square(forms)))) / seen - 1.0) < 0.25
