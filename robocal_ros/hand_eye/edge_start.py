"""First poses of the sensor from corners at known places, and from points on a straight line."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import solve
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, TooFewSamplesError
from robocal_ros.hand_eye.mount_problem import MountProblem, MountState, PoseNoise, TargetView
from robocal_ros.hand_eye.sightings import Sightings, in_plane

Array = NDArray[np.float64]

TURNS = 400  # rotations of the sensor that are tried
DIRECTIONS = 60  # directions of an unknown line that are tried
KEPT = 8
PARTS = 50  # of the corners that are tried
ALIKE_M = 1e-6  # small, so that the descent goes to the very minimum
SEED = 5  # of the fixed set of trials
NO_STRETCH = 2e-3  # of their length: corners that lie on one line but for so much


def closed_corners(value: Array, p_flange: Array) -> Array:
    """Classic closed form: X (4, 4) from corners (m, 3) = (x, z, .) at flange points (m, 3).

    The nine unknowns of p = x r1 + z r3 + t, projected to a rotation and refined on it, are the
    rotation of the corners' cross-covariance (Kabsch 1976): the least squares of their distances.

    Raises
    ------
    TooFewSamplesError
        Fewer than three corners.
    RankDeficientError
        When all corners lie on one line of the laser plane.
    """
    if len(value) < 3:
        raise TooFewSamplesError(f"{len(value)} corners fit the target, at least 3 are needed")
    X, seen = _closed(value, p_flange)
    if not seen:
        words = "rotation about the line of the corners"
        raise RankDeficientError(
            f"not determined: {words}: all corners lie on one line of the laser plane; show the "
            "target from several poses, or a second line of corners",
            [words],
        )
    return X


def robust_corners(value: Array, p_flange: Array) -> Array:
    """`closed_corners` of the part of corners that agrees best, and then of those near them."""
    best = closed_corners(value, p_flange)
    rng = np.random.default_rng(SEED)
    m = len(value)
    rows = np.array([rng.permutation(m)[: max(4, m // 3)] for _ in range(PARTS)])
    X, seen = _closed(value[rows], p_flange[rows])
    median = np.median(_miss(X, value, p_flange), axis=1)
    median[~seen] = np.inf
    first = int(np.argmin(median))
    if seen[first]:
        best = X[first]
    near = _miss(best, value, p_flange) <= 3.0 * median[first]
    try:
        return closed_corners(value[near], p_flange[near])
    except (RankDeficientError, TooFewSamplesError):
        return best


def _closed(value: Array, p_flange: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Closed forms X (..., 4, 4) of corners (..., m, 3), and whether these show them at all."""
    own = in_plane(value)
    middle, there = own.mean(axis=-2, keepdims=True), p_flange.mean(axis=-2, keepdims=True)
    s = np.linalg.svd(own - middle, compute_uv=False)
    R = frames.nearest_rotation(np.swapaxes(p_flange - there, -1, -2) @ (own - middle))
    t = (there - middle @ np.swapaxes(R, -1, -2))[..., 0, :]
    return frames.transform(R, t), np.asarray(s[..., 1] > NO_STRETCH * s[..., 0])


def _miss(X: Array, value: Array, p_flange: Array) -> Array:
    """Distances (..., m) of corners that poses (..., 4, 4) put into the flange frame."""
    found = in_plane(value) @ np.swapaxes(X[..., :3, :3], -1, -2) + X[..., None, :3, 3]
    return np.asarray(np.linalg.norm(found - p_flange, axis=-1))


def line_starts(sightings: Sightings, line: Array | None) -> list[MountState]:
    """The most promising starts for features (x, z) of one straight line, best first.

    ``line`` (2, 3): a point and the unit direction in base; None for an unknown line. With the
    sensor's rotation and the line's direction held, all the rest is linear: both are tried over a
    fixed set, and the best are handed to the maximum likelihood.
    """
    rng = np.random.default_rng(SEED)
    turns = _random_rotations(TURNS, rng)
    if line is not None:
        directions = line[1][None]
    else:
        sphere = rng.standard_normal((DIRECTIONS, 3))
        directions = sphere / np.linalg.norm(sphere, axis=1)[:, None]
    R = sightings.T_base_flange[:, :3, :3]
    seen = _turned(sightings, turns)
    found = [_held(R, seen, u, None if line is None else line[0]) for u in directions]
    costs = np.array([cost for cost, _, _ in found])  # (directions, turns)
    starts = []
    for flat in np.argsort(costs, axis=None)[:KEPT]:
        d, r = np.unravel_index(int(flat), costs.shape)
        _, t, point = found[int(d)]
        X = frames.transform(turns[int(r)], t[int(r)])
        starts.append(MountState(X, (np.stack([point[int(r)], directions[int(d)]]),)))
    return starts


def _random_rotations(count: int, rng: np.random.Generator) -> Array:
    from scipy.spatial.transform import Rotation

    quat = rng.standard_normal((count, 4))
    return np.asarray(Rotation.from_quat(quat).as_matrix())


def _turned(sightings: Sightings, turns: Array) -> Array:
    """Features (p, m, 3) in base with rotations (p, 3, 3) of a sensor at the flange's origin."""
    R, place = sightings.T_base_flange[:, :3, :3], sightings.T_base_flange[:, :3, 3]
    flange = in_plane(sightings.value) @ np.swapaxes(turns, 1, 2)
    return np.asarray((R @ flange[..., None])[..., 0] + place)


def _held(
    R: Array, seen: Array, direction: Array, point: Array | None
) -> tuple[Array, Array, Array]:
    """With rotations and a direction held: costs (p,), t (p, 3), points (p, 3) of the line.

    ``R`` (m, 3, 3) of the flange; ``seen`` (p, m, 3) as `_turned` gives it.
    """
    across = np.linalg.svd(direction[None])[2][1:]  # (2, 3)
    lhs = across @ R
    if point is None:
        lhs = np.concatenate([lhs, np.broadcast_to(-np.eye(2), (len(R), 2, 2))], axis=2)
    lhs = lhs.reshape(2 * len(R), -1)
    known = np.zeros(3) if point is None else point
    rhs = ((seen - known) @ across.T).reshape(len(seen), -1)
    solution = -(np.linalg.pinv(lhs, rcond=1e-9) @ rhs.T).T
    cost = np.sum((solution @ lhs.T + rhs) ** 2, axis=1)
    points = np.broadcast_to(known, (len(seen), 3))
    return cost, solution[:, :3], points if point is not None else solution[:, 3:] @ across


def least_distances(view: TargetView, near: MountState) -> MountState:
    """Classic: the sum of squared distances from the line, every feature alike.

    Raises
    ------
    RankDeficientError
        When the poses leave a direction open.
    """
    plain = np.tile(ALIKE_M**2 * np.eye(3), (len(view.sightings.names), 1, 1))
    alike = TargetView(view.model, replace(view.sightings, covariance=plain))
    problem = MountProblem((alike,), PoseNoise(0.0, 0.0), near)
    return solve(problem, near, robust=False, sizes=problem.sizes).settled()
