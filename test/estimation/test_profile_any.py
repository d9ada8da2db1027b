"""Whatever a profile holds, its fit is finite or refused with a message."""

import contextlib
import warnings

import numpy as np
import pytest
from profile_shapes import COLUMNS, arc_profile, polyline_profile, stairs

from robocal_ros.estimation.edge import CornerRule, EdgeRule, fit_corners, fit_edge
from robocal_ros.estimation.sphere import ArcRule, fit_arc
from robocal_ros.ground.errors import RobocalError, TooFewSamplesError

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
                for value in vars(FITS[name](points)).values():
                    assert np.all(np.isfinite(value))


@pytest.mark.parametrize(("name", "count"), [("arc", 12), ("corners", 3), ("edge", 5)])
def test_few_points_are_refused(name, count):
    with pytest.raises(TooFewSamplesError, match=f"{count} points"):
        FITS[name](np.full((count, 2), 0.1))
