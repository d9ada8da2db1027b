"""The pose of a sensor on the flange as an estimation problem, with the robot's error as nuisance.

A sighting's residual is value(X, target, T (1 + d)) - measured: the pose error d is common to all
that one profile shows. It is marginalised: its covariance is added to the features' own before the
residuals are whitened, profile by profile.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.hand_eye.sightings import COMPONENTS, Index, Sightings, TargetModel

Array = NDArray[np.float64]

COMMON = 8  # errors that all sightings of one pose have in common
SENSOR_UNKNOWNS = ("sensor x", "sensor y", "sensor z", "turn x", "turn y", "turn z")


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations of what all sightings of one pose have in common.

    Attributes
    ----------
    sigma_m, sigma_rad : of a coordinate of the reported pose, and of its turn about an axis.
    aim_m : of light that is laid on a mark by eye.
    """

    sigma_m: float
    sigma_rad: float
    aim_m: float = 0.0

    def covariance(self) -> Array:
        """(8, 8) of (v, w), flange axes, and of the shift and the turn of the light."""
        sigma = np.repeat([self.sigma_m, self.sigma_rad, self.aim_m], [3, 3, 2])
        return np.diag(sigma**2)


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

    Attributes
    ----------
    residual : (m, 3), prediction minus measurement.
    jacobian : (m, 3, k) for the unknowns.
    common : (m, 3, 8) for what all sightings of a pose have in common, as in `PoseNoise`.
    covariance : (m, 3, 3) of the measured value.
    """

    residual: Array
    jacobian: Array
    common: Array
    covariance: Array


class MountProblem:
    """``estimation.loss.Problem`` of one sensor and targets; a sample is a profile, or a sighting.

    The increments (v, w) of the sensor, its axes, shift the pivot and turn about it.

    Parameters
    ----------
    near : where the weights are taken; they stay while the state moves, or there is no one cost.
    pivot : (3,) about which the sensor turns, sensor frame; None for the middle of what was seen.
    together : whether the sightings of one pose are one sample, and their common error is known to
        be common; otherwise each is its own (to find the one that is wrong).
    """

    scale_components = 0  # noise is always given

    def __init__(
        self,
        views: tuple[TargetView, ...],
        noise: PoseNoise,
        near: MountState,
        together: bool = True,
        pivot: Array | None = None,
    ) -> None:
        self.views, self.noise = views, noise
        names = [name for view in views for name in view.model.names]
        self.names = (*SENSOR_UNKNOWNS, *names)
        self.pivot = pivot_of(views) if pivot is None else pivot
        poses = np.concatenate([view.sightings.pose for view in views])
        if not together:
            poses = np.arange(len(poses))
        self.poses, self.sample = np.unique(poses, return_inverse=True)
        self._place = _place_in_sample(self.sample)
        sizes = np.concatenate([np.full(len(v.sightings.names), v.model.components) for v in views])
        self.sizes = np.bincount(self.sample, weights=sizes).astype(np.int64)
        _, _, common, covariance = self.grouped(self.linear(near))
        self.aimed = bool(np.any(common[..., 6:]))  # whether light is laid by eye
        spread = covariance + common @ noise.covariance() @ np.swapaxes(common, 1, 2)
        self._whitening = np.linalg.inv(np.linalg.cholesky(spread))

    def linear(self, state: MountState) -> Linear:
        """Linearise all sightings."""
        X, k = state.T_flange_sensor, len(self.names)
        parts, first = [], len(SENSOR_UNKNOWNS)
        for view, place in zip(self.views, state.places, strict=True):
            seen_from = view.sightings.T_base_flange @ X
            seen = view.model.see(seen_from, place)
            own = len(view.model.names)
            J = np.zeros((len(seen.value), COMPONENTS, k))
            J[:, :, :3] = -seen.slope
            J[:, :, 3:6] = seen.slope @ frames.skew(seen.point - self.pivot)
            turned = np.swapaxes(seen_from[:, :3, :3], 1, 2) @ seen.spread
            J[:, :, first : first + own] = seen.slope @ turned
            first += own
            flange = seen.point @ X[:3, :3].T + X[:3, 3]
            down = seen.slope @ X[:3, :3].T
            aim = np.zeros((len(flange), COMPONENTS, 2)) if seen.aim is None else seen.aim
            common = np.concatenate([-down, down @ frames.skew(flange), aim], axis=2)
            s = view.sightings
            parts.append(Linear(seen.value - s.value, J, common, s.covariance))
        return Linear(
            np.concatenate([p.residual for p in parts]),
            np.concatenate([p.jacobian for p in parts]),
            np.concatenate([p.common for p in parts]),
            np.concatenate([p.covariance for p in parts]),
        )

    def grouped(self, linear: Linear) -> tuple[Array, Array, Array, Array]:
        """Samples (g, c ...): residual, Jacobian (k), common errors (8), covariance (c)."""
        groups, width = len(self.poses), int(self._place.max()) + 1
        c, k = width * COMPONENTS, linear.jacobian.shape[2]
        at = self.sample, self._place
        residual = np.zeros((groups, width, COMPONENTS))
        jacobian = np.zeros((groups, width, COMPONENTS, k))
        common = np.zeros((groups, width, COMPONENTS, COMMON))
        covariance = np.zeros((groups, width, COMPONENTS, width, COMPONENTS))
        row = np.arange(width)
        covariance[:, row, :, row, :] = np.eye(COMPONENTS)  # empty places stay zero, not singular
        residual[at], jacobian[at], common[at] = linear.residual, linear.jacobian, linear.common
        covariance[self.sample, self._place, :, self._place, :] = linear.covariance
        return (
            residual.reshape(groups, c),
            jacobian.reshape(groups, c, k),
            common.reshape(groups, c, COMMON),
            covariance.reshape(groups, c, c),
        )

    def linearise(self, state: MountState) -> tuple[Array, Array]:
        """Whitened residual (g, c) and Jacobian (g, c, k)."""
        return self._whitened(self.linear(state))

    def whitened(self, linear: Linear, column: Array) -> tuple[Array, Array]:
        """Whitened rows (N,) and (N, k + 1) with one unknown more, whose column is (m, 3, 1)."""
        more = replace(linear, jacobian=np.concatenate([linear.jacobian, column], axis=2))
        residual, jacobian = self._whitened(more)
        return residual.ravel(), jacobian.reshape(residual.size, -1)

    def _whitened(self, linear: Linear) -> tuple[Array, Array]:
        residual, jacobian, _, _ = self.grouped(linear)
        whitened = self._whitening @ np.concatenate([residual[..., None], jacobian], axis=2)
        return whitened[..., 0], whitened[..., 1:]

    def retract(self, state: MountState, step: Array) -> MountState:
        """Move sensor and targets; the sensor turns about the pivot."""
        turn = frames.exp_rotation(step[3:6])
        move = frames.transform(turn, self.pivot + step[:3] - turn @ self.pivot)
        places, first = [], len(SENSOR_UNKNOWNS)
        for view, place in zip(self.views, state.places, strict=True):
            own = len(view.model.names)
            places.append(view.model.moved(place, step[first : first + own]))
            first += own
        return MountState(state.T_flange_sensor @ move, tuple(places))

    def deviation(self, state: MountState) -> Array:
        """Distance (k,) from the priors' means; zero where there is none."""
        pairs = zip(self.views, state.places, strict=True)
        return np.concatenate(
            [np.zeros(len(SENSOR_UNKNOWNS)), *(v.model.deviation(place) for v, place in pairs)]
        )

    def prior(self) -> Array:
        """Information (k, k) about the unknowns beforehand; zero where nothing is known."""
        k, first = len(self.names), len(SENSOR_UNKNOWNS)
        information = np.zeros((k, k))
        for view in self.views:
            own = len(view.model.names)
            information[first : first + own, first : first + own] = view.model.prior
            first += own
        return information


def pivot_of(views: tuple[TargetView, ...]) -> Array:
    """The middle (3,) of what was seen, sensor frame: there shifts and turns hardly correlate."""
    value = np.concatenate([view.sightings.value for view in views])
    return np.array([value[:, 0].mean(), 0.0, value[:, 1].mean()])


def _place_in_sample(sample: Index) -> Index:
    """Number (m,) of each sighting within its sample."""
    order = np.argsort(sample, kind="stable")
    ordered = sample[order]
    start = np.searchsorted(ordered, ordered)
    place = np.empty(len(sample), dtype=np.int64)
    place[order] = np.arange(len(sample)) - start
    return place
