"""A profile before anything is known of what it shows: in order, smoothed, and its noise."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import TooFewSamplesError

Array = NDArray[np.float64]

FEWEST_POINTS = 20
SMOOTHED = 5  # columns of the median
MAD = 1.4826  # standard deviation of a normal by its median absolute deviation
SMALLEST_M = 1e-8  # keeps noise-free profiles solvable
_LAGS = (1, 3)  # neighbours of a sensor that smooths are alike, those further apart are not


def ordered(points: Array, what: str) -> tuple[Array, float]:
    """Finite points (m, 2) of a profile (n, 2), m, ascending in x, and the noise of their heights.

    ``what`` they are to show, for the message.

    Raises
    ------
    TooFewSamplesError
        Fewer than 20 finite points.
    """
    rows = points[np.all(np.isfinite(points), axis=1)]
    if len(rows) < FEWEST_POINTS:
        raise TooFewSamplesError(
            f"{len(rows)} points give no {what}: at least {FEWEST_POINTS} are needed; check the "
            "exposure and that the target is in range"
        )
    profile = rows[np.argsort(rows[:, 0], kind="stable")]
    return profile, local_noise(profile[:, 1])


def smoothed(profile: Array) -> Array:
    """A profile (n, 2) in order whose heights are the medians of those around them."""
    from scipy.ndimage import median_filter

    return np.column_stack([profile[:, 0], median_filter(profile[:, 1], SMOOTHED, mode="nearest")])


def local_noise(heights: Array) -> float:
    """Standard deviation of heights (n,) along a profile, n >= 8, about a smooth surface.

    From the median of their second differences, which edges and spikes cannot inflate.
    """
    spreads = [
        float(np.median(np.abs(heights[: -2 * lag] - 2.0 * heights[lag:-lag] + heights[2 * lag :])))
        for lag in _LAGS
    ]
    return max(MAD * max(spreads) / float(np.sqrt(6.0)), SMALLEST_M)
