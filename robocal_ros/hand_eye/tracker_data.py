# SPDX-License-Identifier: Apache-2.0
"""What a laser tracker measures: the paths of a reflector on the flange, and the target.

The target is a cube with a sphere beside it. Source: Jing, Hu and Guo 2020, section 3.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.surfaces import MAD
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    InputError,
    RankDeficientError,
    ResidualError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array
from robocal_ros.hand_eye.profiles import Profile
from robocal_ros.hand_eye.targets import FACES, TrackerTarget
from robocal_ros.kinematics import SerialArm

MOVED = 1e-3  # rad or m: a joint that changes by less stands still
FEWEST_ARC_POINTS = 6
FEWEST_FACE_POINTS = 4
FEWEST_PROFILES = 8


@dataclass(frozen=True)
class TrackerNoise:
    """Standard deviations: of a tracker coordinate, and of a joint that moves between visits."""

    tracker_m: float = 1.5e-5
    joint_rad: float = 5e-5
    joint_m: float = 2e-5


@dataclass(frozen=True, eq=False)
class Arc:
    """The reflector on the flange while one joint moves: an arc, or a line where it slides.

    ``q`` (n, dof): joint readings; ``points`` (n, 3): of the reflector, tracker frame, m.
    """

    name: str
    q: Array
    points: Array

    def joint(self, arm: SerialArm) -> int:
        """The one joint that moves.

        Raises `InputError` when none or several move; `TooFewSamplesError` when there are too few
        points.
        """
        if len(self.points) < FEWEST_ARC_POINTS:
            raise TooFewSamplesError(
                f"{self.name} has {len(self.points)} points (at least {FEWEST_ARC_POINTS})"
            )
        moved = np.flatnonzero(np.ptp(self.q, axis=0) > MOVED)
        if len(moved) != 1:
            names = ", ".join(arm.joint_names[j] for j in moved) or "no joint"
            raise InputError(
                f"{self.name}: {names} moved; drive exactly one joint and keep the others still"
            )
        return int(moved[0])


@dataclass(frozen=True, eq=False)
class TrackerData:
    """All measurements of one calibration; the tracker, the target and the robot's base stay.

    ``arcs``: of two joints, in any order. ``sphere`` (k, 3): measured centres of the sphere, and
    ``faces`` (k, 3) each: reflector centres while it touches one face and the other, tracker
    frame, m. ``q`` (m, dof): joint readings of the profiles.
    """

    arm: SerialArm
    arcs: tuple[Arc, Arc]
    sphere: Array
    faces: tuple[Array, Array]
    q: Array
    profiles: Sequence[Profile]

    def __post_init__(self) -> None:
        if len(self.q) != len(self.profiles):
            raise ValueError(f"{len(self.q)} poses for {len(self.profiles)} profiles")

    def require_enough(self) -> None:
        """Refuse a calibration that lacks measurements.

        Raises `TooFewSamplesError`, naming what is missing.
        """
        if len(self.sphere) < 1:
            raise TooFewSamplesError("the tracker measured no centre of the sphere")
        for name, points in zip(FACES, self.faces, strict=True):
            if len(points) < FEWEST_FACE_POINTS:
                raise TooFewSamplesError(
                    f"{name} has {len(points)} tracker points (at least {FEWEST_FACE_POINTS}): "
                    "spread them over the face"
                )
        if len(self.profiles) < FEWEST_PROFILES:
            raise TooFewSamplesError(
                f"the scan has {len(self.profiles)} profiles (at least {FEWEST_PROFILES})"
            )

    @cached_property
    def motion(self) -> Array:
        """Flange pose of each profile in that of the first: T_flange0_flange (m, 4, 4)."""
        return self.relative(self.q)

    def relative(self, q: Array) -> Array:
        """T_flange0_flange (n, 4, 4) at joint readings (n, dof)."""
        return np.asarray(frames.invert(self.arm.fk(self.q[0])) @ self.arm.fk(q))


# Pose of the flange in the tracker: section 3.1 of the source, for the last two joints of a P-R-P
# arm; here for any two joints, by the lines of their axes in the flange that the nominal geometry
# gives.

SHORTEST_ARC_RAD = float(np.radians(20.0))
SHORTEST_LINE_M = 0.03
SMALLEST_RADIUS_M = 0.03
REJECT = 5.0  # standard deviations
LARGEST_SCATTER = 10.0  # of a path's points, over the tracker's noise
RAYLEIGH = 1.177  # median distance over the standard deviation of a coordinate
MOST_REJECTED = 0.2
LARGEST_SKEW_RAD = float(np.radians(1.0))  # of the axes, against the nominal geometry
MOST_ROUNDS, SETTLED_M = 50, 1e-10  # of a circle
PARALLEL = float(np.sin(np.radians(5.0)))


@dataclass(frozen=True, eq=False)
class Axis:
    """A joint's axis in the tracker frame.

    ``direction`` (3,): along the positive turn (right-hand rule) or slide. ``centre`` (3,): foot
    of the reflector on the axis, m; of a slide a point of its line. ``used`` (n,): points taken.
    """

    name: str
    joint: int
    slides: bool
    direction: Array
    centre: Array
    used: NDArray[np.bool_]


def two_axis_frame(first: Array, second: Array) -> Array:
    """Rotation (3, 3) whose x and y are nearest to two unit vectors, both treated alike.

    What they lack of a right angle is shared by both, so that a frame from the tracker's view and
    one from the sensor's are made in the same way.
    """
    middle, across = first + second, first - second
    middle, across = (
        middle / np.sqrt(2.0 * (middle @ middle)),
        across / np.sqrt(2.0 * (across @ across)),
    )
    x, y = middle + across, middle - across
    return np.column_stack([x, y, frames.skew(x) @ y])


def fit_axis(arc: Arc, joint: int, slides: bool, sigma_m: float) -> Axis:
    """Axis of the one joint that moved, from the path alone; wild points are left out.

    Raises `TooFewSamplesError` when the path is too short; `ResidualError` when they scatter ten
    times more than the tracker does, more than a fifth are wild, or no circle fits them.
    """
    used = np.ones(len(arc.points), dtype=np.bool_)
    fewest = max(FEWEST_ARC_POINTS, (1.0 - MOST_REJECTED) * len(used))
    while True:
        points, readings = arc.points[used], arc.q[used, joint]
        fit = _fit_line(points, readings) if slides else _fit_circle(arc.name, points, readings)
        direction, centre, miss = fit
        scatter, worst = float(np.median(miss)) / RAYLEIGH, int(np.argmax(miss))
        wild = miss[worst] >= REJECT * max(sigma_m, scatter)
        if wild:
            used[np.flatnonzero(used)[worst]] = False
        scattered = scatter > LARGEST_SCATTER * sigma_m
        if scattered or (wild and np.sum(used) < fewest):
            beside_m = scatter if scattered else float(miss[worst])
            raise ResidualError(
                f"{arc.name}: points lie {beside_m * 1e3:.3f} mm beside the "
                f"{'line' if slides else 'circle'} of joint {joint + 1} (noise "
                f"{sigma_m * 1e3:.3f} mm): check that the reflector sits firmly, that the tracker "
                "stood still and that no other joint moved"
            )
        if not wild:
            break
    _require_long(arc, used, centre, joint, slides)
    return Axis(arc.name, joint, slides, direction, centre, used)


def _fit_line(points: Array, readings: Array) -> tuple[Array, Array, Array]:
    """Direction (3,), a point (3,) and the distances (n,) of points (n, 3) from the line."""
    centre = points.mean(axis=0)
    away = points - centre
    direction = np.linalg.svd(away, full_matrices=False)[2][0]
    along = away @ direction
    miss = np.linalg.norm(away - np.outer(along, direction), axis=1)
    return direction * np.sign(along @ (readings - readings.mean())), centre, miss


def _fit_circle(name: str, points: Array, readings: Array) -> tuple[Array, Array, Array]:
    """Axis (3,), centre (3,) and the distances (n,) of points (n, 3) from the circle.

    Plane, then circle in it: to first order the axial and the radial distances part so.
    """
    middle = points.mean(axis=0)
    basis = np.linalg.svd(points - middle, full_matrices=False)[2]
    local = (points - middle) @ basis.T
    xy, height = local[:, :2], local[:, 2]
    rows = np.column_stack([2.0 * xy, np.ones(len(xy))])  # Kasa's circle as the start
    start = np.linalg.lstsq(rows, np.sum(xy**2, axis=1), rcond=None)[0]
    centre, radius = start[:2], float(np.sqrt(start[2] + start[:2] @ start[:2]))
    for _ in range(MOST_ROUNDS):
        away = xy - centre
        distance = np.linalg.norm(away, axis=1)
        rows = np.column_stack([away / distance[:, None], np.ones(len(xy))])
        step = np.linalg.lstsq(rows, distance - radius, rcond=None)[0]
        centre, radius = centre + step[:2], radius + float(step[2])
        if np.linalg.norm(step) < SETTLED_M:
            break
    else:
        raise ResidualError(
            f"{name}: no circle fits its points (a fit did not settle in {MOST_ROUNDS} rounds): "
            "check that the reflector sits firmly and that one joint alone moved, or drive a "
            "longer arc"
        )
    away = xy - centre
    miss = np.hypot(height, np.linalg.norm(away, axis=1) - radius)
    ordered = away[np.argsort(readings)]
    a, b = ordered[:-1], ordered[1:]
    turn = float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])) * np.linalg.det(basis)
    return basis[2] * np.sign(turn), middle + centre @ basis[:2], miss


def _require_long(
    arc: Arc, used: NDArray[np.bool_], centre: Array, joint: int, slides: bool
) -> None:
    extent = float(np.ptp(arc.q[used, joint]))
    if slides:
        if extent < SHORTEST_LINE_M:
            raise TooFewSamplesError(
                f"{arc.name} slides over {extent * 1e3:.0f} mm (at least "
                f"{SHORTEST_LINE_M * 1e3:.0f})"
            )
        return
    if extent < SHORTEST_ARC_RAD:
        raise TooFewSamplesError(
            f"{arc.name} turns over {np.degrees(extent):.0f} deg (at least "
            f"{np.degrees(SHORTEST_ARC_RAD):.0f}): an arc that short gives no axis"
        )
    radius = float(np.linalg.norm(arc.points[used] - centre, axis=1).mean())
    if radius < SMALLEST_RADIUS_M:
        raise TooFewSamplesError(
            f"{arc.name} has a radius of {radius * 1e3:.0f} mm (at least "
            f"{SMALLEST_RADIUS_M * 1e3:.0f}): set the reflector further from the axis"
        )


def fit_axes(data: TrackerData, sigma_m: float) -> tuple[Axis, Axis]:
    """Axes of both arcs.

    Raises `InputError`, `TooFewSamplesError`, `ResidualError` as `Arc.joint` and `fit_axis`;
    `RankDeficientError` when both arcs are of one joint, or of two that slide.
    """
    first, second = (
        fit_axis(arc, joint, bool(data.arm.prismatic[joint]), sigma_m)
        for arc, joint in ((arc, arc.joint(data.arm)) for arc in data.arcs)
    )
    if first.joint == second.joint:
        raise RankDeficientError(
            f"{first.name} and {second.name} are both of joint {first.joint + 1}: the turn of the "
            "flange about its axis is not determined; drive one more joint",
            [f"turn about the axis of joint {first.joint + 1}"],
        )
    if first.slides and second.slides:
        raise RankDeficientError(
            "two joints that slide do not tell where the flange is: drive one that turns",
            ["position of the flange"],
        )
    return first, second


def nominal_axis(data: TrackerData, arc: Arc, joint: int) -> tuple[Array, Array]:
    """Direction (3,) and a point (3,), m, of a joint's axis in the flange of the first profile."""
    q = arc.q[0]
    v, w = np.split(data.arm.jacobian(q)[:, joint], 2)
    T_flange_base = frames.invert(data.arm.fk(data.q[0]))
    R, t = T_flange_base[:3, :3], T_flange_base[:3, 3]
    if data.arm.prismatic[joint]:
        return R @ v, np.zeros(3)
    return R @ w, R @ (data.arm.fk(q)[:3, 3] + np.cross(w, v)) + t


def flange_pose(data: TrackerData, axes: tuple[Axis, Axis], target: TrackerTarget) -> Array:
    """T_tracker_flange (4, 4) at the first profile, in closed form.

    Raises `RankDeficientError` when the axes are parallel, or the reflector's height is needed and
    not known; `ResidualError` when the axes stand to each other otherwise than the nominal geometry
    says.
    """
    nominal = [
        nominal_axis(data, arc, axis.joint) for arc, axis in zip(data.arcs, axes, strict=True)
    ]
    _require_axes(axes, nominal[0][0], nominal[1][0])
    measured = two_axis_frame(axes[0].direction, axes[1].direction)
    R = measured @ two_axis_frame(nominal[0][0], nominal[1][0]).T
    rows, right = [], []
    turning = [i for i in (0, 1) if not axes[i].slides]
    for i in turning:
        n = axes[i].direction
        across = np.eye(3) - np.outer(n, n)
        rows.append(across)
        right.append(across @ (axes[i].centre - R @ nominal[i][1]))
    if len(turning) == 1:
        axis, n = axes[turning[0]], axes[turning[0]].direction
        if target.height_m is None:
            raise RankDeficientError(
                f"one joint slides: the position of the flange along the axis of joint "
                f"{axis.joint + 1} is not determined; measure the height of the reflector above "
                "the flange's origin along this axis, and give it with the target",
                [f"position along the axis of joint {axis.joint + 1}"],
            )
        rows.append(n[None])
        right.append(np.array([n @ axis.centre - target.height_m]))
    t = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
    return frames.transform(R, t)


def _require_axes(axes: tuple[Axis, Axis], first: Array, second: Array) -> None:
    names = " and ".join(f"{axis.joint + 1}" for axis in axes)
    if float(np.linalg.norm(np.cross(first, second))) < PARALLEL:
        raise RankDeficientError(
            f"the axes of joints {names} are parallel: the turn of the flange about them is not "
            "determined; drive another joint",
            [f"turn about the axes of joints {names}"],
        )
    angles = [angle_between(axes[0].direction, axes[1].direction), angle_between(first, second)]
    if abs(angles[0] - angles[1]) > LARGEST_SKEW_RAD:
        raise ResidualError(
            f"the axes of joints {names} stand at {np.degrees(angles[0]):.2f} deg in the tracker "
            f"and at {np.degrees(angles[1]):.2f} deg in the robot file: check the file, the signs "
            "of its joints and the joint readings"
        )


def angle_between(a: Array, b: Array) -> float:
    """Angle between two vectors (3,), rad."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def reflector_in_flange(
    data: TrackerData, axes: tuple[Axis, Axis], T_tracker_flange: Array
) -> Array:
    """Mean position (3,) of the reflector in the flange, m."""
    T_flange_tracker = frames.invert(T_tracker_flange)
    found = []
    for arc, axis in zip(data.arcs, axes, strict=True):
        T = frames.invert(data.relative(arc.q[axis.used])) @ T_flange_tracker
        found.append((T[:, :3, :3] @ arc.points[axis.used][..., None])[..., 0] + T[:, :3, 3])
    return np.asarray(np.concatenate(found).mean(axis=0))


# Tracker and sensor both see the temporary frame K: origin in the sphere's centre, axes along the
# faces' outward normals, made orthonormal in the same way on both sides (section 3.2).

NARROWEST_M = 5e-3  # rms extent of the points on a face in its narrower direction
PARALLEL_FACES = float(np.cos(np.radians(20.0)))


@dataclass(frozen=True, eq=False)
class Plane:
    """Points p with ``normal @ p = offset``."""

    normal: Array
    offset: float
    middle: Array

    def distances(self, points: Array) -> Array:
        """Distances (n,) of points (n, 3), m."""
        return np.abs(points @ self.normal - self.offset)


@dataclass(frozen=True, eq=False)
class Cube:
    """Two faces by outward normals (2, 3) and offsets (2,), and the sphere's centre (3,), m."""

    normals: Array
    offsets: Array
    centre: Array

    @property
    def frame(self) -> Array:
        """Pose (4, 4) of K in the frame of the observer."""
        return frames.transform(two_axis_frame(*self.normals), self.centre)

    @property
    def angle(self) -> float:
        """Angle between the normals, rad."""
        return angle_between(*self.normals)

    @property
    def heights(self) -> Array:
        """Distances (2,) of the sphere's centre above the faces, m."""
        return np.asarray(self.normals @ self.centre - self.offsets)


def moment(points: Array) -> Array:
    """Sum (4, 4) of the outer products of homogeneous points (n, 3)."""
    homogeneous = np.insert(points, 3, 1.0, axis=1)
    return np.asarray(homogeneous.T @ homogeneous)


def fit_plane(sums: Array) -> tuple[Plane, Array]:
    """Plane nearest to points of this `moment`, and their rms extents (3,), the least one last."""
    middle = sums[:3, 3] / sums[3, 3]
    size, axes = np.linalg.eigh(sums[:3, :3] / sums[3, 3] - np.outer(middle, middle))
    normal = axes[:, 0]
    return Plane(normal, float(normal @ middle), middle), np.sqrt(np.maximum(size[::-1], 0.0))


def outward(first: Plane, second: Plane) -> tuple[Array, Array]:
    """Outward normals (2, 3) and offsets (2,): a face of a cube lies behind the other's plane."""
    sign = np.array(
        [
            1.0 if plane.normal @ other.middle <= plane.offset else -1.0
            for plane, other in ((first, second), (second, first))
        ]
    )
    normals = sign[:, None] * np.array([first.normal, second.normal])
    return normals, sign * np.array([first.offset, second.offset])


def tracked_cube(
    faces: Sequence[Array], sphere: Array, reflector_radius_m: float, sigma_m: float
) -> Cube:
    """The target from reflector centres on two faces (k, 3) and on the sphere's centre (k, 3).

    Raises `RankDeficientError` when the points of a face lie on a line, or the faces are parallel;
    `ResidualError` when the points of a face miss a plane, or those of the sphere's centre differ.
    """
    first, second = (_tracked_face(*face, sigma_m) for face in zip(FACES, faces, strict=True))
    normals, offsets = outward(first, second)
    if abs(normals[0] @ normals[1]) > PARALLEL_FACES:
        raise RankDeficientError(
            "face_1 and face_2 are parallel: touch two faces that meet in an edge",
            ["turn about the normal of the faces"],
        )
    centre = np.median(sphere, axis=0)
    spread = float(np.linalg.norm(sphere - centre, axis=1).max())
    if spread > 2.0 * REJECT * sigma_m:
        raise ResidualError(
            f"the tracker's centres of the sphere differ by {spread * 1e3:.3f} mm (noise "
            f"{sigma_m * 1e3:.3f} mm): seat the reflector again and measure anew"
        )
    return Cube(normals, offsets - reflector_radius_m, sphere.mean(axis=0))


def _tracked_face(name: str, points: Array, sigma_m: float) -> Plane:
    plane, extent = fit_plane(moment(points))
    if extent[1] < NARROWEST_M:
        raise RankDeficientError(
            f"the tracker points on {name} lie nearly on a line (rms width "
            f"{extent[1] * 1e3:.1f} mm, at least {NARROWEST_M * 1e3:.0f}): spread them over "
            "the face",
            [f"turn of {name} about a line"],
        )
    miss = plane.distances(points)
    scatter = max(sigma_m, MAD * float(np.median(miss)))
    if miss.max() > REJECT * scatter or scatter > LARGEST_SCATTER * sigma_m:
        raise ResidualError(
            f"{name}: point {int(np.argmax(miss)) + 1} of {len(points)} lies "
            f"{miss.max() * 1e3:.3f} mm beside the plane of the others (noise "
            f"{sigma_m * 1e3:.3f} mm): clean the face, and check that all points are of one face"
        )
    return plane
