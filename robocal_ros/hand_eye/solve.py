"""Where a line-laser sensor sits: profiles of a target and flange poses in, its pose out."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.edge import EdgeRule
from robocal_ros.hand_eye.diagnosis import features, looked
from robocal_ros.hand_eye.leave_one_out import leave_one_out, solved_again
from robocal_ros.hand_eye.mistakes import swapped
from robocal_ros.hand_eye.mount_fit import MountFit, distances, fit_mount, require_seen
from robocal_ros.hand_eye.mount_problem import TargetView, pivot_of
from robocal_ros.hand_eye.profile import Profile
from robocal_ros.hand_eye.quality import (
    HandEyeSettings,
    apart,
    expected_error_m,
    field_points,
    judge,
    judge_classic,
    judge_residuals,
)
from robocal_ros.hand_eye.result import HandEyeResult, Method
from robocal_ros.hand_eye.sphere_radius import require_radius
from robocal_ros.hand_eye.step_task import StepTask
from robocal_ros.hand_eye.targets import LineTarget, SphereTarget, StepTarget
from robocal_ros.hand_eye.tasks import HandEyeData, LineTask, Read, SphereTask, Task

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
