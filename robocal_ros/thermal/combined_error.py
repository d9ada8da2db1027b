"""Two errors of the tool centre point at once: of the robot's drift, and of the tool."""

import numpy as np

from robocal_ros.estimation.descent import chi2_quantile
from robocal_ros.thermal.accuracy import ToolError

MOST_FREEDOM = 1e6  # more of it: as good as a fixed length
HALVINGS = 60


def offset_error(offset_m: float, sigma_m: float) -> ToolError:
    """Of a tip found so far away, with this standard deviation in each axis.

    Mean and variance of the squared length as in `AccuracyForecast.at`.
    """
    mean = offset_m**2 + 3.0 * sigma_m**2
    return ToolError.of_square(mean, 4.0 * offset_m**2 * sigma_m**2 + 6.0 * sigma_m**4)


def both_errors(drift: ToolError, tool: ToolError) -> ToolError:
    """Of both together, taken as independent: other sensors tell them, in other measurements.

    Their mean squares add. So do the variances of their squared lengths, with that of twice their
    product: as large as if both lay on one line, this way or that. An error that is wholly in both,
    on one line, stays below the bound in 83 % of cases.
    """
    (one, its), (other, others) = _square(drift), _square(tool)
    both = ToolError.of_square(one + other, its + others + 4.0 * one * other)
    return ToolError(float(np.hypot(drift.rms_m, tool.rms_m)), both.bound_m)


def _square(error: ToolError) -> tuple[float, float]:
    """Mean and variance of the squared length, of a scaled chi-square with the same bound.

    One degree of freedom at least: the squared length of a Gaussian error has no fewer.
    """
    if error.bound_m == 0.0:
        return 0.0, 0.0
    if error.rms_m == 0.0:
        return error.bound_m**2, 0.0
    ratio = error.bound_m / error.rms_m
    wanted = ratio * ratio  # infinite where ** would raise
    few, many = 0.0, float(np.log(MOST_FREEDOM))
    if wanted <= _over_mean(np.exp(many)):
        return error.bound_m**2, 0.0
    for _ in range(HALVINGS):
        middle = 0.5 * (few + many)
        few, many = (middle, many) if _over_mean(np.exp(middle)) > wanted else (few, middle)
    freedom = float(np.exp(many))
    mean = error.bound_m**2 / _over_mean(freedom)
    return mean, 2.0 * mean**2 / freedom


def _over_mean(freedom: float) -> float:
    """95 % quantile of a chi-square over its mean; falls with the degrees of freedom."""
    return chi2_quantile(0.95, freedom) / freedom
