"""The error of drift and tool together: against draws, however they hang together."""

import numpy as np
import pytest

from robocal_ros.core.combined_error import both_errors, offset_error
from robocal_ros.core.thermal.accuracy import ToolError

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


def along(sigma_m: float, draws: np.ndarray) -> tuple[ToolError, np.ndarray]:
    """An error along one direction only: what has the widest quantiles of all."""
    error = sigma_m * draws
    return ToolError(sigma_m, 1.959964 * sigma_m), error


@pytest.mark.parametrize("together", ["independent", "the same", "rivals"])
@pytest.mark.parametrize("sigmas_m", [(1e-4, 1e-4), (2e-4, 3e-5)])
def test_the_bound_holds_however_they_hang_together(together, sigmas_m):
    """At least 95 % of the sums are shorter (0.2 % is four standard deviations of the draws)."""
    rng = np.random.default_rng(2)
    first = rng.normal(size=DRAWS)
    second = {
        "independent": rng.normal(size=DRAWS),
        "the same": first,
        # Each large just where the other one is not, as far as a sum can be made long so.
        "rivals": np.sign(first) * np.abs(rng.permutation(first)),
    }[together]
    (drift, a), (tool, b) = along(sigmas_m[0], first), along(sigmas_m[1], second)
    both = both_errors(drift, tool)
    assert np.mean(np.abs(a + b) <= both.bound_m) >= 0.95 - 0.002
    if together == "independent":
        assert np.sqrt(np.mean((a + b) ** 2)) == pytest.approx(both.rms_m, rel=0.01)


def test_one_error_alone_is_itself():
    drift = ToolError(1e-4, 2e-4)
    assert both_errors(drift, ToolError(0.0, 0.0)) == drift
    assert both_errors(ToolError(0.0, 0.0), drift) == drift
