"""Two errors of the tool centre point at once: of the robot's drift, and of the tool."""

import numpy as np

from robocal_ros.core.descent import chi2_quantile
from robocal_ros.core.thermal.accuracy import ToolError

# 97.5 % of errors are shorter than the 95 % bound times this, whatever they are made of: their
# squared length is taken for a scaled chi-square, and this ratio is largest at one degree of
# freedom (the squared length of a Gaussian error has no fewer).
WIDER = float(np.sqrt(chi2_quantile(0.975, 1.0) / chi2_quantile(0.95, 1.0)))


def offset_error(offset_m: float, sigma_m: float) -> ToolError:
    """Of a tip found so far away, with this standard deviation in each axis.

    Mean and variance of the squared length as in `AccuracyForecast.at`.
    """
    mean = offset_m**2 + 3.0 * sigma_m**2
    if mean == 0.0:
        return ToolError(0.0, 0.0)
    variance = 4.0 * offset_m**2 * sigma_m**2 + 6.0 * sigma_m**4
    if variance <= 1e-12 * mean**2:
        return ToolError(float(np.sqrt(mean)), float(np.sqrt(mean)))
    scale, freedom = variance / (2.0 * mean), 2.0 * mean**2 / variance
    return ToolError(float(np.sqrt(mean)), float(np.sqrt(scale * chi2_quantile(0.95, freedom))))


def both_errors(drift: ToolError, tool: ToolError) -> ToolError:
    """Of both together: they are independent of each other, so that their mean squares add.

    The bound holds however they are directed, and even where they are not independent: each is
    beyond its 97.5 % in one case in forty, so that one of them is in at most one in twenty, and
    no sum of vectors is longer than their lengths together.
    """
    rms_m = float(np.hypot(drift.rms_m, tool.rms_m))
    if drift.bound_m == 0.0 or tool.bound_m == 0.0:
        return ToolError(rms_m, drift.bound_m + tool.bound_m)
    return ToolError(rms_m, WIDER * (drift.bound_m + tool.bound_m))
