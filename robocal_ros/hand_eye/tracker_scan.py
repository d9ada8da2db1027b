# SPDX-License-Identifier: Apache-2.0
"""The scan of a cube and a sphere, its parts, and the sensor's place from them in closed form.

Source: Jing, Hu and Guo 2020, with the slide along the sensor axis that the solution itself gives
instead of z (its equation 9). Which plane of the scan is which face, and whether the sensor moved
along its +y or -y, is found by trial: the angle between the faces and the sphere's heights above
them must be the tracker's.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations

import numpy as np

from robocal_ros.estimation.estimation import correlation
from robocal_ros.estimation.sphere import SphereRule, fit_sphere
from robocal_ros.estimation.surfaces import MAD
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    RankDeficientError,
    ResidualError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array, Index, Mask
from robocal_ros.hand_eye.mount_problem import from_plane, tangents
from robocal_ros.hand_eye.targets import TrackerTarget
from robocal_ros.hand_eye.tracker_data import (
    PARALLEL_FACES,
    Axis,
    Cube,
    Plane,
    TrackerData,
    TrackerNoise,
    fit_axes,
    fit_plane,
    flange_pose,
    moment,
    outward,
    reflector_in_flange,
    tracked_cube,
    two_axis_frame,
)

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

    ``points`` (n, 2): x and z in the sensor frame of their own profile, m; ``profile`` (n,): its
    number; ``motion`` (m, 4, 4): flange pose of each profile in that of the first.
    """

    points: Array
    profile: Index
    motion: Array

    def part(self, which: Index | Mask) -> "Scan":
        """The same scan with some of its points."""
        return Scan(self.points[which], self.profile[which], self.motion)

    def carried(self, T_flange_sensor: Array) -> Array:
        """Sensor pose (m, 4, 4) of each profile in that of the first."""
        return np.asarray(frames.invert(T_flange_sensor) @ self.motion @ T_flange_sensor)

    def built(self, T_flange_sensor: Array) -> Array:
        """Points (n, 3) in the sensor frame of the first profile."""
        return from_plane(self.carried(T_flange_sensor)[self.profile], self.points)

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
        """`tracker_data.moment` of the points `built`."""
        T = self.carried(T_flange_sensor)
        return np.asarray((T @ self._moments @ np.swapaxes(T, 1, 2)).sum(axis=0))

    def thinned(self, count: int) -> "Scan":
        """The same scan with every so-many-th of its points, about ``count`` of them."""
        return self.part(np.arange(0, len(self.points), max(len(self.points) // count, 1)))

    def direction(self) -> Array:
        """Unit vector (3,), flange, along which the flange moved from the first profile on.

        Raises `ResidualError` when it hardly moved, or turned.
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

    Raises `ResidualError` when there are fewer than two.
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
    for _ in range(1 + ROUNDS):
        if len(chosen) < 3:
            return None
        plane = fit_plane(moment(chosen))[0]
        chosen = judges[plane.distances(judges) < NEAR_M]
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
    first_face, second_face, ball = (_unbroken(scan.part(which)) for which in chosen)
    return first_face, second_face, ball


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


# The sensor's noise is along its beam (z), and smoothed: some neighbours count as one point. Of a
# face a profile holds a line: its z at the middle of its x, and its slope, are all that it shows.
# Of the sphere it shows the centre, to first order about a place that is known well: three
# combinations of it.

FEWEST_POINTS = 8  # of a part in a profile
FEWEST_LINES = 4
REJECT = 4.5  # standard deviations
STEEPEST = 0.25  # cosine between beam and normal below which a point of the sphere tells little
FAINT = 1e-9  # share of the largest information below which a combination tells nothing


@dataclass(frozen=True, eq=False)
class Lines:
    """A face in the m profiles, each field (m,).

    ``middle``: mean x, m; ``z_m`` and ``slope``: of the line there. ``seen``: whether the profile
    shows the face; the other figures are 0, and sigma 1, without.
    """

    middle: Array
    z_m: Array
    slope: Array
    z_sigma: Array
    slope_sigma: Array
    seen: Mask


@dataclass(frozen=True, eq=False)
class Caps:
    """A sphere in the m profiles: ``root @ (s - place) + offset`` is white for its centre s.

    ``place`` (m, 3): about which it was linearised, sensor frame, m. ``root`` (m, 3, 3), ``offset``
    (m, 3); ``seen`` (m, 3): which of the three are determined.
    """

    place: Array
    root: Array
    offset: Array
    seen: Mask


def fit_lines(scan: Scan, name: str) -> tuple[Lines, float, float]:
    """The face ``name`` in each profile, for a noise of 1 m, and the scatter of its points, m.

    Last: how many neighbours count as one, since they share their noise.

    Raises `TooFewSamplesError` when fewer than four profiles show it.
    """
    m = len(scan.motion)
    x, z = scan.points.T
    used = np.ones(len(x), dtype=np.bool_)
    for last in (False, True):
        count = np.bincount(scan.profile[used], minlength=m).astype(float)
        seen = count >= FEWEST_POINTS
        n = np.where(seen, count, 1.0)
        x0, z0 = (np.bincount(scan.profile[used], v[used], m) / n for v in (x, z))
        dx, dz = x - x0[scan.profile], z - z0[scan.profile]
        spread = np.bincount(scan.profile[used], dx[used] ** 2, m)
        product = np.bincount(scan.profile[used], dx[used] * dz[used], m)
        slope = product / np.where(spread > 0.0, spread, 1.0)
        miss = dz - slope[scan.profile] * dx
        shown = used & seen[scan.profile]
        if np.sum(seen) < FEWEST_LINES:
            raise TooFewSamplesError(
                f"{np.sum(seen)} profiles show {name} (at least {FEWEST_LINES}): scan more of it"
            )
        freedom = max(float(np.sum(shown)) - 2.0 * float(np.sum(seen)), 1.0)
        if last:
            noise = float(np.sqrt(np.sum(miss[shown] ** 2) / freedom))
        else:
            noise = MAD * float(np.median(np.abs(miss[shown])))
            used = used & (np.abs(miss) <= REJECT * noise)
    seen &= spread > 0.0
    lines = Lines(
        middle=np.where(seen, x0, 0.0),
        z_m=np.where(seen, z0, 0.0),
        slope=np.where(seen, slope, 0.0),
        z_sigma=np.where(seen, 1.0 / np.sqrt(n), 1.0),
        slope_sigma=np.where(seen, 1.0 / np.sqrt(np.where(seen, spread, 1.0)), 1.0),
        seen=seen,
    )
    return lines, noise, correlation(_side_by_side(miss[shown], scan.profile[shown]))


def _side_by_side(values: Array, profile: Index) -> Array:
    """Values (n,) in the order of their profiles: a column (k, m) for each, zeros below."""
    place = np.arange(len(profile)) - np.searchsorted(profile, profile)
    columns = np.zeros((int(place.max()) + 1, int(profile.max()) + 1))
    columns[place, profile] = values
    return columns


def fit_caps(scan: Scan, place: Array, radius_m: float, noise_m: float, alike: float = 1.0) -> Caps:
    """The sphere in each profile, about its centres (m, 3), sensor frames, m.

    ``alike``: so many neighbours share their noise.

    Raises `TooFewSamplesError` when hardly anything of it is seen.
    """
    m = len(scan.motion)
    # Where the ball is seen at each x: the measured z, being noisy, must not enter the normals.
    x, z = scan.points.T
    side = x - place[scan.profile, 0], -place[scan.profile, 1]
    depth = radius_m**2 - side[0] ** 2 - side[1] ** 2
    used = depth > (STEEPEST * radius_m) ** 2
    front = -np.sqrt(np.where(used, depth, radius_m**2))
    r = (z - place[scan.profile, 2] - front) / noise_m
    J = -np.column_stack([side[0] / front, side[1] / front, np.ones(len(x))]) / noise_m
    information, gradient = np.empty((m, 3, 3)), np.empty((m, 3))
    for last in (False, True):
        used &= (np.bincount(scan.profile[used], minlength=m) >= FEWEST_POINTS)[scan.profile]
        if np.sum(used) < FEWEST_LINES * FEWEST_POINTS:
            raise TooFewSamplesError(f"{np.sum(used)} points show the sphere: scan more of it")
        rows, miss, profile = J[used], r[used], scan.profile[used]
        for i in range(3):
            gradient[:, i] = np.bincount(profile, rows[:, i] * miss, m)
            for j in range(3):
                information[:, i, j] = np.bincount(profile, rows[:, i] * rows[:, j], m)
        size, axes = np.linalg.eigh(information)
        seen = size > FAINT * float(size.max())
        turned = np.einsum("mij,mi->mj", axes, gradient)
        if not last:  # a place that is off, or a joint's error, shifts a profile as a whole
            shift = np.einsum(
                "mij,mj->mi", axes, np.where(seen, turned / np.where(seen, size, 1.0), 0.0)
            )
            used &= np.abs(r - np.sum(J * shift[scan.profile], axis=1)) < REJECT
    length, share = np.sqrt(np.where(seen, size, 1.0)), np.sqrt(alike)
    return Caps(
        place=place,
        root=np.where(seen, length / share, 0.0)[:, :, None] * np.swapaxes(axes, 1, 2),
        offset=np.where(seen, turned / length / share, 0.0),
        seen=seen,
    )


THINNED = 6000  # points that are enough to find the parts
FEW = 500  # points that are enough for a face while the direction is searched
MOST_ROUNDS = 150
SEARCHED, SETTLED = 1e-5, 1e-9  # rad
MOST_TURNS, PLAIN_TURNS = 40, 4
TRIAL, LONGEST_STEP = 1e-5, 0.3  # rad, of Newton's method
PLACED = 1e-6
MATCH_M = 5e-4  # of the sphere's heights, and of the faces' angle over ARM_M
ARM_M = 0.05
DISTINCT_RAD = float(np.radians(2.0))
CLEARLY = 5.0  # times worse than the best is no rival
ALIKE_M = 2e-4


@dataclass(frozen=True, eq=False)
class Classic:
    """Closed-form answer, and what it was made of: ``data``, ``target``, ``noise``.

    ``T_tracker_flange`` (4, 4): at the first profile. ``tracked``: the target in the tracker frame.
    ``parts``: the scan of face 1, face 2 and the sphere. ``mismatch_m``: by how much tracker and
    sensor disagree about the target's shape.
    """

    data: TrackerData
    target: TrackerTarget
    noise: TrackerNoise
    axes: tuple[Axis, Axis]
    T_tracker_flange: Array
    T_flange_sensor: Array
    reflector: Array
    tracked: Cube
    parts: tuple[Scan, Scan, Scan]
    mismatch_m: float


@dataclass(frozen=True, eq=False)
class _Match:
    T_flange_sensor: Array
    seen: Cube
    mismatch_m: float


def solve_classic(data: TrackerData, target: TrackerTarget, noise: TrackerNoise) -> Classic:
    """Both poses in closed form."""
    data.require_enough()
    axes = fit_axes(data, noise.tracker_m)
    T_tracker_flange = flange_pose(data, axes, target)
    tracked = tracked_cube(data.faces, data.sphere, target.reflector_radius_m, noise.tracker_m)
    counts = [len(profile.points) for profile in data.profiles]
    scan = Scan(
        np.concatenate([profile.points for profile in data.profiles]),
        np.repeat(np.arange(len(counts)), counts),
        data.motion,
    )
    search = _CubeSearch(tracked, T_tracker_flange, target)
    match = search.best(scan.thinned(THINNED))
    parts = parts_of(scan, match.T_flange_sensor, match.seen, target.sphere_radius_m)
    match = search.refined(parts, match.T_flange_sensor)
    return Classic(
        data=data,
        target=target,
        noise=noise,
        axes=axes,
        T_tracker_flange=T_tracker_flange,
        T_flange_sensor=match.T_flange_sensor,
        reflector=reflector_in_flange(data, axes, T_tracker_flange),
        tracked=tracked,
        parts=parts,
        mismatch_m=match.mismatch_m,
    )


def each_without(classic: Classic) -> list[Array | None]:
    """T_flange_sensor without each of the profiles, solved again; None where that fails."""
    search = _CubeSearch(classic.tracked, classic.T_tracker_flange, classic.target)
    found: list[Array | None] = []
    for profile in range(len(classic.data.profiles)):
        first, second, ball = (part.part(part.profile != profile) for part in classic.parts)
        try:
            match = search.refined((first, second, ball), classic.T_flange_sensor)
            found.append(match.T_flange_sensor)
        except RobocalError:
            found.append(None)
    return found


@dataclass(frozen=True, eq=False)
class _CubeSearch:
    tracked: Cube
    T_tracker_flange: Array
    target: TrackerTarget

    def best(self, scan: Scan) -> _Match:
        """The one trial that fits.

        Raises `ResidualError` when none does; the sphere's own error where that is why;
        `RankDeficientError` when two mountings of the sensor do.
        """
        matches, failures = self._matches(scan)
        backwards = replace(scan, motion=frames.invert(scan.motion))
        if not matches and self._matches(backwards)[0]:
            raise ResidualError(
                "the scan fits the tracker's target only when it is built backwards, as its mirror "
                "image (the frame of face_1, face_2 and their edge is left-handed): the joint "
                "readings of the profiles run against those of the arcs, or against the motion"
            )
        if not matches and failures:
            raise failures[0]
        if not matches:
            raise ResidualError(
                "no two faces in the scan stand to each other and to the sphere as face_1 and "
                f"face_2 do in the tracker ({np.degrees(self.tracked.angle):.2f} deg; sphere "
                f"{self.tracked.heights[0] * 1e3:.2f} and {self.tracked.heights[1] * 1e3:.2f} mm "
                "above them): were other faces touched, did the target move, is the reflector's "
                "radius right, does z of the profiles grow the way that the sensor's description "
                "says (z_grows)?"
            )
        matches.sort(key=lambda match: match.mismatch_m)
        first = matches[0]
        for other in matches[1:]:
            if other.mismatch_m < max(CLEARLY * first.mismatch_m, ALIKE_M):
                raise RankDeficientError(
                    "two mountings of the sensor explain the scan: the slide is square to the edge "
                    "of both faces, or the sphere is as high above one as above the other; turn "
                    "the cube so that its edge runs at about 45 deg to the slide",
                    ["direction of the slide in the sensor frame"],
                )
        return first

    def _matches(self, scan: Scan) -> tuple[list[_Match], list[RobocalError]]:
        """All trials that fit, and why the sphere of others could not be fitted."""
        matches: list[_Match] = []
        failures: list[RobocalError] = []
        starts = []
        for y in (scan.direction(), -scan.direction()):
            side, back = tangents(y).T
            starts.append(frames.transform(np.column_stack([side, y, -back]), np.zeros(3)))
        faces = find_planes(scan, starts[0])
        for first, second in permutations(range(len(faces)), 2):
            pair = scan.part(faces[first]).thinned(FEW), scan.part(faces[second]).thinned(FEW)
            for start in starts:
                X = self._turned(pair, start, SEARCHED)
                if X is None:
                    continue
                known = [match.T_flange_sensor[:3, :3] for match in matches]
                turns = [frames.log_rotation(X[:3, :3].T @ R) for R in known]
                if any(np.linalg.norm(turn) < DISTINCT_RAD for turn in turns):
                    continue
                if abs(_cube(pair, X, np.zeros(3)).angle - self.tracked.angle) * ARM_M > MATCH_M:
                    continue
                rest = np.ones(len(scan.points), dtype=np.bool_)
                rest[np.concatenate([faces[first], faces[second]])] = False
                try:
                    match = self._placed(pair, scan.part(rest), X)
                except RobocalError as error:
                    failures.append(error)
                    continue
                if match is not None and match.mismatch_m < MATCH_M:
                    matches.append(match)
        return matches, failures

    def _turned(self, faces: tuple[Scan, Scan], X: Array, settled: float) -> Array | None:
        """T_flange_sensor whose rotation builds the scan that gives it; None when none does.

        The source's iteration first; then Newton's, which also settles where that creeps.
        """
        R, t = X[:3, :3], X[:3, 3]
        for turn in range(MOST_TURNS):
            miss = self._miss(faces, R, t)
            if miss is None:
                return None
            step = miss
            if turn >= PLAIN_TURNS:
                tried = [
                    self._miss(faces, R @ frames.exp_rotation(e), t) for e in TRIAL * np.eye(3)
                ]
                columns = [other - miss for other in tried if other is not None]
                if len(columns) == 3:
                    newton = np.linalg.lstsq(np.array(columns).T, -TRIAL * miss, rcond=None)[0]
                    step = np.asarray(newton) if np.linalg.norm(newton) < LONGEST_STEP else miss
            R = R @ frames.exp_rotation(step)
            if np.linalg.norm(step) < settled:
                return frames.transform(R, t)
        return None

    def _miss(self, faces: tuple[Scan, Scan], R: Array, t: Array) -> Array | None:
        """Turn (3,) from a rotation to the one that the scan built with it gives."""
        normals = _cube(faces, frames.transform(R, t), np.zeros(3)).normals
        if normals[:, 2].max() > 0.0:  # the sensor sees no face from behind
            return None
        if abs(normals[0] @ normals[1]) > PARALLEL_FACES:
            return None
        measured = two_axis_frame(*self.tracked.normals)
        image = self.T_tracker_flange[:3, :3].T @ measured @ two_axis_frame(*normals).T
        return frames.log_rotation(R.T @ image)

    def _placed(self, faces: tuple[Scan, Scan], ball: Scan, X: Array) -> _Match | None:
        """The match with the place of the sensor too, from the sphere; None when none settles."""
        rule = SphereRule(self.target.sphere_radius_m)
        for _ in range(MOST_ROUNDS):
            seen = _cube(faces, X, fit_sphere(ball.built(X), rule).centre)
            T_tracker_sensor = self.tracked.frame @ frames.invert(seen.frame)
            update = frames.invert(self.T_tracker_flange) @ T_tracker_sensor
            change = float(np.abs(update - X).max())
            X = update
            if change < PLACED:
                angle = abs(seen.angle - self.tracked.angle) * ARM_M
                heights = np.abs(seen.heights - self.tracked.heights)
                return _Match(X, seen, max(angle, float(heights.max())))
        return None

    def refined(self, parts: tuple[Scan, Scan, Scan], X: Array) -> _Match:
        """The match from all points of the parts.

        Raises `ResidualError` when it does not settle.
        """
        turned = self._turned(parts[:2], X, SETTLED)
        match = None if turned is None else self._placed(parts[:2], parts[2], turned)
        if match is None:
            raise ResidualError(
                "the direction of the scan in the sensor frame does not settle: turn the cube so "
                "that its edge runs at about 45 deg to the slide"
            )
        return match


def _cube(faces: tuple[Scan, Scan], X: Array, centre: Array) -> Cube:
    """The target in the sensor frame of the first profile."""
    first, second = (fit_plane(face.moment(X))[0] for face in faces)
    return Cube(*outward(first, second), centre)
