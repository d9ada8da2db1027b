# SPDX-License-Identifier: Apache-2.0
"""Maximum likelihood of a mount: robust, with the robot's own error found where none is given."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import Estimate, observability, solve
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, ResidualError, RobocalError
from robocal_ros.ground.frames import Array
from robocal_ros.hand_eye.mount_problem import (
    FIRST_NOISE,
    Bend,
    MountProblem,
    MountState,
    SphereModel,
    TargetView,
    averaged_covariance,
    in_plane,
    restricted_noise,
)
from robocal_ros.hand_eye.result import (
    ARM_M,
    PoseNoise,
    PoseRows,
    apart,
    at_origin,
    beside_found_noise,
    increment,
)
from robocal_ros.kinematics.joint_errors import JointErrors, ShotJoints, flange_errors

AXES = ("the laser line (x)", "the laser plane's normal (y)", "the beam (z)")
ALONG = 0.9  # cosine from which a direction is named after an axis
SMALL_TURN_RAD = float(np.radians(1.0))  # turns below this show nothing
FARTHEST_AXIS_M = 5.0  # a turn about an axis beyond it is a translation, in a field of 0.1 m
ENOUGH = "by 20 deg or more"

# Chance that a clean set loses any shot. A robot's errors hang together and have longer tails than
# a Gaussian's; a shot of another pose or target is off by far more than this asks for.
FALSE_REJECTION = 1e-4
LOOKS = 3
HOPELESS = 100.0  # times the least sum of squares, from which a start leads to a false minimum
LARGEST_POSE_M = 2e-3  # error of a pose in space that a robot may have
ROUNDS = 8
POSE_NUMBERS = 6
CALM_M = 1e-4  # and rad at 1 m: the noise of a good robot, to tell poses from noise
LEAST_AIM = 1  # so that four poses suffice to tell how well the eye aims
SETTLED = 0.02  # relative change of the noise, and of the state in standard deviations
UNSETTLED = (
    f"mount and noise of the poses had not settled after {ROUNDS} rounds: measure more often"
)
OPEN_M = 0.02  # expected error of a direction from which a plan counts it as not seen
ARBITRARY_RAD = 0.17  # a turn so uncertain is arbitrary: its covariance no longer tells of it

CLEARLY = 0.4  # of the misfit as given: below it the undone data may be the right ones
FITS_M = 5e-4  # misfit of data that are right
FAR_START = 10.0  # times what fits; the closed form of right data is off by noise alone
FITS = 5.0  # times the rms of the others
FARTHEST_M, NEAREST_M = 20.0, 0.02  # of a flange from its base

CONDITION = 1e5
SURE = 4.0  # standard deviations
TOLERANCE_M = 5e-5  # of a sphere that is sold as a reference


def describe_motion(direction: Array, T_base_flange: Array) -> str:
    """Words for an open direction (v, w) (6,) of the sensor, sensor axes, and what to do.

    ``T_base_flange`` (m, 4, 4): the poses that leave it open.
    """
    v, w = direction[:3], direction[3:]
    turn = float(np.linalg.norm(w))
    if turn * FARTHEST_AXIS_M < max(float(np.linalg.norm(v)), 1e-300):
        words = f"translation along {_axis(v)}"
    else:
        centre = np.cross(w, v) / turn**2  # the point of the axis next to the origin
        words = f"rotation about {_axis(w)}"
        if np.linalg.norm(centre) > 1e-3:
            place = ", ".join(f"{1e3 * value:.0f}" for value in centre)
            words += f" through ({place}) mm of the sensor"
        if abs(float(v @ w) / turn**2) > 1e-3:
            words += ", with a translation along it"
    R = T_base_flange[:, :3, :3]
    turns = frames.log_rotation(R @ R[0].T)  # axes about which the poses turn
    _, s, Vt = np.linalg.svd(turns, full_matrices=False)
    axes = int(np.sum(s / np.sqrt(len(turns)) > SMALL_TURN_RAD))
    if axes == 0:
        return f"{words}: the poses do not turn; turn the flange about two axes, {ENOUGH}"
    if axes == 1:
        axis = ", ".join(f"{value:.2f}" for value in Vt[0])
        found = f"all poses turn about ({axis}) of the base"
        return f"{words}: {found}; tilt the flange about another axis, {ENOUGH}"
    return f"{words}: show the target at other places of the profile, at other distances and tilts"


def _axis(direction: Array) -> str:
    unit = direction / np.linalg.norm(direction)
    place = int(np.argmax(np.abs(unit)))
    if abs(unit[place]) > ALONG:
        return AXES[place]
    return f"({', '.join(f'{value:.2f}' for value in unit)}) of the sensor"


def joined(words: Sequence[str]) -> str:
    """Several `describe_motion` in one sentence, a remedy that they share said once."""
    parts = [each.partition(": ") for each in words]
    what = "; ".join(first for first, _, _ in parts)
    remedies = dict.fromkeys(remedy for _, _, remedy in parts if remedy)
    return ": ".join(filter(None, (what, "; ".join(remedies))))


@dataclass(frozen=True, eq=False)
class MountFit:
    """The most likely mount.

    ``views``: of the sightings that were used, in the order of the problem's. ``state``,
    ``covariance`` (k, k) of the problem's unknowns; ``scale``: how far the misfit widened it.
    ``noise``: of reported poses, given or found. ``rejected``: names of sightings not used, with
    the reason. ``doubt``: why this is no solution, or not the only one, in words; empty where it
    is. ``bend``: of the sensor, where it was found.
    """

    views: tuple[TargetView, ...]
    state: MountState
    covariance: Array
    scale: float
    noise: PoseNoise
    rejected: Mapping[str, str]
    doubt: str
    bend: Bend | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Of the sightings that were used."""
        return tuple(name for view in self.views for name in view.sightings.names)


def distances(views: tuple[TargetView, ...], state: MountState) -> Array:
    """Distance of each sighting from its target, m."""
    far = []
    for view, place in zip(views, state.places, strict=True):
        T = view.sightings.T_base_flange @ state.T_flange_sensor
        far.append(view.model.distance(T, place, view.sightings.value))
    return np.concatenate(far)


def misfit(views: tuple[TargetView, ...], state: MountState) -> float:
    """Median distance of sightings from their target, m."""
    return float(np.median(distances(views, state)))


def fit_mount(
    views: tuple[TargetView, ...],
    start: MountState,
    noise: PoseNoise | None = None,
    bend: Bend | None = None,
) -> MountFit:
    """Estimate the sensor's pose and what is unknown of its targets.

    ``noise``: of reported poses; None to estimate it. ``bend``: of the sensor; the covariance holds
    what is not known of it.
    """
    rejected: dict[str, str] = {}
    state = start
    found = noise_of(misfit(views, start)) if noise is None else noise
    found = replace(found, aim_m=FIRST_NOISE.aim_m, repeat_m=FIRST_NOISE.repeat_m)
    poses = np.concatenate([view.sightings.pose for view in views])
    if len(np.unique(poses)) < len(poses):  # one sighting of a profile may be wrong, not all of it
        estimate, wrong, found, _ = _settle(views, state, found, noise, bend, together=False)
        state = estimate.state
        views = without(views, wrong, rejected)
    estimate, wrong, found, settled = _settle(views, state, found, noise, bend, together=True)
    views = without(views, wrong, rejected)
    last = MountProblem(views, found, estimate.state, bend=bend)
    return MountFit(
        views,
        estimate.state,
        estimate.scale**2 * averaged_covariance(last, estimate.state, noise),
        estimate.scale,
        found,
        rejected,
        estimate.creeping or ("" if settled else UNSETTLED),
        bend,
    )


def first_look(views: tuple[TargetView, ...], start: MountState) -> MountState:
    """Where a start leads, robustly, the noise as the misfit tells it. Raises as `fit_mount`.

    So a state that is far off, or poses that cannot fit, are not followed to the last digit.
    """
    state = start
    for _ in range(LOOKS):
        state = _looked_nearer(views, state)
    return state


def _looked_nearer(views: tuple[TargetView, ...], state: MountState) -> MountState:
    """One of the rounds of `first_look`."""
    noise = noise_of(misfit(views, state))
    return _solved(MountProblem(views, noise, state, together=False), state).state


def minima(
    view: TargetView, starts: Sequence[MountState]
) -> tuple[list[tuple[float, MountState]], RobocalError | None]:
    """The sums of squares and states to which the starts lead, the least first.

    Where none leads anywhere: why the first one does not. Once a start fits as right data do,
    others that are far from that after the same round are false minima, and cost most to follow.
    """
    runs = [(np.inf, start) for start in starts]
    failure: RobocalError | None = None
    for _ in range(LOOKS):
        least = min((squares for squares, _ in runs), default=np.inf)
        fits = least < len(view.sightings.names) * FITS_M**2
        going, runs = runs, []
        for squares, state in going:
            if fits and squares > HOPELESS * least:
                continue
            try:
                state = _looked_nearer((view,), state)
            except RobocalError as error:
                failure = failure or error
                if isinstance(error, RankDeficientError):
                    break  # it lies in the poses, not in the start
                continue
            far = np.minimum(distances((view,), state), LARGEST_POSE_M)
            runs.append((float(np.sum(far**2)), state))
    return sorted(runs, key=lambda pair: pair[0]), failure


def noise_of(misfit_m: float) -> PoseNoise:
    """Noise of poses that explains a misfit."""
    off_m = max(misfit_m, FIRST_NOISE.sigma_m)
    return PoseNoise(off_m, off_m / ARM_M, FIRST_NOISE.aim_m)


def _settle(
    views: tuple[TargetView, ...],
    state: MountState,
    noise: PoseNoise,
    given: PoseNoise | None,
    bend: Bend | None,
    together: bool,
) -> tuple[Estimate[MountState], NDArray[np.bool_], PoseNoise, bool]:
    """Solve, take weights and noise anew, until both stay; whether they do is told last.

    Which sightings (m,) are wrong, too.
    """
    for _ in range(ROUNDS):
        problem = MountProblem(views, noise, state, together, bend=bend)
        freedom = max(noise_numbers(problem), 1) if given is None else np.inf
        estimate = _solved(problem, state, freedom)
        X, before = state.T_flange_sensor, noise
        step = increment(X, estimate.state.T_flange_sensor, problem.pivot)
        away = float(np.sqrt(step @ np.linalg.solve(estimate.covariance[:6, :6], step)))
        state = estimate.state
        noise, sure = restricted_noise(problem, state, ~estimate.rejected, given)
        old, new = (np.array([n.sigma_m, n.aim_m, n.repeat_m]) for n in (before, noise))
        change = np.log(new / old)
        settled = sure and away < SETTLED and bool(np.max(np.abs(change)) < SETTLED)
        if settled:
            break
    return estimate, estimate.rejected[problem.sample], noise, settled


def noise_numbers(problem: MountProblem) -> int:
    """How many numbers tell each noise: at most six of a pose, less the unknowns.

    Where light is laid by eye, two of a pose tell how well; three unknowns look the same.
    """
    poses = len(np.unique(np.concatenate([view.sightings.pose for view in problem.views])))
    told = min(POSE_NUMBERS * poses, int(problem.sizes.sum())) - len(problem.names)
    return min(told, 2 * poses - 3 + LEAST_AIM) if problem.aimed else told


def _solved(
    problem: MountProblem, state: MountState, freedom: float = np.inf, robust: bool = True
) -> Estimate[MountState]:
    """Solve robustly; a refusal names the sensor's own open directions, where there are any."""
    prior, sizes = problem.prior(), problem.sizes
    try:
        return solve(
            problem,
            state,
            prior_information=prior,
            robust=robust,
            sizes=sizes,
            freedom=freedom,
            false_rejection=FALSE_REJECTION,
        )
    except RankDeficientError as error:
        _, jacobian = problem.linearise(state)
        null = observability(jacobian.reshape(-1, jacobian.shape[2])).null[:6]
        T = np.concatenate([view.sightings.T_base_flange for view in problem.views])
        words = []
        for d in null.T:
            if np.linalg.norm(d) > 1e-9:
                at_sensor = np.concatenate([d[:3] - np.cross(d[3:], problem.pivot), d[3:]])
                words.append(describe_motion(at_sensor, T))
        if words:
            raise RankDeficientError(f"not determined: {joined(words)}", words) from error
        # All samples would do, but not those of them that fit together.
        raise RankDeficientError(
            "those samples that fit together do not determine the sensor: measure again, more "
            "often",
            error.directions,
        ) from error


def require_seen(fit: MountFit) -> None:
    """Refuse a direction of which the poses, even of a good robot, tell something arbitrary.

    That is `OPEN_M`, or a turn of `ARBITRARY_RAD` and the shift that goes with it. What they show
    better is an answer with its sigma, weak as it may be.

    Turns count at the distance at which the targets were seen.

    Raises `RankDeficientError`, naming it, with the missing motion.
    """
    T = np.concatenate([view.sightings.T_base_flange for view in fit.views])
    sigma_m, sigma_rad = min(fit.noise.sigma_m, CALM_M), min(fit.noise.sigma_rad, CALM_M)
    calm = replace(fit.noise, sigma_m=sigma_m, sigma_rad=sigma_rad)
    problem = MountProblem(fit.views, calm, fit.state)
    J = problem.linearise(fit.state)[1].reshape(-1, len(problem.names))
    covariance = np.asarray(np.linalg.pinv(J.T @ J + problem.prior()))
    seen = np.concatenate([view.sightings.value[:, :2] for view in fit.views])
    reach_m = np.linalg.norm(seen, axis=1).mean()
    covariance = at_origin(covariance[:6, :6], problem.pivot)
    limit_m = max(OPEN_M, ARBITRARY_RAD * float(reach_m))
    words = open_directions(covariance, float(reach_m), T, limit_m)
    if words:
        raise RankDeficientError(f"not determined: {joined(words)}", words)


def open_directions(
    covariance: Array, reach_m: float, T_base_flange: Array, limit_m: float = OPEN_M
) -> list[str]:
    """Directions in words that a covariance (6, 6) at the sensor's origin leaves as good as open.

    ``reach_m``: distance at which turns count; ``limit_m``: of the standard deviation.
    """
    size = np.repeat([1.0, reach_m], 3)
    values, vectors = np.linalg.eigh(covariance * np.outer(size, size))
    open_ones = vectors[:, np.sqrt(np.maximum(values, 0.0)) > limit_m]
    return [describe_motion(direction / size, T_base_flange) for direction in open_ones.T]


def mount_errors(
    fit: MountFit, told: Array, joints: ShotJoints, size_rad: float, given: PoseNoise | None
) -> JointErrors | None:
    """What joints that err by ``size_rad`` add to a mount's covariance ``told`` (6, 6).

    To first order, with the fit's weights; see `beside_found_noise`.
    """
    problem = MountProblem(fit.views, fit.noise, fit.state)
    first = np.unique(problem.sample, return_index=True)[1]
    shot = np.concatenate([view.sightings.shot for view in fit.views])[first]
    errors = flange_errors(joints.arm, size_rad, joints.q[shot])
    if errors is None:
        return None
    linear, k = problem.linear(fit.state), len(problem.names)
    both = np.concatenate([linear.jacobian, linear.common[..., :6]], axis=2)
    J, G = np.split(problem.whitened(replace(linear, jacobian=both))[1], [k], axis=2)
    flat = J.reshape(-1, k)
    known = np.linalg.inv(flat.T @ flat + problem.prior())
    rows = PoseRows(J, G, np.asarray(known, dtype=np.float64), slice(0, 6))
    return beside_found_noise(rows, errors, fit.noise, told, size_rad, given is not None)


def without(
    views: tuple[TargetView, ...], wrong: NDArray[np.bool_], rejected: dict[str, str]
) -> tuple[TargetView, ...]:
    """The views without sightings marked in ``wrong`` (m,); those are named in ``rejected``."""
    kept, first = [], 0
    for view in views:
        names = view.sightings.names
        out = wrong[first : first + len(names)]
        first += len(names)
        for name, bad in zip(names, out, strict=True):
            if bad:
                rejected[name] = "does not fit the others"
        kept.append(view.take(~out))
    return tuple(kept)


def solved_again(fit: MountFit, views: tuple[TargetView, ...]) -> MountState:
    """The mount from part of the views of a fit: nothing is rejected any more."""
    part = MountProblem(views, fit.noise, fit.state)
    prior, sizes = part.prior(), part.sizes
    return solve(part, fit.state, prior_information=prior, robust=False, sizes=sizes).settled()


def leave_one_out(
    views: tuple[TargetView, ...], solved: Callable[[tuple[TargetView, ...]], MountState]
) -> Array | None:
    """Distance of each sighting from what is ``solved`` without its pose, m.

    None where the rest does not suffice.
    """
    sample = np.concatenate([view.sightings.pose for view in views])
    own = np.zeros(len(sample))
    for pose in np.unique(sample):
        out = sample == pose
        rest = without(views, out, {})
        if any(len(view.sightings.names) == 0 for view in rest):
            return None  # a target that only this pose saw
        try:
            own[out] = distances(views, solved(rest))[out]
        except (RobocalError, np.linalg.LinAlgError):  # a single shot of stairs leads nowhere
            return None
    return own


def undone(T_base_flange: Array) -> Iterator[tuple[str, Array]]:
    """Common mistakes that may be in poses (m, 4, 4), in words, and the poses without each."""
    T = T_base_flange
    for shift, where in ((-1, "after"), (1, "before")):
        words = f"each profile fits the pose {where} its own: the two lists are shifted by one"
        yield words, np.roll(T, shift, axis=0)
    words = "the poses fit when inverted: give the flange in the base, not the base in it"
    yield words, frames.invert(T)
    words = "the poses fit when their quaternions are read as w, x, y, z: reorder them"
    quat_xyzw = np.roll(frames.quat_xyzw(T), -1, axis=1)
    yield words, frames.transform_from_quat(T[:, :3, 3], quat_xyzw)
    left_handed = "they come from a left-handed frame: turn one axis round"
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    yield f"the poses fit when mirrored as a whole: {left_handed}", np.asarray(flip @ T @ flip)
    for number, axis in enumerate("xyz"):
        mirrored = T.copy()
        mirrored[:, number, 3] *= -1.0
        yield f"the poses fit with {axis} of their positions negated: {left_handed}", mirrored
    far = float(np.linalg.norm(T[:, :3, 3], axis=1).max())
    if far < NEAREST_M:
        words = "the poses fit when 1000 times larger: their positions are in m where mm are meant"
        yield words, frames.transform(T[:, :3, :3], 1e3 * T[:, :3, 3])
    if far > FARTHEST_M:
        words = "the poses fit when 1000 times smaller: their positions are in mm where m are meant"
        yield words, frames.transform(T[:, :3, :3], 1e-3 * T[:, :3, 3])


def explain(
    suspects: Iterable[tuple[str, float, Callable[[], float]]], as_given_m: float
) -> str | None:
    """The words of the suspect with the smallest misfit, m; None where none fits.

    A mistake is recognised because undoing it makes everything fit. ``suspects``: their words, the
    misfit of a closed form, and what it is when followed; the nearest is followed first.
    """
    best, least = None, min(CLEARLY * as_given_m, FITS_M)
    for words, start_m, followed in sorted(suspects, key=lambda suspect: suspect[1]):
        if start_m > as_given_m or (best is not None and start_m > FAR_START * least):
            break
        try:
            found = followed()
        except RobocalError:
            continue
        if found < least:
            best, least = words, found
    return best


def swapped(fit: MountFit, view: TargetView, place: Array, shots: Sequence[str]) -> dict[str, str]:
    """Which rejected sightings of a view fit the pose of another rejected shot, with the reason.

    ``shots``: the name of each. Repeats of one pose cannot be told apart: they are no swap.
    """
    lost = view.take(np.array([name in fit.rejected for name in view.sightings.names]))
    limit = FITS * float(np.sqrt(np.mean(distances(fit.views, fit.state) ** 2)))
    s = lost.sightings
    found: dict[str, str] = {}
    for shot in np.unique(s.shot):
        rows = np.flatnonzero(s.shot == shot)
        for other in np.unique(s.shot[s.shot != shot]):
            T = s.T_base_flange[[np.flatnonzero(s.shot == other)[0]]] @ fit.state.T_flange_sensor
            own = lost.take(rows)
            mine = own.sightings.T_base_flange[0] @ fit.state.T_flange_sensor
            if apart(mine, T[0], in_plane(own.sightings.value)) < limit:
                continue
            far = own.model.distance(np.repeat(T, len(rows), axis=0), place, own.sightings.value)
            if np.median(far) < limit:
                words = f"fits the pose of {shots[other]}, not its own: swapped?"
                found |= {s.names[row]: words for row in rows}
    return found


def require_radius(fit: MountFit, views: tuple[TargetView, ...]) -> None:
    """Refuse a fit that would be clearly better with another radius of its sphere.

    ``views``: of all sightings. A wrong radius is seen where profiles at several heights of the
    sphere disagree, and those that show it best may have been left out: both are asked, and the
    fit with the other radius must explain more.

    Raises `ResidualError`, naming the radius that fits.
    """
    model = next((view.model for view in views if isinstance(view.model, SphereModel)), None)
    if model is None:
        return
    state, noise = fit.state, fit.noise
    asked = [_other_radius(MountProblem(fit.views, noise, state), state, fit.scale)]
    if fit.rejected:
        for _ in range(LOOKS):
            problem = MountProblem(views, noise, state)
            state = _solved(problem, state, robust=False).state
            noise, _ = restricted_noise(problem, state, np.ones(len(problem.poses), np.bool_), None)
        asked.append(_other_radius(MountProblem(views, noise, state), state, 1.0))
    for change in asked:
        radius_m = model.radius_m + change
        if not change or radius_m <= 0.0:
            continue
        other = fit_mount(
            tuple(
                replace(v, model=SphereModel(radius_m)) if isinstance(v.model, SphereModel) else v
                for v in views
            ),
            state,
        )
        if len(other.names) >= len(fit.names) and (
            len(other.names) > len(fit.names) or other.noise.sigma_m < noise.sigma_m
        ):
            raise ResidualError(
                f"the profiles fit a sphere of radius {radius_m * 1e3:.2f} mm, not "
                f"{model.radius_m * 1e3:.2f} mm: check which sphere is mounted"
            )


def _other_radius(problem: MountProblem, state: MountState, scale: float) -> float:
    """What the radius of a sphere would gain, m, by a score test; 0 where that is not clear."""
    linear = problem.linear(state)
    column = np.zeros_like(linear.jacobian[:, :, :1])
    column[:, 2, 0] = np.concatenate(
        [
            view.model.radius_m / np.maximum(view.sightings.value[:, 2], 1e-6)
            if isinstance(view.model, SphereModel)
            else np.zeros(len(view.sightings.names))
            for view in problem.views
        ]
    )  # dr / dR at a given height of the laser plane
    jacobian = np.concatenate([linear.jacobian, column], axis=2)
    residual, jacobian = problem.whitened(replace(linear, jacobian=jacobian))
    residual, jacobian = residual.ravel(), jacobian.reshape(residual.size, -1)
    unit = np.linalg.norm(jacobian, axis=0)
    if np.any(unit == 0.0) or np.linalg.cond(jacobian / unit) > CONDITION:
        return 0.0  # the radius looks like another unknown
    normal = jacobian.T @ jacobian
    change = float(np.linalg.solve(normal, -jacobian.T @ residual)[-1])
    sigma = scale * float(np.sqrt(np.linalg.inv(normal)[-1, -1]))
    return change if abs(change) > max(SURE * sigma, TOLERANCE_M) else 0.0
