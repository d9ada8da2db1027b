"""A straight piece of a profile, and the corner where two of them meet."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.descent import FALSE_REJECTION, chi2_quantile
from robocal_ros.estimation.neighbours import on_curve
from robocal_ros.estimation.profile_noise import MAD, SMALLEST_M

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FEWEST_POINTS = 6
_FREE_ROUNDS = 12  # in which a point that was left out may come back
_WORST = 0.5  # share of points beside a line that is still one


@dataclass(frozen=True, eq=False)
class Flank:
    """A straight piece of a profile.

    Attributes
    ----------
    rows : (n,) indices of its points in the profile, ascending.
    middle : (2,) mean of its points, m.
    direction : (2,) unit vector in the order of the points.
    start_m, end_m : of its points along the direction, from the middle.
    noise_m : standard deviation of a point along the normal.
    spread_m2 : sum of squares of its points along the direction.
    """

    rows: NDArray[np.int64]
    middle: Array
    direction: Array
    start_m: float
    end_m: float
    noise_m: float
    spread_m2: float

    @property
    def normal(self) -> Array:
        """(2,) unit normal, a quarter turn from x to z ahead of the direction."""
        return np.array([-self.direction[1], self.direction[0]])

    def at(self, along_m: float) -> Array:
        """Point (2,) of the line at a distance from the middle."""
        return np.asarray(self.middle + along_m * self.direction)

    def along(self, point: Array) -> float:
        """Distance of a point (2,) from the middle, along the direction."""
        return float((point - self.middle) @ self.direction)

    def variance(self, along_m: float) -> float:
        """Variance of the line along its normal at a distance from the middle, m^2."""
        return self.noise_m**2 * (1.0 / len(self.rows) + along_m**2 / self.spread_m2)


def fit_flank(points: Array, rows: NDArray[np.int64], start: Flank | None = None) -> Flank | None:
    """Line through the points of a profile (m, 2) with these row numbers (n,), ascending in x.

    Where no start is given it is the median of the directions between points half of the piece
    apart; total least squares over the points whose residual fits its predicted variance is the
    answer. None where fewer than six points, or fewer than half of them, lie on a line.
    """
    cloud = points[rows]
    count = len(rows)
    if count < FEWEST_POINTS:
        return None
    factor = chi2_quantile(1.0 - FALSE_REJECTION / count, 1.0) ** 0.5
    direction, residual, scatter = _first_line(cloud) if start is None else _beside(start, cloud)
    near = np.abs(residual) <= factor * scatter
    for attempt in itertools.count():
        if np.sum(near) < max(FEWEST_POINTS, _WORST * count):
            return None
        middle = cloud[near].mean(axis=0)
        direction = _main_direction(cloud[near] - middle, direction)
        away = cloud - middle
        residual = away @ np.array([-direction[1], direction[0]])
        along = away @ direction
        spread = float(np.sum(along[near] ** 2)) + SMALLEST_M**2
        leverage = 1.0 / np.sum(near) + along**2 / spread
        noise = float(np.sqrt(np.sum(residual[near] ** 2) / (np.sum(near) - 2))) + SMALLEST_M
        # A point in use pulled the line to itself, any other did not.
        expected = 1.0 + np.where(near, -1.0, 1.0) * np.minimum(leverage, 0.5)
        update = on_curve((residual / (factor * noise)) ** 2 / expected)
        if attempt >= _FREE_ROUNDS:  # a point at the limit must not come and go for ever
            update = update & near
        if np.array_equal(update, near):
            break
        near = update
    return Flank(
        rows=rows[near],
        middle=middle,
        direction=direction,
        start_m=float(np.min(along[near])),
        end_m=float(np.max(along[near])),
        noise_m=noise,
        spread_m2=spread,
    )


def _beside(flank: Flank, cloud: Array) -> tuple[Array, Array, Array]:
    """Direction (2,) of a straight piece, distances (n,) of points from it and their scatter."""
    away = cloud - flank.middle
    scatter = flank.noise_m * np.sqrt(1.0 + (away @ flank.direction) ** 2 / flank.spread_m2)
    return flank.direction, away @ flank.normal, scatter


def _first_line(cloud: Array) -> tuple[Array, Array, Array]:
    """The same for points (n, 2) ascending in x of which nothing is known."""
    half = len(cloud) // 2
    step = cloud[half:] - cloud[: len(cloud) - half]
    angle = _median(np.arctan2(step[:, 1], step[:, 0]))
    residual = cloud @ np.array([-np.sin(angle), np.cos(angle)])
    residual -= _median(residual)
    scatter = np.full(len(cloud), MAD * _median(np.abs(residual)) + SMALLEST_M)
    return np.array([np.cos(angle), np.sin(angle)]), residual, scatter


def _median(values: Array) -> float:
    """The upper median of values (n,), in a fifth of NumPy's time for the few of a piece."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def _main_direction(away: Array, towards: Array) -> Array:
    """Direction (2,) of largest extent of points (n, 2) about their mean."""
    (xx, xz), (_, zz) = (away.T @ away).tolist()
    angle = 0.5 * np.arctan2(2.0 * xz, xx - zz)
    main = np.array([np.cos(angle), np.sin(angle)])
    return main if main @ towards > 0.0 else -main


def angle_between(a: Flank, b: Flank) -> float:
    """Turn from the direction of a to that of b, rad; positive from x to z."""
    turn = a.direction[0] * b.direction[1] - a.direction[1] * b.direction[0]
    return float(np.arctan2(turn, a.direction @ b.direction))


def intersection(a: Flank, b: Flank) -> tuple[Array, Array]:
    """Point (2,) where two lines meet and its covariance (2, 2), m^2; they are not parallel."""
    # Along a line of direction u to where it meets another: cross(b - a, v) / cross(u, v).
    sine = np.sin(angle_between(a, b))
    between = b.middle - a.middle
    along_a = (between[0] * b.direction[1] - between[1] * b.direction[0]) / sine
    along_b = (between[0] * a.direction[1] - between[1] * a.direction[0]) / sine
    # An error of one line along its normal moves the point along the other.
    moved = np.array([b.direction, a.direction]) / sine
    variances = np.array([a.variance(along_a), b.variance(along_b)])
    return a.at(along_a), np.asarray((moved.T * variances) @ moved)
