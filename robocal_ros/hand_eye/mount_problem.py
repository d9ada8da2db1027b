# SPDX-License-Identifier: Apache-2.0
"""The pose of a sensor on the flange as an estimation problem, with the robot's error as nuisance.

Each profile is reduced to features that hold all it says (Fisher information) about where the
target is: the circle that the laser plane cuts out of a sphere (x0, z0, r), or the point where an
edge pierces that plane (x, z), for a marked edge with the place along it.

A sighting's residual is value(X, target, T (1 + d)) - measured: the pose error d is common to all
that one profile shows. It is marginalised: its covariance is added to the features' own before the
residuals are whitened, profile by profile.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial import cKDTree

from robocal_ros.ground import frames
from robocal_ros.ground.frames import Array, Index
from robocal_ros.hand_eye.result import ARM_M, PoseNoise

SAME = 2e-4  # m, and rad: readings of a robot at rest differ by less, poses on purpose by more
COMPONENTS = 3  # of every sighting; a model with fewer leaves the last ones empty
COMMON = 8  # errors that all sightings of one pose have in common
# Of which of them each noise is, and of what changes from visit to visit.
COLUMNS = {"sigma_m": slice(6), "aim_m": slice(6, COMMON), "repeat_m": slice(COMMON, None)}
SENSOR_UNKNOWNS = ("sensor x", "sensor y", "sensor z", "turn x", "turn y", "turn z")
EQUATOR = 0.995  # share of the radius beyond which the circle's radius goes on straight
FLATTEST = 0.02  # sine of the angle between edge and laser plane below which nothing is seen

FIRST_NOISE = PoseNoise(5e-5, 5e-5 / ARM_M, 1e-4, 2e-5)
NOISE_RANGE_M = (1e-6, 1e-2)
FLAT = 0.02  # slope of the likelihood: a hundredth of the noise's own uncertainty
NEAR = 0.2  # relative step in which the likelihood's bend is seen
NODES = (-2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0)  # standard deviations of a noise's logarithm
WIDEST = 1.0  # of them


@dataclass(frozen=True, eq=False)
class Sightings:
    """Features (m) of one target.

    ``names``: of the features, for reports. ``shot`` (m,) index of the shot that each was seen in.
    ``pose`` (m,) index of the pose that it was taken from, as of `same_pose`: those with one index
    share its error. ``T_base_flange`` (m, 4, 4) reported pose of each. ``value`` (m, 3), m;
    ``covariance``: (m, 3, 3). Empty components have value 0 and variance 1.
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


def from_plane(T: Array, value: Array) -> Array:
    """Points (n, 3) where sensor poses (4, 4) or (n, 4, 4) put features (n, 2 or 3): x, z first."""
    return np.asarray(value[:, :1] * T[..., :3, 0] + value[:, 1:2] * T[..., :3, 2] + T[..., :3, 3])


@dataclass(frozen=True, eq=False)
class Seen:
    """What a model predicts for m sightings.

    ``value`` (m, 3) predicted features. ``point`` (m, 3) the point of the target that is seen,
    sensor frame, m. ``slope`` (m, 3, 3) change of the value as that point moves with the target,
    sensor axes. ``spread`` (m, 3, k) displacement of that point, base axes, for each unknown of the
    target. ``aim`` (m, 3, 2) change of the value with how the light was laid on the target by eye,
    which all sightings of one pose have in common; None where nothing is laid by eye.
    """

    value: Array
    point: Array
    slope: Array
    spread: Array
    aim: Array | None = None


class TargetModel(ABC):
    """A target with k unknowns of its own; ``place`` is whatever says where it is.

    ``components``: how many of the three components of a sighting it has.
    """

    components = COMPONENTS

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names (k) of the unknowns."""

    def prior(self, noise: PoseNoise) -> Array:
        """Information (k, k) about the unknowns beforehand, where poses err by so much."""
        return np.zeros((len(self.names), len(self.names)))

    @abstractmethod
    def see(self, T_base_sensor: Array, place: Array) -> Seen:
        """Predict the sightings from sensor poses (m, 4, 4)."""

    @abstractmethod
    def moved(self, place: Array, step: Array) -> Array:
        """The place after an increment (k,) of the unknowns."""

    @abstractmethod
    def distance(self, T_base_sensor: Array, place: Array, value: Array) -> Array:
        """How far (m,) sightings (m, 3), put into base, are from the target, m."""

    def deviation(self, place: Array) -> Array:
        """Distance (k,) of the place from the prior's mean."""
        return np.zeros(len(self.names))

    def take(self, rows: NDArray[np.bool_] | Index) -> "TargetModel":
        """The model for the sightings at ``rows``."""
        return self


def moved(T: Array, step: Array) -> Array:
    """A pose (4, 4) after an increment (v, w) (6,), m and rad, along its own axes."""
    return np.asarray(T @ frames.transform(frames.exp_rotation(step[3:]), step[:3]))


def tangents(direction: Array) -> Array:
    """Two unit vectors (3, 2) square to a unit vector (3,) and to each other."""
    x, y, z = direction.tolist()  # by hand: `np.cross` takes most of a descent's time
    side = np.array([(0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0)][int(np.argmin(np.abs(direction)))])
    side /= np.linalg.norm(side)
    a, b, c = side.tolist()
    return np.array([(a, y * c - z * b), (b, z * a - x * c), (c, x * b - y * a)])


def _in_sensor(T_base_sensor: Array, point: Array) -> Array:
    """Points of the base, (3,) or (m, 3), in each sensor frame (m, 3)."""
    away = point - T_base_sensor[:, :3, 3]
    return np.asarray(np.einsum("mji,mj->mi", T_base_sensor[:, :3, :3], away))


def circle_centres(value: Array, radius_m: float, side: Array) -> Array:
    """Sphere centres (m, 3), sensor frame, of circles (x0, z0, r) on the sides (m,) of +-y."""
    y = side * np.sqrt(np.maximum(radius_m**2 - value[:, 2] ** 2, 0.0))
    return np.column_stack([value[:, 0], y, value[:, 1]])


@dataclass(frozen=True)
class SphereModel(TargetModel):
    """A sphere of known radius; sightings (x0, z0, r), place (3,) = its centre in base."""

    radius_m: float

    names = ("sphere x", "sphere y", "sphere z")

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

    def distance(self, T_base_sensor: Array, place: Array, value: Array) -> Array:
        """Distance of each profile's own sphere centre; its side is the predicted one."""
        side = np.where(_in_sensor(T_base_sensor, place)[:, 1] < 0.0, -1.0, 1.0)
        own = circle_centres(value, self.radius_m, side)
        return np.asarray(np.linalg.norm(frames.apply(T_base_sensor, own) - place, axis=1))


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
class LineModel(TargetModel):
    """A straight edge; sightings (x, z), place (2, 3) = a point and the unit direction in base.

    ``known``: then it has no unknowns. Otherwise four: shifts and tilts across the edge.
    """

    known: bool = False

    components = 2

    @property
    def names(self) -> tuple[str, ...]:
        """None for a known edge."""
        return () if self.known else ("line shift 1", "line shift 2", "line tilt 1", "line tilt 2")

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

    def distance(self, T_base_sensor: Array, place: Array, value: Array) -> Array:
        """Distance of each feature from the line."""
        away = frames.apply(T_base_sensor, in_plane(value)) - place[0]
        return np.asarray(np.linalg.norm(away - np.outer(away @ place[1], place[1]), axis=1))


@dataclass(frozen=True, eq=False)
class CornerModel(TargetModel):
    """Marked edges of a staircase; sightings (x, z, 0): the light was laid on the mark by eye.

    What the eye missed is a shift of the light along the edges and a turn across them.

    ``corner_user`` (m, 3) mark that each sighting shows, user frame, m. ``edge_user`` (3,) unit
    direction of the edges. ``T_base_user`` (4, 4) as taught; ``taught_sigma`` (6,) of its error
    (v, w), user axes, or None where it is exact. Place (4, 4) = the user frame.
    """

    corner_user: Array
    edge_user: Array
    T_base_user: Array
    taught_sigma: Array | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """None for an exact user frame."""
        turns = ("user frame x", "user frame y", "user frame z")
        return () if self.taught_sigma is None else (*turns, *(f"{name} turn" for name in turns))

    def prior(self, noise: PoseNoise) -> Array:
        """About the teaching error, and that of the robot where it taught.

        Joints that turn little from shot to shot err alike in all of them, and otherwise where the
        frame was taught: by as much, as far as one can tell, as those that turn.
        """
        if self.taught_sigma is None:
            return np.zeros((0, 0))
        robot = np.repeat([noise.sigma_m, noise.sigma_rad], 3)
        return np.diag(1.0 / (self.taught_sigma**2 + robot**2))

    @cached_property
    def _across(self) -> Array:
        """Place (m,) of each corner across the edges, from -1 to 1."""
        away = self.corner_user - self.corner_user.mean(axis=0)
        away = away - np.outer(away @ self.edge_user, self.edge_user)
        across = away @ np.linalg.svd(away)[2][0]
        return np.asarray(across / max(float(np.abs(across).max()), 1e-9))

    def see(self, T_base_sensor: Array, place: Array) -> Seen:
        """Points where the edges pierce the laser plane, and how far from the mark."""
        R = place[:3, :3]
        s = _in_sensor(T_base_sensor, self.corner_user @ R.T + place[:3, 3])
        u = np.einsum("mji,j->mi", T_base_sensor[:, :3, :3], R @ self.edge_user)
        p, along, slope = _pierce(s, u)
        spread = np.zeros((len(s), 3, len(self.names)))
        if self.taught_sigma is not None:
            at_user = self.corner_user + along[:, None] * self.edge_user
            spread[:, :, :3] = R
            spread[:, :, 3:] = -R @ frames.skew(at_user)
        aim = np.zeros((len(s), 3, 2))
        aim[:, 2, 0] = 1.0
        aim[:, 2, 1] = self._across
        return Seen(np.column_stack([p[:, 0], p[:, 2], along]), p, slope, spread, aim)

    def moved(self, place: Array, step: Array) -> Array:
        """The user frame after a step along its own axes."""
        return place if self.taught_sigma is None else moved(place, step)

    def deviation(self, place: Array) -> Array:
        """How far the user frame is from the taught one."""
        if self.taught_sigma is None:
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
        return replace(self, corner_user=self.corner_user[rows])


@dataclass(frozen=True, eq=False)
class TargetView:
    """Sightings of one target, and its model."""

    model: TargetModel
    sightings: Sightings

    def take(self, rows: NDArray[np.bool_] | Index) -> "TargetView":
        """The sightings at ``rows``."""
        return TargetView(self.model.take(rows), self.sightings.take(rows))


@dataclass(frozen=True, eq=False)
class MountState:
    """Pose of the sensor, and the place of each view's target."""

    T_flange_sensor: Array
    places: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class Linear:
    """All sightings (m) linearised: nothing is whitened yet.

    ``residual`` (m, 3), prediction minus measurement. ``jacobian`` (m, 3, k) for the unknowns.
    ``common`` (m, 3, 8) for what all sightings of a pose have in common, as in `PoseNoise`.
    ``covariance`` (m, 3, 3) of the measured value.
    """

    residual: Array
    jacobian: Array
    common: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Bend:
    """What is not known of a sensor's linearity: r numbers, of which nothing else is known.

    Beforehand each is a normal one of size one. ``pull``: how each sighting (3, r), by its name,
    moves with them. ``taken`` (r,): those that were taken out of the sightings.
    """

    pull: Mapping[str, Array]
    taken: Array


class MountProblem:
    """`Problem` of a sensor and targets; a sample is a profile or a sighting.

    The increments (v, w) of the sensor, its axes, shift the pivot and turn about it.

    ``near``: where the weights are taken; they stay while the state moves, or there is no one cost.
    ``pivot`` (3,) about which the sensor turns, sensor frame; None for the middle of what was seen.
    ``together``: whether the sightings of one pose are one sample, and their common error is known
    to be common; otherwise each is its own (to find the one that is wrong). ``bend``: of the
    sensor; the likelihood of noises counts it, the state does not hold it.
    """

    scale_components = 0  # noise is always given

    def __init__(
        self,
        views: tuple[TargetView, ...],
        noise: PoseNoise,
        near: MountState,
        together: bool = True,
        pivot: Array | None = None,
        bend: Bend | None = None,
    ) -> None:
        self.views, self.noise, self.bend = views, noise, bend
        names = list(SENSOR_UNKNOWNS)
        self._columns = []  # of each target's unknowns
        for view in views:
            self._columns.append(slice(len(names), len(names) + len(view.model.names)))
            names += view.model.names
        self.names = tuple(names)
        self.pivot = pivot_of(views) if pivot is None else pivot
        poses = np.concatenate([view.sightings.pose for view in views])
        if not together:
            poses = np.arange(len(poses))
        self.poses, self.sample = np.unique(poses, return_inverse=True)
        order = np.argsort(self.sample, kind="stable")
        ordered = self.sample[order]
        self._place = np.empty(len(order), dtype=np.int64)  # of each sighting in its sample
        self._place[order] = np.arange(len(order)) - np.searchsorted(ordered, ordered)
        sizes = np.concatenate([np.full(len(v.sightings.names), v.model.components) for v in views])
        self.sizes = np.bincount(self.sample, weights=sizes).astype(np.int64)
        self._visit, self.visits = self._numbered_visits()
        self._near: tuple[MountState, Linear] | None = None
        self._near = near, self.linear(near)
        _, _, common, covariance = self.grouped(self._near[1])
        self.aimed = bool(np.any(common[..., 6:COMMON]))  # whether light is laid by eye
        nuisance = common @ noise.covariance(self.visits) @ np.swapaxes(common, 1, 2)
        spread = covariance + nuisance
        self._whitening = np.linalg.inv(np.linalg.cholesky(spread))

    def _numbered_visits(self) -> tuple[Index, int]:
        """Number (m,) of the visit within its sample, and how many one has; 0 where none has two.

        A shot is a visit.
        """
        shots = np.concatenate([view.sightings.shot for view in self.views])
        pairs, row = np.unique(np.column_stack([self.sample, shots]), axis=0, return_inverse=True)
        number = np.arange(len(pairs)) - np.searchsorted(pairs[:, 0], pairs[:, 0])
        most = int(number.max()) + 1
        return number[row.ravel()].astype(np.int64), most if most > 1 else 0

    def linear(self, state: MountState) -> Linear:
        """Linearise all sightings."""
        if self._near is not None and state is self._near[0]:  # where every descent begins
            return self._near[1]
        X, k = state.T_flange_sensor, len(self.names)
        parts = []
        for view, place, columns in zip(self.views, state.places, self._columns, strict=True):
            seen_from = view.sightings.T_base_flange @ X
            seen = view.model.see(seen_from, place)
            J = np.zeros((len(seen.value), COMPONENTS, k))
            J[:, :, :3] = -seen.slope
            J[:, :, 3:6] = seen.slope @ frames.skew(seen.point - self.pivot)
            turned = np.swapaxes(seen_from[:, :3, :3], 1, 2) @ seen.spread
            J[:, :, columns] = seen.slope @ turned
            flange = seen.point @ X[:3, :3].T + X[:3, 3]
            down = seen.slope @ X[:3, :3].T
            aim = np.zeros((len(flange), COMPONENTS, 2)) if seen.aim is None else seen.aim
            common = np.concatenate([-down, down @ frames.skew(flange), aim], axis=2)
            s = view.sightings
            parts.append((seen.value - s.value, J, common, s.covariance))
        return Linear(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def grouped(self, linear: Linear) -> tuple[Array, Array, Array, Array]:
        """Samples (g, c ...): residual, Jacobian (k), common errors (8 + 6 v), covariance (c)."""
        groups, width = len(self.poses), int(self._place.max()) + 1
        c, k = width * COMPONENTS, linear.jacobian.shape[2]
        at = self.sample, self._place
        residual = np.zeros((groups, width, COMPONENTS))
        jacobian = np.zeros((groups, width, COMPONENTS, k))
        common = np.zeros((groups, width, COMPONENTS, COMMON + 6 * self.visits))
        covariance = np.zeros((groups, width, COMPONENTS, width, COMPONENTS))
        row = np.arange(width)
        covariance[:, row, :, row, :] = np.eye(COMPONENTS)  # empty places stay zero, not singular
        residual[at], jacobian[at] = linear.residual, linear.jacobian
        common[(*at, slice(None), slice(COMMON))] = linear.common
        for visit in range(self.visits):
            own = self.sample[self._visit == visit], self._place[self._visit == visit]
            columns = slice(COMMON + 6 * visit, COMMON + 6 * (visit + 1))
            common[(*own, slice(None), columns)] = linear.common[self._visit == visit, :, :6]
        covariance[self.sample, self._place, :, self._place, :] = linear.covariance
        return (
            residual.reshape(groups, c),
            jacobian.reshape(groups, c, k),
            common.reshape(groups, c, -1),
            covariance.reshape(groups, c, c),
        )

    def linearise(self, state: MountState) -> tuple[Array, Array]:
        """Whitened residual (g, c) and Jacobian (g, c, k)."""
        return self.whitened(self.linear(state))

    def whitened(self, linear: Linear) -> tuple[Array, Array]:
        """`linearise` of what is linearised already, with any number of columns."""
        residual, jacobian, _, _ = self.grouped(linear)
        whitened = self._whitening @ np.concatenate([residual[..., None], jacobian], axis=2)
        return whitened[..., 0], whitened[..., 1:]

    def retract(self, state: MountState, step: Array) -> MountState:
        """Move sensor and targets; the sensor turns about the pivot."""
        turn = frames.exp_rotation(step[3:6])
        move = frames.transform(turn, self.pivot + step[:3] - turn @ self.pivot)
        targets = zip(self.views, state.places, self._columns, strict=True)
        places = [view.model.moved(place, step[columns]) for view, place, columns in targets]
        return MountState(state.T_flange_sensor @ move, tuple(places))

    def deviation(self, state: MountState) -> Array:
        """Distance (k,) from the priors' means; zero where there is none."""
        pairs = zip(self.views, state.places, strict=True)
        return np.concatenate(
            [np.zeros(len(SENSOR_UNKNOWNS)), *(v.model.deviation(place) for v, place in pairs)]
        )

    def prior(self) -> Array:
        """Information (k, k) about the unknowns beforehand; zero where nothing is known."""
        information = np.zeros((len(self.names), len(self.names)))
        for view, columns in zip(self.views, self._columns, strict=True):
            information[columns, columns] = view.model.prior(self.noise)
        return information


def pivot_of(views: tuple[TargetView, ...]) -> Array:
    """The middle (3,) of what was seen, sensor frame: there shifts and turns hardly correlate."""
    value = np.concatenate([view.sightings.value for view in views])
    return np.array([value[:, 0].mean(), 0.0, value[:, 1].mean()])


class RestrictedLikelihood:
    """How likely noises are that are not known: of the poses, and of how the eye aims.

    Restricted maximum likelihood (Patterson and Thompson 1971): of that part of the measurements
    which the unknowns cannot explain, what is not known of the sensor's bend among them: as far as
    residuals tell that, they tell no noise. Noises are given by their logarithms (n,).
    """

    def __init__(
        self,
        problem: MountProblem,
        state: MountState,
        keep: NDArray[np.bool_],
        given: PoseNoise | None,
    ) -> None:
        linear, bend = problem.linear(state), problem.bend
        self._known = problem.prior()
        self._pull = self._known @ problem.deviation(state)
        if bend is not None:
            names = [name for view in problem.views for name in view.sightings.names]
            pull = np.array([bend.pull[name] for name in names])
            both = np.concatenate([linear.jacobian, pull], axis=2)
            linear = replace(linear, jacobian=both)
            self._known = block_diag(self._known, np.eye(len(bend.taken)))
            self._pull = np.concatenate([self._pull, bend.taken])
        r, J, G, C = (part[keep] for part in problem.grouped(linear))
        self.unknown = ["sigma_m"] if given is None else []
        self.unknown += ["aim_m"] if np.any(G[..., 6:COMMON]) else []
        self.unknown += ["repeat_m"] if problem.visits else []
        self._own, self._noise, self._visits = C, problem.noise, problem.visits
        self._all = np.concatenate([r[..., None], J, G], axis=2)
        self.now = np.log([getattr(self._noise, field) for field in self.unknown])

    def noise(self, log_sigma: Array) -> PoseNoise:
        """The noise that they stand for."""
        sigma = dict(zip(self.unknown, np.exp(log_sigma).tolist(), strict=True))
        if "sigma_m" in sigma:
            sigma["sigma_rad"] = FIRST_NOISE.sigma_rad / FIRST_NOISE.sigma_m * sigma["sigma_m"]
        return replace(self._noise, **sigma)

    def at(self, log_sigma: Array) -> tuple[float, Array, Array, Array, Array]:
        """-2 log likelihood, normal matrix (k, k), the step (k,) to the best state there.

        The last of the k are the bend's. Then the whitened samples, and the covariance of what a
        pose has in common.
        """
        common = self.noise(log_sigma).covariance(self._visits)
        G = self._all[..., -len(common) :]
        L = np.linalg.cholesky(self._own + G @ common @ np.swapaxes(G, 1, 2))
        white = np.linalg.solve(L, self._all)
        r = white[..., 0].ravel()
        J = white[..., 1 : -len(common)].reshape(-1, len(self._known))
        normal = J.T @ J + self._known
        gradient = J.T @ r + self._pull
        step = -np.linalg.solve(normal, gradient)
        spread = 2.0 * np.sum(np.log(np.diagonal(L, axis1=1, axis2=2)))
        cost = r @ r + gradient @ step + spread + np.linalg.slogdet(normal)[1]
        return float(cost), normal, np.asarray(step), white, common

    def with_slope(self, log_sigma: Array) -> tuple[float, Array]:
        """-2 log likelihood and its slope (n,)."""
        cost, normal, step, white, common = self.at(log_sigma)
        J, G = white[..., 1 : -len(common)], white[..., -len(common) :]
        left = white[..., 0] + J @ step
        JG = np.swapaxes(J, 1, 2) @ G
        grown = np.sum(G**2, axis=(0, 1)) - np.sum(JG * np.linalg.solve(normal, JG), axis=(0, 1))
        fitted = np.sum((left[:, None, :] @ G) ** 2, axis=(0, 1))
        each = 2.0 * np.diag(common) * (grown - fitted)
        return cost, np.array([each[COLUMNS[field]].sum() for field in self.unknown])

    def information(self, log_sigma: Array) -> Array:
        """What the measurements tell of them, as Fisher has it (n, n).

        A change of the covariance by dV tells tr(P dV P dV) / 2 of its size, where P is the inverse
        of V less what the unknowns take (Patterson and Thompson 1971); its root is Jeffreys' prior.
        """
        _, normal, _, white, common = self.at(log_sigma)
        J, G = white[..., 1 : -len(common)], white[..., -len(common) :] * np.sqrt(np.diag(common))
        groups, n = len(G), len(common)
        GJ = (np.swapaxes(G, 1, 2) @ J).reshape(groups * n, -1)
        seen = -(GJ @ np.linalg.solve(normal, GJ.T)).reshape(groups, n, groups, n)
        own = np.arange(groups)
        seen[own, :, own, :] += np.swapaxes(G, 1, 2) @ G
        each = np.einsum("gihj->ij", seen**2)
        parts = [COLUMNS[field] for field in self.unknown]
        return np.array([[2.0 * each[a, b].sum() for b in parts] for a in parts])


def restricted_noise(
    problem: MountProblem, state: MountState, keep: NDArray[np.bool_], given: PoseNoise | None
) -> tuple[PoseNoise, bool]:
    """The most likely noise of poses, unless it is ``given``, and of light that is laid by eye.

    ``keep`` (g,): samples that are used. The flag: whether the likelihood's top was reached.
    """
    from scipy.optimize import minimize

    likely = RestrictedLikelihood(problem, state, keep, given)
    if not likely.unknown:
        return problem.noise, True
    low, high = np.log(NOISE_RANGE_M)
    best = minimize(
        likely.with_slope,
        likely.now,
        jac=True,
        method="L-BFGS-B",
        bounds=[(low, high)] * len(likely.unknown),
        options={"gtol": FLAT},
    )
    # The search also ends, and well by its own account, where no step of it lowers the cost.
    downhill = np.clip(best.x - best.jac, low, high) - best.x
    return likely.noise(best.x), bool(np.max(np.abs(downhill)) <= FLAT)


def averaged_covariance(problem: MountProblem, state: MountState, given: PoseNoise | None) -> Array:
    """Covariance (k, k) of the unknowns, averaged over what the noise may be.

    Few poses tell their own noise badly, and the covariance for the likeliest one is too small: an
    error is of the noise that is true, which is independent of that found, and where n numbers tell
    this their squared ratio is n / (n - 2) in the mean (of 1 / chi-square). So much the mean of the
    noise's square is above the likeliest under Jeffreys' prior, and only under that. By the law of
    total variance, summed over a grid around the problem's own noise, which is the likeliest.
    """
    keep, own = np.ones(len(problem.poses), dtype=np.bool_), slice(len(problem.names))
    likely = RestrictedLikelihood(problem, state, keep, given)
    best = likely.now
    least, normal = likely.at(best)[:2]
    if not likely.unknown:
        return np.asarray(np.linalg.inv(normal)[own, own])
    width = []
    for axis in NEAR * np.eye(len(best)):
        bend = (likely.at(best + axis)[0] + likely.at(best - axis)[0] - 2.0 * least) / NEAR**2
        width.append(np.sqrt(2.0 / max(bend, 2.0 / WIDEST**2)))
    spread, weight = [], []
    for nodes in product(NODES, repeat=len(best)):
        there = best + np.array(width) * nodes
        cost, normal, step = likely.at(there)[:3]
        spread.append(np.linalg.inv(normal) + np.outer(step, step))
        weight.append(0.5 * (least - cost + np.linalg.slogdet(likely.information(there))[1]))
    # The noise found need not be the likeliest, where the search for it ended early.
    weights = np.exp(np.array(weight) - np.max(weight))
    return np.asarray((np.tensordot(weights, spread, 1) / np.sum(weights))[own, own])
