"""The straight surfaces in a profile, and the corners where neighbours meet.

The profile is split at the point farthest from the chord until no point is farther than its noise
explains (Ramer 1972; Douglas and Peucker 1973); each piece is a line fitted robustly.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.flank import Flank, angle_between, fit_flank, intersection
from robocal_ros.estimation.profile_noise import smoothed

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

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


@dataclass(frozen=True)
class SurfaceRule:
    """What straight surfaces and their corners must be like.

    Attributes
    ----------
    least_turn_rad : of the surface at a corner.
    sigma_m : largest standard deviation of a corner in any direction; a worse one is left out.
    margin_m : points so near to a corner are left out, for no edge is sharp.
    shortest_m : a straight piece shorter than this is no surface.
    reach : how far a surface may be extended to a corner, of the part of it that is seen.
    """

    least_turn_rad: float = float(np.radians(20.0))
    sigma_m: float = 1e-4
    margin_m: float = 2e-4
    shortest_m: float = 1.5e-3
    reach: float = 1.5


@dataclass(frozen=True, eq=False)
class Corner:
    """Where two neighbouring surfaces meet.

    Attributes
    ----------
    point : (2,) x, z, m.
    covariance : (2, 2) m^2.
    turn_rad : from the first surface to the second; positive where the corner is convex, an outer
        edge, nearer to the sensor than the surfaces.
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
