"""How targets would be seen from planned poses, and from which others they could be."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.hand_eye.look_point import OFF_EQUATOR, looked_at
from robocal_ros.hand_eye.mount_problem import TargetView
from robocal_ros.hand_eye.planning import SensorRange
from robocal_ros.hand_eye.sightings import Seen, Sightings, TargetModel, same_pose
from robocal_ros.hand_eye.sphere_start import FEWEST_PROFILES
from robocal_ros.hand_eye.step_task import StepTask, require_marks
from robocal_ros.hand_eye.target_models import LineModel, SphereModel
from robocal_ros.hand_eye.targets import StepTarget

Array = NDArray[np.float64]

SMALLEST = 0.2  # of the radius: a circle that the laser plane cuts out
STEEPEST_RAD = float(np.radians(60.0))  # slope of a surface that still returns light
NEEDED = 0.3  # of a circle's radius: how deep an arc must be seen to know its centre
CUT = 0.3  # of that depth: what may be cut off at the near end
EDGE_POINTS = 10.0  # on each side of an edge, by which its place is known
TILTS_RAD = np.radians([-25.0, 0.0, 25.0])
ROLLS_RAD = np.radians([-60.0, 0.0, 60.0])
ASIDE = (-0.25, 0.25)  # of the field's width
ALONG_M = (-0.04, 0.0, 0.04)  # of an edge


def _tilted(T_base_sensor: Array) -> Array:
    """Rotations (n, 3, 3) of a sensor turned about the mean of planned ones."""
    mean = frames.nearest_rotation(T_base_sensor[:, :3, :3].mean(axis=0))
    turns = np.array(list(product(TILTS_RAD, TILTS_RAD, ROLLS_RAD)))
    return np.stack([mean @ frames.rotation_from_rpy(turn) for turn in turns])


def _looking(turns: Array, at: Array, target: Array) -> Array:
    """Sensor poses (n, 4, 4) with these rotations that see the target (3,) at ``at`` (n, 3)."""
    return frames.transform(turns, target - np.einsum("nij,nj->ni", turns, at))


def _places(sensor: SensorRange, heights: tuple[float, ...], behind_m: float = 0.0) -> Array:
    """Where a target may be seen (k, 3), sensor frame, m.

    ``behind_m``: how far the point that is placed lies behind the surface that is seen.
    """
    far = np.linspace(sensor.near_m, sensor.far_m, 5)[[1, 3]] + behind_m
    aside = np.array(ASIDE) * sensor.width_m
    return np.array(list(product(aside, heights, far)))


def _expected(
    model: TargetModel, seen: Seen, T_base_flange: Array, covariance: Array
) -> TargetView:
    """A view in which everything is seen as predicted."""
    m = len(T_base_flange)
    names = tuple(f"pose {i + 1}" for i in range(m))
    pose = same_pose(T_base_flange)
    return TargetView(
        model, Sightings(names, np.arange(m), pose, T_base_flange, seen.value, covariance)
    )


def _out_of_range(x: Array, z: Array, depth: Array, sensor: SensorRange) -> dict[int, str]:
    """Poses whose sighting (x, z to z + depth), m, lies out of the field of view."""
    found = {}
    for i in np.flatnonzero((z < sensor.near_m - CUT * depth) | (z + depth > sensor.far_m)):
        found[int(i)] = f"the target is at {z[i] * 1e3:.0f} mm, the sensor sees "
        found[int(i)] += f"{sensor.near_m * 1e3:.0f} to {sensor.far_m * 1e3:.0f} mm"
    for i in np.flatnonzero(np.abs(x) > 0.5 * sensor.width_m):
        found.setdefault(int(i), f"the target is {x[i] * 1e3:.0f} mm aside, out of the laser line")
    return found


@dataclass(frozen=True)
class PlannedSphere:
    """A sphere; ``centre`` (3,) in base, or None: where most poses see it."""

    radius_m: float
    sensor: SensorRange
    centre: tuple[float, float, float] | None = None
    fewest: int = field(default=FEWEST_PROFILES, init=False)

    def place(self, T_base_sensor: Array) -> Array:
        """Its centre."""
        if self.centre is not None:
            return np.array(self.centre)
        centres, misfit = looked_at(T_base_sensor, self.radius_m, self.sensor)
        blind = [
            len(self.unseen(self.view(T_base_sensor, np.eye(4), centre))) for centre in centres
        ]
        return np.asarray(centres[min(range(len(blind)), key=lambda i: (blind[i], misfit[i]))])

    def view(self, T_base_flange: Array, T_flange_sensor: Array, place: Array) -> TargetView:
        """Circles, with the covariance that their arcs will have."""
        model = SphereModel(self.radius_m)
        seen = model.see(T_base_flange @ T_flange_sensor, place)
        r = np.maximum(seen.value[:, 2], 0.1 * self.radius_m)
        slope = np.linspace(-STEEPEST_RAD, STEEPEST_RAD, 41)
        J = np.column_stack([np.sin(slope), -np.cos(slope), np.ones(len(slope))])
        step = self.sensor.width_m / self.sensor.points
        share = np.cos(slope) * (slope[1] - slope[0])  # columns are even along the laser line
        unit = np.linalg.inv((J * share[:, None]).T @ J)
        return _expected(
            model, seen, T_base_flange, self.sensor.noise_m**2 * (step / r)[:, None, None] * unit
        )

    def unseen(self, view: TargetView) -> dict[int, str]:
        """Out of the field of view, or beside the sphere."""
        x, z, r = view.sightings.value.T
        found = _out_of_range(x, z - r, NEEDED * r, self.sensor)
        for i in np.flatnonzero(r < SMALLEST * self.radius_m):
            found.setdefault(int(i), "the laser plane passes beside the sphere")
        return found

    def candidates(self, T_base_sensor: Array, place: Array) -> Array:
        """On both sides of the laser plane."""
        high = OFF_EQUATOR * self.radius_m
        cut = np.sqrt(self.radius_m**2 - high**2)  # the arc lies before the circle's centre
        at = _places(self.sensor, (-high, high), (1.0 - 0.5 * NEEDED) * cut)
        pairs = list(product(_tilted(T_base_sensor), at))
        return _looking(np.array([R for R, _ in pairs]), np.array([s for _, s in pairs]), place)


@dataclass(frozen=True, eq=False)
class PlannedLine:
    """A straight edge; ``line`` (2, 3), a point and the direction, or None: across the poses."""

    sensor: SensorRange
    line: Array | None = None

    @property
    def fewest(self) -> int:
        """Two equations each, and enough over to tell the noise."""
        return 8 if self.line is None else 6

    def place(self, T_base_sensor: Array) -> Array:
        """A point and the direction."""
        if self.line is not None:
            return self.line
        point = (T_base_sensor @ np.array([0.0, 0.0, self.sensor.middle_m, 1.0])).mean(axis=0)[:3]
        normal = T_base_sensor[:, :3, 1].mean(axis=0)
        return np.stack([point, normal / np.linalg.norm(normal)])

    def view(self, T_base_flange: Array, T_flange_sensor: Array, place: Array) -> TargetView:
        """Points of the edge."""
        model = LineModel(self.line is not None)
        seen = model.see(T_base_flange @ T_flange_sensor, place)
        step = self.sensor.width_m / self.sensor.points
        spread = np.diag([(0.5 * step) ** 2, self.sensor.noise_m**2 / EDGE_POINTS, 1.0])
        return _expected(model, seen, T_base_flange, np.tile(spread, (len(T_base_flange), 1, 1)))

    def unseen(self, view: TargetView) -> dict[int, str]:
        """Out of the field of view."""
        x, z, nothing = view.sightings.value.T
        return _out_of_range(x, z, nothing, self.sensor)

    def candidates(self, T_base_sensor: Array, place: Array) -> Array:
        """At several places along the edge."""
        at = _places(self.sensor, (0.0,))
        trios = list(product(_tilted(T_base_sensor), at, ALONG_M))
        poses = [_looking(R[None], s[None], place[0] + a * place[1])[0] for R, s, a in trios]
        return np.array(poses)


@dataclass(frozen=True, eq=False)
class PlannedStairs:
    """A staircase; ``marks`` of the planned poses: None where all lay the light on the first.

    Raises
    ------
    InputError
        For a mark that the target does not have.
    """

    target: StepTarget
    sensor: SensorRange
    marks: Sequence[str] | None = None
    fewest: int = field(default=4, init=False)

    def __post_init__(self) -> None:
        require_marks(self.target, self.marks or ())

    def place(self, T_base_sensor: Array) -> Array:
        """The taught user frame."""
        return self.target.T_base_user

    def view(self, T_base_flange: Array, T_flange_sensor: Array, place: Array) -> TargetView:
        """All corners of the mark on which each pose lays the light."""
        marks = self.lit(T_base_flange @ T_flange_sensor)
        corners = [self.target.corners[mark] for mark in marks]
        shot = np.repeat(np.arange(len(corners)), [len(each) for each in corners])
        T = T_base_flange[shot]
        model = StepTask(self.target).model(np.concatenate(corners))
        seen = model.see(T @ T_flange_sensor, place)
        step = self.sensor.width_m / self.sensor.points
        sigma = np.array([0.5 * step, self.sensor.noise_m / np.sqrt(EDGE_POINTS), 0.0])
        spread = np.diag(sigma**2 + self.target.sigma_m**2)
        names = tuple(f"pose {i + 1}" for i in shot)
        pose, covariance = same_pose(T_base_flange)[shot], np.tile(spread, (len(shot), 1, 1))
        return TargetView(model, Sightings(names, shot, pose, T, seen.value, covariance))

    def lit(self, T_base_sensor: Array) -> tuple[str, ...]:
        """The mark that is nearest to the laser plane of each sensor pose (m, 4, 4)."""
        known = self._known()
        middles = np.array([self.target.corners[mark].mean(axis=0) for mark in known])
        base = middles @ self.target.T_base_user[:3, :3].T + self.target.T_base_user[:3, 3]
        away = base[None] - T_base_sensor[:, None, :3, 3]
        y = np.abs(np.einsum("mki,mi->mk", away, T_base_sensor[:, :3, 1]))
        return tuple(known[nearest] for nearest in np.argmin(y, axis=1))

    def _known(self) -> list[str]:
        known = list(self.target.corners)
        return known[:1] if self.marks is None else known

    def unseen(self, view: TargetView) -> dict[int, str]:
        """Poses that see less than two corners, or not the only one of a mark."""
        x, z, _ = view.sightings.value.T
        found: dict[int, str] = {}
        out = _out_of_range(x, z, np.zeros_like(z), self.sensor)
        for pose in np.unique(view.sightings.shot):
            rows = np.flatnonzero(view.sightings.shot == pose)
            if sum(int(row) not in out for row in rows) < min(2, len(rows)):
                found[int(pose)] = next(out[int(row)] for row in rows if int(row) in out)
        return found

    def candidates(self, T_base_sensor: Array, place: Array) -> Array:
        """Light through the marks: tilted about their line, and within the plane of the light."""
        every = [self.target.corners[mark] for mark in self._known()]
        mean = frames.nearest_rotation(T_base_sensor[:, :3, :3].mean(axis=0))
        x = mean[:, 0]
        if len(every[0]) > 1:  # a corner alone lies on no line
            along = place[:3, :3] @ (every[0][-1] - every[0][0])
            x = along / np.linalg.norm(along) * np.sign(along @ x)
        y = mean[:, 1] - x * (x @ mean[:, 1])
        y /= np.linalg.norm(y)
        level = np.column_stack([x, y, np.cross(x, y)])
        poses = []
        places = _places(self.sensor, (0.0,))
        for number, (about_x, about_y, at) in enumerate(product(TILTS_RAD, TILTS_RAD, places)):
            R = level @ frames.rotation_from_rpy([about_x, 0.0, 0.0])
            R = R @ frames.rotation_from_rpy([0.0, about_y, 0.0])
            middle = place[:3, :3] @ every[number % len(every)].mean(axis=0) + place[:3, 3]
            poses.append(_looking(R[None], at[None], middle)[0])
        return np.array(poses)
