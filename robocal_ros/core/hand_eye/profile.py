"""A profile: what a line-laser sensor sees in one shot, in its own x-z plane."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.core.errors import InputError, TooFewSamplesError

Array = NDArray[np.float64]

FEWEST_POINTS = 10
NARROWEST_M, WIDEST_M = 1e-3, 20.0  # no line laser's field of view is outside of this


@dataclass(frozen=True, eq=False)
class Profile:
    """Points of one profile.

    Attributes
    ----------
    points : (n, 2) x along the laser line and z along the beam, sensor frame, m, in the order of
        the sensor's columns; its plane is y = 0. Finite: what the sensor did not see is left out.
    name : of the shot, for reports.
    """

    points: Array
    name: str


def profile_of(points: ArrayLike, name: str) -> Profile:
    """Check and wrap points (n, 2), m; columns without a return (not-a-number) are left out.

    Raises
    ------
    InputError
        When the points are not (n, 2), or their extent is that of another unit.
    TooFewSamplesError
        When nearly nothing was seen.
    """
    rows = np.asarray(points, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 2:
        raise InputError(f"profile {name} has shape {rows.shape}, not (points, 2)")
    rows = rows[np.all(np.isfinite(rows), axis=1)]
    if len(rows) < FEWEST_POINTS:
        raise TooFewSamplesError(
            f"profile {name} has {len(rows)} points (at least {FEWEST_POINTS}): check the exposure "
            "and that the target is in range"
        )
    extent = float(np.ptp(rows, axis=0).max())
    if extent < NARROWEST_M:
        raise InputError(
            f"profile {name} is {extent * 1e3:.4g} mm wide: is it a thousand times too small, in m "
            "where mm are expected?"
        )
    if extent > WIDEST_M:
        raise InputError(
            f"profile {name} is {extent:.4g} m wide: is it a thousand times too large, in mm where "
            "m are expected?"
        )
    return Profile(rows, name)
