"""A profile: what a line-laser sensor sees in one shot, in its own x-z plane."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground.errors import InputError, TooFewSamplesError

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
    if not NARROWEST_M <= extent <= WIDEST_M:
        small = extent < NARROWEST_M
        width = f"{extent * 1e3:.4g} mm" if small else f"{extent:.4g} m"
        raise InputError(
            f"profile {name} comes out {width} wide: is it a thousand times too "
            f"{'small' if small else 'large'}? A table's x_mm and z_mm hold mm, a message m"
        )
    return Profile(rows, name)
