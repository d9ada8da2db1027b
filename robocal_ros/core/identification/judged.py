"""Identify on one part of the data, judge on another."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.assessment import ErrorSummary, Verdict, judge, pose_groups, summarise
from robocal_ros.core.codes import Code
from robocal_ros.core.errors import InputError
from robocal_ros.core.identification.cell import CellModel
from robocal_ros.core.identification.solve import Identification, Method, Part, identify
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.samples import Measurements

Array = NDArray[np.float64]


@dataclass(frozen=True)
class JudgedIdentification:
    """An identification with its figures on data that were not used to solve.

    Attributes
    ----------
    current, candidate : held-out errors of the model in force and of the identified one.
    predicted_rms_m : the candidate's error expected from its covariance alone.
    predicted_total_rms_m : the same with the noise of the measurements added.
    """

    identification: Identification
    current: ErrorSummary
    candidate: ErrorSummary
    predicted_rms_m: float
    predicted_total_rms_m: float
    verdict: Verdict


def identify_and_judge(
    arm: SerialArm,
    train: Measurements,
    check: Measurements,
    *,
    fit: Collection[Part] = ("base", "tool", "geometry"),
    method: Method = "map",
    check_refit: Collection[Part] = (),
    in_force: SerialArm | None = None,
) -> JudgedIdentification:
    """Identify from ``train`` and compare with the model in force on ``check``.

    Parameters
    ----------
    check_refit : ``base``, ``tool``: parts that are solved anew from the check data, for both
        models, because those come from another set-up; the geometry is held.
    in_force : arm with the parameters in force, default the nominal ``arm``; base and targets
        are fitted to it from the same training data.
    """
    if "geometry" in check_refit:
        raise InputError("the geometry is what is checked: refit only base and tool")
    result = identify(arm, train, fit=fit, method=method)
    set_up = frozenset(fit) - {"geometry"}
    rival = identify(arm if in_force is None else in_force, train, fit=set_up, method="map")
    before = _check_error(rival.cell, check, check_refit)
    after = _check_error(result.cell, check, check_refit)
    predicted, total = _predicted(result, train, check, check_refit)
    verdict = judge(before, after, pose_groups(check.q), predicted)
    if verdict.accept and not result.estimate.converged:
        verdict = Verdict(
            Code.POSES_NOT_INFORMATIVE,
            f"the solution still crept after {result.estimate.iterations} iterations along "
            f"directions that the poses hardly show; {verdict.reason}",
        )
    return JudgedIdentification(
        result, summarise(before), summarise(after), predicted, total, verdict
    )


def _check_error(cell: CellModel, check: Measurements, refit: Collection[Part]) -> Array:
    if refit:
        cell = identify(cell.arm, check, fit=refit, method="map", start=_start(cell, refit)).cell
    return np.asarray(np.linalg.norm(cell.residual(check), axis=1))


def _start(cell: CellModel, refit: Collection[Part]) -> CellModel | None:
    """Keep what is not refitted; with both refitted nothing of the old set-up counts."""
    return None if frozenset(refit) >= {"base", "tool"} else cell


def _predicted(
    result: Identification, train: Measurements, check: Measurements, refit: Collection[Part]
) -> tuple[float, float]:
    """Rms error expected at the check poses: of the model, and with measurement noise."""
    known = {name: i for i, name in enumerate(result.cell.targets)}
    target = np.array([known.get(name, 0) for name in check.target], dtype=np.int64)
    variance = result.predicted_variance(check.q, target, without=refit)
    model = float(np.mean(np.trace(variance, axis1=1, axis2=2)))
    sigma = check.sigma if check.sigma is not None else train.sigma
    noise = result.estimate.scale if sigma is None else float(np.sqrt(np.mean(sigma**2)))
    return float(np.sqrt(model)), float(np.sqrt(model + 3.0 * noise**2))


