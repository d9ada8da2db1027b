"""Where a line-laser sensor sits: profiles of a target and flange poses in, its pose out."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.assessment import Verdict
from robocal_ros.core.codes import Code
from robocal_ros.core.errors import RankDeficientError, ResidualError, RobocalError
from robocal_ros.core.fitting.edge import EdgeRule
from robocal_ros.core.hand_eye.mistakes import explain, misfit, swapped
from robocal_ros.core.hand_eye.mount_fit import MountFit, fit_mount, leave_one_out, require_seen
from robocal_ros.core.hand_eye.mount_problem import View
from robocal_ros.core.hand_eye.quality import (
    HandEyeSettings,
    expected_error_m,
    judge,
    working_points,
)
from robocal_ros.core.hand_eye.result import HandEyeResult, Method
from robocal_ros.core.hand_eye.sphere_radius import require_radius
from robocal_ros.core.hand_eye.step_task import StepTask
from robocal_ros.core.hand_eye.targets import LineTarget, SphereTarget, StepTarget
from robocal_ros.core.hand_eye.tasks import HandEyeData, LineTask, Read, SphereTask, Task

Array = NDArray[np.float64]

DOUBTFUL_M = 5e-4  # median distance from which a mistake in the data is looked for
PROMISING = 3  # starts that are followed to the end


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
    read = task.read(data)
    fit = best_fit(task, read.view, settings)
    as_given = misfit(fit)
    if as_given > DOUBTFUL_M:
        _require_no_mistake(task, data, fit, settings, as_given)
    require_radius(fit)
    rejected = {**read.rejected, **fit.rejected, **_swapped(read.view, fit)}
    if method == "classic":
        return _classic(task, read, fit, rejected)
    return result_of(task, fit, rejected, len(data.names), settings)


def best_fit(task: Task, view: View, settings: HandEyeSettings) -> MountFit:
    """The most likely of the fits that the promising starts lead to.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When none leads anywhere.
    """
    fits: list[MountFit] = []
    failure: RobocalError | None = None
    for start in task.starts(view):
        try:
            fits.append(fit_mount((view,), start, settings.noise()))
        except RobocalError as error:
            failure = failure or error
            if isinstance(error, RankDeficientError):
                break  # it lies in the poses, not in the start
        if len(fits) >= PROMISING:
            break
    if not fits:
        raise failure or RobocalError("no start was found")
    best = min(fits, key=misfit)
    require_seen(best, float(np.abs(working_points(best)).max()))
    return best


def _require_no_mistake(
    task: Task, data: HandEyeData, fit: MountFit, settings: HandEyeSettings, as_given: float
) -> None:
    def refit(T_base_flange: Array) -> MountFit:
        return best_fit(task, task.read(replace(data, T_base_flange=T_base_flange)).view, settings)

    words = explain(refit, data.T_base_flange, as_given)
    if words is not None:
        raise ResidualError(f"samples are off by {as_given * 1e3:.3g} mm: {words}")


def _swapped(view: View, fit: MountFit) -> dict[str, str]:
    names = np.array([name in fit.rejected for name in view.sightings.names])
    if np.sum(names) < 2:
        return {}
    return swapped(fit, replace(fit, views=(view.take(names),)))


def result_of(
    task: Task, fit: MountFit, rejected: dict[str, str], shots: int, settings: HandEyeSettings
) -> HandEyeResult:
    """The result of a fit, judged."""
    error_m = expected_error_m(fit.covariance[:6, :6], working_points(fit))
    lost = shots - len(np.unique(np.concatenate([v.sightings.pose for v in fit.views])))
    return HandEyeResult(
        kind=task.kind,
        method="best",
        T_flange_sensor=fit.state.T_flange_sensor,
        covariance=fit.covariance[:6, :6],
        samples=fit.names,
        residual_m=fit.distances(),
        leave_one_out_m=leave_one_out(fit),
        rejected=rejected,
        target=task.found(fit.state.places[0]),
        working_error_m=error_m,
        verdict=judge(fit, shots, lost, error_m, settings),
        more={
            "robot_sigma_mm": fit.noise.sigma_m * 1e3,
            "working_distance_mm": float(working_points(fit)[1, 2]) * 1e3,
        },
    )


def _classic(task: Task, read: Read, fit: MountFit, rejected: dict[str, str]) -> HandEyeResult:
    """The classic estimate from all profiles that gave a feature; it tells no covariance."""
    state = task.classic(read.view, fit.state)
    every = replace(fit, views=(read.view,), state=state)
    words = "closed form: no covariance, no outlier is left out; compare with method best"
    return HandEyeResult(
        kind=task.kind,
        method="classic",
        T_flange_sensor=state.T_flange_sensor,
        covariance=None,
        samples=every.names,
        residual_m=every.distances(),
        rejected=dict(read.rejected),
        target=task.found(state.places[0]),
        verdict=Verdict(Code.ACCEPT, words),
    )
