"""Bodies that a simulated laser meets, and scenes of them; all geometry is in base, in metres."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

AWAY_M = 1e-9  # a ray does not meet the surface on which it begins
TABLE_M = 2.0


class ScannedBody(Protocol):
    """Anything that a ray meets."""

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays (n, 3) with unit directions (n, 3) first meet it.

        Returns the distances (n,), infinite for those that miss, and the outward unit normals
        (n, 3) there, any for those.
        """


@dataclass(frozen=True, eq=False)
class Ball:
    """A sphere; centre (3,)."""

    centre: Array
    radius_m: float

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """See `ScannedBody`."""
        away = origin - self.centre
        distance = _first_root(
            np.ones(len(away)),
            np.sum(away * direction, axis=1),
            np.sum(away**2, axis=1) - self.radius_m**2,
        )
        return distance, _at(away, direction, distance) / self.radius_m


@dataclass(frozen=True, eq=False)
class Stem:
    """The side of a round bar from ``start`` (3,) along the unit vector ``axis`` (3,)."""

    start: Array
    axis: Array
    radius_m: float
    length_m: float

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """See `ScannedBody`."""
        away = origin - self.start
        across = away - np.outer(away @ self.axis, self.axis)
        slant = direction - np.outer(direction @ self.axis, self.axis)
        distance = _first_root(
            np.sum(slant**2, axis=1),
            np.sum(across * slant, axis=1),
            np.sum(across**2, axis=1) - self.radius_m**2,
        )
        along = _at(away, direction, distance) @ self.axis
        distance = np.where((along >= 0.0) & (along <= self.length_m), distance, np.inf)
        return distance, _at(across, slant, distance) / self.radius_m


@dataclass(frozen=True, eq=False)
class Prism:
    """A body of one cross-section.

    Attributes
    ----------
    T_base_user : (4, 4) its frame.
    outline : (k, 2) corners y, z of the cross-section, once around.
    length_m : it reaches from x = 0 to there.
    """

    T_base_user: Array
    outline: Array
    length_m: float

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """See `ScannedBody`."""
        R, t = self.T_base_user[:3, :3], self.T_base_user[:3, 3]
        p, d = (origin - t) @ R, direction @ R
        best, normal = np.full(len(p), np.inf), np.zeros_like(p)
        for distance, outward in [*self._sides(p, d), *self._ends(p, d)]:
            nearer = distance < best
            best = np.where(nearer, distance, best)
            normal[nearer] = outward
        return best, normal @ R.T

    def _sides(self, p: Array, d: Array) -> list[tuple[Array, Array]]:
        found = []
        following = np.roll(self.outline, -1, axis=0)
        turn = np.sign(_area(self.outline))
        for a, b in zip(self.outline, following, strict=True):
            side = b - a
            outward = turn * np.array([0.0, side[1], -side[0]]) / np.linalg.norm(side)
            distance = _plane(p, d, outward, np.array([0.0, *a]))
            x, y, z = _at(p, d, distance).T
            share = ((y - a[0]) * side[0] + (z - a[1]) * side[1]) / (side @ side)
            inside = (x >= 0.0) & (x <= self.length_m) & (share >= 0.0) & (share <= 1.0)
            found.append((np.where(inside, distance, np.inf), outward))
        return found

    def _ends(self, p: Array, d: Array) -> list[tuple[Array, Array]]:
        found = []
        for x, sign in ((0.0, -1.0), (self.length_m, 1.0)):
            outward = np.array([sign, 0.0, 0.0])
            distance = _plane(p, d, outward, np.array([x, 0.0, 0.0]))
            inside = _inside(self.outline, _at(p, d, distance)[:, 1:])
            found.append((np.where(inside, distance, np.inf), outward))
        return found


@dataclass(frozen=True)
class Scene:
    """Bodies that stand still together."""

    bodies: Sequence[ScannedBody]

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """The first of all bodies that a ray meets; see `ScannedBody`."""
        best, normal = np.full(len(origin), np.inf), np.zeros_like(origin)
        for body in self.bodies:
            distance, outward = body.meet(origin, direction)
            nearer = distance < best
            best = np.where(nearer, distance, best)
            normal[nearer] = outward[nearer]
        return best, normal


def ball_on_table(centre: ArrayLike, radius_m: float, height_m: float = 0.08) -> Scene:
    """A ball on a stem of a quarter of its diameter, its centre ``height_m`` above a table."""
    c = np.asarray(centre, dtype=np.float64)
    foot = c - [0.0, 0.0, height_m]
    stem = Stem(foot, np.array([0.0, 0.0, 1.0]), 0.25 * radius_m, height_m)
    return Scene((Ball(c, radius_m), stem, table(foot)))


def table(place: ArrayLike) -> Prism:
    """A level table top around ``place`` (3,)."""
    half = 0.5 * TABLE_M
    T = np.eye(4)
    T[:3, 3] = np.asarray(place) - [half, 0.0, 0.0]
    return Prism(T, np.array([[-half, -0.05], [half, -0.05], [half, 0.0], [-half, 0.0]]), TABLE_M)


def stairs(
    T_base_user: Array, steps: int, length_m: float, height_m: float, depth_m: float
) -> Prism:
    """Steps cut from one block; they rise along y, x runs along the lowest front edge."""
    outline = [[0.0, 0.0]]
    for i in range(steps):
        outline += [[i * depth_m, (i + 1) * height_m], [(i + 1) * depth_m, (i + 1) * height_m]]
    return Prism(T_base_user, np.array([*outline, [steps * depth_m, 0.0]]), length_m)


def block(T_base_user: Array, length_m: float, width_m: float, height_m: float) -> Prism:
    """A block from the origin along x, y and down z: x is one of its upper edges."""
    outline = np.array([[0.0, 0.0], [0.0, -height_m], [width_m, -height_m], [width_m, 0.0]])
    return Prism(T_base_user, outline, length_m)


def grooved_block(
    T_base_user: Array, length_m: float, half_width_m: float, groove_m: float, depth_m: float
) -> Prism:
    """A block with a V-groove ``groove_m`` wide: x runs along its bottom, z up out of it."""
    w, g, bottom = half_width_m, 0.5 * groove_m, -depth_m
    yz = [[0.0, 0.0], [-g, depth_m], [-w, depth_m], [-w, bottom], [w, bottom], [w, depth_m]]
    return Prism(T_base_user, np.array([*yz, [g, depth_m]]), length_m)


def _at(origin: Array, direction: Array, distance: Array) -> Array:
    """Points (n, 3) on the rays; those that miss are put at the origin of their ray."""
    return np.asarray(origin + np.where(np.isfinite(distance), distance, 0.0)[:, None] * direction)


def _first_root(a: Array, b: Array, c: Array) -> Array:
    """Smallest root beyond ``AWAY_M`` of ``a t^2 + 2 b t + c = 0``, infinite without one."""
    with np.errstate(divide="ignore", invalid="ignore"):
        half = np.sqrt(b**2 - a * c)
        near, far = (-b - half) / a, (-b + half) / a
        t = np.where(near > AWAY_M, near, far)
        return np.where(t > AWAY_M, t, np.inf)  # not-a-number compares as false


def _plane(p: Array, d: Array, normal: Array, point: Array) -> Array:
    """Distances (n,) to a plane, infinite where it is behind the ray or beside it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = ((point - p) @ normal) / (d @ normal)
    return np.where(np.isfinite(t) & (t > AWAY_M), t, np.inf)


def _area(outline: Array) -> float:
    """Twice the signed area of a polygon."""
    y, z = outline.T
    return float(np.sum(y * np.roll(z, -1) - np.roll(y, -1) * z))


def _inside(outline: Array, points: Array) -> NDArray[np.bool_]:
    """Whether points (n, 2) are in a polygon, by the parity of a ray's crossings."""
    odd = np.zeros(len(points), dtype=bool)
    y, z = points.T
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if a[1] != b[1]:
            crosses = (a[1] > z) != (b[1] > z)
            odd ^= crosses & (y < a[0] + (z - a[1]) * (b[0] - a[0]) / (b[1] - a[1]))
    return odd
