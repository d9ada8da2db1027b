"""Is the model that a cycle gives better than the one in force, in mm, throughout the workspace?"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import (
    SPREAD_POSES,
    Judgement,
    gross,
    judge,
    summarise,
    too_narrow,
)
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.solve import random_postures
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.identification import CycleDrift, visit_variance
from robocal_ros.thermal.spots import ColdSpots

Array = NDArray[np.float64]


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
