"""Where in a profile a circle may be: the start of `fit_arc`.

Circles through three points of the smoothed profile, at all places and several widths, judged by
truncated squares (MSAC, Torr and Zisserman 2000); the best ones are improved by Gauss-Newton
over the points near them (Chum, Matas and Kittler 2003) and judged again. Nothing is drawn at
random.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.profile_noise import smoothed

Array = NDArray[np.float64]

SMALLEST_SHARE, LARGEST_SHARE = 0.2, 1.5  # radius of a circle, of the sphere's
_FLAT_SHARE = 4.0  # what was thought a circle grows beyond this where it is a piece of a plane
_WIDTHS = (0.12, 0.2, 0.33, 0.55, 0.8)  # between the points of a triple, of the sphere's radius
_PLACES, _JUDGES = 128, 320
_BEST = 4
_REACHES = (2.0, 1.4, 1.0)  # limits, one after the other
_RIDGE = 1e-12  # keeps a flat piece solvable; where steps end it does not matter
_FEWEST = 8  # points that improve a start


def find_circle(points: Array, radius: float, limit: float) -> Array | None:
    """The circle (x0, z0, r) with its near side on most points (n, 2); None if there is none.

    Parameters
    ----------
    points : (n, 2) of the profile, m.
    radius : of the sphere, m; the circle's is 0.2 to 1.5 of it.
    limit : distance from the circle within which a point is near it, m.
    """
    circles = _through(_triples(points, radius))
    circles = circles[
        (circles[:, 2] > SMALLEST_SHARE * radius) & (circles[:, 2] < LARGEST_SHARE * radius)
    ]
    if not len(circles):
        return None
    judges = points[:: max(len(points) // _JUDGES, 1)]
    best = circles[np.argsort(_costs(circles, judges, limit), kind="stable")[:_BEST]]
    improved = np.array([_improved(circle, points, limit) for circle in best])
    improved = improved[improved[:, 2] < _FLAT_SHARE * radius]
    if not len(improved):
        return None
    return np.asarray(improved[np.argmin(_costs(improved, points, limit))])


def step(J: Array, residual: Array, weight: Array | float = 1.0) -> tuple[Array, Array]:
    """Least-squares increment (3,) of a circle and the normal matrix (3, 3) it comes from."""
    weighted = J.T * weight
    normal = weighted @ J
    ridge = _RIDGE * np.trace(normal) * np.eye(3)
    return -np.linalg.solve(normal + ridge, weighted @ residual), normal


def linearised(circle: Array, points: Array) -> tuple[Array, Array]:
    """Jacobian (n, 3) and residual (n,), distance from the centre less r, of points (n, 2).

    The unknowns are those of the circle (x0, z0, r).
    """
    away = points - circle[:2]
    distance = np.sqrt(np.einsum("ij,ij->i", away, away))
    J = np.full((len(points), 3), -1.0)
    J[:, :2] = -away / np.maximum(distance, np.finfo(float).tiny)[:, None]
    return J, distance - circle[2]


def _triples(points: Array, radius: float) -> Array:
    """Triples (t, 3, 2), left to right, of the smoothed profile."""
    smooth = smoothed(points[np.argsort(points[:, 0], kind="stable")])
    x = smooth[:, 0]
    middle = np.linspace(0, len(x) - 1, min(_PLACES, len(x))).round().astype(np.int64)
    reach = radius * np.array(_WIDTHS)[:, None]
    last = len(x) - 1
    left = np.searchsorted(x, x[middle] - reach).ravel()
    right = np.minimum(np.searchsorted(x, x[middle] + reach), last).ravel()
    rows = np.column_stack([left, np.tile(middle, len(_WIDTHS)), right])
    return np.asarray(smooth[rows])


def _through(triples: Array) -> Array:
    """Circles (c, 3) through triples (t, 3, 2); those whose near side passes through the middle."""
    a, b = triples[:, 0] - triples[:, 1], triples[:, 2] - triples[:, 1]
    area = 2.0 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    # The outer points lie further from the sensor than the middle one: the surface is convex.
    convex = area < -np.finfo(float).tiny
    a, b, area, middle = a[convex], b[convex], area[convex], triples[convex, 1]
    aa, bb = np.sum(a * a, axis=1), np.sum(b * b, axis=1)
    foot = np.column_stack([b[:, 1] * aa - a[:, 1] * bb, a[:, 0] * bb - b[:, 0] * aa])
    foot /= area[:, None]
    return np.column_stack([middle + foot, np.sqrt(np.sum(foot * foot, axis=1))])


def _costs(circles: Array, points: Array, limit: float) -> Array:
    """Truncated squares (c,) of the points' distances from the near sides of circles (c, 3)."""
    square = _misses(circles, points)
    np.square(square, out=square)
    square[points[:, 1] >= circles[:, 1:2]] = limit**2
    return np.asarray(np.minimum(square, limit**2, out=square).sum(axis=1))


def _misses(circles: Array, points: Array) -> Array:
    """Distances (c, n) of points from circles (c, 3), exact near the circle.

    ``((x - x0)^2 + (z - z0)^2 - r^2) / 2 r`` as one product of matrices.
    """
    away = points - points[0]  # so that squares of large numbers do not cancel
    x0, z0 = (circles[:, :2] - points[0]).T
    powers = np.stack([np.sum(away * away, axis=1), *away.T, np.ones(len(away))])
    r = circles[:, 2]
    shape = np.column_stack([np.ones(len(r)), -2.0 * x0, -2.0 * z0, x0**2 + z0**2 - r**2])
    return np.asarray((shape / (2.0 * r)[:, None]) @ powers)


def _improved(circle: Array, points: Array, limit: float) -> Array:
    for reach in _REACHES:
        near = np.abs(_misses(circle[None], points)[0]) < reach * limit
        near &= points[:, 1] < circle[1]
        if np.sum(near) < _FEWEST:
            break
        circle = circle + step(*linearised(circle, points[near]))[0]
    return circle
