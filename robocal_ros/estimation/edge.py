"""The feature of a straight-line target, an edge or a groove, from one profile.

*Classic*, as published for the line target: the extremum of the second derivative of the profile,
refined below the sample spacing by a parabola. *Best*: the straight surfaces are fitted by robust
lines, and the feature is where the two of the sharpest turn meet; where a surface falls away and
its neighbour is not seen, it is where the surface ends.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_coeffs, savgol_filter

from robocal_ros.estimation.polyline import places
from robocal_ros.estimation.surfaces import (
    SMOOTHED,
    SurfaceRule,
    Surfaces,
    ordered,
    smoothed,
    surfaces,
)
from robocal_ros.ground.errors import ResidualError, TooFewSamplesError

Array = NDArray[np.float64]

Kind = Literal["edge", "groove"]

_WINDOW = 21  # columns of the smoothing
_DEGREE = 3
_WIDEST = 5.0  # columns without a return beyond the end of a surface
_RIVAL = 0.8  # share of the sharpest turn at which another one could be meant as well


@dataclass(frozen=True)
class EdgeRule(SurfaceRule):
    """What the feature in a profile must be like.

    Attributes
    ----------
    kind : "edge" is an outer edge, nearer to the sensor than the surfaces beside it; where the best
        form finds none, it is the end of a surface beyond which a farther one is seen. "groove" is
        an inner edge, the bottom of a groove or the foot of a step, farther from the sensor than
        the surfaces beside it.
    classic : the published form instead of the best one: the largest second derivative of z over x
        for an edge, the smallest (most negative) for a groove.
    """

    kind: Kind = "edge"
    classic: bool = False


@dataclass(frozen=True, eq=False)
class EdgeFit:
    """A feature.

    Attributes
    ----------
    point : (2,) x, z in the sensor frame, m.
    covariance : (2, 2) m^2.
    """

    point: Array
    covariance: Array


def fit_edge(points: Array, rule: EdgeRule) -> EdgeFit:
    """Find the edge or groove in points (n, 2) of a profile: x, z in m.

    The sensor looks along +z.

    Raises
    ------
    TooFewSamplesError
        Fewer than 20 finite points.
    ResidualError
        No such feature, or several that could be meant: the message says where.
    """
    profile, noise = ordered(points, rule.kind)
    return _classic(profile, noise, rule.kind) if rule.classic else _best(profile, noise, rule)


def _best(profile: Array, noise: float, rule: EdgeRule) -> EdgeFit:
    found = surfaces(profile, noise, rule)
    sign = 1.0 if rule.kind == "edge" else -1.0
    corners = [c for c in found.corners if c is not None and sign * c.turn_rad > 0.0]
    if corners:
        sharpest = max(abs(corner.turn_rad) for corner in corners)
        corners = [c for c in corners if abs(c.turn_rad) >= _RIVAL * sharpest]
        candidates = [EdgeFit(corner.point, corner.covariance) for corner in corners]
    elif rule.kind == "edge":
        candidates = _ends(found, profile)
    else:
        candidates = []
    if len(candidates) != 1:
        where = f", at {places(np.array([c.point for c in candidates]))}" if candidates else ""
        raise ResidualError(
            f"the profile shows {len(candidates)} {rule.kind}s{where}, expected one: let "
            f"the laser line cross the {rule.kind} so that both of its sides are seen, and nothing "
            "else like it"
        )
    return candidates[0]


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


def _classic(profile: Array, noise: float, kind: Kind) -> EdgeFit:
    """Extremum of the second derivative of the smoothed profile, refined by a parabola."""
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
