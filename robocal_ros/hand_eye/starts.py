"""First poses of the sensor from corners at known places, and from points on a straight line."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import solve
from robocal_ros.estimation.polyline import CornerFit
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, TooFewSamplesError
from robocal_ros.hand_eye.mount_problem import MountProblem, MountState, PoseNoise, TargetView
from robocal_ros.hand_eye.target_models import Index, Sightings, circle_centres, in_plane

# ---- edge start ---------------------------------------------------------------------------------


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


# ---- a first pose of the sensor from circles on a sphere, and the classic closed form -----------
#
# A circle tells the sphere's centre but for the side: y = +-sqrt(R^2 - r^2). The sides are found
# with the pose: of all patterns of a few profiles, the right one agrees best (with rotation
# columns that are a rotation; the mirrored pattern has the determinant -1).


FEWEST_PROFILES = 5
SUBSET = 6  # profiles whose sides are tried in all patterns
DRAWS = 24  # one of them holds no wrong pair, very likely, even with four among 15
MIRROR = np.array([1.0, -1.0, 1.0])
KEPT_SPHERES = 3  # starts of each draw, and in the end


def linear_mounts(T_base_flange: Array, centres: Array) -> tuple[Array, Array]:
    """Classic closed form for many patterns (p) of sides: M (p, 3, 3), t (p, 3).

    R_i (M s_i + t) + t_i = c is linear in M and t; differences from the mean leave out c. M is
    near the rotation of the sensor. ``centres`` (p, m, 3): the sphere in each sensor frame.
    """
    R, place = T_base_flange[:, :3, :3], T_base_flange[:, :3, 3]
    p, m = centres.shape[:2]
    A = np.concatenate([np.einsum("mij,pmk->pmijk", R, centres).reshape(p, m, 3, 9),
                        np.broadcast_to(R, (p, m, 3, 3))], axis=3)  # fmt: skip
    A = (A - A.mean(axis=1, keepdims=True)).reshape(p, 3 * m, 12)
    b = -(place - place.mean(axis=0)).reshape(-1)
    solution = np.linalg.pinv(A, rcond=1e-9) @ b
    return solution[:, :9].reshape(p, 3, 3), solution[:, 9:]


def _placed(T_base_flange: Array, turn: Array, centres: Array) -> tuple[Array, Array]:
    """X (p, 4, 4) and sphere (p, 3) that fit best with these rotations (p, 3, 3) of the sensor."""
    R, place = T_base_flange[:, :3, :3], T_base_flange[:, :3, 3]
    p, m = centres.shape[:2]
    # R_i t - c = -(R_i M s_i + t_i)
    lhs = np.concatenate([R, np.broadcast_to(-np.eye(3), (m, 3, 3))], axis=2).reshape(3 * m, 6)
    rhs = np.einsum("mij,pjk,pmk->pmi", R, turn, centres) + place
    solution = -(np.linalg.pinv(lhs, rcond=1e-9) @ rhs.reshape(p, 3 * m).T).T
    return frames.transform(turn, solution[:, :3]), solution[:, 3:]


def _misses(T_base_flange: Array, X: Array, place: Array, centres: Array) -> Array:
    """Distances (p, m) of centres (p, m, 3), put into base, from each sphere (p, 3)."""
    T = T_base_flange[None] @ X[:, None]
    return np.asarray(np.linalg.norm(frames.apply(T, centres) - place[:, None], axis=2))


def sphere_starts(sightings: Sightings, radius_m: float) -> list[MountState]:
    """The most promising starts, best first: each from a few profiles, judged on all of them."""
    rng = np.random.default_rng(0)
    m = len(sightings.names)
    X_all, c_all = [], []
    for draw in range(DRAWS if m > SUBSET else 1):
        rows = np.arange(m) if m <= SUBSET else _subset(m, draw, rng)
        X, c = _by_patterns(sightings.take(rows), radius_m)
        X_all.append(X)
        c_all.append(c)
    X, c = np.concatenate(X_all), np.concatenate(c_all)
    T = sightings.T_base_flange
    sides = _sides(T, X, c)
    centres = _on_sides(sightings, radius_m, sides)
    score = np.median(_misses(T, X, c, centres), axis=1)
    best = np.argsort(score)[:KEPT_SPHERES]
    return [MountState(X[i], (c[i],)) for i in best]


def _subset(m: int, draw: int, rng: np.random.Generator) -> Index:
    if draw == 0:  # spread over the whole set
        return np.linspace(0, m - 1, SUBSET).round().astype(np.int64)
    return np.sort(rng.permutation(m)[:SUBSET]).astype(np.int64)


def _by_patterns(sightings: Sightings, radius_m: float) -> tuple[Array, Array]:
    """The best poses from these profiles, over all patterns of sides."""
    m = len(sightings.names)
    patterns = np.array([(1.0, *rest) for rest in product((1.0, -1.0), repeat=m - 1)])
    M, _ = linear_mounts(sightings.T_base_flange, _on_sides(sightings, radius_m, patterns))
    turn = frames.nearest_rotation(np.concatenate([M, M * MIRROR]))  # of the opposite pattern too
    centres = _on_sides(sightings, radius_m, np.concatenate([patterns, -patterns]))
    X, c = _placed(sightings.T_base_flange, turn, centres)
    miss = _misses(sightings.T_base_flange, X, c, centres)
    best = np.argsort(np.sum(miss**2, axis=1))[:KEPT_SPHERES]
    return X[best], c[best]


def _on_sides(sightings: Sightings, radius_m: float, sides: Array) -> Array:
    """Sphere centres (p, m, 3), sensor frame, for many patterns of sides (p, m)."""
    value = np.broadcast_to(sightings.value, (*sides.shape, 3)).reshape(-1, 3)
    return circle_centres(value, radius_m, sides.ravel()).reshape(*sides.shape, 3)


def _sides(T_base_flange: Array, X: Array, place: Array) -> Array:
    """Sides (p, m) of the laser planes on which each solution's sphere lies."""
    T = T_base_flange[None] @ X[:, None]
    y = np.einsum("pmj,pmj->pm", T[..., :3, 1], place[:, None] - T[..., :3, 3])
    return np.where(y < 0.0, -1.0, 1.0)


def classic_sphere(sightings: Sightings, radius_m: float, near: MountState) -> MountState:
    """Classic: the closed form from all profiles, their sides as in a state near the solution."""
    X, place = near.T_flange_sensor[None], near.places[0][None]
    side = _sides(sightings.T_base_flange, X, place)[0]
    centres = circle_centres(sightings.value, radius_m, side)
    M, t = linear_mounts(sightings.T_base_flange, centres[None])
    found = frames.transform(frames.nearest_rotation(M[0]), t[0])
    T = sightings.T_base_flange @ found
    return MountState(found, (frames.apply(T, centres).mean(axis=0),))


def agreed_centre(sightings: Sightings, radius_m: float, T_flange_sensor: Array) -> Array:
    """The centre (3,) in base, the sensor held: each profile on the side on which they agree."""
    T = sightings.T_base_flange @ T_flange_sensor
    both = []
    for side in (1.0, -1.0):
        own = circle_centres(sightings.value, radius_m, np.full(len(T), side))
        both.append(frames.apply(T, own))
    points = np.concatenate(both)
    gap = np.linalg.norm(points[:, None, None] - np.stack(both)[None], axis=3).min(axis=1)
    near = points[int(np.argmin(np.median(gap, axis=1)))]
    side = np.argmin(np.linalg.norm(np.stack(both) - near, axis=2), axis=0)
    return np.asarray(np.median(np.stack(both)[side, np.arange(len(T))], axis=0))


# ---- which corner of a profile is which corner of the staircase ---------------------------------
#
# A profile may show more corners than are wanted (concave ones, the block's rear edge, the table)
# or fewer. First each profile is laid along the target by the distances between its corners; the
# pose that comes of this then tells, for every profile, where each corner must be.


CLEAR = 1.5  # times better than the next, from which a place along the target is sure
NEAR = 0.35  # of the distance between neighbours: farther than this is another corner


@dataclass(frozen=True, eq=False)
class Match:
    """Corners of a profile (rows of its fit) and the target's that they are."""

    rows: Index
    corners: Index

    @property
    def turned(self) -> "Match":
        """The same the other way round, for a profile that shows the whole target."""
        return Match(self.rows, self.corners[::-1])


def along(fit: CornerFit, target: Array) -> Match | None:
    """Lay a profile's corners along all corners (k, 3) of a target; None where it is not clear."""
    k = len(target)
    spacing = np.linalg.norm(np.diff(target, axis=0), axis=1)
    every = np.arange(len(fit.points))
    found: list[tuple[float, Index]] = []
    for rows in (every, every[fit.convex], every[~fit.convex]):
        for first in range(len(rows) - k + 1):
            window = rows[first : first + k]
            own = np.linalg.norm(np.diff(fit.points[window], axis=0), axis=1)
            off = min(_difference(own, spacing), _difference(own, spacing[::-1]))
            if not any(np.array_equal(window, other) for _, other in found):
                found.append((off, window))
    found.sort(key=lambda pair: pair[0])
    if not found or (len(found) > 1 and found[1][0] < CLEAR * found[0][0]):
        return None
    return Match(found[0][1], np.arange(k))


def _difference(own: Array, spacing: Array) -> float:
    """How unlike distances are, a common scale counting little: a tilted plane stretches them."""
    if not len(own):
        return 0.0
    ratio = own / spacing
    return float(np.std(ratio) + 0.1 * abs(np.mean(ratio) - 1.0))


def nearest(fit: CornerFit, predicted: Array) -> Match:
    """The corners that lie where the target's (k, 2) are predicted, sensor frame, m."""
    gap = np.linalg.norm(fit.points[:, None] - predicted[None], axis=2)
    apart = np.linalg.norm(predicted[:, None] - predicted[None], axis=2)
    apart[np.diag_indices_from(apart)] = np.inf
    rows = np.argmin(gap, axis=0)
    least = gap[rows, np.arange(len(predicted))]
    mine = np.argmin(gap, axis=1)[rows] == np.arange(len(predicted))
    near = mine & (least < NEAR * apart.min(axis=1))
    return Match(rows[near].astype(np.int64), np.flatnonzero(near).astype(np.int64))
