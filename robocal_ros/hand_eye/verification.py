"""A mount judged on data that were not used to find it: the same target, or another one."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict, errors_document, summarise
from robocal_ros.estimation.estimation import solve
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.mount_fit import distances, without
from robocal_ros.hand_eye.mount_problem import (
    SENSOR_UNKNOWNS,
    MountProblem,
    MountState,
    PoseNoise,
    TargetView,
)
from robocal_ros.hand_eye.quality import HandEyeSettings, judge_residuals
from robocal_ros.hand_eye.restricted_noise import FIRST_NOISE
from robocal_ros.hand_eye.result import HandEyeResult
from robocal_ros.hand_eye.tasks import HandEyeData, Task

Array = NDArray[np.float64]
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
