"""The error of drift and tool together, against draws."""

import numpy as np
import pytest

from robocal_ros.thermal.accuracy import ToolError, both_errors, offset_error

DRAWS = 200_000


@pytest.mark.parametrize("offset_m", [0.0, 5e-5, 3e-4])
@pytest.mark.parametrize("sigma_m", [1e-5, 5e-5])
def test_an_offset_known_so_well(offset_m, sigma_m):
    """Rms within 1 %; 95 % holds 94.5 to 95.5 %, the quantile being an approximation."""
    rng = np.random.default_rng(1)
    error = np.linalg.norm([offset_m, 0, 0] + sigma_m * rng.normal(size=(DRAWS, 3)), axis=1)
    told = offset_error(offset_m, sigma_m)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(told.rms_m, rel=0.01)
    assert np.mean(error < told.bound_m) == pytest.approx(0.95, abs=0.005)


def test_an_offset_known_exactly():
    assert offset_error(1e-4, 0.0) == ToolError(1e-4, 1e-4)
    assert offset_error(0.0, 0.0) == ToolError(0.0, 0.0)


def drawn(kind: str, size_m: float, rng: np.random.Generator) -> tuple[ToolError, np.ndarray]:
    """Errors (DRAWS, 3) along x, of a fixed length along x, or every way alike."""
    if kind == "along":
        error = size_m * rng.normal(size=(DRAWS, 1)) * [1.0, 0.0, 0.0]
        return ToolError(size_m, 1.959964 * size_m), error
    if kind == "fixed":
        return ToolError(size_m, size_m), np.tile([size_m, 0.0, 0.0], (DRAWS, 1))
    error = size_m * rng.normal(size=(DRAWS, 3))
    return offset_error(0.0, size_m), error


@pytest.mark.parametrize("first", ["along", "around"])
@pytest.mark.parametrize("second", ["along", "fixed", "around"])
@pytest.mark.parametrize("sizes_m", [(1e-4, 1e-4), (2e-4, 3e-5), (3e-5, 2e-4)])
def test_the_bound_holds_for_both_together(first, second, sizes_m):
    """Independent errors, however they lie to each other: 95 %, within the approximation."""
    rng = np.random.default_rng(2)
    (drift, a), (tool, b) = drawn(first, sizes_m[0], rng), drawn(second, sizes_m[1], rng)
    both = both_errors(drift, tool)
    length = np.linalg.norm(a + b, axis=1)
    assert np.mean(length <= both.bound_m) >= 0.95 - 0.005
    assert np.sqrt(np.mean(length**2)) == pytest.approx(both.rms_m, rel=0.01)


def test_what_is_in_both_errors_is_said_to_hold_less():
    """The same Gaussian twice on one line: 2 |n| < 1.96 sqrt(2), which is 83.4 % of cases."""
    one = ToolError(1e-4, 1.959964 * 1e-4)
    along = 1e-4 * np.random.default_rng(3).normal(size=DRAWS)
    share = np.mean(np.abs(2.0 * along) <= both_errors(one, one).bound_m)
    assert share == pytest.approx(0.834, abs=4.0 * np.sqrt(0.834 * 0.166 / DRAWS))


def test_two_errors_along_one_line_are_one_such_error():
    both = both_errors(ToolError(3e-4, 1.959964 * 3e-4), ToolError(4e-4, 1.959964 * 4e-4))
    assert both.bound_m == pytest.approx(1.959964 * 5e-4, rel=1e-4)


def test_one_error_alone_is_itself():
    drift = ToolError(1e-4, 2e-4)
    for both in (both_errors(drift, ToolError(0.0, 0.0)), both_errors(ToolError(0.0, 0.0), drift)):
        assert both.rms_m == drift.rms_m
        assert both.bound_m == pytest.approx(drift.bound_m, rel=1e-9)


def test_a_bound_counts_where_no_rms_is_told():
    both = both_errors(ToolError(0.0, 1e-3), ToolError(1e-4, 2e-4))
    assert both.bound_m >= 1e-3


def test_an_rms_that_is_all_but_none_is_no_crash():
    """A Gaussian error on one line, the widest that there is: its bound stays."""
    both = both_errors(ToolError(1e-200, 1e-3), ToolError(0.0, 0.0))
    assert both.bound_m == pytest.approx(1e-3, rel=1e-9)
