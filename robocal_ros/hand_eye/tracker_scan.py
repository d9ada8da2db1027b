"""The scan of a cube and a sphere, built from profiles, and its parts."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import ResidualError
from robocal_ros.hand_eye.profile import Profile
from robocal_ros.hand_eye.tracker_cube import Cube, Plane, fit_plane, moment

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MOST_PLANES = 4
TRIPLES = 150
JUDGES = 800
REACH_M = 0.012  # between the points of a triple
NEAR_M = 3e-4  # of a part's own points
CLEAR_M = 1e-3  # points so near to another part may be of either
SMALLEST_SHARE = 0.03
FEWEST_PATCH_POINTS = 100
ROUNDS = 4
SHORTEST_RUN_M = 3e-3
WIDEST_GAP_M = 3e-3  # between neighbours on one part
SHORTEST_SCAN_M = 0.02
LARGEST_TURN_RAD = float(np.radians(5.0))


@dataclass(frozen=True, eq=False)
class Scan:
    """All profiles of a scan.

    Attributes
    ----------
    points : (n, 2) x and z in the sensor frame of their own profile, m.
    profile : (n,) number of the profile of each.
    motion : (m, 4, 4) flange pose of each profile in that of the first.
    """

    points: Array
    profile: Index
    motion: Array

    @classmethod
    def of(cls, profiles: Sequence[Profile], motion: Array) -> "Scan":
        """Join profiles; ``motion`` (m, 4, 4)."""
        xz = np.concatenate([profile.points for profile in profiles])
        number = np.repeat(np.arange(len(profiles)), [len(p.points) for p in profiles])
        return cls(xz, number, motion)

    def part(self, which: Index | NDArray[np.bool_]) -> "Scan":
        """The same scan with some of its points."""
        return Scan(self.points[which], self.profile[which], self.motion)

    def carried(self, T_flange_sensor: Array) -> Array:
        """Sensor pose (m, 4, 4) of each profile in that of the first."""
        return np.asarray(frames.invert(T_flange_sensor) @ self.motion @ T_flange_sensor)

    def built(self, T_flange_sensor: Array) -> Array:
        """Points (n, 3) in the sensor frame of the first profile."""
        T = self.carried(T_flange_sensor)[self.profile]
        x, z = self.points[:, :1], self.points[:, 1:]
        return np.asarray(T[:, :3, 0] * x + T[:, :3, 2] * z + T[:, :3, 3])

    @cached_property
    def _moments(self) -> Array:
        """Of each profile in its own sensor frame (m, 4, 4)."""
        x, z = self.points.T
        rows = (x * x, x * z, x, z * z, z, np.ones(len(x)))
        count = len(self.motion)
        sums = [np.bincount(self.profile, row, count) for row in rows]
        found = np.zeros((count, 4, 4))
        for row, (i, j) in zip(sums, ((0, 0), (0, 2), (0, 3), (2, 2), (2, 3), (3, 3)), strict=True):
            found[:, i, j] = found[:, j, i] = row
        return found

    def moment(self, T_flange_sensor: Array) -> Array:
        """`tracker_cube.moment` of the points `built`."""
        T = self.carried(T_flange_sensor)
        return np.asarray((T @ self._moments @ np.swapaxes(T, 1, 2)).sum(axis=0))

    def thinned(self, count: int) -> "Scan":
        """The same scan with every so-many-th of its points, about ``count`` of them."""
        return self.part(np.arange(0, len(self.points), max(len(self.points) // count, 1)))

    def direction(self) -> Array:
        """Unit vector (3,), flange, along which the flange moved from the first profile on.

        Raises
        ------
        ResidualError
            When it hardly moved, or turned.
        """
        way = self.motion[:, :3, 3]
        ends = way[np.argmax(np.linalg.norm(way, axis=1))]
        length = float(np.linalg.norm(ends))
        turn = float(np.linalg.norm(frames.log_rotation(self.motion[:, :3, :3]), axis=1).max())
        if length < SHORTEST_SCAN_M or turn > LARGEST_TURN_RAD:
            raise ResidualError(
                f"the scan moved over {length * 1e3:.1f} mm and turned by {np.degrees(turn):.1f} "
                f"deg: slide over at least {SHORTEST_SCAN_M * 1e3:.0f} mm without turning the "
                f"flange by more than {np.degrees(LARGEST_TURN_RAD):.0f} deg"
            )
        return np.asarray(ends / length)


def find_planes(scan: Scan, T_flange_sensor: Array) -> list[Index]:
    """Points of each flat part, the largest first.

    A plane stays one when the scan's direction is not known well: it is only sheared.

    Raises
    ------
    ResidualError
        When there are fewer than two.
    """
    cloud = scan.built(T_flange_sensor)
    rng = np.random.default_rng(0)
    free = np.ones(len(cloud), dtype=np.bool_)
    found: list[Index] = []
    while len(found) < MOST_PLANES:
        rest = np.flatnonzero(free)
        fewest = max(FEWEST_PATCH_POINTS, SMALLEST_SHARE * len(cloud))
        if len(rest) < fewest:
            break
        plane = _best_plane(cloud[rest], rng)
        if plane is None:
            break
        taken = rest[plane.distances(cloud[rest]) < NEAR_M]
        if len(taken) < fewest:
            break
        found.append(taken)
        free[taken] = False
    if len(found) < 2:
        raise ResidualError(
            f"the scan shows {len(found)} flat faces of the two that are needed: bring two faces "
            "of the cube into the sensor's range"
        )
    return found


def _best_plane(cloud: Array, rng: np.random.Generator) -> Plane | None:
    """The plane through three near points with the most points near it, refined."""
    judges = cloud[rng.integers(len(cloud), size=min(JUDGES, len(cloud)))]
    first = cloud[rng.integers(len(cloud), size=TRIPLES)]
    apart = np.linalg.norm(first[:, None] - judges, axis=2)
    near = np.where((apart > 0.2 * REACH_M) & (apart < REACH_M), rng.random(apart.shape), 0.0)
    order = np.argpartition(-near, 2, axis=1)[:, :2]
    whole = np.take_along_axis(near, order, axis=1).min(axis=1) > 0.0
    a, b = judges[order[whole, 0]] - first[whole], judges[order[whole, 1]] - first[whole]
    normal = np.cross(a, b)
    length = np.linalg.norm(normal, axis=1)
    wide = length > 0.3 * np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    normal = normal[wide] / length[wide, None]
    if not len(normal):
        return None
    miss = np.abs(judges @ normal.T - np.sum(first[whole][wide] * normal, axis=1))
    best = int(np.argmin(np.minimum(miss, 2.0 * NEAR_M).sum(axis=0)))
    chosen = judges[miss[:, best] < 2.0 * NEAR_M]
    if len(chosen) < 3:
        return None
    plane = fit_plane(moment(chosen))[0]
    for _ in range(ROUNDS):
        chosen = judges[plane.distances(judges) < NEAR_M]
        if len(chosen) < 3:
            return None
        plane = fit_plane(moment(chosen))[0]
    return plane


def parts_of(
    scan: Scan, T_flange_sensor: Array, seen: Cube, radius_m: float
) -> tuple[Scan, Scan, Scan]:
    """The scan of the first face, of the second and of the sphere; without points near another.

    ``seen`` is in the sensor frame of the first profile.
    """
    cloud = scan.built(T_flange_sensor)
    distance = np.linalg.norm(cloud - seen.centre, axis=1)
    first, second = np.abs(cloud @ seen.normals.T - seen.offsets).T
    off_ball = distance > radius_m + CLEAR_M
    on_ball = np.abs(distance - radius_m) < NEAR_M
    chosen = (
        (first < NEAR_M) & (second > CLEAR_M) & off_ball,
        (second < NEAR_M) & (first > CLEAR_M) & off_ball,
        on_ball & (np.minimum(first, second) > CLEAR_M),
    )
    faces_and_ball = [_unbroken(scan.part(which)) for which in chosen]
    return faces_and_ball[0], faces_and_ball[1], faces_and_ball[2]


def _unbroken(scan: Scan) -> Scan:
    """The longest run of points in each profile, where it is long enough.

    A face ends where its plane meets a table; beyond, the crossing of both is a short run.
    """
    points, profile = scan.points, scan.profile
    if not len(points):
        return scan
    apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > WIDEST_GAP_M
    begins = np.flatnonzero(np.concatenate([[True], apart | (np.diff(profile) > 0)]))
    ends = np.append(begins[1:], len(points)) - 1
    extent = np.linalg.norm(points[ends] - points[begins], axis=1)
    longest = np.full(len(scan.motion), SHORTEST_RUN_M)
    np.maximum.at(longest, profile[begins], extent)
    keep = extent >= longest[profile[begins]]
    return scan.part(np.repeat(keep, ends - begins + 1))
