"""The corners of a staircase, from one profile.

The profile is split at the point farthest from the chord until no point is farther than its noise
explains (Ramer 1972; Douglas and Peucker 1973). *Classic*, as published for the step target, those
points are the corners, and one that is off the line through its like is moved onto it along z.
*Best*, each piece is a line fitted robustly, and a corner is where two neighbours meet.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from robocal_ros.core.errors import ResidualError, TooFewSamplesError
from robocal_ros.core.fitting.flank import Flank, angle_between, fit_flank, intersection
from robocal_ros.core.fitting.profile_noise import local_noise

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

FEWEST_POINTS = 20
_SPLIT = 8.0  # standard deviations of a point
_SPLIT_M = 2e-5
_SMOOTHED = 5  # columns
_OVERLAP = 5.0  # columns by which pieces may pass their corner
_GAP = 5.0  # columns
_ON_LINE = 0.8  # share of the points of two pieces that are one
_SAME_DIRECTION_RAD = 0.2  # between pieces that may be one
_NOISIER = 1.5  # the points of two pieces that are one scatter no more than each
_GHOSTS = 2  # pieces back that a surface may go on
_REFINEMENTS = 2


@dataclass(frozen=True)
class CornerRule:
    """What the corners in a profile must be like.

    Attributes
    ----------
    count : how many corners the profile must show, convex and concave ones; None takes what is
        there.
    classic : the published form instead of the best one.
    least_turn_rad : of the surface at a corner.
    sigma_m : largest standard deviation of a corner in any direction; a worse one is left out.
    margin_m : points so near to a corner are left out, for no edge is sharp.
    shortest_m : a straight piece shorter than this is no surface.
    reach : how far a surface may be extended to a corner, of the part of it that is seen.
    repair_m : classic only: a corner farther than this from the line through its like is moved.
    """

    count: int | None = None
    classic: bool = False
    least_turn_rad: float = float(np.radians(20.0))
    sigma_m: float = 1e-4
    margin_m: float = 2e-4
    shortest_m: float = 1.5e-3
    reach: float = 1.5
    repair_m: float = 2e-4


@dataclass(frozen=True, eq=False)
class CornerFit:
    """Corners in the order of the laser line.

    Attributes
    ----------
    points : (k, 2) x, z in the sensor frame, m.
    covariance : (k, 2, 2) m^2; neighbours share a surface, so their errors are not independent.
    repaired : (k,) moved onto the line through the others; in the best form none is.
    convex : (k,) outer edges, nearer to the sensor than the surfaces beside them.
    left_out : (j, 2) where a surface ends without a corner that is known: its neighbour was not
        seen, or too little of it.
    noise_m : standard deviation of a point along z, from the profile.
    """

    points: Array
    covariance: Array
    repaired: Mask
    convex: Mask
    left_out: Array
    noise_m: float


def fit_corners(points: Array, rule: CornerRule) -> CornerFit:
    """Find the corners of straight surfaces in points (n, 2) of a profile: x, z in m.

    Points are in the order of the sensor's columns; the sensor looks along +z.

    Raises
    ------
    TooFewSamplesError
        Fewer than 20 finite points.
    ResidualError
        No corner, or another number of them than expected: the message says where they are, and
        where surfaces end without one.
    """
    rows = points[np.all(np.isfinite(points), axis=1)]
    if len(rows) < FEWEST_POINTS:
        raise TooFewSamplesError(
            f"{len(rows)} points give no corners: at least {FEWEST_POINTS} are needed; check the "
            "exposure and that the target is in range"
        )
    backwards = rows[-1, 0] < rows[0, 0]
    profile = rows[np.argsort(rows[:, 0], kind="stable")]
    noise = local_noise(profile[:, 1])
    found = _best(profile, noise, rule)
    if backwards:
        found = CornerFit(
            found.points[::-1],
            found.covariance[::-1],
            found.repaired[::-1],
            found.convex[::-1],
            found.left_out[::-1],
            noise,
        )
    _require(found, rule)
    return found


def split(profile: Array, noise: float) -> Rows:
    """Rows (v,) at which a profile (n, 2), ascending in x, is split; its ends are among them."""
    threshold = max(_SPLIT * noise, _SPLIT_M)
    smooth = np.column_stack(
        [profile[:, 0], median_filter(profile[:, 1], _SMOOTHED, mode="nearest")]
    )
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


def _best(profile: Array, noise: float, rule: CornerRule) -> CornerFit:
    spacing = float(np.median(np.diff(profile[:, 0])))
    flanks = [
        flank
        for flank in _merged(profile, _pieces(profile, _GAP * spacing, noise))
        if flank.end_m - flank.start_m > rule.shortest_m
    ]
    slack = _OVERLAP * spacing + _SPLIT * noise
    flanks = _without_ghosts(flanks, slack, rule)
    for _ in range(_REFINEMENTS):
        flanks = _refined(profile, flanks, slack, rule)
    joined = [_corner(a, b, slack, rule) for a, b in zip(flanks[:-1], flanks[1:], strict=True)]
    corners = [corner for corner in joined if corner is not None]
    ends = [
        place
        for a, b, corner in zip(flanks[:-1], flanks[1:], joined, strict=True)
        if corner is None
        for place in (a.at(a.end_m), b.at(b.start_m))
    ]
    return CornerFit(
        points=np.array([point for point, _, _ in corners]).reshape(-1, 2),
        covariance=np.array([covariance for _, covariance, _ in corners]).reshape(-1, 2, 2),
        repaired=np.zeros(len(corners), dtype=np.bool_),
        convex=np.array([convex for _, _, convex in corners], dtype=np.bool_),
        left_out=np.array(ends).reshape(-1, 2),
        noise_m=noise,
    )


def _pieces(profile: Array, gap: float, noise: float) -> list[Flank]:
    """Straight pieces of a profile, none across a gap in x."""
    pieces = []
    ends = np.flatnonzero(np.diff(profile[:, 0]) > gap) + 1
    for first, last in zip([0, *ends], [*ends, len(profile)], strict=True):
        vertices = first + split(profile[first:last], noise)
        for start, end in zip(vertices[:-1], vertices[1:], strict=True):
            piece = fit_flank(profile, np.arange(start, end + 1))
            pieces += [piece] if piece is not None else []
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


def _without_ghosts(flanks: list[Flank], slack: float, rule: CornerRule) -> list[Flank]:
    """Flanks less those that meet no neighbour but stand between two that meet each other."""
    kept = list(flanks)
    middle = 1
    while middle < len(kept) - 1:
        before, ghost, after = kept[middle - 1 : middle + 2]
        alone = _corner(before, ghost, slack, rule) is None
        alone &= _corner(ghost, after, slack, rule) is None
        if alone and _corner(before, after, slack, rule) is not None:
            del kept[middle]
            middle = max(middle - 1, 1)
        else:
            middle += 1
    return kept


def _refined(profile: Array, flanks: list[Flank], slack: float, rule: CornerRule) -> list[Flank]:
    """Flanks fitted again to all points between their corners."""
    corners = [_corner(a, b, slack, rule) for a, b in zip(flanks[:-1], flanks[1:], strict=True)]
    x = profile[:, 0]
    refined = []
    for flank, left, right in zip(flanks, [None, *corners], [*corners, None], strict=True):
        margin = rule.margin_m * abs(float(flank.direction[0]))
        first, last = x[flank.rows[0]], x[flank.rows[-1]]
        if left is not None:
            first = left[0][0] + margin
        if right is not None:
            last = right[0][0] - margin
        rows = np.flatnonzero((x >= first) & (x <= last))
        again = fit_flank(profile, rows)
        refined.append(flank if again is None else again)
    return refined


def _corner(a: Flank, b: Flank, slack: float, rule: CornerRule) -> tuple[Array, Array, bool] | None:
    """Corner of two neighbours, its covariance and whether it is convex; None where none is known.

    It lies where both end, or not farther away than a share of their lengths.
    """
    turn = angle_between(a, b)
    if abs(turn) < rule.least_turn_rad:
        return None
    point, covariance = intersection(a, b)
    for ahead, flank in ((a.along(point) - a.end_m, a), (b.start_m - b.along(point), b)):
        if not -slack < ahead < max(rule.reach * (flank.end_m - flank.start_m), slack):
            return None
    if float(np.linalg.eigvalsh(covariance)[-1]) > rule.sigma_m**2:
        return None
    return point, covariance, turn > 0.0


def _require(fit: CornerFit, rule: CornerRule) -> None:
    found = len(fit.points)
    if found and rule.count in (None, found):
        return
    expected = "at least one" if rule.count is None else str(rule.count)
    message = f"the profile shows {found} corners, expected {expected}"
    if found:
        message += f"; they are at {_places(fit.points)}"
    if len(fit.left_out):
        message += f"; surfaces end without a known corner at {_places(fit.left_out)}"
    raise ResidualError(
        message + ": let the laser line cross the steps only, and turn the sensor so that it sees "
        "both sides of each"
    )


def _places(points: Array) -> str:
    return ", ".join(f"({x:.2f}, {z:.2f}) mm" for x, z in points * 1e3)
