"""The corners of a staircase, from one profile.

*Classic*, as published for the step target, the corners are the points at which the profile is
split, and one that is off the line through its like is moved onto it along z. *Best*, a corner is
where two neighbouring surfaces meet, each fitted by a robust line.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.surfaces import SurfaceRule, off_chord, ordered, split, surfaces
from robocal_ros.ground.errors import ResidualError

# ---- profile noise ------------------------------------------------------------------------------


Array = NDArray[np.float64]


# ---- the corners of a staircase, from one profile -----------------------------------------------


Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CornerRule(SurfaceRule):
    """What the corners in a profile must be like.

    Attributes
    ----------
    count : how many corners the profile must show, convex and concave ones; None takes what is
        there.
    classic : the published form instead of the best one.
    repair_m : classic only: a corner farther than this from the line through its like is moved.
    """

    count: int | None = None
    classic: bool = False
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
    profile, noise = ordered(rows, "corners")
    backwards = rows[-1, 0] < rows[0, 0]
    found = (_classic if rule.classic else _best)(profile, noise, rule)
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


def _best(profile: Array, noise: float, rule: CornerRule) -> CornerFit:
    found = surfaces(profile, noise, rule)
    corners = [corner for corner in found.corners if corner is not None]
    ends = [
        place
        for a, b, corner in zip(found.flanks[:-1], found.flanks[1:], found.corners, strict=True)
        if corner is None
        for place in (a.at(a.end_m), b.at(b.start_m))
    ]
    return CornerFit(
        points=np.array([corner.point for corner in corners]).reshape(-1, 2),
        covariance=np.array([corner.covariance for corner in corners]).reshape(-1, 2, 2),
        repaired=np.zeros(len(corners), dtype=np.bool_),
        convex=np.array([corner.turn_rad > 0.0 for corner in corners], dtype=np.bool_),
        left_out=np.array(ends).reshape(-1, 2),
        noise_m=noise,
    )


def _classic(profile: Array, noise: float, rule: CornerRule) -> CornerFit:
    """The farthest points; their covariance is that of a column more or less."""
    spacing = float(np.median(np.diff(profile[:, 0])))
    vertices = profile[split(profile, off_chord(noise, spacing))]
    steps = np.diff(vertices, axis=0)
    points = vertices[1:-1]
    turn = steps[:-1, 0] * steps[1:, 1] - steps[:-1, 1] * steps[1:, 0]
    column = steps / np.maximum(steps[:, :1], np.finfo(float).tiny)
    column *= spacing
    spread = np.einsum("ki,kj->kij", column, column)
    covariance = 0.5 * (spread[:-1] + spread[1:]) + noise**2 * np.eye(2)
    repaired = np.zeros(len(points), dtype=np.bool_)
    for kind in (turn > 0.0, turn <= 0.0):
        points[kind], repaired[kind] = _repaired(points[kind], rule.repair_m)
    return CornerFit(points, covariance, repaired, turn > 0.0, np.empty((0, 2)), noise)


def _repaired(points: Array, limit: float) -> tuple[Array, Mask]:
    """Points (k, 2), of which those far from the line through the others lie on it, at their x.

    The line is the best through any two of them (RANSAC with all pairs tried), then the least
    squares of those near it.
    """
    if len(points) < 3:
        return points, np.zeros(len(points), dtype=np.bool_)
    first, second = np.triu_indices(len(points), 1)
    chord = points[second] - points[first]
    normals = np.column_stack([-chord[:, 1], chord[:, 0]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    distance = np.abs(normals @ points.T - np.sum(normals * points[first], axis=1)[:, None])
    best = np.argmin(np.sum(np.minimum(distance, limit) ** 2, axis=1))
    far = distance[best] > limit
    slope, offset = np.polyfit(points[~far, 0], points[~far, 1], 1)
    z = np.where(far, slope * points[:, 0] + offset, points[:, 1])
    return np.column_stack([points[:, 0], z]), np.asarray(far)


def _require(fit: CornerFit, rule: CornerRule) -> None:
    found = len(fit.points)
    if found and rule.count in (None, found):
        return
    expected = "at least one" if rule.count is None else str(rule.count)
    message = f"the profile shows {found} corners, expected {expected}"
    if found:
        message += f"; they are at {places(fit.points)}"
    if len(fit.left_out):
        message += f"; surfaces end without a known corner at {places(fit.left_out)}"
    raise ResidualError(
        message + ": let the laser line cross the steps only, and turn the sensor so that it sees "
        "both sides of each"
    )


def places(points: Array) -> str:
    """Points (k, 2) of a profile in words."""
    return ", ".join(f"({x:.2f}, {z:.2f}) mm" for x, z in points * 1e3)
