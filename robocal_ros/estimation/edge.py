# SPDX-License-Identifier: Apache-2.0
"""The corners of a staircase, and the edge or groove of a straight-line target, from one profile.

*Classic*, as published: the corners are the points at which the profile is split, and one that is
off the line through its like is moved onto it along z; an edge or groove is the extremum of the
second derivative of the profile, refined below the sample spacing by a parabola. *Best*: where
neighbouring surfaces meet, each fitted by a robust line (of an edge, the two of the sharpest
turn); where a surface falls away and its neighbour is not seen, the edge is where it ends.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.signal import savgol_coeffs, savgol_filter

from robocal_ros.estimation.surfaces import (
    OPPOSITE,
    SMOOTHED,
    SurfaceRule,
    Surfaces,
    mirror,
    off_chord,
    ordered,
    smoothed,
    split,
    surfaces,
)
from robocal_ros.ground.errors import ResidualError, TooFewSamplesError
from robocal_ros.ground.frames import Array, Mask

# ---- the corners of a staircase, from one profile -----------------------------------------------


@dataclass(frozen=True)
class CornerRule(SurfaceRule):
    """What the corners in a profile must be like.

    ``count``: how many corners the profile must show, convex and concave ones; None takes what is
    there. ``classic``: the published form instead of the best one. ``repair_m``: classic only: a
    corner farther than this from the line through its like is moved.
    """

    count: int | None = None
    classic: bool = False
    repair_m: float = 2e-4


@dataclass(frozen=True, eq=False)
class CornerFit:
    """Corners in the order of the laser line.

    ``points`` (k, 2): x, z in the sensor frame, m. ``covariance`` (k, 2, 2): m^2; neighbours share
    a surface, so their errors are not independent. ``repaired`` (k,): moved onto the line through
    the others; in the best form none is. ``convex`` (k,): outer edges, nearer to the sensor than
    the surfaces beside them. ``left_out`` (j, 2): where a surface ends without a corner that is
    known: its neighbour was not seen, or too little of it. ``noise_m``: standard deviation of a
    point along z, from the profile. ``sides``: points (n, 2) on the two surfaces that meet at each
    corner, m; classic tells none.
    """

    points: Array
    covariance: Array
    repaired: Mask
    convex: Mask
    left_out: Array
    noise_m: float
    sides: tuple[tuple[Array, Array], ...] = ()


def fit_corners(points: Array, rule: CornerRule) -> CornerFit:
    """Find the corners of straight surfaces in points (n, 2) of a profile: x, z in m.

    Points are in the order of the sensor's columns.

    Raises `TooFewSamplesError`: fewer than 20 finite points; `ResidualError`: no corner, or another
    number of them than expected: the message says where they are, and where surfaces end without
    one.
    """
    rows = points[np.all(np.isfinite(points), axis=1)]
    turned = mirror(rule.towards)
    profile, noise = ordered(rows * turned, "corners")
    backwards = rows[-1, 0] < rows[0, 0]
    found = (_classic_corners if rule.classic else _best_corners)(profile, noise, rule)
    if backwards:
        found = CornerFit(
            found.points[::-1],
            found.covariance[::-1],
            found.repaired[::-1],
            found.convex[::-1],
            found.left_out[::-1],
            noise,
            found.sides[::-1],
        )
    found = replace(
        found,
        points=found.points * turned,
        covariance=found.covariance * np.outer(turned, turned),
        left_out=found.left_out * turned,
        sides=tuple((a * turned, b * turned) for a, b in found.sides),
    )
    _require(found, rule)
    return found


def _best_corners(profile: Array, noise: float, rule: CornerRule) -> CornerFit:
    found = surfaces(profile, noise, rule)
    corners = [corner for corner in found.corners if corner is not None]
    pairs = list(zip(found.flanks[:-1], found.flanks[1:], found.corners, strict=True))
    ends = [
        place
        for a, b, corner in pairs
        if corner is None
        for place in (a.at(a.end_m), b.at(b.start_m))
    ]
    on = {id(flank): profile[flank.rows] for flank in found.flanks}  # a surface has one array
    return CornerFit(
        points=np.array([corner.point for corner in corners]).reshape(-1, 2),
        covariance=np.array([corner.covariance for corner in corners]).reshape(-1, 2, 2),
        repaired=np.zeros(len(corners), dtype=np.bool_),
        convex=np.array([corner.turn_rad > 0.0 for corner in corners], dtype=np.bool_),
        left_out=np.array(ends).reshape(-1, 2),
        noise_m=noise,
        sides=tuple((on[id(a)], on[id(b)]) for a, b, corner in pairs if corner is not None),
    )


def _classic_corners(profile: Array, noise: float, rule: CornerRule) -> CornerFit:
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


# ---- the feature of a straight-line target, an edge or a groove, from one profile ---------------

Kind = Literal["edge", "groove"]

_WINDOW = 21  # columns of the smoothing
_DEGREE = 3
_WIDEST = 5.0  # columns without a return beyond the end of a surface
_RIVAL = 0.8  # share of the sharpest turn at which another one could be meant as well


@dataclass(frozen=True)
class EdgeRule(SurfaceRule):
    """What the feature in a profile must be like.

    ``kind``: "edge" is an outer edge, nearer to the sensor than the surfaces beside it; where the
    best form finds none, it is the end of a surface beyond which a farther one is seen. "groove" is
    an inner edge, the bottom of a groove or the foot of a step, farther from the sensor than the
    surfaces beside it. ``classic``: the published form instead of the best one: the largest second
    derivative of z over x for an edge, the smallest (most negative) for a groove.
    """

    kind: Kind = "edge"
    classic: bool = False


@dataclass(frozen=True, eq=False)
class EdgeFit:
    """A feature.

    ``point`` (2,): x, z in the sensor frame, m. ``covariance`` (2, 2): m^2. ``sides``: points (n,
    2) on the surfaces that meet there, m; none where one ends alone, and in the classic form.
    """

    point: Array
    covariance: Array
    sides: tuple[Array, ...] = ()


def fit_edge(points: Array, rule: EdgeRule) -> EdgeFit:
    """Find the edge or groove in points (n, 2) of a profile: x, z in m.

    Raises `TooFewSamplesError`: fewer than 20 finite points; `ResidualError`: no such feature, or
    several that could be meant: the message says where.
    """
    turned = mirror(rule.towards)
    profile, noise = ordered(points * turned, rule.kind)
    found = (_classic if rule.classic else _best)(profile, noise, rule)
    sides = tuple(side * turned for side in found.sides)
    return EdgeFit(found.point * turned, found.covariance * np.outer(turned, turned), sides)


def _best(profile: Array, noise: float, rule: EdgeRule) -> EdgeFit:
    candidates = _candidates(profile, noise, rule)
    if len(candidates) == 1:
        return candidates[0]
    others = [] if candidates else _candidates(profile * mirror(True), noise, rule)
    if len(others) == 1:
        other = "groove" if rule.kind == "edge" else "edge"
        where = places(others[0].point[None] * mirror(not rule.towards))
        raise ResidualError(
            f"the profile shows one {other}, at {where}, and no {rule.kind}: if z of this sensor "
            f"grows the other way set z_grows {OPPOSITE[rule.towards]}, else the line is a {other}"
        )
    seen = np.array([c.point for c in candidates]).reshape(-1, 2) * mirror(rule.towards)
    where = f", at {places(seen)}" if candidates else ""
    raise ResidualError(
        f"the profile shows {len(candidates)} {rule.kind}s{where}, expected one: let the laser "
        f"line cross the {rule.kind} so that both of its sides are seen, and nothing else like it"
    )


def _candidates(profile: Array, noise: float, rule: EdgeRule) -> list[EdgeFit]:
    """What could be meant: the sharpest corners of this kind, else the ends of surfaces."""
    found = surfaces(profile, noise, rule)
    sign = 1.0 if rule.kind == "edge" else -1.0
    pairs = zip(found.flanks[:-1], found.flanks[1:], found.corners, strict=True)
    corners = [(a, b, c) for a, b, c in pairs if c is not None and sign * c.turn_rad > 0.0]
    if corners:
        sharpest = max(abs(c.turn_rad) for _, _, c in corners)
        return [
            EdgeFit(c.point, c.covariance, (profile[a.rows], profile[b.rows]))
            for a, b, c in corners
            if abs(c.turn_rad) >= _RIVAL * sharpest
        ]
    return _ends(found, profile) if rule.kind == "edge" else []


def _ends(found: Surfaces, profile: Array) -> list[EdgeFit]:
    """Where a surface ends before a farther one: between its last point and the next one seen.

    Where the sensor saw nothing for several columns nobody knows where the surface ends.
    """
    x = profile[:, 0]
    widest = _WIDEST * float(np.median(np.diff(x)))
    ends = []
    for a, b, corner in zip(found.flanks[:-1], found.flanks[1:], found.corners, strict=True):
        if corner is not None:
            continue
        if a.at(a.end_m)[1] < b.at(b.start_m)[1]:
            flank, row, beyond = a, int(a.rows[-1]), int(a.rows[-1]) + 1
        else:
            flank, row, beyond = b, int(b.rows[0]), int(b.rows[0]) - 1
        gap = float(x[beyond] - x[row])
        if abs(gap) > widest:
            continue
        column = gap / float(flank.direction[0])
        end = flank.along(profile[row]) + 0.5 * column
        axes = np.array([flank.direction, flank.normal])
        variances = np.array([column**2 / 12.0, flank.variance(end)])
        ends.append(EdgeFit(flank.at(end), (axes.T * variances) @ axes))
    return ends


def _classic(profile: Array, noise: float, rule: EdgeRule) -> EdgeFit:
    """Extremum of the second derivative of the smoothed profile, refined by a parabola."""
    kind = rule.kind
    x, first = np.unique(profile[:, 0], return_index=True)
    if len(x) < 2 * _WINDOW:
        raise TooFewSamplesError(
            f"{len(x)} columns give no {kind}: at least {2 * _WINDOW} are needed; check the "
            "exposure and that the target is in range"
        )
    grid, spacing = np.linspace(x[0], x[-1], len(x), retstep=True)
    height = smoothed(np.column_stack([grid, np.interp(grid, x, profile[first, 1])]))[:, 1]
    curvature = savgol_filter(height, _WINDOW, _DEGREE, deriv=2, delta=spacing)
    curvature *= 1.0 if kind == "edge" else -1.0
    inner = slice(_WINDOW // 2 + 1, -_WINDOW // 2 - 1)
    top = _WINDOW // 2 + 1 + int(np.argmax(curvature[inner]))
    before, peak, after = curvature[top - 1 : top + 2]
    bend = before - 2.0 * peak + after
    if peak <= 0.0 or bend >= 0.0:
        raise ResidualError(
            f"the second derivative of the profile has no extremum of the kind {kind}: let the "
            "laser line cross it"
        )
    shift = 0.5 * (before - after) / bend
    kernel = savgol_coeffs(_WINDOW, _DEGREE, deriv=2, delta=spacing)
    difference = np.pad(kernel, (2, 0)) - np.pad(kernel, (0, 2))
    sigma = spacing * noise * float(np.linalg.norm(difference)) / (2.0 * abs(bend))
    at = float(grid[top] + shift * spacing)
    near = height[top - SMOOTHED : top + SMOOTHED + 1]
    x_variance = sigma**2 + spacing**2 / 12.0
    steepness = float(np.mean((np.diff(near) / spacing) ** 2))
    return EdgeFit(
        point=np.array([at, float(np.interp(at, grid, height))]),
        covariance=np.diag([x_variance, noise**2 + steepness * x_variance]),
    )
