"""Where a line-laser sensor sits: profiles of a target and flange poses in, its pose out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict, errors_document, summarise
from robocal_ros.estimation.edge import EdgeRule
from robocal_ros.estimation.estimation import solve
from robocal_ros.ground.errors import (
    Code,
    InputError,
    RankDeficientError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.hand_eye.mount_fit import (
    MountFit,
    distances,
    fit_mount,
    leave_one_out,
    require_radius,
    require_seen,
    solved_again,
    swapped,
    without,
)
from robocal_ros.hand_eye.mount_problem import (
    FIRST_NOISE,
    SENSOR_UNKNOWNS,
    MountProblem,
    MountState,
    PoseNoise,
    TargetView,
    pivot_of,
)
from robocal_ros.hand_eye.quality import (
    HandEyeSettings,
    apart,
    expected_error_m,
    field_points,
    judge,
    judge_classic,
    judge_residuals,
)
from robocal_ros.hand_eye.result import HandEyeResult, Method, TargetKind
from robocal_ros.hand_eye.shots import Profile
from robocal_ros.hand_eye.targets import LineTarget, SphereTarget, StepTarget
from robocal_ros.hand_eye.tasks import (
    HandEyeData,
    LineTask,
    Read,
    SphereTask,
    StepTask,
    Task,
    features,
    looked,
)

Array = NDArray[np.float64]


def solve_sphere(
    data: HandEyeData, target: SphereTarget, method: Method, settings: HandEyeSettings
) -> HandEyeResult:
    """From profiles across a sphere that stands still. Raises as `solve_task`."""
    return solve_task(SphereTask(target), data, method, settings)


def solve_step(
    data: HandEyeData, target: StepTarget, method: Method, settings: HandEyeSettings
) -> HandEyeResult:
    """From profiles along the marks of a staircase. Raises as `solve_task`."""
    return solve_task(StepTask(target), data, method, settings)


def solve_line(
    data: HandEyeData,
    target: LineTarget | None,
    method: Method,
    settings: HandEyeSettings,
    rule: EdgeRule,
) -> HandEyeResult:
    """From profiles across a straight edge, unknown where ``target`` is None. Raises as above."""
    return solve_task(LineTask(target, rule), data, method, settings)


def solve_task(
    task: Task, data: HandEyeData, method: Method, settings: HandEyeSettings
) -> HandEyeResult:
    """Calibrate with one target.

    Raises
    ------
    TooFewSamplesError
        Fewer usable profiles than the unknowns need; with the commonest reason.
    RankDeficientError
        The poses leave a direction open; it is named, with the missing motion.
    ResidualError
        Nothing fits: shifted lists, inverted or left-handed poses, a wrong unit, a wrong radius
        are named where they explain it.
    InputError
        A mark that the target does not have.
    """
    read = features(task, data)
    fit = fit_mount((read.view,), looked(task, data, read), settings.noise())
    require_radius(fit)
    require_seen(fit)
    if method == "classic":
        return _classic(task, read, fit, data, settings)
    return result_of([task], fit, [read], data, settings)


def _swapped(view: TargetView, fit: MountFit, place: Array, shots: Sequence[str]) -> dict[str, str]:
    names = np.array([name in fit.rejected for name in view.sightings.names])
    return swapped(fit, view.take(names), place, shots) if np.sum(names) > 1 else {}


def result_of(
    tasks: Sequence[Task],
    fit: MountFit,
    reads: Sequence[Read],
    data: HandEyeData,
    settings: HandEyeSettings,
) -> HandEyeResult:
    """The result of a fit to one target or several, judged."""
    field, pivot = field_of(data), pivot_of(fit.views)
    error_m = expected_error_m(fit.covariance[:6, :6], field - pivot)
    shots = len(data.names)
    rejected = {name: why for read in reads for name, why in read.rejected.items()}
    rejected |= dict(fit.rejected)
    for read, place in zip(reads, fit.state.places, strict=True):
        rejected |= _swapped(read.view, fit, place, data.names)
    found = [task.found(place) for task, place in zip(tasks, fit.state.places, strict=True)]
    more = {
        "robot_sigma_mm": fit.noise.sigma_m * 1e3,
        "working_distance_mm": float(field[0, 2]) * 1e3,
    }
    for task, view, place, read in zip(tasks, fit.views, fit.state.places, reads, strict=True):
        more |= task.more(
            replace(fit, views=(view,), state=replace(fit.state, places=(place,))), read
        )
    alone = len(tasks) == 1
    return HandEyeResult(
        kind=tasks[0].kind if alone else "joint",
        method="best",
        T_flange_sensor=fit.state.T_flange_sensor,
        covariance=fit.covariance[:6, :6],
        samples=fit.names,
        residual_m=fit.distances(),
        leave_one_out_m=leave_one_out(fit.views, solved_again(fit)),
        rejected=rejected,
        target=found[0] if alone else {t.kind: f for t, f in zip(tasks, found, strict=True)},
        working_error_m=error_m,
        pivot=pivot,
        place=fit.state.places[0] if alone else None,
        verdict=judge(fit, shots, shots - _shots(fit.views), error_m, settings),
        more=more,
    )


def field_of(data: HandEyeData) -> Array:
    """Points (5, 3) of the field that the profiles of a data set cover."""
    return field_points([p.points for p in data.profiles if isinstance(p, Profile)])


def _shots(views: tuple[TargetView, ...]) -> int:
    return len(np.unique(np.concatenate([view.sightings.shot for view in views])))


def _classic(
    task: Task, read: Read, best: MountFit, data: HandEyeData, settings: HandEyeSettings
) -> HandEyeResult:
    """The classic estimate from all profiles that gave a feature; it tells no covariance.

    Its error is its distance from the best estimate, with that one's own.
    """
    views, shots = (read.view,), len(data.names)
    state = task.classic(read.view, best.state)
    residual = distances(views, state)
    field, pivot = field_of(data), pivot_of(best.views)
    own_m = expected_error_m(best.covariance[:6, :6], field - pivot)
    apart_m = apart(state.T_flange_sensor, best.state.T_flange_sensor, field)
    error_m = float(np.hypot(apart_m, own_m))
    refused = judge_residuals(residual, shots, shots - _shots(views), settings)
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
        verdict=refused or judge_classic(apart_m, error_m, settings),
    )


# ---- verification -------------------------------------------------------------------------------


Document = dict[str, Any]

HELD = len(SENSOR_UNKNOWNS)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Distances (n,) of ``samples`` from a target, m; ``rejected``: shots without a feature."""

    samples: tuple[str, ...]
    distance_m: Array
    rejected: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class Verification:
    """What other data say of a mount.

    Attributes
    ----------
    samples, distance_m : (n,) distance of each from the target, m.
    target : what was found of the target with the mount held.
    rejected : shots and features that were not used, and why.
    """

    samples: tuple[str, ...]
    distance_m: Array
    target: Document
    rejected: Mapping[str, str]
    verdict: Verdict


def held_out(task: Task, data: HandEyeData, T_flange_sensor: Array, place: Array) -> HeldOut:
    """How far other shots of the same target, which has not moved, are off.

    Parameters
    ----------
    place : of the target, as `HandEyeResult` holds it.

    Raises
    ------
    TooFewSamplesError
        When no shot shows the target.
    """
    read = task.read(data, T_flange_sensor)
    state = MountState(T_flange_sensor, (place,))
    return HeldOut(read.view.sightings.names, distances((read.view,), state), read.rejected)


def judged(
    result: HandEyeResult,
    seen: HeldOut,
    shots: int,
    settings: HandEyeSettings,
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
    refused = judge_residuals(seen.distance_m, shots, len(seen.rejected), settings)
    verdict = result.verdict
    if refused is not None and verdict.accept:
        words = f"shots that were not used to solve: {refused.reason}"
        verdict = Verdict(refused.code, words)
    return replace(result, verdict=verdict, more={**result.more, "held_out": document})


def verify(
    task: Task, data: HandEyeData, T_flange_sensor: Array, settings: HandEyeSettings
) -> Verification:
    """Hold a mount, find the target with it, and see how far each sighting is off.

    Raises
    ------
    TooFewSamplesError
        When too few shots show the target.
    RankDeficientError
        When they do not tell where it is.
    """
    read = task.read(data)
    start = MountState(T_flange_sensor, (task.placed(read.view, T_flange_sensor),))
    rejected = dict(read.rejected)
    view, state = fit_place(read.view, start, settings.noise() or FIRST_NOISE, rejected)
    far = distances((view,), state)
    return Verification(
        view.sightings.names,
        far,
        task.found(state.places[0]),
        rejected,
        _verdict(far, len(rejected), settings),
    )


def _verdict(far: Array, lost: int, settings: HandEyeSettings) -> Verdict:
    rms = float(np.sqrt(np.mean(far**2)))
    words = f"{len(far)} samples are off by {rms * 1e3:.3f} mm rms"
    if lost > len(far):
        return Verdict(Code.RESIDUAL_TOO_LARGE, f"{words}, but {lost} do not fit at all")
    if rms > settings.limit_m:
        words = f"{words} (allowed {settings.limit_m * 1e3:g} mm): the mount is not this one"
        return Verdict(Code.RESIDUAL_TOO_LARGE, words)
    return Verdict(Code.ACCEPT, words)


def fit_place(
    view: TargetView, start: MountState, noise: PoseNoise, rejected: dict[str, str]
) -> tuple[TargetView, MountState]:
    """The target's most likely place with the sensor held; outliers are named in ``rejected``.

    Raises
    ------
    RankDeficientError
        When the sightings do not tell it.
    """
    if not view.model.names:
        return view, start
    problem = MountProblem((view,), noise, start)
    estimate = solve(
        _PlaceProblem(problem),
        start,
        prior_information=view.model.prior,
        sizes=problem.sizes,
    )
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


# ---- one mount from several targets at once: what one leaves open, another shows ----------------


Part = tuple[Task, HandEyeData]


def solve_joint(
    parts: Sequence[Part],
    settings: HandEyeSettings,
    checks: Mapping[TargetKind, HandEyeData] | None = None,
) -> HandEyeResult:
    """Calibrate with all shots of several targets; names of samples begin with their target's kind.

    At least one target must suffice for a first pose of the sensor. ``checks``: by kind, other
    shots of targets, which have not moved; they judge the result.

    Raises
    ------
    InputError
        Fewer than two targets, or two of one kind.
    ResidualError
        One target's samples contradict each other; the mistake is named as in `solve_task`.
    TooFewSamplesError, RankDeficientError
        When no target gives a first pose, the first one's reason; as `solve_task` otherwise.
    """
    kinds = [task.kind for task, _ in parts]
    if len(kinds) < 2 or len(set(kinds)) < len(kinds):
        raise InputError(f"several targets of different kinds are needed, not: {', '.join(kinds)}")
    alone = [_alone(*part) for part in parts]
    X = _first(alone, settings)
    reads = _named(parts, [read for read, _ in alone])
    views = tuple(read.view for read in reads)
    places = [
        task.placed(view, X.T_flange_sensor) for (task, _), view in zip(parts, views, strict=True)
    ]
    fit = fit_mount(views, MountState(X.T_flange_sensor, tuple(places)), settings.noise())
    require_radius(fit)
    require_seen(fit)
    tasks = [task for task, _ in parts]
    result = result_of(tasks, fit, reads, _data(parts), settings)
    if not checks:
        return result
    shots = sum(len(data.names) for data in checks.values())
    return judged(result, _held_out(tasks, fit.state, checks), shots, settings)


def _held_out(
    tasks: Sequence[Task], state: MountState, checks: Mapping[TargetKind, HandEyeData]
) -> HeldOut:
    """How far all other shots are off."""
    found = {
        task.kind: held_out(task, checks[task.kind], state.T_flange_sensor, place)
        for task, place in zip(tasks, state.places, strict=True)
        if task.kind in checks
    }
    return HeldOut(
        tuple(f"{kind}/{name}" for kind, one in found.items() for name in one.samples),
        np.concatenate([one.distance_m for one in found.values()]),
        {
            f"{kind}/{name}": why
            for kind, one in found.items()
            for name, why in one.rejected.items()
        },
    )


def _alone(task: Task, data: HandEyeData) -> tuple[Read, MountState | RobocalError]:
    """Features of one target, and where they lead alone, or why nowhere: others may show more."""
    read = features(task, data)
    try:
        return read, looked(task, data, read)
    except (TooFewSamplesError, RankDeficientError) as error:
        return read, error


def _first(
    alone: Sequence[tuple[Read, MountState | RobocalError]], settings: HandEyeSettings
) -> MountState:
    """The pose of the sensor from the target that shows it best alone."""
    failures = [near for _, near in alone if isinstance(near, RobocalError)]
    fits = []
    for read, near in alone:
        if isinstance(near, MountState):
            try:
                fits.append(fit_mount((read.view,), near, settings.noise()))
            except (TooFewSamplesError, RankDeficientError) as error:
                failures.append(error)
    if not fits:
        raise failures[0]
    return min(fits, key=lambda fit: float(np.trace(fit.covariance[:3, :3]))).state


def _named(parts: Sequence[Part], reads: Sequence[Read]) -> list[Read]:
    """Samples called after their target; shots of all are numbered through."""
    named, first = [], 0
    for (task, data), read in zip(parts, reads, strict=True):
        s = read.view.sightings
        s = replace(
            s,
            names=tuple(f"{task.kind}/{name}" for name in s.names),
            shot=s.shot + first,
            pose=s.pose + first,
        )
        named.append(
            Read(
                replace(read.view, sightings=s),
                {f"{task.kind}/{name}": why for name, why in read.rejected.items()},
                {f"{task.kind}/{name}": points for name, points in read.points.items()},
            )
        )
        first += len(data.names)
    return named


def _data(parts: Sequence[Part]) -> HandEyeData:
    """All shots together."""
    return HandEyeData(
        tuple(f"{task.kind}/{name}" for task, data in parts for name in data.names),
        np.concatenate([data.T_base_flange for _, data in parts]),
        [profile for _, data in parts for profile in data.profiles],
    )
