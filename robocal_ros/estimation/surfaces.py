# SPDX-License-Identifier: Apache-2.0
"""The straight surfaces in a profile, and the corners where neighbours meet.

The profile is split at the point farthest from the chord until no point is farther than its noise
explains (Ramer 1972; Douglas and Peucker 1973); each piece is a line fitted robustly.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import FALSE_REJECTION, chi2_quantile
from robocal_ros.ground.errors import TooFewSamplesError
from robocal_ros.ground.frames import Array, Mask

Rows = NDArray[np.int64]

OPPOSITE = {False: "towards", True: "away"}  # what to set where ``towards`` is wrong

_SPLIT = 8.0  # standard deviations of a point
_SPLIT_COLUMNS = 3.0  # a corner lies between two columns
_OVERLAP = 5.0  # columns by which pieces may pass their corner
_GAP = 5.0  # columns
_ON_LINE = 0.8  # share of the points of two pieces that are one
_SAME_DIRECTION_RAD = 0.2  # between pieces that may be one
_NOISIER = 1.5  # the points of two pieces that are one scatter no more than each
_GHOSTS = 2  # pieces back that a surface may go on
_HOLE = 0.5  # largest part of a surface that may be missing
_MEETING, _BREAK = 0.25, -0.9  # worth of a corner, of none, in points of the smaller neighbour
_REFINEMENTS = 2
FEWEST_ON_FLANK = 6
_FREE_ROUNDS = 12  # in which a point that was left out may come back
_WORST = 0.5  # share of points beside a line that is still one


@dataclass(frozen=True, eq=False)
class Flank:
    """A straight piece of a profile.

    ``rows`` (n,): indices of its points in the profile, ascending. ``middle`` (2,): mean of its
    points, m. ``direction`` (2,): unit vector in the order of the points. ``start_m``, ``end_m``:
    of its points along the direction, from the middle. ``noise_m``: standard deviation of a point
    along the normal. ``spread_m2``: sum of squares of its points along the direction.
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
    if count < FEWEST_ON_FLANK:
        return None
    factor = chi2_quantile(1.0 - FALSE_REJECTION / count, 1.0) ** 0.5
    direction, residual, scatter = _first_line(cloud) if start is None else _beside(start, cloud)
    near = np.abs(residual) <= factor * scatter
    for attempt in itertools.count():
        if np.sum(near) < max(FEWEST_ON_FLANK, _WORST * count):
            return None
        middle = cloud[near].mean(axis=0)
        away = cloud - middle
        (xx, xz), (_, zz) = (away[near].T @ away[near]).tolist()
        angle = 0.5 * np.arctan2(2.0 * xz, xx - zz)  # of the largest extent
        main = np.array([np.cos(angle), np.sin(angle)])
        direction = main if main @ direction > 0.0 else -main
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


@dataclass(frozen=True)
class SurfaceRule:
    """What straight surfaces and their corners must be like.

    ``towards``: whether z grows towards the sensor (a height), not away from it (a distance).
    ``least_turn_rad``: of the surface at a corner.
    ``sigma_m``: largest standard deviation of a corner in any direction; a worse one is left out.
    ``margin_m``: points so near to a corner are left out, for no edge is sharp.
    ``shortest_m``: a straight piece shorter than this is no surface.
    ``reach``: how far a surface may be extended to a corner, of the part of it that is seen.
    """

    towards: bool = False
    least_turn_rad: float = float(np.radians(20.0))
    sigma_m: float = 1e-4
    margin_m: float = 2e-4
    shortest_m: float = 1.5e-3
    reach: float = 1.5


@dataclass(frozen=True, eq=False)
class Corner:
    """Where two neighbouring surfaces meet.

    ``point`` (2,): x, z, m. ``covariance`` (2, 2): m^2. ``turn_rad``: from the first surface to the
    second; positive where the corner is convex, an outer edge, nearer to the sensor than the
    surfaces.
    """

    point: Array
    covariance: Array
    turn_rad: float


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Flanks in ascending x, and the corner of each with the next, None where none is known."""

    flanks: list[Flank]
    corners: list[Corner | None]


def surfaces(profile: Array, noise: float, rule: SurfaceRule) -> Surfaces:
    """Straight surfaces in points (n, 2) of a profile, ascending in x; noise is that of z, m."""
    spacing = float(np.median(np.diff(profile[:, 0])))
    slack = _OVERLAP * spacing + rule.margin_m
    threshold = off_chord(noise, spacing)
    flanks = [
        flank
        for flank in _merged(profile, _pieces(profile, _GAP * spacing, threshold))
        if flank.end_m - flank.start_m > rule.shortest_m
    ]
    if not flanks:
        return Surfaces([], [])
    flanks = _chain(flanks, slack, rule)
    for _ in range(_REFINEMENTS):
        flanks = _refined(profile, flanks, slack, rule)
    return Surfaces(flanks, _corners(flanks, slack, rule))


def off_chord(noise: float, spacing: float) -> float:
    """How far from a chord a point of a straight surface may be, m."""
    return max(_SPLIT * noise, _SPLIT_COLUMNS * spacing)


def split(profile: Array, threshold: float) -> Rows:
    """Rows (v,) at which a profile (n, 2), ascending in x, is split; its ends are among them."""
    smooth = smoothed(profile)
    vertices = [0, len(smooth) - 1]
    pieces = [(0, len(smooth) - 1)]
    while pieces:
        first, last = pieces.pop()
        chord = smooth[last] - smooth[first]
        away = smooth[first : last + 1] - smooth[first]
        length = max(float(np.hypot(*chord)), np.finfo(float).tiny)
        distance = np.abs(away[:, 0] * chord[1] - away[:, 1] * chord[0]) / length
        farthest = first + int(np.argmax(distance))
        if distance[farthest - first] > threshold and first < farthest < last:
            vertices.append(farthest)
            pieces += [(first, farthest), (farthest, last)]
    return np.sort(np.array(vertices, dtype=np.int64))


def _pieces(profile: Array, gap: float, threshold: float) -> list[Flank]:
    """Straight pieces of a profile, none across a gap in x."""
    pieces = []
    ends = np.flatnonzero(np.diff(profile[:, 0]) > gap) + 1
    for first, last in zip([0, *ends], [*ends, len(profile)], strict=True):
        vertices = first + split(profile[first:last], threshold)
        for start, end in itertools.pairwise(vertices):
            piece = fit_flank(profile, np.arange(start, end + 1))
            if piece is not None and _whole(profile, piece):
                pieces.append(piece)
    return pieces


def _merged(profile: Array, flanks: list[Flank]) -> list[Flank]:
    """Flanks of which neighbours on one line are one: spikes and gaps split a surface."""
    merged: list[Flank] = []
    for flank in flanks:
        whole = flank
        for back in range(1, min(_GHOSTS, len(merged)) + 1):  # a ghost between is passed over
            both = _united(profile, merged[-back], flank)
            if both is not None:
                whole = both
                del merged[-back:]
                break
        merged.append(whole)
    return merged


def _united(profile: Array, a: Flank, b: Flank) -> Flank | None:
    """One line through the points of two pieces; None where they lie on two."""
    if abs(angle_between(a, b)) > _SAME_DIRECTION_RAD:
        return None
    both = fit_flank(profile, np.concatenate([a.rows, b.rows]))
    if both is None or both.noise_m > _NOISIER * max(a.noise_m, b.noise_m):
        return None
    on_it = all(np.isin(part.rows, both.rows).mean() > _ON_LINE for part in (a, b))
    return both if on_it else None


def _whole(profile: Array, flank: Flank) -> bool:
    """Whether points cover a flank: those on both sides of a jump in z do not."""
    along = np.sort(profile[flank.rows] @ flank.direction)
    return float(np.max(np.diff(along))) < _HOLE * (flank.end_m - flank.start_m)


def _chain(flanks: list[Flank], slack: float, rule: SurfaceRule) -> list[Flank]:
    """The sequence of flanks that holds most points and meets at most corners.

    A double reflection meets no neighbour, or one by chance, but stands between two that meet.
    """
    value = [float(len(flank.rows)) for flank in flanks]
    before = [-1] * len(flanks)
    for j, flank in enumerate(flanks):
        alone = value[j]
        for i in range(max(j - 1 - _GHOSTS, 0), j):
            smaller = min(len(flanks[i].rows), len(flank.rows))
            meets = _corner(flanks[i], flank, slack, rule) is not None
            worth = value[i] + alone + (_MEETING if meets else _BREAK) * smaller
            if worth > value[j]:
                value[j], before[j] = worth, i
    chain = []
    at = int(np.argmax(value))
    while at >= 0:
        chain.append(flanks[at])
        at = before[at]
    return chain[::-1]


def _refined(profile: Array, flanks: list[Flank], slack: float, rule: SurfaceRule) -> list[Flank]:
    """Flanks fitted again to all points between their corners."""
    corners = _corners(flanks, slack, rule)
    x = profile[:, 0]
    refined = []
    for flank, left, right in zip(flanks, [None, *corners], [*corners, None], strict=True):
        margin = rule.margin_m * float(flank.direction[0])
        first, last = x[flank.rows[0]] - slack, x[flank.rows[-1]] + slack
        if left is not None:
            first = left.point[0] + margin
        if right is not None:
            last = right.point[0] - margin
        again = fit_flank(profile, np.flatnonzero((x >= first) & (x <= last)), flank)
        refined.append(flank if again is None else again)
    return refined


def _corners(flanks: list[Flank], slack: float, rule: SurfaceRule) -> list[Corner | None]:
    return [_corner(a, b, slack, rule) for a, b in itertools.pairwise(flanks)]


def _corner(a: Flank, b: Flank, slack: float, rule: SurfaceRule) -> Corner | None:
    """Corner of two neighbours: in x between the end of one and the start of the other."""
    turn = angle_between(a, b)
    if abs(turn) < rule.least_turn_rad:
        return None
    point, covariance = intersection(a, b)
    end, start = a.at(a.end_m), b.at(b.start_m)
    if not end[0] - slack < point[0] < start[0] + slack:
        return None
    for ahead, flank in ((a.along(point) - a.end_m, a), (b.start_m - b.along(point), b)):
        if ahead > max(rule.reach * (flank.end_m - flank.start_m), slack):
            return None
    if float(np.linalg.eigvalsh(covariance)[-1]) > rule.sigma_m**2:
        return None
    return Corner(point, covariance, turn)


def mirror(towards: bool) -> Array:
    """Factors (2,) of x and z that make a sensor's profile one whose z grows away from it."""
    return np.array([1.0, -1.0 if towards else 1.0])


FEWEST_POINTS = 20
SMOOTHED = 5  # columns of the median
MAD = 1.4826  # standard deviation of a normal by its median absolute deviation
SMALLEST_M = 1e-8  # keeps noise-free profiles solvable
_LAGS = (1, 3)  # neighbours of a sensor that smooths are alike, those further apart are not


def ordered(points: Array, what: str) -> tuple[Array, float]:
    """Finite points (m, 2) of a profile (n, 2), m, ascending in x, and the noise of their heights.

    ``what`` they are to show, for the message.

    Raises `TooFewSamplesError`: fewer than 20 finite points.
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


_NEAR = 13  # columns
_CLOSE = 5.0  # limits within which a point that is off the curve is another surface's that meets it
_AGAINST = 2.0  # weight of such a point against that of one on the curve
_AGREEING = 0.7  # weight of the neighbours that are on the curve
_PIECE = 0.2  # smallest piece, of the largest


def on_curve(excess: Array) -> Mask:
    """Which points (n,) are on a curve, with most of their neighbours and in a large piece.

    Where another surface meets or crosses the curve, the points near both are left out. Far ones,
    spikes and what is behind the curve, have no say.

    ``excess`` (n,): a point's squared distance from the curve over the largest that its noise
    explains, in the order of the columns.
    """
    near = excess < 1.0
    window = np.ones(min(_NEAR, len(near)))
    votes = np.convolve(near.astype(np.float64), window, mode="same")
    against = np.convolve((~near & (excess < _CLOSE**2)).astype(np.float64), window, mode="same")
    rows = np.flatnonzero(near & (votes > _AGREEING * (votes + _AGAINST * against)))
    piece = np.cumsum(np.diff(rows, prepend=rows[:1]) > _NEAR)
    size = np.bincount(piece, minlength=1)
    kept = np.zeros(len(near), dtype=np.bool_)
    kept[rows[size[piece] >= _PIECE * size.max()]] = True
    return kept
