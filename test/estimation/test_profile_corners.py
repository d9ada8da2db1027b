# SPDX-License-Identifier: Apache-2.0
"""The corners of a staircase in a profile: accuracy, its own estimate of it, what is left out."""

import numpy as np
import pytest
from profile_shapes import (
    COLUMNS,
    NOISE_M,
    contaminated,
    mean_squares_agree,
    polyline_profile,
    stairs,
)

from robocal_ros.estimation.edge import CornerRule, fit_corners
from robocal_ros.ground.errors import ResidualError

STEPS = 4
COUNT = 2 * STEPS - 1
CONVEX = np.arange(COUNT) % 2 == 0
TILTS = np.radians([15.0, 30.0, 45.0, 60.0, 75.0])


def squares(fit, truth):
    return [
        e @ np.linalg.solve(C, e) for e, C in zip(fit.points - truth, fit.covariance, strict=True)
    ]


@pytest.mark.parametrize("tilt", TILTS)
def test_the_covariance_holds_whatever_the_tilt(tilt):
    rng = np.random.default_rng(1)
    found, errors = [], []
    for _ in range(30):
        vertices = stairs(STEPS, tilt + rng.uniform(-0.05, 0.05))
        fit = fit_corners(polyline_profile(vertices, rng), CornerRule(count=COUNT))
        assert np.array_equal(fit.convex, CONVEX)
        assert not np.any(fit.repaired)
        assert len(fit.left_out) == 0
        found.append(np.mean(squares(fit, vertices[1:-1])))
        sigma = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2))
        errors.append(np.mean((fit.points - vertices[1:-1]) / sigma, axis=0))
    # Neighbours share a surface: a profile counts as about half as many independent corners.
    assert abs(np.mean(found) / 2.0 - 1.0) < 0.05 + 3.5 * np.sqrt(2.0 / (30 * COUNT))
    scatter = 3.3 / np.sqrt(len(errors))
    assert np.all(np.abs(np.mean(errors, axis=0)) < 0.1 + scatter)


@pytest.mark.parametrize("noise", [5e-6, NOISE_M, 1e-4])
def test_steps_of_any_size_and_noise(noise):
    rng = np.random.default_rng(2)
    for _ in range(15):
        tread, rise = rng.uniform(0.006, 0.014, size=2)
        vertices = stairs(3, np.radians(rng.uniform(30.0, 60.0)), tread=tread, rise=rise)
        fit = fit_corners(polyline_profile(vertices, rng, noise=noise), CornerRule(count=5))
        # 99.99 % of a corner's chi-square, for 75 corners.
        assert np.max(squares(fit, vertices[1:-1])) < 2.0 * np.log(75 / 1e-3)
        assert fit.noise_m == pytest.approx(noise, rel=0.2)


def test_spikes_and_gaps():
    rng = np.random.default_rng(3)
    found = []
    complete = 0
    for _ in range(40):
        vertices = stairs(STEPS, np.radians(rng.uniform(35.0, 55.0)))
        points, _ = contaminated(polyline_profile(vertices, rng), rng, gaps=3)
        fit = fit_corners(points, CornerRule())
        complete += len(fit.points) == COUNT
        nearest = np.linalg.norm(fit.points[:, None] - vertices[1:-1], axis=2).argmin(axis=1)
        assert len(set(nearest)) == len(fit.points)
        assert np.array_equal(fit.convex, CONVEX[nearest])
        found += squares(fit, vertices[1:-1][nearest])
    # A surface of 80 columns or more outlasts two gaps of 25; all three hit one of the eight in one
    # profile of 64, and so four of 40 profiles once in 250 such sets.
    assert complete >= 37
    assert mean_squares_agree(np.array(found), 2)


def test_double_reflections_at_inner_corners():
    rng = np.random.default_rng(4)
    found = []
    for _ in range(40):
        vertices = stairs(STEPS, np.radians(rng.uniform(35.0, 55.0)))
        points = polyline_profile(vertices, rng)
        for corner in vertices[2:-1:2]:
            start = np.searchsorted(points[:, 0], corner[0]) + rng.integers(-12, 3)
            ghost = slice(start, start + rng.integers(8, 25))
            away = points[ghost, 0] - corner[0]
            height = corner[1] - rng.uniform(0.003, 0.008) + rng.uniform(-1.0, 1.0) * away
            points[ghost, 1] = height + rng.normal(scale=NOISE_M, size=len(away))
        fit = fit_corners(points, CornerRule(count=COUNT))
        found += squares(fit, vertices[1:-1])
    assert mean_squares_agree(np.array(found), 2)


def test_rounded_edges():
    rng = np.random.default_rng(5)
    found = []
    for _ in range(30):
        vertices = stairs(STEPS, np.radians(rng.uniform(35.0, 55.0)))
        points = polyline_profile(vertices, rng, noise=0.0)
        for corner, sign in zip(vertices[1:-1], np.where(CONVEX, 1.0, -1.0), strict=True):
            chamfer = corner[1] + sign * 1e-4
            near = np.abs(points[:, 0] - corner[0]) < 3e-4
            cut = np.maximum if sign > 0.0 else np.minimum
            points[near, 1] = cut(points[near, 1], chamfer)
        points[:, 1] += rng.normal(scale=NOISE_M, size=len(points))
        found += squares(fit_corners(points, CornerRule(count=COUNT)), vertices[1:-1])
    assert mean_squares_agree(np.array(found), 2)


def test_the_order_is_that_of_the_columns():
    rng = np.random.default_rng(6)
    points = polyline_profile(stairs(STEPS, 0.7), rng)
    fit = fit_corners(points, CornerRule())
    back = fit_corners(points[::-1], CornerRule())
    assert np.allclose(back.points[::-1], fit.points, atol=1e-12)
    assert np.array_equal(back.convex[::-1], fit.convex)


def jumps(rng, shadow):
    """Profile of two treads whose riser was not seen, the second one with a riser beside it."""
    x = COLUMNS
    z = np.where(x < 0.0, 0.194 + 0.3 * x, 0.203 + 0.3 * x)
    z = np.where(x > 0.02, 0.209 - 1.2 * (x - 0.02), z)
    points = np.column_stack([x, z + rng.normal(scale=NOISE_M, size=len(x))])
    return points[(x < 0.0) | (x > shadow)]


@pytest.mark.parametrize("shadow", [0.0, 0.002])
def test_a_riser_that_was_not_seen_gives_no_corner(shadow):
    rng = np.random.default_rng(7)
    for _ in range(10):
        fit = fit_corners(jumps(rng, shadow), CornerRule(count=1))
        truth = np.array([[0.02, 0.209]])
        assert np.max(squares(fit, truth)) < 2.0 * np.log(10 / 1e-3)
        assert not fit.convex[0]
        ends = np.array([[0.0, 0.194], [shadow, 0.203 + 0.3 * shadow]])
        assert np.allclose(fit.left_out, ends, atol=3e-4)


def test_a_wrong_count_is_refused_with_the_places():
    rng = np.random.default_rng(8)
    with pytest.raises(
        ResidualError,
        match=r"1 corners, expected 3; they are at .*; surfaces end .* \(-0\.0\d, 193\.\d+\)",
    ):
        fit_corners(jumps(rng, 0.0), CornerRule(count=3))


def test_a_plane_has_no_corner():
    rng = np.random.default_rng(9)
    for _ in range(20):
        points, _ = contaminated(polyline_profile(np.array([[-0.05, 0.2], [0.05, 0.21]]), rng), rng)
        with pytest.raises(ResidualError, match="0 corners"):
            fit_corners(points, CornerRule())


def test_noise_free_corners_are_exact_and_the_classic_ones_are_a_column_off():
    vertices = stairs(STEPS, np.radians(40.0))
    points = polyline_profile(vertices, np.random.default_rng(0), noise=0.0)
    best = fit_corners(points, CornerRule(count=COUNT))
    assert np.allclose(best.points, vertices[1:-1], atol=1e-8)
    classic = fit_corners(points, CornerRule(count=COUNT, classic=True))
    column = COLUMNS[1] - COLUMNS[0]
    assert np.array_equal(classic.convex, CONVEX)
    # A median of five columns is no more than two of them away.
    assert np.all(np.abs(classic.points[:, 0] - vertices[1:-1, 0]) <= 2.0 * column)


def test_classic_errors_are_as_large_as_it_says():
    rng = np.random.default_rng(10)
    errors, sigmas = [], []
    for _ in range(40):
        vertices = stairs(STEPS, np.radians(rng.uniform(40.0, 50.0)))
        points = polyline_profile(vertices, rng)
        fit = fit_corners(points, CornerRule(count=COUNT, classic=True))
        errors.append(fit.points - vertices[1:-1])
        sigmas.append(np.diagonal(fit.covariance, axis1=1, axis2=2))
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(sigmas))
    # It says a column, as a rule of thumb: a median of five moves a corner by two at most.
    assert 0.5 < ratio < 2.0


def test_classic_repairs_an_outlying_corner():
    rng = np.random.default_rng(11)
    for _ in range(20):
        vertices = stairs(STEPS, np.radians(45.0))
        points = polyline_profile(vertices, rng)
        away = np.minimum(np.abs(points[:, 0] - vertices[3, 0]) / 2.4e-3, 1.0)
        points[:, 1] -= 2.5e-4 * (1.0 + np.cos(np.pi * away))  # dirt on the second outer edge
        fit = fit_corners(points, CornerRule(count=COUNT, classic=True))
        assert np.array_equal(fit.repaired, np.arange(COUNT) == 2)
        assert abs(fit.points[2, 1] - vertices[3, 1]) < 2e-4


def test_dirt_on_an_edge_moves_no_corner():
    rng = np.random.default_rng(12)
    found = []
    for _ in range(30):
        vertices = stairs(STEPS, np.radians(rng.uniform(35.0, 55.0)))
        points = polyline_profile(vertices, rng)
        at = np.searchsorted(points[:, 0], vertices[3, 0])
        points[at - 2 : at + 3, 1] -= 6e-4
        found += squares(fit_corners(points, CornerRule(count=COUNT)), vertices[1:-1])
    assert mean_squares_agree(np.array(found), 2)
