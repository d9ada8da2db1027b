"""The noise of a profile, from the profile itself: before anything is known of what it shows."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAD = 1.4826  # standard deviation of a normal by its median absolute deviation
SMALLEST_M = 1e-8  # keeps noise-free profiles solvable
_LAGS = (1, 3)  # neighbours of a sensor that smooths are alike, those further apart are not


def local_noise(heights: Array) -> float:
    """Standard deviation of heights (n,) along a profile, n >= 8, about a smooth surface.

    From the median of their second differences, which edges and spikes cannot inflate.
    """
    spreads = [
        float(np.median(np.abs(heights[: -2 * lag] - 2.0 * heights[lag:-lag] + heights[2 * lag :])))
        for lag in _LAGS
    ]
    return max(MAD * max(spreads) / float(np.sqrt(6.0)), SMALLEST_M)
