"""A production programme: from pose to pose, a rest at each, and the way home."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

PEAK = 1.875  # of a minimum-jerk motion's speed, over its mean
SPEED_RAD_S = 1.5  # of the fastest joint at its peak
REST_S = 0.5
SHORTEST_S = 0.5  # of a motion


def programme(
    q_start: ArrayLike, poses: ArrayLike, speed: float = SPEED_RAD_S, rest_s: float = REST_S
) -> tuple[Array, Array, Array, Array]:
    """Times (k,) from 0, joints, velocities and accelerations (k, n) of a way through poses.

    From ``q_start`` (n,) at rest to each of ``poses`` (m, n) in turn, with a rest at each: what
    `SimulatedCell.follow` takes. ``speed``: of the fastest joint, rad/s
    (prismatic: m/s); ``rest_s`` longer than 0.
    """
    points = np.vstack([np.asarray(q_start)[None], np.asarray(poses)])
    moves = np.maximum(PEAK * np.max(np.abs(np.diff(points, axis=0)), axis=1) / speed, SHORTEST_S)
    depart = np.cumsum(moves + rest_s)
    time = np.column_stack([depart - rest_s, depart]).ravel()
    q = np.repeat(points[1:], 2, axis=0)
    return time, q, np.zeros_like(q), np.zeros_like(q)
