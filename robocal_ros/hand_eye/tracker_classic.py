"""Multiple coordinate transformations in closed steps: the sensor through a frame that both see.

Source: Jing, Hu and Guo 2020, with the slide along the sensor axis that the solution itself gives
instead of z (its equation 9). Which plane of the scan is which face, and whether the sensor moved
along its +y or -y, is found by trial: the angle between the faces and the sphere's heights above
them must be the tracker's.
"""

from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.sphere import SphereRule, fit_sphere
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, ResidualError, RobocalError
from robocal_ros.hand_eye.target_models import tangents
from robocal_ros.hand_eye.tracker_data import (
    PARALLEL_FACES,
    Axis,
    Cube,
    TrackerData,
    TrackerNoise,
    TrackerTarget,
    fit_axes,
    fit_plane,
    flange_pose,
    outward,
    reflector_in_flange,
    tracked_cube,
    two_axis_frame,
)
from robocal_ros.hand_eye.tracker_scan import Scan, find_planes, parts_of

Array = NDArray[np.float64]
Index = NDArray[np.int64]

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
    """Closed-form answer, and what it was made of.

    Attributes
    ----------
    T_tracker_flange : (4, 4) at the first profile, m.
    tracked, seen : the target in the tracker frame, and in the sensor frame of the first profile.
    parts : the scan of face 1, face 2 and the sphere.
    mismatch_m : by how much tracker and sensor disagree about the target's shape.
    """

    axes: tuple[Axis, Axis]
    T_tracker_flange: Array
    T_flange_sensor: Array
    reflector: Array
    tracked: Cube
    seen: Cube
    parts: tuple[Scan, Scan, Scan]
    mismatch_m: float


@dataclass(frozen=True, eq=False)
class _Match:
    T_flange_sensor: Array
    seen: Cube
    mismatch_m: float


def solve_classic(data: TrackerData, target: TrackerTarget, noise: TrackerNoise) -> Classic:
    """Both poses in closed form.

    Raises
    ------
    RobocalError
        Naming what the data lack; see `tracker_flange`, `tracker_cube` and `tracker_scan`.
    """
    data.require_enough()
    axes = fit_axes(data, noise.tracker_m)
    T_tracker_flange = flange_pose(data, axes, target)
    tracked = tracked_cube(data.faces, data.sphere, target.reflector_radius_m, noise.tracker_m)
    scan = Scan.of(data.profiles, data.motion)
    search = _CubeSearch(tracked, T_tracker_flange, target)
    match = search.best(scan.thinned(THINNED))
    X = match.T_flange_sensor
    parts = parts_of(scan, X, match.seen, target.sphere_radius_m)
    match = search.refined(parts, X)
    return Classic(
        axes=axes,
        T_tracker_flange=T_tracker_flange,
        T_flange_sensor=match.T_flange_sensor,
        reflector=reflector_in_flange(data, axes, T_tracker_flange),
        tracked=tracked,
        seen=match.seen,
        parts=parts,
        mismatch_m=match.mismatch_m,
    )


def each_without(classic: Classic, target: TrackerTarget, profiles: int) -> list[Array | None]:
    """T_flange_sensor without each of the profiles, solved again; None where that fails."""
    search = _CubeSearch(classic.tracked, classic.T_tracker_flange, target)
    found: list[Array | None] = []
    for profile in range(profiles):
        first, second, ball = (part.part(part.profile != profile) for part in classic.parts)
        try:
            match = search.refined((first, second, ball), classic.T_flange_sensor)
        except RobocalError:
            match = None
        found.append(None if match is None else match.T_flange_sensor)
    return found


@dataclass(frozen=True, eq=False)
class _CubeSearch:
    tracked: Cube
    T_tracker_flange: Array
    target: TrackerTarget

    def best(self, scan: Scan) -> _Match:
        """The one trial that fits.

        Raises
        ------
        ResidualError
            When none does; the sphere's own error where that is why.
        RankDeficientError
            When two mountings of the sensor do.
        """
        matches, failures = self._matches(scan)
        if not matches and self._matches(_reversed(scan))[0]:
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
                "radius right?"
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
        way = scan.direction()
        starts = [
            frames.transform(_rotation_from_y(sign * way), np.zeros(3)) for sign in (1.0, -1.0)
        ]
        faces = find_planes(scan, starts[0])
        for first, second in permutations(range(len(faces)), 2):
            pair = scan.part(faces[first]).thinned(FEW), scan.part(faces[second]).thinned(FEW)
            for start in starts:
                X = self._turned(pair, start, SEARCHED)
                if X is None or any(_alike(X, match.T_flange_sensor) for match in matches):
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
            step = miss if turn < PLAIN_TURNS else self._newton(faces, R, t, miss)
            R = R @ frames.exp_rotation(step)
            if np.linalg.norm(step) < settled:
                return frames.transform(R, t)
        return None

    def _newton(self, faces: tuple[Scan, Scan], R: Array, t: Array, miss: Array) -> Array:
        """Newton's step (3,) where it is a sound one, else the plain one."""
        tried = [self._miss(faces, R @ frames.exp_rotation(e), t) for e in TRIAL * np.eye(3)]
        columns = [other - miss for other in tried if other is not None]
        if len(columns) < 3:
            return miss
        step = np.asarray(np.linalg.lstsq(np.array(columns).T, -TRIAL * miss, rcond=None)[0])
        return step if np.linalg.norm(step) < LONGEST_STEP else miss

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

        Raises
        ------
        ResidualError
            When it does not settle.
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
    planes = outward(*(fit_plane(face.moment(X))[0] for face in faces))
    normals = np.array([plane.normal for plane in planes])
    return Cube(normals, np.array([plane.offset for plane in planes]), centre)


def _alike(X: Array, Y: Array) -> bool:
    turn = frames.log_rotation(X[:3, :3].T @ Y[:3, :3])
    return bool(np.linalg.norm(turn) < DISTINCT_RAD)


def _reversed(scan: Scan) -> Scan:
    return replace(scan, motion=frames.invert(scan.motion))


def _rotation_from_y(direction: Array) -> Array:
    """A rotation (3, 3) whose y column is a unit vector (3,)."""
    side, back = tangents(direction).T
    return np.column_stack([side, direction, -back])
