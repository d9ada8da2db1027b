# SPDX-License-Identifier: Apache-2.0
"""Where a line-laser sensor sits: profiles of a target and flange poses in, its pose out."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from robocal_ros.estimation.assessment import Verdict, errors_document, summarise
from robocal_ros.estimation.estimation import solve
from robocal_ros.ground.errors import (
    Code,
    InputError,
    RankDeficientError,
    ResidualError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array, Document
from robocal_ros.hand_eye.agreement import disagreement
from robocal_ros.hand_eye.linearity import SensorLinearity
from robocal_ros.hand_eye.mount_fit import (
    LARGEST_POSE_M,
    OPEN_M,
    MountFit,
    describe_motion,
    distances,
    explain,
    first_look,
    fit_mount,
    leave_one_out,
    minima,
    misfit,
    mount_errors,
    noise_numbers,
    noise_of,
    require_radius,
    require_seen,
    solved_again,
    swapped,
    undone,
    without,
)
from robocal_ros.hand_eye.mount_problem import (
    FIRST_NOISE,
    SENSOR_UNKNOWNS,
    Bend,
    MountProblem,
    MountState,
    TargetView,
    in_plane,
    pivot_of,
)
from robocal_ros.hand_eye.profiles import Profile
from robocal_ros.hand_eye.result import (
    HandEyeResult,
    HandEyeSettings,
    Method,
    PoseNoise,
    TargetKind,
    apart,
    expected_error_m,
    field_points,
    judge_classic,
    judge_residuals,
    said_of_joints,
    shots_of,
)
from robocal_ros.hand_eye.tasks import HandEyeData, Read, Task, read_with
from robocal_ros.kinematics.joint_errors import ShotJoints

Part = tuple[Task, HandEyeData]

HELD = len(SENSOR_UNKNOWNS)
DOUBTFUL_M = 2e-4  # median distance from which a mistake in the data is looked for
SHOWN = 0.5  # of the profiles
WRONG_M = 2e-3  # the same, from which something is wrong, whatever it is
FEWEST_TOLD = 6  # numbers that tell the noise of poses, where it is found from the data
CERTAIN = 1e3  # times likelier than any other, from which a minimum is not doubted
CONTRADICTED = 2.0  # times the given noise
MOST_MISFITS = 0.2  # of those that show the target
FEWEST_SPARE = 3  # measured numbers beyond the unknowns, without which nothing is judged


def solve_task(
    task: Task, data: HandEyeData, method: Method, settings: HandEyeSettings
) -> HandEyeResult:
    """Calibrate with one target.

    Raises `TooFewSamplesError` when fewer profiles are usable than the unknowns need, with the
    commonest reason; `RankDeficientError` when the poses leave a direction open, with the missing
    motion; `ResidualError` when nothing fits: shifted lists, inverted or left-handed poses, a wrong
    unit, a wrong radius are named where they explain it; `InputError` for a mark that the target
    does not have.
    """
    read = features(task, data)
    near, doubt = looked(task, data, read)
    fit, (read,) = _fitted([read], near, settings.noise())
    fit = replace(fit, doubt=fit.doubt or doubt)
    if method == "classic":
        return _classic(task, read, fit, data, settings)
    return _result_of([task], fit, [read], data, settings)


def _result_of(
    tasks: Sequence[Task],
    fit: MountFit,
    reads: Sequence[Read],
    data: HandEyeData,
    settings: HandEyeSettings,
) -> HandEyeResult:
    """The result of a fit to one target or several, judged."""
    field, pivot = field_of(data), pivot_of(fit.views)
    linearity = next((read.linearity for read in reads if read.linearity is not None), None)
    error_m = float(expected_error_m(fit.covariance[:6, :6], field - pivot))
    shots = len(data.names)
    rejected = {name: why for read in reads for name, why in read.rejected.items()}
    rejected |= dict(fit.rejected)
    every = summarise(distances(tuple(read.view for read in reads), fit.state))
    other = disagreement(fit, settings.noise(), field)
    error_m = float(np.hypot(error_m, other.beyond_m if other else 0.0))  # who is right?
    more: Document = {
        "spread": errors_document(every),
        "robot_sigma_mm": fit.noise.sigma_m * 1e3,
        "working_distance_mm": float(field[0, 2]) * 1e3,
    }
    if linearity is not None:
        if not linearity.assumed:
            of_it = _bent(fit, reads, linearity)[1]
            own_m = float(expected_error_m(of_it[:6, :6], field - pivot))
            more["linearity"] = {**linearity.document(), "working_error_mm": own_m * 1e3}
        error_m = float(np.hypot(error_m, linearity.rms_m))  # of points as the sensor tells them
    found: Document = {}
    for task, view, place, read in zip(tasks, fit.views, fit.state.places, reads, strict=True):
        rejected |= swapped(fit, read.view, place, data.names)
        found[task.kind] = task.found(place)
        state = replace(fit.state, places=(place,))
        more |= task.more(replace(fit, views=(view,), state=state), read)
    alone = len(tasks) == 1
    verdict = judge(fit, shots, shots - _shots(fit.views), error_m, settings)
    if other is not None:
        verdict = other.judged(verdict, [t.kind for t in tasks], error_m > settings.limit_m)
    uncertain = verdict.code is Code.POSES_NOT_INFORMATIVE and error_m > settings.limit_m
    found_one = HandEyeResult(
        kind=tasks[0].kind if alone else "joint",
        method="best",
        T_flange_sensor=fit.state.T_flange_sensor,
        covariance=fit.covariance[:6, :6],
        samples=fit.names,
        residual_m=distances(fit.views, fit.state),
        leave_one_out_m=leave_one_out(fit.views, partial(solved_again, fit)),
        rejected=rejected,
        target=found[tasks[0].kind] if alone else found,
        working_error_m=error_m,
        pivot=pivot,
        place=fit.state.places[0] if alone else None,
        linearity=None if linearity is None or linearity.assumed else linearity,
        unobservable=tuple(weak_directions(fit, settings.limit_m) if uncertain else ()),
        verdict=verdict,
        more=more,
    )
    joints, size_rad, erring = data.joints, settings.joint_error_rad, None
    if joints is not None and size_rad > 0.0:
        erring = mount_errors(fit, fit.covariance[:6, :6], joints, size_rad, settings.noise())
    return said_of_joints(found_one, erring)


def _bent(fit: MountFit, reads: Sequence[Read], linearity: SensorLinearity) -> tuple[Array, Array]:
    """What mount and linearity say of each other, linearised at a fit.

    How the numbers (r,) that stand for the coefficients have to move to where both are likeliest:
    the curves' own form tells them with their covariance, the mount's residuals the rest. Then what
    is left unknown of them in the covariance (k, k) of the fit's unknowns: that of both together
    less that where they are known.
    """
    pulled = _pulled(reads, linearity)
    problem = MountProblem(fit.views, fit.noise, fit.state)
    linear = problem.linear(fit.state)
    both = np.concatenate([linear.jacobian, [pulled[name] for name in fit.names]], axis=2)
    residual, jacobian = problem.whitened(replace(linear, jacobian=both))
    J, P = np.split(jacobian.reshape(-1, both.shape[2]), [len(problem.names)], axis=1)
    r, prior = residual.ravel(), problem.prior()
    known = np.linalg.pinv(J.T @ J + prior, hermitian=True)
    moved = known @ J.T @ P  # how the unknowns follow the numbers
    own = P.T @ P - P.T @ J @ moved + np.eye(P.shape[1])
    slope = P.T @ r - moved.T @ (J.T @ r + prior @ problem.deviation(fit.state))
    return np.asarray(np.linalg.solve(own, -slope)), np.asarray(
        moved @ np.linalg.solve(own, moved.T)
    )


def _pulled(reads: Sequence[Read], linearity: SensorLinearity) -> dict[str, Array]:
    """How features (3, r), by their names, move with the numbers of `SensorLinearity.root`."""
    root = linearity.root
    return {name: pull @ root for read in reads for name, pull in read.pulled.items()}


def _fitted(
    reads: list[Read], start: MountState, given: PoseNoise | None
) -> tuple[MountFit, list[Read]]:
    """The fit, and the features without the linearity as mount and curves together have it.

    Raises as `require_radius` and `require_seen`.
    """
    fit = fit_mount(tuple(read.view for read in reads), start, given)
    linearity = next((read.linearity for read in reads if read.linearity is not None), None)
    if linearity is not None:
        taken = _bent(fit, reads, linearity)[0]
        step, bend = linearity.root @ taken, Bend(_pulled(reads, linearity), taken)
        own = replace(linearity, coefficients=linearity.coefficients + step)
        without_it = []
        for read in reads:
            s = read.view.sightings
            moved = np.array([read.pulled[name] @ step for name in s.names])
            view = replace(read.view, sightings=replace(s, value=s.value - moved))
            without_it.append(replace(read, linearity=own, view=view))
        reads = without_it
        fit = fit_mount(tuple(read.view for read in reads), fit.state, given, bend)
    require_radius(fit, tuple(read.view for read in reads))
    require_seen(fit)
    return fit, reads


def field_of(data: HandEyeData) -> Array:
    """Points (5, 3) of the field that the profiles of a data set cover."""
    return field_points([p.points for p in data.profiles if isinstance(p, Profile)])


def _shots(views: tuple[TargetView, ...]) -> int:
    return len(np.unique(np.concatenate([view.sightings.shot for view in views])))


def _classic(
    task: Task, read: Read, best: MountFit, data: HandEyeData, settings: HandEyeSettings
) -> HandEyeResult:
    """The classic estimate from all profiles that gave a feature; it tells no covariance.

    Its error is its distance from the best estimate, with that one's own: what refuses that one
    leaves nothing to judge by.
    """
    views, shots = (read.view,), len(data.names)
    state = task.classic(read.view, best.state)
    residual = distances(views, state)
    field, pivot = field_of(data), pivot_of(best.views)
    own_m = float(expected_error_m(best.covariance[:6, :6], field - pivot))
    apart_m = apart(state.T_flange_sensor, best.state.T_flange_sensor, field)
    error_m = float(np.hypot(apart_m, own_m))
    verdict = judge_residuals(residual, shots, shots - _shots(views))
    if verdict is None:
        verdict = judge(best, shots, shots - _shots(best.views), own_m, settings)
    if verdict.accept:
        verdict = judge_classic(apart_m, error_m, settings.limit_m)
    return HandEyeResult(
        kind=task.kind,
        method="classic",
        T_flange_sensor=state.T_flange_sensor,
        covariance=None,
        samples=read.view.sightings.names,
        residual_m=residual,
        leave_one_out_m=leave_one_out(views, lambda part: task.classic(part[0], best.state)),
        rejected=dict(read.rejected),
        target=task.found(state.places[0]),
        place=state.places[0],
        working_error_m=error_m,
        verdict=verdict,
    )


def judge(
    fit: MountFit, shots: int, lost: int, error_m: float, settings: HandEyeSettings
) -> Verdict:
    """The verdict on a mount; ``lost`` of ``shots`` gave nothing or did not fit."""
    far_m = distances(fit.views, fit.state)
    refused = _too_few(fit, settings) or judge_residuals(far_m, shots, lost) or _inconsistent(fit)
    if refused is not None:
        return refused
    if fit.doubt:
        return Verdict(Code.POSES_NOT_INFORMATIVE, fit.doubt)
    figures = f"a point in the field of view is expected to be off by {error_m * 1e3:.3f} mm rms"
    if error_m > settings.limit_m:
        words = (
            f"{figures} (allowed {settings.limit_m * 1e3:g} mm), most by a "
            f"{weak_directions(fit, settings.limit_m)[0]}; measure more often; check-plan proposes "
            "poses"
        )
        return Verdict(Code.POSES_NOT_INFORMATIVE, words)
    rms = float(np.sqrt(np.mean(far_m**2)))
    words = f"{figures}; samples are off by {rms * 1e3:.3f} mm rms"
    if fit.scale > CONTRADICTED:
        words += f", {fit.scale:.1f} times what the given noise explains"
    return Verdict(Code.ACCEPT, words)


def weak_directions(fit: MountFit, limit_m: float) -> list[str]:
    """What is known worse than a limit, the worst first: by how much, and what would show it."""
    seen = np.concatenate([view.sightings.value[:, :2] for view in fit.views])
    T = np.concatenate([view.sightings.T_base_flange for view in fit.views])
    size = np.repeat([1.0, max(float(np.ptp(seen, axis=0).max()), OPEN_M)], 3)  # of a turn
    values, vectors = np.linalg.eigh(fit.covariance[:6, :6] * np.outer(size, size))
    found: list[str] = []
    for variance, direction in zip(values[::-1], vectors.T[::-1], strict=True):
        sigma_m = float(np.sqrt(variance))
        if sigma_m > limit_m or not found:
            v, w = np.split(direction / size, 2)
            open_one = np.concatenate([v - np.cross(w, pivot_of(fit.views)), w])
            what, _, remedy = describe_motion(open_one, T).partition(": ")
            found.append(f"{what}, known to {sigma_m * 1e3:.2f} mm there: {remedy}")
    return found


def _too_few(fit: MountFit, settings: HandEyeSettings) -> Verdict | None:
    """Refuse data that leave too little to judge by; None where they do not."""
    problem = MountProblem(fit.views, fit.noise, fit.state)
    spare = int(problem.sizes.sum()) - len(fit.covariance)
    if spare < FEWEST_SPARE:
        words = f"only {spare} measured numbers beyond the unknowns: more poses are needed"
        return Verdict(Code.TOO_FEW_SAMPLES, words)
    if settings.noise() is None and (told := noise_numbers(problem)) < FEWEST_TOLD:
        words = f"too few poses, {len(problem.poses)}, to tell the robot's noise ({max(told, 0)} "
        words += f"numbers, {FEWEST_TOLD} are needed): show the target from more poses, or give it"
        return Verdict(Code.TOO_FEW_SAMPLES, words)
    return None


def _inconsistent(fit: MountFit) -> Verdict | None:
    """Refuse poses that contradict each other by more than a robot; None where they do not."""
    off_m = float(np.sqrt(3.0)) * fit.noise.sigma_m * fit.scale
    if off_m > LARGEST_POSE_M:
        words = f"from pose to pose robot and target are off by {off_m * 1e3:.2f} mm: has the "
        words += "target moved, does the robot repeat, are the poses those of the profiles?"
        return Verdict(Code.RESIDUAL_TOO_LARGE, words)
    wrong = len(fit.rejected)
    if wrong > MOST_MISFITS * (wrong + len(fit.names)) and len(shots_of(fit.rejected)) > 1:
        words = f"{wrong} of {wrong + len(fit.names)} features do not fit the others: see the "
        return Verdict(Code.RESIDUAL_TOO_LARGE, f"{words}rejected ones")
    return None


def features(task: Task, data: HandEyeData) -> Read:
    """Features of the profiles.

    Raises `ResidualError` when poses must tell which feature is which, and do not: with the mistake
    that explains it; `RobocalError` when too little is seen.
    """
    try:
        return task.read(data)
    except InputError:
        raise
    except RobocalError as error:
        if task.read_by_poses:
            _name_mistake(task, data, None, np.inf, error)
        raise


def looked(task: Task, data: HandEyeData, read: Read) -> tuple[MountState, str]:
    """A state near the solution, and why another may be the right one, if so.

    Raises `ResidualError` when the data do not fit: with the mistake that explains it, where one
    does; `RobocalError` when too little is seen, or the poses leave a direction open.
    """
    try:
        near, doubt = look(task, read.view)
    except RobocalError as error:
        _name_mistake(task, data, read, np.inf, error)
        raise
    as_given = misfit((read.view,), near) if _shown(read.view, data) else np.inf
    if as_given > DOUBTFUL_M:
        _name_mistake(task, data, read, as_given, None)
    if as_given > WRONG_M:
        off = f"samples are off by {misfit((read.view,), near) * 1e3:.3g} mm"
        raise ResidualError(
            f"{off} or do not show the target where it must be, and no common mistake explains it: "
            "has the target moved, are poses and profiles of the same run, is it the right target?"
        )
    return near, doubt


def _shown(view: TargetView, data: HandEyeData) -> bool:
    """Whether most of the profiles show the target where it must be."""
    usable = sum(isinstance(profile, Profile) for profile in data.profiles)
    return len(np.unique(view.sightings.shot)) > SHOWN * usable


def look(task: Task, view: TargetView) -> tuple[MountState, str]:
    """The state nearest to the sightings to which a start leads, before the noise is known.

    Why another one may be right, too; empty where none is. The sum of squares judges, each not
    larger than that of the largest error that a robot may have: a median hides what half of few
    sightings say against a false minimum.

    Raises `TooFewSamplesError` or `RankDeficientError` when none leads anywhere.
    """
    runs, failure = minima(view, task.starts(view))
    if not runs:
        raise failure or RobocalError("no start was found")
    least, best = runs[0]
    numbers = view.model.components * len(view.sightings.names)
    seen = in_plane(view.sightings.value)
    for squares, state in runs[1:]:
        if squares > least * np.exp(2.0 * np.log(CERTAIN) / numbers):
            break
        off_m = apart(best.T_flange_sensor, state.T_flange_sensor, seen)
        if off_m > LARGEST_POSE_M:
            words = f"another place of the sensor, {off_m * 1e3:.0f} mm away, fits nearly as well "
            rms = np.sqrt([squares / len(seen), least / len(seen)]) * 1e3
            words += f"({rms[0]:.3f} mm rms, this one {rms[1]:.3f}): show the target from more "
            return best, f"{words}poses that differ"
    return best, ""


def _name_mistake(
    task: Task, data: HandEyeData, read: Read | None, as_given: float, error: RobocalError | None
) -> None:
    """Raise with the mistake that explains a misfit, m, or an error; nothing where none does."""

    def posed(T_base_flange: Array) -> TargetView:
        other = replace(data, T_base_flange=T_base_flange)
        return task.read(other).view if read is None else task.posed(read.view, other)

    def of_target(other: Task) -> TargetView:
        return other.read(data).view if read is None else other.posed(read.view, data)

    def undoing() -> Iterator[tuple[str, Task, Callable[[], TargetView]]]:
        for words, poses in undone(data.T_base_flange):
            yield words, task, partial(posed, poses)
        if read is not None and error is not None and not task.read_by_poses:
            return  # open directions lie in the poses, whatever is told of the target
        for words, other in task.suspects():
            yield words, other, partial(of_target, other)

    def suspects() -> Iterator[tuple[str, float, Callable[[], float]]]:
        for words, other, seen in undoing():
            try:
                view = seen()
                if _shown(view, data):
                    start = other.starts(view)[0]
                    yield words, misfit((view,), start), partial(_followed, view, start)
            except RobocalError:
                continue

    words = explain(suspects(), as_given)
    if words is None:
        return
    if not np.isfinite(as_given):
        raise ResidualError(f"the samples do not fit: {words}") from error
    raise ResidualError(f"samples are off by {as_given * 1e3:.3g} mm: {words}")


def _followed(view: TargetView, start: MountState) -> float:
    return misfit((view,), first_look((view,), start))


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Distances (n,) of ``samples`` from a target, m; ``rejected``: shots without a feature."""

    samples: tuple[str, ...]
    distance_m: Array
    rejected: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class Verification(HeldOut):
    """What other data say of a mount.

    ``target``: what was found of the target with the mount held; ``rejected``: shots without a
    feature, and features by which the target was not found, and why; the latter are among the
    samples all the same.
    """

    target: Document
    verdict: Verdict


def held_out(
    task: Task,
    data: HandEyeData,
    T_flange_sensor: Array,
    place: Array,
    linearity: SensorLinearity | None = None,
) -> HeldOut:
    """How far other shots of the same target, which has not moved, are off.

    ``place``, ``linearity``: as `HandEyeResult` holds them.

    Raises `TooFewSamplesError` when no shot shows the target.
    """
    read = read_with(task, data, linearity, T_flange_sensor)
    state = MountState(T_flange_sensor, (place,))
    return HeldOut(read.view.sightings.names, distances((read.view,), state), read.rejected)


def judged(
    result: HandEyeResult,
    seen: HeldOut,
    shots: int,
    left_out: Mapping[str, str] | None = None,
) -> HandEyeResult:
    """A result with what ``shots`` that were not used say of it; they may refuse it.

    ``left_out``: what was no shot from the first, with the reason.
    """
    rejected = {**(left_out or {}), **seen.rejected}
    document = errors_document(summarise(seen.distance_m)) | {
        "rejected": list(rejected),
        "rejected_because": rejected,
    }
    refused = judge_residuals(seen.distance_m, shots, len(seen.rejected))
    verdict = result.verdict
    if refused is not None and verdict.accept:
        words = f"shots that were not used to solve: {refused.reason}"
        verdict = Verdict(refused.code, words)
    return replace(result, verdict=verdict, more={**result.more, "held_out": document})


def verify(
    task: Task,
    data: HandEyeData,
    T_flange_sensor: Array,
    settings: HandEyeSettings,
    linearity: SensorLinearity | None = None,
) -> Verification:
    """Hold a mount, find the target with it, and see how far each sighting is off.

    ``linearity``: of the sensor, as it was found with the mount; None where none was.

    Raises `TooFewSamplesError` when too few shots show the target; `RankDeficientError` when they
    do not tell where it is.
    """
    read = read_with(task, data, linearity)
    start = MountState(T_flange_sensor, (task.placed(read.view, T_flange_sensor),))
    rejected = dict(read.rejected)
    given = settings.noise()
    noise = given or noise_of(misfit((read.view,), start))
    known = read.view.model.prior(given or FIRST_NOISE)  # the misfit may be the mount's
    view, state = _fit_place(read.view, start, noise, known, rejected)
    fit = distances((view,), state)
    rms = float(np.sqrt(np.mean(fit**2)))
    words, code = f"{len(fit)} samples are off by {rms * 1e3:.3f} mm rms", Code.ACCEPT
    far = distances((read.view,), state)
    if len(rejected) > len(fit):
        code = Code.RESIDUAL_TOO_LARGE
        words = f"{words}, but {len(rejected)} show nothing or do not fit"
    elif rms > settings.limit_m:
        code = Code.RESIDUAL_TOO_LARGE
        words = f"{words} (allowed {settings.limit_m * 1e3:g} mm): the mount is not this one"
    return Verification(
        samples=read.view.sightings.names,
        distance_m=far,
        rejected=rejected,
        target=task.found(state.places[0]),
        verdict=Verdict(code, words),
    )


def _fit_place(
    view: TargetView, start: MountState, noise: PoseNoise, known: Array, rejected: dict[str, str]
) -> tuple[TargetView, MountState]:
    """The target's most likely place with the sensor held; outliers are named in ``rejected``.

    ``known`` (k, k): information about it beforehand.
    """
    if not view.model.names:
        return view, start
    problem = MountProblem((view,), noise, start)
    estimate = solve(_PlaceProblem(problem), start, prior_information=known, sizes=problem.sizes)
    kept = without((view,), estimate.rejected[problem.sample], rejected)
    return kept[0], estimate.settled()


class _PlaceProblem:
    """`MountProblem` whose sensor is held."""

    scale_components = 0

    def __init__(self, problem: MountProblem) -> None:
        self._problem = problem
        self.names = problem.names[HELD:]

    def linearise(self, state: MountState) -> tuple[Array, Array]:
        residual, jacobian = self._problem.linearise(state)
        return residual, jacobian[..., HELD:]

    def retract(self, state: MountState, step: Array) -> MountState:
        return self._problem.retract(state, np.concatenate([np.zeros(HELD), step]))

    def deviation(self, state: MountState) -> Array:
        return self._problem.deviation(state)[HELD:]


def solve_joint(
    parts: Sequence[Part],
    settings: HandEyeSettings,
    checks: Mapping[TargetKind, HandEyeData] | None = None,
) -> HandEyeResult:
    """Calibrate with all shots of several targets: what one leaves open, another shows.

    At least one target must suffice for a first pose of the sensor. Names of samples begin with
    their target's kind. ``checks``: by kind, other shots of targets, which have not moved; they
    judge the result.

    Raises `InputError`: fewer than two targets, or two of one kind; `ResidualError`: one target's
    samples contradict each other; the mistake is named as in `solve_task`; `TooFewSamplesError` or
    `RankDeficientError` when no target gives a first pose, the first one's reason; as `solve_task`
    otherwise.
    """
    tasks = [task for task, _ in parts]
    kinds = [task.kind for task in tasks]
    if len(kinds) < 2 or len(set(kinds)) < len(kinds):
        raise InputError(f"several targets of different kinds are needed, not: {', '.join(kinds)}")
    own, X = _alone(parts, settings)
    data, reads = _together(parts, own)
    places = tuple(task.placed(read.view, X) for task, read in zip(tasks, reads, strict=True))
    fit, reads = _fitted(reads, MountState(X, places), settings.noise())
    result = _result_of(tasks, fit, reads, data, settings)
    if not checks:
        return result
    shots = sum(len(data.names) for data in checks.values())
    seen = _held_out(tasks, fit.state, checks, result.linearity)
    return judged(result, seen, shots)


def _alone(parts: Sequence[Part], settings: HandEyeSettings) -> tuple[list[Read], Array]:
    """Features of each target, and the pose of the sensor from the one that shows it best alone."""
    fits, unseen = [], list[RobocalError]()
    reads = [features(task, data) for task, data in parts]
    every = [read.linearity for read in reads if read.linearity is not None]
    known = min(every, key=lambda own: own.assumed, default=None)
    if known is not None:  # one sensor has one
        reads = [
            read if read.linearity is known else task.read(data, None, known)
            for read, (task, data) in zip(reads, parts, strict=True)
        ]
    for read, (task, data) in zip(reads, parts, strict=True):
        try:
            near, _ = looked(task, data, read)
            fits.append(fit_mount((read.view,), near, settings.noise()))
        except (TooFewSamplesError, RankDeficientError) as error:
            unseen.append(error)  # others may show more
    if not fits:
        raise unseen[0]
    best = min(fits, key=lambda fit: float(np.trace(fit.covariance[:3, :3])))
    return reads, best.state.T_flange_sensor


def _together(parts: Sequence[Part], reads: Sequence[Read]) -> tuple[HandEyeData, list[Read]]:
    """All shots as one data set, numbered through, and samples called after their target."""
    named, first = [], 0
    for (task, data), read in zip(parts, reads, strict=True):
        s = read.view.sightings
        s = replace(
            s,
            names=tuple(f"{task.kind}/{name}" for name in s.names),
            shot=s.shot + first,
            pose=s.pose + first,
        )
        rejected = {f"{task.kind}/{name}": why for name, why in read.rejected.items()}
        points = {f"{task.kind}/{name}": points for name, points in read.points.items()}
        pulled = {f"{task.kind}/{name}": pull for name, pull in read.pulled.items()}
        view = replace(read.view, sightings=s)
        named.append(Read(view, rejected, points, read.linearity, pulled))
        first += len(data.names)
    known = [data.joints for _, data in parts if data.joints is not None]
    together = HandEyeData(
        tuple(f"{task.kind}/{name}" for task, data in parts for name in data.names),
        np.concatenate([data.T_base_flange for _, data in parts]),
        [profile for _, data in parts for profile in data.profiles],
    )
    if len(known) == len(parts):
        joints = ShotJoints(known[0].arm, np.concatenate([part.q for part in known]))
        together = replace(together, joints=joints)
    return together, named


def _held_out(
    tasks: Sequence[Task],
    state: MountState,
    checks: Mapping[TargetKind, HandEyeData],
    linearity: SensorLinearity | None,
) -> HeldOut:
    """How far all other shots are off."""
    names: list[str] = []
    far: list[Array] = []
    rejected: dict[str, str] = {}
    for task, place in zip(tasks, state.places, strict=True):
        if task.kind in checks:
            one = held_out(task, checks[task.kind], state.T_flange_sensor, place, linearity)
            names += [f"{task.kind}/{name}" for name in one.samples]
            far.append(one.distance_m)
            rejected |= {f"{task.kind}/{name}": why for name, why in one.rejected.items()}
    return HeldOut(tuple(names), np.concatenate(far), rejected)
