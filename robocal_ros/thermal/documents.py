"""Thermal results as plain documents (JSON), in the units people read."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import (
    SPREAD_POSES,
    Judgement,
    errors_document,
    gross,
    judge,
    judged_errors_document,
    summarise,
    too_narrow,
    verdict_document,
)
from robocal_ros.ground import frames
from robocal_ros.ground.frames import transform_document
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.judged import cell_document
from robocal_ros.identification.solve import random_postures
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import parameters_document
from robocal_ros.thermal.flange_sensor import JudgedFlangeSensor
from robocal_ros.thermal.identification import CycleDrift, visit_variance
from robocal_ros.thermal.reference import ColdSpots
from robocal_ros.thermal.sensor_calibration import NAMES, SensorCalibration, sensor_verdict

Array = NDArray[np.float64]
Document = dict[str, Any]


def sensor_document(found: SensorCalibration, arm: SerialArm) -> Document:
    """A placed sensor: where, how well, and whether to trust it.

    ``covariance`` is in SI, of ``covariance_of``.
    """
    covariance, sigma = found.covariance, found.sigma
    to_display = np.array([1e3 if name.endswith("_mm") else np.degrees(1.0) for name in NAMES])
    fitted = np.linalg.norm(found.residual, axis=1)
    judged = found.left_out[np.isfinite(found.left_out)]
    return {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "method": found.method,
        "T_sensor_base": transform_document(found.T_sensor_base),
        "sphere_in_flange_mm": (found.sphere_in_flange * 1e3).tolist(),
        "covariance_of": list(NAMES),
        "covariance": None if covariance is None else covariance.tolist(),
        "sigma": None
        if sigma is None
        else dict(zip(NAMES, (sigma * to_display).tolist(), strict=True)),
        "residual": errors_document(summarise(fitted)),
        "left_out": errors_document(summarise(judged)) if len(judged) else None,
        "samples": len(fitted),
        "rejected": list(found.rejected),
        "verdict": verdict_document(sensor_verdict(found)),
    }


def placed_of(document: Mapping[str, Any]) -> tuple[Array, Array]:
    """T_sensor_base (4, 4) and the sphere in the flange's frame (3,), m, of a sensor's document."""
    pose = document["T_sensor_base"]
    xyz = np.array(pose["xyz_mm"]) * 1e-3
    T_sensor_base = frames.transform_from_quat(xyz, pose["quat_xyzw"])
    return T_sensor_base, np.array(document["sphere_in_flange_mm"]) * 1e-3


def cycle_document(
    found: CycleDrift, judged: Judgement, spots: ColdSpots, nominal: SerialArm, method: str
) -> Document:
    """A cycle's drift in the form of ``identify``; the nominal model is the cold one here."""
    names = nominal.parameters.names
    sigma = dict(zip(names, np.sqrt(np.diag(found.covariance)).tolist(), strict=True))
    solved = {name: value for name, value in sigma.items() if value > 0.0}
    held = [name for name in names if name not in solved]
    return {
        "robot": nominal.name,
        "model_hash": nominal.model_hash,
        "method": method,
        **judged_errors_document(judged),
        "parameters": parameters_document(nominal, found.arm, solved),
        **cell_document(spots.cell),
        "noise_mm": found.noise_m * 1e3,
        "samples": len(found.warm),
        "cold_visits": int(spots.visits.sum()),
        "rank": found.seen.rank,
        "unknowns": len(names) - len(held),
        "condition": found.seen.condition,
        "unobservable": list(found.unobservable),
        "held": held,
        "rejected": [found.warm.sample[i] for i in np.flatnonzero(found.rejected)],
        "held_out_rejected": list(judged.held_out_rejected),
        "converged": True,
        "verdict": verdict_document(judged.verdict),
    }


def flange_sensor_document(judged: JudgedFlangeSensor) -> Document:
    """A measuring robot in the form of ``identify``, with hand-eye pose and spheres."""
    result = judged.identification
    problem, seen = result.problem, result.estimate.observability
    sigma = dict(
        zip(problem.names, np.sqrt(np.diag(result.estimate.covariance)).tolist(), strict=True)
    )
    return {
        "robot": result.nominal.name,
        "model_hash": result.nominal.model_hash,
        "method": "map",
        **judged_errors_document(judged),
        "parameters": parameters_document(result.nominal, result.cell.arm, sigma),
        "T_flange_sensor": transform_document(result.cell.T_flange_sensor),
        "spheres": {
            name: {"xyz_mm": (centre * 1e3).tolist()}
            for name, centre in zip(result.cell.spheres, result.cell.centres, strict=True)
        },
        "noise_mm": result.noise_m * 1e3,
        "samples": len(result.problem.data),
        "rank": seen.rank,
        "unknowns": len(problem.names),
        "condition": seen.condition,
        "unobservable": list(result.unobservable),
        "held": [],
        "rejected": list(result.rejected),
        "held_out_rejected": list(judged.held_out_rejected),
        "converged": result.estimate.converged,
        "verdict": verdict_document(judged.verdict),
    }


# ---- cycle verdict ------------------------------------------------------------------------------


def judge_cycle(
    found: CycleDrift,
    spots: ColdSpots,
    *,
    in_force: SerialArm,
    check: Measurements | None = None,
    sigma_m: float,
) -> Judgement:
    """Judge at the poses of ``check``, else at each pose of the cycle from the others.

    ``in_force`` is an arm of the cold model's type. A drift that the cycle's poses do not show
    throughout the workspace is refused, whatever the poses themselves say.
    """
    data = found.warm if check is None else check
    spot = spots.match(data)
    y = spots.drift(data)
    A = spots.rows(data.q, spots.target[spot])[0]
    chosen, cold = spots.cell.arm.parameters, spots.cell.arm
    current = np.linalg.norm(y - A @ chosen.read(in_force.mdh - cold.mdh), axis=1)
    if check is None:
        after, spread = np.linalg.norm(found.left_out, axis=1), found.left_out_sigma
        usable = ~found.rejected
    else:
        after = np.linalg.norm(y - A @ found.drift, axis=1)
        noise = 3.0 * visit_variance(spots, spot, data, sigma_m)
        spread = np.sqrt(np.einsum("mik,kl,mil->m", A, found.covariance, A) + noise)
        usable = np.ones(len(data), dtype=np.bool_)
    return conclude(
        found, spots, data, in_force, after=after, current=current, spread=spread, usable=usable
    )


def conclude(
    found: CycleDrift,
    spots: ColdSpots,
    data: Measurements,
    in_force: SerialArm,
    *,
    current: Array,
    after: Array,
    spread: Array,
    usable: NDArray[np.bool_],
) -> Judgement:
    """Judge from the errors (m,) of the model in force and of the candidate at ``data``.

    ``spread`` (m,) is what the covariances expect of ``after``; ``usable`` (m,) what may judge.
    """
    chosen, cold, spot = spots.cell.arm.parameters, spots.cell.arm, spots.match(data)
    A = spots.rows(data.q, spots.target[spot])[0]
    sound = usable & ~gross(current, after)
    rows = workspace_rows(spots)
    moved = rows @ (found.drift - chosen.read(in_force.mdh - cold.mdh))
    change = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
    doubt = _doubt(found, rows, summarise(current[sound]).rms_m, change)
    return Judgement(
        nominal=summarise(np.linalg.norm(spots.drift(data), axis=1)[sound]),
        current=summarise(current[sound]),
        candidate=summarise(after[sound]),
        predicted_rms_m=_rms(A, found.covariance),
        predicted_total_rms_m=float(np.sqrt(np.mean(spread[sound] ** 2))),
        workspace_rms_m=_rms(rows, found.covariance),
        held_out_rejected=tuple(data.sample[i] for i in np.flatnonzero(~sound)),
        verdict=judge(current[sound], after[sound], spot[sound], doubt),
    )


def _doubt(found: CycleDrift, rows: Array, current_rms_m: float, change_m: float) -> str:
    """Say why the poses do not carry over to the workspace; empty when they do.

    Poses that halve the prior's error there do, however small the change: the model in force came
    from such poses too and is no better known elsewhere.
    """
    error = _rms(rows, found.covariance)
    prior = found.prior_covariance
    if prior is not None and error <= 0.5 * _rms(rows, prior):
        return ""
    return too_narrow(error, change_m, current_rms_m, SPREAD_POSES)


def _rms(rows: Array, covariance: Array) -> float:
    """Rms length, m, of what a covariance (k, k) does to points with rows (m, 3, k)."""
    return float(np.sqrt(np.mean(np.einsum("mik,kl,mil->m", rows, covariance, rows))))


def workspace_rows(spots: ColdSpots) -> Array:
    """Displacement (p, 3, k) of the first target by the parameters, throughout the joint limits."""
    q = random_postures(spots.cell.arm)
    return spots.rows(q, np.zeros(len(q), dtype=np.int64))[0]
