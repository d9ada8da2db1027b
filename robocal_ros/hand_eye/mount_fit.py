"""Maximum likelihood of a mount: robust, with the robot's own error found where none is given."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import Estimate, observability, solve
from robocal_ros.ground.errors import RankDeficientError
from robocal_ros.hand_eye.mount_problem import MountProblem, MountState, PoseNoise, TargetView
from robocal_ros.hand_eye.naming import describe_motion, joined
from robocal_ros.hand_eye.restricted_noise import FIRST_NOISE, averaged_covariance, restricted_noise
from robocal_ros.hand_eye.result import at_origin, increment, moved_origin

Array = NDArray[np.float64]

LOOKS = 3
ROUNDS = 8
POSE_NUMBERS = 6
CALM_M = 1e-4  # and rad at 1 m: the noise of a good robot, to tell poses from noise
LEAST_AIM = 1  # so that four poses suffice to tell how well the eye aims
SETTLED = 0.02  # relative change of the noise, and of the state in standard deviations
UNSETTLED = (
    f"mount and noise of the poses had not settled after {ROUNDS} rounds: measure more often"
)
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
    creeping : why this is no solution, in words; empty where it is one.
    """

    views: tuple[TargetView, ...]
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

    def distances(self) -> Array:
        """Distance of each sighting that was used from its target, m."""
        return distances(self.views, self.state)


def distances(views: tuple[TargetView, ...], state: MountState) -> Array:
    """Distance of each sighting from its target, m."""
    pairs = zip(views, state.places, strict=True)
    return np.concatenate([_distance(view, state, place) for view, place in pairs])


def misfit(views: tuple[TargetView, ...], state: MountState) -> float:
    """Median distance of sightings from their target, m."""
    return float(np.median(distances(views, state)))


def _distance(view: TargetView, state: MountState, place: Array) -> Array:
    T = view.sightings.T_base_flange @ state.T_flange_sensor
    return view.model.distance(T, place, view.sightings.value)


def fit_mount(
    views: tuple[TargetView, ...], start: MountState, noise: PoseNoise | None = None
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
    state = start
    found = FIRST_NOISE if noise is None else replace(noise, aim_m=FIRST_NOISE.aim_m)
    poses = np.concatenate([view.sightings.pose for view in views])
    if len(np.unique(poses)) < len(poses):  # one sighting of a profile may be wrong, not all of it
        estimate, wrong, found, _ = _settle(views, state, found, noise, together=False)
        state = estimate.state
        views = without(views, wrong, rejected)
    estimate, wrong, found, settled = _settle(views, state, found, noise, together=True)
    views = without(views, wrong, rejected)
    last = MountProblem(views, found, estimate.state)
    return MountFit(
        views,
        estimate.state,
        estimate.scale**2 * averaged_covariance(last, estimate.state, noise),
        estimate.scale,
        found,
        rejected,
        estimate.creeping or ("" if settled else UNSETTLED),
    )


def first_look(views: tuple[TargetView, ...], start: MountState) -> MountState:
    """Where a start leads, robustly, the noise as the misfit tells it. Raises as `fit_mount`.

    So a state that is far off, or poses that cannot fit, are not followed to the last digit.
    """
    state = start
    for _ in range(LOOKS):
        off = max(misfit(views, state), FIRST_NOISE.sigma_m)
        noise = PoseNoise(off, FIRST_NOISE.sigma_rad, FIRST_NOISE.aim_m)
        problem = MountProblem(views, noise, state, together=False)
        state = _solved(problem, state).state
    return state


def _settle(
    views: tuple[TargetView, ...],
    state: MountState,
    noise: PoseNoise,
    given: PoseNoise | None,
    together: bool,
) -> tuple[Estimate[MountState], NDArray[np.bool_], PoseNoise, bool]:
    """Solve, take weights and noise anew, until both stay; whether they do is told last.

    Which sightings (m,) are wrong, too.
    """
    for _ in range(ROUNDS):
        problem = MountProblem(views, noise, state, together)
        estimate = _solved(
            problem, state, max(noise_numbers(problem), 1) if given is None else np.inf
        )
        away = _away(problem.pivot, state, estimate)
        state, before = estimate.state, noise
        noise, sure = restricted_noise(problem, state, ~estimate.rejected, given)
        change = np.log([noise.sigma_m / before.sigma_m, noise.aim_m / before.aim_m])
        settled = sure and away < SETTLED and bool(np.max(np.abs(change)) < SETTLED)
        if settled:
            break
    return estimate, estimate.rejected[problem.sample], noise, settled


def _away(pivot: Array, before: MountState, estimate: Estimate[MountState]) -> float:
    """How far the sensor has moved, in standard deviations."""
    step = increment(before.T_flange_sensor, estimate.state.T_flange_sensor, pivot)
    return float(np.sqrt(step @ np.linalg.solve(estimate.covariance[:6, :6], step)))


def noise_numbers(problem: MountProblem) -> int:
    """How many numbers tell the noise: at most six of a pose, less the unknowns.

    Where light is laid by eye, two of a pose tell how well; three unknowns look the same.
    """
    poses = len(np.unique(np.concatenate([view.sightings.pose for view in problem.views])))
    told = min(POSE_NUMBERS * poses, int(problem.sizes.sum())) - len(problem.names)
    if problem.aimed:
        return min(told, 2 * poses - 3 + LEAST_AIM)
    return told


def _solved(
    problem: MountProblem, state: MountState, freedom: float = np.inf
) -> Estimate[MountState]:
    try:
        estimate = solve(
            problem,
            state,
            prior_information=problem.prior(),
            sizes=problem.sizes,
            freedom=freedom,
        )
    except RankDeficientError as error:
        raise _in_words(problem, state) or _few_agree(error) from error
    return estimate


def _in_words(problem: MountProblem, state: MountState) -> RankDeficientError | None:
    """The refusal with the sensor's own open directions; None where it is another unknown's."""
    _, jacobian = problem.linearise(state)
    null = observability(jacobian.reshape(-1, jacobian.shape[2])).null[:6]
    T = np.concatenate([view.sightings.T_base_flange for view in problem.views])
    words = [
        describe_motion(moved_origin(d, problem.pivot), T)
        for d in null.T
        if np.linalg.norm(d) > 1e-9
    ]
    return refuse_open(words) if words else None


def _few_agree(error: RankDeficientError) -> RankDeficientError:
    """The refusal where all samples would do, but not those of them that fit together."""
    words = "those samples that fit together do not determine the sensor: measure again, more often"
    return RankDeficientError(words, error.directions)


def refuse_open(words: list[str]) -> RankDeficientError:
    """The refusal for directions that are not seen, in words."""
    return RankDeficientError(f"not determined: {joined(words)}", words)


def require_seen(fit: MountFit) -> None:
    """Refuse a direction that the poses, even of a good robot, show no better than `OPEN_M`.

    Turns count at the distance at which the targets were seen.

    Raises
    ------
    RankDeficientError
        Naming it, with the missing motion.
    """
    T = np.concatenate([view.sightings.T_base_flange for view in fit.views])
    calm = replace(fit.noise, sigma_m=min(fit.noise.sigma_m, CALM_M))
    calm = replace(calm, sigma_rad=min(calm.sigma_rad, CALM_M))
    problem = MountProblem(fit.views, calm, fit.state)
    J = problem.linearise(fit.state)[1].reshape(-1, len(problem.names))
    covariance = np.asarray(np.linalg.pinv(J.T @ J + problem.prior()))
    reach_m = np.abs(np.concatenate([view.sightings.value[:, 1] for view in fit.views])).mean()
    words = open_directions(at_origin(covariance[:6, :6], problem.pivot), float(reach_m), T)
    if words:
        raise refuse_open(words)


def open_directions(covariance: Array, reach_m: float, T_base_flange: Array) -> list[str]:
    """Directions in words that a covariance (6, 6) at the sensor's origin leaves as good as open.

    ``reach_m``: distance at which turns count.
    """
    size = np.repeat([1.0, reach_m], 3)
    values, vectors = np.linalg.eigh(covariance * np.outer(size, size))
    open_ones = vectors[:, np.sqrt(np.maximum(values, 0.0)) > OPEN_M]
    return [describe_motion(direction / size, T_base_flange) for direction in open_ones.T]


def without(
    views: tuple[TargetView, ...], wrong: NDArray[np.bool_], rejected: dict[str, str]
) -> tuple[TargetView, ...]:
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
