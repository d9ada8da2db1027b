# SPDX-License-Identifier: Apache-2.0
"""Profiles of known shapes, as a line-laser sensor would measure them: simulated."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NOISE_M = 3.7e-5
COLUMNS = np.linspace(-0.045, 0.045, 1280)  # x, m
TABLE_M = 0.208


def arc_profile(
    circle: tuple[float, float, float],
    rng: np.random.Generator,
    *,
    noise: float = NOISE_M,
    along: str = "normal",
    half_angle: float = np.radians(65.0),
    x: Array = COLUMNS,
    table: bool = True,
) -> tuple[Array, NDArray[np.bool_]]:
    """Points (n, 2) of a circle's near side before a table, and which ones are the circle's.

    The noise is along the surface's normal or along the beam.
    """
    x0, z0, r = circle
    angle = (x - x0) / r
    on = np.abs(angle) < np.sin(half_angle)
    angle = np.arcsin(np.clip(angle, -1.0, 1.0))
    error = rng.normal(scale=noise, size=len(x))
    points = np.column_stack([x, np.full(len(x), TABLE_M) + 0.02 * x + error])
    arc = np.column_stack([np.sin(angle), -np.cos(angle)])
    shift = arc * error[:, None] if along == "normal" else np.array([0.0, 1.0]) * error[:, None]
    points[on] = (np.array([x0, z0]) + r * arc + shift)[on]
    keep = on | table
    return points[keep], on[keep]


def stairs(
    steps: int, tilt: float, *, tread: float = 0.01, rise: float = 0.01, ends: float = 0.012
) -> Array:
    """Vertices (2 steps + 1, 2) of a staircase, turned by tilt: its corners and both its ends.

    At a tilt of 45 deg treads and risers are seen alike. The corners in between alternate, the
    first is convex.
    """
    moves = [(tread, 0.0), (0.0, rise)] * steps
    moves = [(ends, 0.0), *moves[1:-1], (0.0, ends)]
    vertices = np.vstack([[0.0, 0.0], np.cumsum(moves, axis=0)])
    turn = np.array([[np.cos(tilt), np.sin(tilt)], [-np.sin(tilt), np.cos(tilt)]])
    vertices = vertices @ turn.T
    return np.asarray(vertices - vertices.mean(axis=0) + np.array([0.0, 0.2]))


def polyline_profile(
    vertices: Array, rng: np.random.Generator, *, noise: float = NOISE_M, x: Array = COLUMNS
) -> Array:
    """Points (n, 2) of straight surfaces between vertices (v, 2) ascending in x; noise along z."""
    seen = x[(x > vertices[0, 0]) & (x < vertices[-1, 0])]
    z = np.interp(seen, vertices[:, 0], vertices[:, 1])
    return np.column_stack([seen, z + rng.normal(scale=noise, size=len(seen))])


def contaminated(
    points: Array, rng: np.random.Generator, *, spikes: float = 0.03, gaps: int = 4
) -> tuple[Array, NDArray[np.int64]]:
    """Points with spikes of up to 10 mm and gaps of 25 columns, and which rows are left."""
    points = points.copy()
    spiked = rng.random(len(points)) < spikes
    points[spiked, 1] += rng.uniform(-0.01, 0.01, np.sum(spiked))
    keep = np.ones(len(points), dtype=np.bool_)
    for start in rng.integers(len(points), size=gaps):
        keep[start : start + 25] = False
    return points[keep], np.flatnonzero(keep)


def turned(vertices: Array, angle: float) -> Array:
    """Vertices (v, 2) turned about (0, 0.2)."""
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    middle = np.array([0.0, 0.2])
    return np.asarray((vertices - middle) @ turn.T + middle)


def mean_squares_agree(squares: Array, dof: int) -> bool:
    """Whether the mean of squared, normalised errors (m,) is that of chi-square with dof.

    Within 5 % (2.5 % of the standard deviation) and 3.5 standard deviations of the mean.
    """
    mean = float(np.mean(squares)) / dof
    scatter = 3.5 * float(np.sqrt(2.0 / (dof * len(squares))))
    return abs(mean - 1.0) < 0.05 + scatter
