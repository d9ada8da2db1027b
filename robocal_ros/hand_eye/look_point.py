"""Where sensor poses look for a sphere that nobody has told the place of."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.hand_eye.planning import SensorRange

Array = NDArray[np.float64]

OFF_EQUATOR = 0.55  # of the radius: where a laser plane tells the side and the height of a sphere
BEHIND = 0.7  # of the radius: how far the centre lies behind the arc that is seen
MOST_ROUNDS = 100  # the best centres settle in a handful
SETTLED_M = 1e-6


def looked_at(T_base_sensor: Array, radius_m: float, sensor: SensorRange) -> tuple[Array, Array]:
    """Centres (2 m, 3) that poses (m, 4, 4) may look at, base, and the misfit (2 m,) of each.

    A laser plane passes a sphere on one of two sides. From each side of each pose the centre goes
    to where the others agree best: iteratively reweighted least squares with Cauchy's weights, so
    that a pose which looks elsewhere hardly counts; each pose on the side that is nearer. Lengths
    in the sensor frame are in terms of how far the sphere may be off and still be seen. The centre
    is rough, to some mm: nobody lays the light where a sphere is best seen.
    """
    R, origin = T_base_sensor[:, :3, :3], T_base_sensor[:, :3, 3]
    off = OFF_EQUATOR * radius_m
    allowed = np.array(
        [
            0.5 * sensor.width_m,
            radius_m - off,
            0.5 * (sensor.far_m - sensor.near_m) + radius_m,
        ]
    )
    middle_m = sensor.middle_m + BEHIND * radius_m  # its surface is seen, not its centre
    starts = np.array([[0.0, side * off, middle_m] for side in (-1.0, 1.0)])
    centres = (np.einsum("mij,sj->smi", R, starts) + origin).reshape(-1, 3)
    for _ in range(MOST_ROUNDS):
        miss, at = _misses(R, origin, centres, off, middle_m, allowed)
        weight = 1.0 / (1.0 + np.sum(miss**2, axis=2))
        precision = np.einsum("mij,j,mkj->mik", R, allowed**-2.0, R)
        wanted = origin + np.einsum("mij,pmj->pmi", R, at)
        A = np.einsum("pm,mik->pik", weight, precision)
        b = np.einsum("pm,mik,pmk->pi", weight, precision, wanted)
        before, centres = centres, np.linalg.solve(A, b[..., None])[..., 0]
        if np.abs(centres - before).max() < SETTLED_M:
            break
    miss, _ = _misses(R, origin, centres, off, middle_m, allowed)
    return centres, np.sum(np.log1p(np.sum(miss**2, axis=2)), axis=1)


def _misses(
    R: Array, origin: Array, centres: Array, off: float, middle_m: float, allowed: Array
) -> tuple[Array, Array]:
    """Misses (p, m, 3) of centres (p, 3), in terms of what is allowed, and where each is wanted."""
    s = np.einsum("mji,pmj->pmi", R, centres[:, None] - origin)
    at = np.zeros_like(s)
    at[..., 1] = np.where(s[..., 1] < 0.0, -off, off)
    at[..., 2] = middle_m
    return (s - at) / allowed, at
