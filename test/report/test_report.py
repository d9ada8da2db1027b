"""Figures of a shift: numbers that can be checked by hand, drawn the same each time."""

import numpy as np
import pytest

from robocal_ros.report import figures
from robocal_ros.report.validation import ShiftErrors, figures_of

CYCLES, POSES = 4, 6


def make_errors() -> ShiftErrors:
    before = np.random.default_rng(0).normal(0.0, 2e-4, (CYCLES, POSES, 3))
    return ShiftErrors(
        hours=np.arange(1.0, CYCLES + 1.0),
        accepted=[True, False, False, True],
        before=before,
        after=0.25 * before,
        held=0.5 * before,
    )


def test_figures_of_known_errors():
    """Distances 0.05, 0.1 (three axes of 0.0577) and 5 mm: counted by hand."""
    axis = 0.1e-3 / np.sqrt(3.0)
    error = np.array([[0.05e-3, 0.0, 0.0], [axis, axis, axis], [3e-3, 4e-3, 0.0]])
    found = figures_of(error)
    assert found["mean_mm"] == pytest.approx((0.05 + 0.1 + 5.0) / 3)
    assert found["rms_mm"] == pytest.approx(np.sqrt((0.05**2 + 0.1**2 + 25.0) / 3))
    assert found["max_mm"] == pytest.approx(5.0)
    assert found["share_within_tolerance"] == pytest.approx(7 / 9)
    assert found["n"] == 3


def test_figures_are_drawn_the_same_each_time():
    report = make_errors()
    for draw in (figures.drift_over_time, figures.error_by_pose):
        first, second = figures.svg(draw(report)), figures.svg(draw(report))
        assert first == second
        assert figures.png(draw(report)).startswith(b"\x89PNG")


def test_the_drift_curve_shows_the_mean_error():
    """The line of the figure is the number of the table."""
    report = make_errors()
    (axes,) = figures.drift_over_time(report).axes
    line = next(line for line in axes.lines if line.get_color() == figures.BEFORE)
    assert np.asarray(line.get_ydata())[0] == 0.0
    expected = [figures_of(error)["mean_mm"] for error in report.before]
    np.testing.assert_allclose(np.asarray(line.get_ydata())[1:], expected)
