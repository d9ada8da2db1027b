"""Models of the targets: a sphere, a straight edge, the marked edges of a staircase."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robocal_ros.ground import frames

# ---- what profiles show of a target, and how a model of the target predicts it ------------------
#
# Each profile is reduced to features that hold all it says (Fisher information) about where the
# target is: the circle that the laser plane cuts out of a sphere (x0, z0, r), or the point where
# an edge pierces that plane (x, z), for a marked edge with the place along it.


Array = NDArray[np.float64]
Index = NDArray[np.int64]

SAME = 2e-4  # m, and rad: readings of a robot at rest differ by less, poses on purpose by more
COMPONENTS = 3  # of every sighting; a model with fewer leaves the last ones empty


@dataclass(frozen=True, eq=False)
class Sightings:
    """Features (m) of one target.

    Attributes
    ----------
    names : of the features, for reports.
    shot : (m,) index of the shot that each was seen in.
    pose : (m,) index of the pose that it was taken from, as of `same_pose`: those with one index
        share its error.
    T_base_flange : (m, 4, 4) reported pose of each.
    value : (m, 3), m; covariance : (m, 3, 3). Empty components have value 0 and variance 1.
    """

    names: tuple[str, ...]
    shot: Index
    pose: Index
    T_base_flange: Array
    value: Array
    covariance: Array

    def take(self, rows: NDArray[np.bool_] | Index) -> "Sightings":
        """Those at ``rows`` (mask or index)."""
        index = np.arange(len(self.names))[rows]
        return Sightings(
            tuple(self.names[i] for i in index),
            self.shot[index],
            self.pose[index],
            self.T_base_flange[index],
            self.value[index],
            self.covariance[index],
        )


def same_pose(T_base_flange: Array) -> Index:
    """Of poses (m, 4, 4) the index (m,) of the first that is the same to `SAME`.

    What errs in a pose is common to all that is seen from it, however often: only what the sensor
    itself errs by is drawn anew.
    """
    place = T_base_flange[:, :3].reshape(-1, 12)
    near = cKDTree(place).query_ball_point(place, SAME, p=np.inf)
    return np.array([min(rows) for rows in near], dtype=np.int64)


def in_plane(value: Array) -> Array:
    """Points (..., 3) of the laser plane, sensor frame, from features (..., 3) that begin x, z."""
    return np.stack([value[..., 0], np.zeros(value.shape[:-1]), value[..., 1]], axis=-1)


@dataclass(frozen=True, eq=False)
class Seen:
    """What a model predicts for m sightings.

    Attributes
    ----------
    value : (m, 3) predicted features.
    point : (m, 3) the point of the target that is seen, sensor frame, m.
    slope : (m, 3, 3) change of the value as that point moves with the target, sensor axes.
    spread : (m, 3, k) displacement of that point, base axes, for each unknown of the target.
    aim : (m, 3, 2) change of the value with how the light was laid on the target by eye, which all
        sightings of one pose have in common; None where nothing is laid by eye.
    """

    value: Array
    point: Array
    slope: Array
    spread: Array
    aim: Array | None = None


class TargetModel(Protocol):
    """A target with k unknowns of its own; ``place`` is whatever says where it is."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names (k) of the unknowns."""

    @property
    def components(self) -> int:
        """How many of the three components of a sighting it has."""

    @property
    def prior(self) -> Array:
        """Information (k, k) about the unknowns beforehand."""

    def see(self, T_base_sensor: Array, place: Array) -> Seen:
        """Predict the sightings from sensor poses (m, 4, 4)."""

    def moved(self, place: Array, step: Array) -> Array:
        """The place after an increment (k,) of the unknowns."""

    def deviation(self, place: Array) -> Array:
        """Distance (k,) of the place from the prior's mean."""

    def distance(self, T_base_sensor: Array, place: Array, value: Array) -> Array:
        """How far (m,) sightings (m, 3), put into base, are from the target, m."""

    def take(self, rows: NDArray[np.bool_] | Index) -> "TargetModel":
        """The model for the sightings at ``rows``."""


# ---- steps of a search: of a pose along its own axes, and of a direction across itself ----------


def moved(T: Array, step: Array) -> Array:
    """A pose (4, 4) after an increment (v, w) (6,), m and rad, along its own axes."""
    return np.asarray(T @ frames.transform(frames.exp_rotation(step[3:]), step[:3]))


def tangents(direction: Array) -> Array:
    """Two unit vectors (3, 2) square to a unit vector (3,) and to each other."""
    side = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    side /= np.linalg.norm(side)
    return np.column_stack([side, np.cross(direction, side)])


# ---- models of the targets: a sphere, a straight edge, the marked edges of a staircase ----------


EQUATOR = 0.995  # share of the radius beyond which the circle's radius goes on straight
FLATTEST = 0.02  # sine of the angle between edge and laser plane below which nothing is seen


def _in_sensor(T_base_sensor: Array, point: Array) -> Array:
    """Points of the base, (3,) or (m, 3), in each sensor frame (m, 3)."""
    away = point - T_base_sensor[:, :3, 3]
    return np.asarray(np.einsum("mji,mj->mi", T_base_sensor[:, :3, :3], away))


@dataclass(frozen=True)
class SphereModel:
    """A sphere of known radius; sightings (x0, z0, r), place (3,) = its centre in base."""

    radius_m: float

    names = ("sphere x", "sphere y", "sphere z")
    components = 3
    prior = np.zeros((3, 3))

    def see(self, T_base_sensor: Array, place: Array) -> Seen:
        """Circles that the laser plane cuts out."""
        s = _in_sensor(T_base_sensor, place)
        y, R = s[:, 1], self.radius_m
        near = np.clip(y, -EQUATOR * R, EQUATOR * R)
        r = np.sqrt(R**2 - near**2)
        fall = -near / r  # dr / dy
        slope = np.zeros((len(s), 3, 3))
        slope[:, 0, 0] = slope[:, 1, 2] = 1.0
        slope[:, 2, 1] = fall
        spread = np.broadcast_to(np.eye(3), (len(s), 3, 3))
        value = np.column_stack([s[:, 0], s[:, 2], r + fall * (y - near)])
        return Seen(value, s, slope, spread)

    def moved(self, place: Array, step: Array) -> Array:
        """The centre after a step."""
        return np.asarray(place + step)

    def deviation(self, place: Array) -> Array:
        """Nothing is known beforehand."""
        return np.zeros(3)

    def distance(self, T_base_sensor: Array, place: Array, value: Array) -> Array:
        """Distance of each profile's own sphere centre; its side is the predicted one."""
        side = np.where(_in_sensor(T_base_sensor, place)[:, 1] < 0.0, -1.0, 1.0)
        own = circle_centres(value, self.radius_m, side)
        return np.asarray(np.linalg.norm(frames.apply(T_base_sensor, own) - place, axis=1))

    def take(self, rows: NDArray[np.bool_] | Index) -> "SphereModel":
        """The same for all sightings."""
        return self


def circle_centres(value: Array, radius_m: float, side: Array) -> Array:
    """Sphere centres (m, 3), sensor frame, of circles (x0, z0, r) on the sides (m,) of +-y."""
    y = side * np.sqrt(np.maximum(radius_m**2 - value[:, 2] ** 2, 0.0))
    return np.column_stack([value[:, 0], y, value[:, 1]])


def _pierce(s: Array, u: Array) -> tuple[Array, Array, Array]:
    """Where edges through s (m, 3) along u (m, 3) pierce y = 0, how far along, and the slope."""
    steep = np.where(np.abs(u[:, 1]) < FLATTEST, np.copysign(FLATTEST, u[:, 1]), u[:, 1])
    along = -s[:, 1] / steep
    slope = np.zeros((len(s), 3, 3))
    slope[:, 0, 0] = slope[:, 1, 2] = 1.0
    slope[:, 0, 1], slope[:, 1, 1] = -u[:, 0] / steep, -u[:, 2] / steep
    slope[:, 2, 1] = -1.0 / steep
    return s + along[:, None] * u, along, slope


@dataclass(frozen=True, eq=False)
class LineModel:
    """A straight edge; sightings (x, z), place (2, 3) = a point and the unit direction in base.

    ``known``: then it has no unknowns. Otherwise four: shifts and tilts across the edge.
    """

    known: bool = False

    components = 2

    @property
    def names(self) -> tuple[str, ...]:
        """None for a known edge."""
        return () if self.known else ("line shift 1", "line shift 2", "line tilt 1", "line tilt 2")

    @property
    def prior(self) -> Array:
        """Nothing is known beforehand."""
        return np.zeros((len(self.names), len(self.names)))

    def see(self, T_base_sensor: Array, place: Array) -> Seen:
        """Points where the edge pierces the laser plane."""
        point, direction = place
        s = _in_sensor(T_base_sensor, point)
        u = np.einsum("mji,j->mi", T_base_sensor[:, :3, :3], direction)
        p, along, slope = _pierce(s, u)
        slope[:, 2] = 0.0
        spread = np.zeros((len(s), 3, len(self.names)))
        if not self.known:
            across = tangents(direction)
            spread[:, :, :2] = across
            spread[:, :, 2:] = along[:, None, None] * across
        value = np.column_stack([p[:, 0], p[:, 2], np.zeros(len(p))])
        return Seen(value, p, slope, spread)

    def moved(self, place: Array, step: Array) -> Array:
        """The line after a step across it."""
        if self.known:
            return place
        across = tangents(place[1])
        direction = place[1] + across @ step[2:]
        return np.stack([place[0] + across @ step[:2], direction / np.linalg.norm(direction)])

    def deviation(self, place: Array) -> Array:
        """Nothing is known beforehand."""
        return np.zeros(len(self.names))

    def distance(self, T_base_sensor: Array, place: Array, value: Array) -> Array:
        """Distance of each feature from the line."""
        away = frames.apply(T_base_sensor, in_plane(value)) - place[0]
        return np.asarray(np.linalg.norm(away - np.outer(away @ place[1], place[1]), axis=1))

    def take(self, rows: NDArray[np.bool_] | Index) -> "LineModel":
        """The same for all sightings."""
        return self


@dataclass(frozen=True, eq=False)
class CornerModel:
    """Marked edges of a staircase; sightings (x, z, 0): the light was laid on the mark by eye.

    What the eye missed is a shift of the light along the edges and a turn across them.

    Attributes
    ----------
    corner_user : (m, 3) mark that each sighting shows, user frame, m.
    edge_user : (3,) unit direction of the edges.
    T_base_user : (4, 4) as taught; ``information`` (6, 6) about its error (v, w), user axes, or
        None where it is exact. Place (4, 4) = the user frame.
    """

    corner_user: Array
    edge_user: Array
    T_base_user: Array
    information: Array | None = None

    components = 3

    @property
    def across(self) -> Array:
        """Place (m,) of each corner across the edges, from -1 to 1."""
        away = self.corner_user - self.corner_user.mean(axis=0)
        away = away - np.outer(away @ self.edge_user, self.edge_user)
        place = away @ np.linalg.svd(away)[2][0]
        return np.asarray(place / max(float(np.abs(place).max()), 1e-9))

    @property
    def names(self) -> tuple[str, ...]:
        """None for an exact user frame."""
        turns = ("user frame x", "user frame y", "user frame z")
        return () if self.information is None else (*turns, *(f"{name} turn" for name in turns))

    @property
    def prior(self) -> Array:
        """About the teaching error."""
        return np.zeros((0, 0)) if self.information is None else self.information

    def see(self, T_base_sensor: Array, place: Array) -> Seen:
        """Points where the edges pierce the laser plane, and how far from the mark."""
        R = place[:3, :3]
        s = _in_sensor(T_base_sensor, self.corner_user @ R.T + place[:3, 3])
        u = np.einsum("mji,j->mi", T_base_sensor[:, :3, :3], R @ self.edge_user)
        p, along, slope = _pierce(s, u)
        spread = np.zeros((len(s), 3, len(self.names)))
        if self.information is not None:
            at_user = self.corner_user + along[:, None] * self.edge_user
            spread[:, :, :3] = R
            spread[:, :, 3:] = -R @ frames.skew(at_user)
        aim = np.zeros((len(s), 3, 2))
        aim[:, 2, 0], aim[:, 2, 1] = 1.0, self.across
        return Seen(np.column_stack([p[:, 0], p[:, 2], along]), p, slope, spread, aim)

    def moved(self, place: Array, step: Array) -> Array:
        """The user frame after a step along its own axes."""
        if self.information is None:
            return place
        return moved(place, step)

    def deviation(self, place: Array) -> Array:
        """How far the user frame is from the taught one."""
        if self.information is None:
            return np.zeros(0)
        T = frames.invert(self.T_base_user) @ place
        return np.concatenate([T[:3, 3], frames.log_rotation(T[:3, :3])])

    def distance(self, T_base_sensor: Array, place: Array, value: Array) -> Array:
        """Distance of each corner from its mark."""
        corner = self.corner_user @ place[:3, :3].T + place[:3, 3]
        base = frames.apply(T_base_sensor, in_plane(value))
        return np.asarray(np.linalg.norm(base - corner, axis=1))

    def take(self, rows: NDArray[np.bool_] | Index) -> "CornerModel":
        """The corners at ``rows``."""
        return CornerModel(
            self.corner_user[rows], self.edge_user, self.T_base_user, self.information
        )
