"""The pose of a sensor on the flange as an estimation problem, with the robot's error as nuisance.

A sighting's residual is value(X, target, T (1 + d)) - measured: the pose error d is common to all
that one profile shows. It is marginalised: its covariance is added to the features' own before the
residuals are whitened, profile by profile.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.hand_eye.target_models import COMPONENTS, Index, Sightings, TargetModel

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


# ---- how well the robot repeats and the eye aims, from what a fit leaves over -------------------
#
# Restricted maximum likelihood (Patterson and Thompson 1971): the noise at which that part of the
# measurements is most likely which the unknowns cannot explain.


FIRST_NOISE = PoseNoise(5e-5, 5e-5, 1e-4)  # turns count as shifts at an arm's length of 1 m
NOISE_RANGE_M = (1e-6, 1e-2)
FLAT = 0.02  # slope of the likelihood: a hundredth of the noise's own uncertainty
NEAR = 0.2  # relative step in which the likelihood's bend is seen
NODES = (-2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0)  # standard deviations of a noise's logarithm
WIDEST = 1.0  # of them


class RestrictedLikelihood:
    """The restricted likelihood of noises that are not known, by their logarithms."""

    def __init__(
        self,
        problem: MountProblem,
        state: MountState,
        keep: NDArray[np.bool_],
        given: PoseNoise | None,
    ) -> None:
        r, J, G, C = (part[keep] for part in problem.grouped(problem.linear(state)))
        self.unknown = ["sigma_m"] if given is None else []
        self.unknown += ["aim_m"] if np.any(G[..., 6:]) else []
        self._own, self._noise = C, problem.noise
        self._all = np.concatenate([r[..., None], J, G], axis=2)
        self._known = problem.prior()
        self._pull = self._known @ problem.deviation(state)

    @property
    def now(self) -> Array:
        """Logarithms (n,) of the problem's own noise."""
        return np.log([getattr(self._noise, field) for field in self.unknown])

    def noise(self, log_sigma: Array) -> PoseNoise:
        """The noise that they stand for."""
        return _with(self._noise, self.unknown, log_sigma)

    def at(self, log_sigma: Array) -> tuple[float, Array, Array]:
        """-2 log likelihood, normal matrix (k, k) and the step (k,) to the best state there."""
        cost, normal, step, _, _ = self._whitened(log_sigma)
        return cost, normal, step

    def with_slope(self, log_sigma: Array) -> tuple[float, Array]:
        """-2 log likelihood and its slope (n,)."""
        cost, normal, step, white, common = self._whitened(log_sigma)
        J, G = white[..., 1:-COMMON], white[..., -COMMON:]
        left = white[..., 0] + J @ step
        JG = np.swapaxes(J, 1, 2) @ G
        grown = np.sum(G**2, axis=(0, 1)) - np.sum(JG * np.linalg.solve(normal, JG), axis=(0, 1))
        fitted = np.sum((left[:, None, :] @ G) ** 2, axis=(0, 1))
        each = 2.0 * np.diag(common) * (grown - fitted)
        parts = {"sigma_m": each[:6].sum(), "aim_m": each[6:].sum()}
        return cost, np.array([parts[field] for field in self.unknown])

    def _whitened(self, log_sigma: Array) -> tuple[float, Array, Array, Array, Array]:
        common = self.noise(log_sigma).covariance()
        G = self._all[..., -COMMON:]
        L = np.linalg.cholesky(self._own + G @ common @ np.swapaxes(G, 1, 2))
        white = np.linalg.solve(L, self._all)
        r, J = white[..., 0].ravel(), white[..., 1:-COMMON].reshape(-1, len(self._known))
        normal = J.T @ J + self._known
        gradient = J.T @ r + self._pull
        step = -np.linalg.solve(normal, gradient)
        spread = 2.0 * np.sum(np.log(np.diagonal(L, axis1=1, axis2=2)))
        cost = r @ r + gradient @ step + spread + np.linalg.slogdet(normal)[1]
        return float(cost), normal, np.asarray(step), white, common


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

    Few poses tell their own noise badly, and the covariance for the likeliest one is too small: for
    n numbers to spare the mean of the noise's square is wider by n / (n - 3). By the law of total
    variance, summed over a grid around the problem's own noise, which is the likeliest. The prior
    is flat in the noise (Gelman 2006, Bayesian Analysis 1:515), not in its logarithm: that would
    believe in noises near zero wherever what features err by hides them, and tell too little.
    """
    keep = np.ones(len(problem.poses), dtype=np.bool_)
    likely = RestrictedLikelihood(problem, state, keep, given)
    best = likely.now
    least, normal, _ = likely.at(best)
    if not likely.unknown:
        return np.asarray(np.linalg.inv(normal))
    width = []
    for axis in NEAR * np.eye(len(best)):
        bend = (likely.at(best + axis)[0] + likely.at(best - axis)[0] - 2.0 * least) / NEAR**2
        width.append(np.sqrt(2.0 / max(bend, 2.0 / WIDEST**2)))
    total, weights = np.zeros_like(normal), 0.0
    for nodes in product(NODES, repeat=len(best)):
        away = np.array(width) * nodes
        cost, normal, step = likely.at(best + away)
        weight = float(np.exp(0.5 * (least - cost) + away.sum()))
        total += weight * (np.linalg.inv(normal) + np.outer(step, step))
        weights += weight
    return np.asarray(total / weights)


def _with(noise: PoseNoise, unknown: list[str], log_sigma: Array) -> PoseNoise:
    found = replace(noise, **dict(zip(unknown, np.exp(log_sigma).tolist(), strict=True)))
    if "sigma_m" in unknown:
        ratio = FIRST_NOISE.sigma_rad / FIRST_NOISE.sigma_m
        return replace(found, sigma_rad=ratio * found.sigma_m)
    return found
