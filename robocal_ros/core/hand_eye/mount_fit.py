"""Maximum likelihood of a mount: robust, with the robot's own error estimated where none is given.

The error of poses is one unknown scale, found by restricted maximum likelihood (Patterson and
Thompson 1971): the likelihood of what is left after the unknowns are fitted.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.errors import RankDeficientError, RobocalError
from robocal_ros.core.estimation import Estimate, solve
from robocal_ros.core.hand_eye.mount_problem import MountProblem, MountState, PoseNoise, View
from robocal_ros.core.hand_eye.naming import describe_motion

Array = NDArray[np.float64]

FIRST_NOISE = PoseNoise(5e-5, 5e-5)
NOISE_RANGE_M = (1e-6, 1e-2)
ROUNDS = 8
SETTLED = 0.02  # relative change of the noise
OPEN_M = 0.02  # expected error of a direction from which it counts as not seen


@dataclass(frozen=True, eq=False)
class MountFit:
    """The most likely mount.

    Attributes
    ----------
    views : of the sightings that were used, in the order of the problem's.
    state, covariance : (k, k) of the problem's unknowns; scale: how far the misfit widened it.
    noise : of reported poses, given or found.
    rejected : names of sightings not used, with the reason.
    """

    views: tuple[View, ...]
    state: MountState
    covariance: Array
    scale: float
    noise: PoseNoise
    rejected: Mapping[str, str]
    creeping: str

    @property
    def names(self) -> tuple[str, ...]:
        """Of the sightings that were used."""
        return tuple(name for view in self.views for name in view.sightings.names)

    def distances(self, state: MountState | None = None) -> Array:
        """Distance of each sighting that was used from its target, m."""
        state = state or self.state
        pairs = zip(self.views, state.places, strict=True)
        return np.concatenate([_distance(view, state, place) for view, place in pairs])


def _distance(view: View, state: MountState, place: Array) -> Array:
    T = view.sightings.T_base_flange @ state.T_flange_sensor
    return view.model.distance(T, place, view.sightings.value)


def fit_mount(
    views: tuple[View, ...], start: MountState, noise: PoseNoise | None = None
) -> MountFit:
    """Estimate the sensor's pose and what is unknown of its targets.

    Parameters
    ----------
    noise : of reported poses; None to estimate it.

    Raises
    ------
    TooFewSamplesError
        Fewer equations than unknowns.
    RankDeficientError
        When poses leave a direction open; its words say which motion is missing.
    """
    rejected: dict[str, str] = {}
    state, found = start, noise or FIRST_NOISE
    alone = MountProblem(views, found, together=False)
    if len(alone.poses) > len(MountProblem(views, found).poses):
        estimate, found = _settle(alone, state, noise)
        state = estimate.state
        views = _without(views, estimate.rejected[alone.sample], rejected)
    problem = MountProblem(views, found)
    estimate, found = _settle(problem, state, noise)
    views = _without(views, estimate.rejected[problem.sample], rejected)
    return MountFit(
        views,
        estimate.state,
        estimate.covariance,
        estimate.scale,
        found,
        rejected,
        estimate.creeping,
    )


def _settle(
    problem: MountProblem, state: MountState, given: PoseNoise | None
) -> tuple[Estimate[MountState], PoseNoise]:
    """Solve, and estimate the noise of poses from what is left, until both stay."""
    noise = problem.noise
    for _ in range(ROUNDS):
        problem.noise = noise
        estimate = _solved(problem, state)
        state = estimate.state
        if given is not None:
            break
        before, noise = noise, _restricted_noise(problem, estimate)
        if abs(noise.sigma_m / before.sigma_m - 1.0) < SETTLED:
            break
    return estimate, noise


def _solved(problem: MountProblem, state: MountState) -> Estimate[MountState]:
    try:
        estimate = solve(problem, state, prior_information=problem.prior(), sizes=problem.sizes)
    except RankDeficientError as error:
        raise _in_words(problem, state) or error from error
    return estimate


def _in_words(problem: MountProblem, state: MountState) -> RankDeficientError | None:
    """The refusal with the sensor's own open directions; None where it is another unknown's."""
    from robocal_ros.core.observability import observability

    _, jacobian = problem.linearise(state)
    null = observability(jacobian.reshape(-1, jacobian.shape[2])).null[:6]
    T = np.concatenate([view.sightings.T_base_flange for view in problem.views])
    words = [describe_motion(d, T) for d in null.T if np.linalg.norm(d) > 1e-9]
    return refuse_open(words) if words else None


def refuse_open(words: list[str]) -> RankDeficientError:
    """The refusal for directions that are not seen, in words."""
    return RankDeficientError(f"not determined: {'; '.join(words)}", words)


def require_seen(fit: MountFit, reach_m: float) -> None:
    """Refuse a direction of the sensor that is known no better than `OPEN_M`.

    ``reach_m``: distance at which turns count.

    Raises
    ------
    RankDeficientError
        Naming it, with the missing motion.
    """
    size = np.repeat([1.0, reach_m], 3)
    values, vectors = np.linalg.eigh(fit.covariance[:6, :6] * np.outer(size, size))
    T = np.concatenate([view.sightings.T_base_flange for view in fit.views])
    open_ones = vectors[:, np.sqrt(np.maximum(values, 0.0)) > OPEN_M]
    words = [describe_motion(direction / size, T) for direction in open_ones.T]
    if words:
        raise refuse_open(words)


def _without(
    views: tuple[View, ...], wrong: NDArray[np.bool_], rejected: dict[str, str]
) -> tuple[View, ...]:
    """The views without sightings marked in ``wrong`` (m,); those are named in ``rejected``."""
    kept, first = [], 0
    for view in views:
        names = view.sightings.names
        out = wrong[first : first + len(names)]
        first += len(names)
        rejected |= {
            name: "does not fit the others" for name, bad in zip(names, out, strict=True) if bad
        }
        kept.append(view.take(~out))
    return tuple(kept)


def _restricted_noise(problem: MountProblem, estimate: Estimate[MountState]) -> PoseNoise:
    """Scale of the poses' error at which what is left is most likely."""
    from scipy.optimize import minimize_scalar

    keep = ~estimate.rejected
    r, J, G, C = (part[keep] for part in problem.grouped(problem.linear(estimate.state)))
    ratio = FIRST_NOISE.sigma_rad / FIRST_NOISE.sigma_m
    prior = problem.prior()
    known = np.zeros((J.shape[2], J.shape[2])) if prior is None else prior
    unit = G @ PoseNoise(1.0, ratio).covariance() @ np.swapaxes(G, 1, 2)
    both = np.concatenate([r[..., None], J], axis=2)

    def cost(log_sigma: float) -> float:
        L = np.linalg.cholesky(C + np.exp(2.0 * log_sigma) * unit)
        white = np.linalg.solve(L, both)
        r_white, J_white = white[..., 0], white[..., 1:].reshape(-1, J.shape[2])
        normal = J_white.T @ J_white + known
        gradient = J_white.T @ r_white.ravel()
        misfit = np.sum(r_white**2) - gradient @ np.linalg.solve(normal, gradient)
        spread = 2.0 * np.sum(np.log(np.diagonal(L, axis1=1, axis2=2)))
        return float(misfit + spread + np.linalg.slogdet(normal)[1])

    bounds = tuple(np.log(NOISE_RANGE_M))
    best = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": SETTLED / 2})
    sigma_m = float(np.exp(best.x))
    return PoseNoise(sigma_m, ratio * sigma_m)


def leave_one_out(fit: MountFit) -> Array | None:
    """Distance of each sighting from the solution without its pose, m; None where none is left."""
    problem = MountProblem(fit.views, fit.noise)
    own = fit.distances()
    for group in range(len(problem.poses)):
        out = problem.sample == group
        rest = _without(fit.views, out, {})
        if any(len(view.sightings.names) == 0 for view in rest):
            return None  # a target that only this pose saw
        try:
            part = MountProblem(rest, fit.noise)
            found = solve(
                part, fit.state, prior_information=part.prior(), robust=False, sizes=part.sizes
            )
        except RobocalError:
            return None
        own[out] = replace(fit, state=found.state).distances()[out]
    return own
