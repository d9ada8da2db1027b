"""A first pose of the sensor from circles on a sphere, and the classic closed form.

A circle tells the sphere's centre but for the side: y = +-sqrt(R^2 - r^2). The sides are found with
the pose: of all patterns of a few profiles, the right one agrees best (with rotation columns that
are a rotation; the mirrored pattern has the determinant -1).
"""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.hand_eye.mount_problem import MountState
from robocal_ros.hand_eye.sightings import Index, Sightings
from robocal_ros.hand_eye.target_models import circle_centres

Array = NDArray[np.float64]

FEWEST_PROFILES = 5
SUBSET = 6  # profiles whose sides are tried in all patterns
DRAWS = 24  # one of them holds no wrong pair, very likely, even with four among 15
MIRROR = np.array([1.0, -1.0, 1.0])
KEPT = 3  # starts of each draw, and in the end


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
    best = np.argsort(score)[:KEPT]
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
    best = np.argsort(np.sum(miss**2, axis=1))[:KEPT]
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
