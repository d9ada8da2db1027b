# SPDX-License-Identifier: Apache-2.0
"""An edge or a groove in a profile: accuracy, its own estimate of it, and what is refused."""

import numpy as np
import pytest
from long_form import more
from profile_shapes import (
    COLUMNS,
    NOISE_M,
    contaminated,
    mean_squares_agree,
    polyline_profile,
    turned,
)

from robocal_ros.estimation.edge import EdgeRule, fit_edge
from robocal_ros.ground.errors import ResidualError

COLUMN_M = float(COLUMNS[1] - COLUMNS[0])


def roof(kind, rng, half_angle):
    """Vertices (3, 2) of two surfaces that meet in the middle one."""
    x = np.array([-0.02, 0.0, 0.02]) + rng.uniform(-0.005, 0.005)
    rise = 0.02 / np.tan(half_angle) * (1.0 if kind == "edge" else -1.0)
    return turned(np.column_stack([x, [0.2 + rise, 0.2, 0.2 + rise]]), rng.uniform(-0.4, 0.4))


def square(fit, truth):
    return (fit.point - truth) @ np.linalg.solve(fit.covariance, fit.point - truth)


@pytest.mark.parametrize("kind", ["edge", "groove"])
@pytest.mark.parametrize("dirty", [False, True])
@pytest.mark.parametrize("half_angle", np.radians([45.0, *more(70.0)]))
def test_the_covariance_holds_and_the_bias_is_small(kind, dirty, half_angle):
    rng = np.random.default_rng(1)
    squares, normalised = [], []
    for _ in range(70):
        vertices = roof(kind, rng, half_angle)
        points = polyline_profile(vertices, rng)
        if dirty:
            points, _ = contaminated(points, rng, gaps=2)
        fit = fit_edge(points, EdgeRule(kind=kind))
        squares.append(square(fit, vertices[1]))
        normalised.append((fit.point - vertices[1]) / np.sqrt(np.diag(fit.covariance)))
    assert mean_squares_agree(np.array(squares), 2)
    scatter = 3.3 / np.sqrt(len(normalised))
    assert np.all(np.abs(np.mean(normalised, axis=0)) < 0.1 + scatter)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_surface_that_falls_away_ends_within_a_column(mirrored):
    rng = np.random.default_rng(2)
    squares, errors = [], []
    for _ in range(100):
        at, slope = rng.uniform(-0.01, 0.01), rng.uniform(-0.5, 0.5)
        z = np.where(at > COLUMNS, 0.195 + slope * (COLUMNS - at), 0.206 + 0.1 * COLUMNS)
        points = np.column_stack([COLUMNS, z + rng.normal(scale=NOISE_M, size=len(z))])
        if mirrored:
            points, at = points[::-1] * [-1.0, 1.0], -at
        fit = fit_edge(points, EdgeRule())
        squares.append(square(fit, [at, 0.195]))
        errors.append(fit.point[0] - at)
    # Uniform over a column, and the noise of the last point along the slope t, in x NOISE_M t /
    # (1 + t^2): 0.12 columns on average and 0.21 at most: one in ten is beyond half a column, and
    # 3.5 standard deviations of 100 such; none, one point lost, is beyond 0.5 + 4 x 0.21 + 1.
    assert np.mean(np.abs(errors) <= 0.5 * COLUMN_M) > 0.9 - 3.5 * np.sqrt(0.9 * 0.1 / 100)
    assert np.max(np.abs(errors)) < 2.34 * COLUMN_M
    # The fit counts the uniform error, not that noise, which adds 0.21 of its variance. The square
    # of a normalised uniform error has a variance of 0.8, of a normal one (across) of 2.
    assert abs(np.mean(squares) / 2.0 - 1.105) < 3.5 * np.sqrt((0.8 + 2.0) / 4.0 / 100)


def v_groove(rng):
    """Vertices (5, 2) of a plate with a groove 6 mm wide and 4 mm deep."""
    vertices = np.array([[-0.03, 0.2], [-0.003, 0.2], [0.0, 0.204], [0.003, 0.2], [0.03, 0.2]])
    return turned(vertices, rng.uniform(-0.2, 0.2))


def test_a_groove_in_a_plate():
    rng = np.random.default_rng(3)
    squares = []
    for _ in range(40):
        vertices = v_groove(rng)
        points = polyline_profile(vertices, rng)
        squares.append(square(fit_edge(points, EdgeRule(kind="groove")), vertices[2]))
        with pytest.raises(ResidualError, match=r"2 edges, at \(-[23]\.\d+, .*expected one"):
            fit_edge(points, EdgeRule(kind="edge"))
    assert mean_squares_agree(np.array(squares), 2)


@pytest.mark.parametrize("kind", ["edge", "groove"])
def test_a_plane_has_neither(kind):
    rng = np.random.default_rng(4)
    for _ in range(20):
        plane = polyline_profile(np.array([[-0.05, 0.2], [0.05, 0.21]]), rng)
        points, _ = contaminated(plane, rng)
        with pytest.raises(ResidualError, match=f"0 {kind}s"):
            fit_edge(points, EdgeRule(kind=kind))


def test_an_end_behind_missing_columns_is_not_guessed():
    rng = np.random.default_rng(5)
    z = np.where(COLUMNS < 0.0, 0.195, 0.206) + rng.normal(scale=NOISE_M, size=len(COLUMNS))
    points = np.column_stack([COLUMNS, z])[(COLUMNS < -0.002) | (COLUMNS > 0.001)]
    with pytest.raises(ResidualError, match="0 edges"):
        fit_edge(points, EdgeRule())


@pytest.mark.parametrize("kind", ["edge", "groove"])
def test_the_classic_form_is_refined_below_a_column_but_blunts_the_edge(kind):
    rng = np.random.default_rng(6)
    errors = []
    for _ in range(70):
        x = np.array([-0.02, 0.0, 0.02]) + rng.uniform(-0.005, 0.005)
        rise = 0.02 if kind == "edge" else -0.02
        vertices = np.column_stack([x, [0.2 + rise, 0.2, 0.2 + rise]])
        points = polyline_profile(vertices, rng)
        classic = fit_edge(points, EdgeRule(kind=kind, classic=True))
        errors.append(classic.point - vertices[1])
    x_error, z_error = np.array(errors).T
    assert np.sqrt(np.mean(x_error**2)) < COLUMN_M
    assert abs(np.mean(x_error)) < 3.3 * np.std(x_error) / np.sqrt(len(x_error))
    # A median of five columns cuts a 45 deg edge by one to two columns.
    assert 0.0 < np.mean(z_error) * np.sign(rise) < 2.5 * COLUMN_M
