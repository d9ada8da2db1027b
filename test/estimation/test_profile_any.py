# SPDX-License-Identifier: Apache-2.0
"""Whatever a profile holds, its fit is finite or refused with a message."""

import contextlib
import warnings

import numpy as np
import pytest
from profile_shapes import COLUMNS, arc_profile, polyline_profile, stairs

from robocal_ros.estimation.edge import CornerRule, EdgeRule, fit_corners, fit_edge
from robocal_ros.estimation.sphere import ArcRule, fit_arc
from robocal_ros.ground.errors import ResidualError, RobocalError, TooFewSamplesError

FITS = {
    "arc": lambda points: fit_arc(points, ArcRule(0.02)),
    "corners": lambda points: fit_corners(points, CornerRule()),
    "classic corners": lambda points: fit_corners(points, CornerRule(classic=True)),
    "edge": lambda points: fit_edge(points, EdgeRule()),
    "groove": lambda points: fit_edge(points, EdgeRule(kind="groove")),
    "classic edge": lambda points: fit_edge(points, EdgeRule(classic=True)),
}


def profiles(rng):
    """Degenerate, random, rounded, thinned and shuffled profiles."""
    yield np.full((30, 2), 0.1)
    yield np.full((30, 2), np.nan)
    yield np.column_stack([COLUMNS, np.full(len(COLUMNS), 0.2)])
    yield np.column_stack([np.zeros(len(COLUMNS)), COLUMNS])
    yield np.column_stack([COLUMNS, 0.2 + 0.01 * np.sign(np.sin(900.0 * COLUMNS))])
    for _ in range(8):
        x = np.sort(rng.uniform(-0.05, 0.05, rng.integers(20, 400)))
        yield np.column_stack([x, 0.2 + rng.normal(size=len(x)) * 10.0 ** rng.uniform(-6, -1)])
        yield rng.normal(size=(len(x), 2)) * 10.0 ** rng.uniform(-6, 1)
        yield np.round(polyline_profile(stairs(4, 0.7), rng), rng.integers(3, 6))
        arc = np.round(arc_profile((0.0, 0.215, 0.015), rng)[0], rng.integers(3, 6))
        yield arc
        arc[rng.random(len(arc)) < 0.5] = np.nan
        yield arc
        yield rng.permutation(arc)


@pytest.mark.parametrize("name", FITS)
def test_a_fit_is_finite_or_refused(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for points in profiles(np.random.default_rng(0)):
            with contextlib.suppress(RobocalError):
                for value in leaves(list(vars(FITS[name](points)).values())):
                    assert np.all(np.isfinite(value))


def leaves(value):
    """The numbers and arrays of lists of them."""
    if isinstance(value, list | tuple):
        return [leaf for part in value for leaf in leaves(part)]
    return [value]


@pytest.mark.parametrize(("name", "count"), [("arc", 12), ("corners", 3), ("edge", 5)])
def test_few_points_are_refused(name, count):
    with pytest.raises(TooFewSamplesError, match=f"{count} points"):
        FITS[name](np.full((count, 2), 0.1))


HEIGHTS = np.array([1.0, -1.0])


def test_a_height_is_a_distance_turned():
    """The feature of a sensor whose z grows the other way is that of the same points, turned."""
    rng = np.random.default_rng(1)
    arc, steps = arc_profile((0.003, 0.215, 0.015), rng)[0], polyline_profile(stairs(3, 0.7), rng)
    one, other = fit_arc(arc, ArcRule(0.02)), fit_arc(arc * HEIGHTS, ArcRule(0.02, towards=True))
    np.testing.assert_allclose(other.centre, one.centre * HEIGHTS)
    np.testing.assert_allclose(other.covariance[0, 1], -one.covariance[0, 1])
    np.testing.assert_array_equal(other.used, one.used)
    for classic in (False, True):
        far = fit_corners(steps, CornerRule(classic=classic))
        high = fit_corners(steps * HEIGHTS, CornerRule(towards=True, classic=classic))
        np.testing.assert_allclose(high.points, far.points * HEIGHTS)
        np.testing.assert_array_equal(high.convex, far.convex)
        np.testing.assert_allclose(high.covariance[:, 0, 1], -far.covariance[:, 0, 1])
    roof = steps[(steps[:, 0] > far.points[0, 0] - 8e-3) & (steps[:, 0] < far.points[1, 0] - 1e-3)]
    edge = fit_edge(roof, EdgeRule())
    np.testing.assert_allclose(
        fit_edge(roof * HEIGHTS, EdgeRule(towards=True)).point, edge.point * HEIGHTS
    )


@pytest.mark.parametrize(("towards", "other"), [(False, "towards"), (True, "away")])
def test_what_opens_the_other_way_names_the_setting(towards, other):
    rng = np.random.default_rng(2)
    turned = np.array([1.0, 1.0 if towards else -1.0])
    arc = arc_profile((0.0, 0.215, 0.015), rng)[0] * turned
    with pytest.raises(ResidualError, match=f"opens the wrong way: .* set z_grows {other}"):
        fit_arc(arc, ArcRule(0.02, towards=towards))
    roof = polyline_profile(np.array([[-0.02, 0.21], [0.0, 0.2], [0.02, 0.21]]), rng) * turned
    with pytest.raises(ResidualError, match=f"one groove, .* set z_grows {other}"):
        fit_edge(roof, EdgeRule(towards=towards))
