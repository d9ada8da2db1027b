"""Drift of the model parameters between a cold reference and a warm visit of the same poses."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import estimation
from robocal_ros.core.assessment import LARGEST_RMS_M, gross, judge, pose_groups, summarise
from robocal_ros.core.errors import InputError, ResidualError, TooFewSamplesError
from robocal_ros.core.identification.cell import CellModel, CellProblem, make_layout
from robocal_ros.core.identification.judged import JudgedIdentification, uninformative
from robocal_ros.core.identification.mismatch import require_match
from robocal_ros.core.identification.solve import Identification, Method, identify
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.observability import describe
from robocal_ros.core.samples import Measurements

Array = NDArray[np.float64]

SAME_VISIT_RAD = float(np.radians(0.5))


@dataclass(frozen=True)
class ColdReference:
    """Cold visit of the measuring poses.

    Attributes
    ----------
    cell : the cold model with base and targets as fitted to the cold visit.
    data : the cold measurements.
    rejected : names of those that did not fit the others.
    """

    cell: CellModel
    data: Measurements
    rejected: tuple[str, ...] = ()

    @property
    def used(self) -> Measurements:
        """The measurements that placed base and targets."""
        return self.data.take(~np.isin(self.data.sample, self.rejected))


def capture_reference(arm: SerialArm, data: Measurements) -> ColdReference:
    """Place base and targets from a cold visit with the cold model ``arm``.

    Samples that do not fit the others do not place them, and are named in ``rejected``; a warm
    visit of such a pose will not fit either.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When the visit cannot place them.
    InputError, ResidualError
        When the visit misses the arm by a mistake that can be named, or by more than 5 mm rms.
    """
    require_match(arm, data, base=True, tool=True)
    placed = identify(arm, data, fit=("base", "tool"), method="lsq")
    reference = ColdReference(placed.cell, data, placed.rejected)
    rms = summarise(placed.cell.residual(reference.used)).rms_m
    if rms > LARGEST_RMS_M:
        raise ResidualError(
            f"the cold visit misses the model by {rms * 1e3:.1f} mm rms, more than any robot's "
            f"static error ({LARGEST_RMS_M * 1e3:.0f} mm): check robot file, units, joint signs "
            "and target names"
        )
    return reference


def against_reference(reference: ColdReference, warm: Measurements, sigma_m: float) -> Measurements:
    """Warm measurements less the cold residual of the same pose (static errors cancel).

    Poses are the same when all joints agree within 0.5 deg. Visits of one pose are averaged,
    because they share the noise of its cold visit: the result's sigma holds both.

    Raises
    ------
    InputError
        When a warm sample has no cold counterpart.
    """
    cold = reference.cell.residual(reference.data)
    visits: dict[tuple[int, str], list[int]] = {}
    for i, group in enumerate(pose_groups(warm.q)):
        visits.setdefault((int(group), warm.target[i]), []).append(i)
    rows = [np.array(indices) for indices in visits.values()]
    near = [_cold_visits(reference, warm, int(row[0])) for row in rows]
    counts = [(np.sum(visit), len(row)) for visit, row in zip(near, rows, strict=True)]
    return Measurements(
        q=np.array([warm.q[row].mean(axis=0) for row in rows]),
        position=np.array(
            [
                warm.position[row].mean(axis=0) + cold[visit].mean(axis=0)
                for row, visit in zip(rows, near, strict=True)
            ]
        ),
        target=tuple(warm.target[row[0]] for row in rows),
        sample=tuple("+".join(warm.sample[i] for i in row) for row in rows),
        sigma=np.array([sigma_m * np.sqrt(1.0 / before + 1.0 / now) for before, now in counts]),
    )


def _cold_visits(reference: ColdReference, warm: Measurements, i: int) -> NDArray[np.bool_]:
    """Mark the cold samples of the same target and pose as a warm one."""
    same = np.array([t == warm.target[i] for t in reference.data.target], dtype=np.bool_)
    near = same & (np.max(np.abs(reference.data.q - warm.q[i]), axis=1) < SAME_VISIT_RAD)
    if not np.any(near):
        raise InputError(
            f"sample {warm.sample[i]} of target '{warm.target[i]}' was not measured in the "
            "cold reference: visit the reference poses, or capture a new reference"
        )
    return np.asarray(near)


def identify_drift(
    nominal: SerialArm,
    reference: ColdReference,
    warm: Measurements,
    *,
    sigma_m: float,
    in_force: SerialArm,
    prior_covariance: Array,
    method: Method = "map",
) -> JudgedIdentification:
    """Identify the drifted model and judge it by leaving out one pose at a time.

    Parameters
    ----------
    sigma_m : standard deviation of one coordinate of one visit (sensor and repeatability).
    in_force : the model that the candidate must beat at the left-out poses.
    prior_covariance : (k, k), SI, of the drift of the free parameters, for ``map``.

    Raises
    ------
    TooFewSamplesError
        With fewer than two poses.
    """
    data = against_reference(reference, warm, sigma_m)
    groups = pose_groups(data.q)
    if groups.max() < 1:
        raise TooFewSamplesError("one pose cannot show a drift: measure at least five")
    prior = prior_covariance if method == "map" else None
    result = _identify(nominal, reference, data, method, prior)
    after, model = _left_out(nominal, reference, data, groups, method, prior)
    current = replace(reference.cell, arm=nominal.with_mdh(in_force.mdh))
    plain = np.linalg.norm(reference.cell.residual(data), axis=1)
    before = np.linalg.norm(current.residual(data), axis=1)
    sound = ~(gross(before, after) | result.estimate.rejected)
    doubt = _doubt(result, summarise(before[sound]).rms_m, in_force, prior)
    return JudgedIdentification(
        identification=result,
        nominal=summarise(plain[sound]),
        current=summarise(before[sound]),
        candidate=summarise(after[sound]),
        predicted_rms_m=float(np.sqrt(model.mean())),
        predicted_total_rms_m=float(np.sqrt(model.mean() + 3.0 * result.noise_m**2)),
        workspace_rms_m=result.workspace_rms(result.estimate.covariance),
        held_out_rejected=tuple(data.sample[i] for i in np.flatnonzero(~sound)),
        verdict=judge(before[sound], after[sound], groups[sound], doubt),
    )


def _left_out(
    nominal: SerialArm,
    reference: ColdReference,
    data: Measurements,
    groups: NDArray[np.int64],
    method: Method,
    prior: Array | None,
) -> tuple[Array, Array]:
    """Error (m,) at each sample of the model without its pose, and its predicted variance (m,)."""
    error, variance = np.empty(len(data)), np.empty(len(data))
    for group in range(int(groups.max()) + 1):
        left = groups == group
        part, others = data.take(left), data.take(~left)
        without = _identify(nominal, reference, others, method, prior)
        error[left] = np.linalg.norm(without.cell.residual(part), axis=1)
        spread = without.predicted_variance(part.q, part.target_index(without.cell.targets))
        variance[left] = np.trace(spread, axis1=1, axis2=2)
    return error, variance


def _doubt(
    result: Identification, current_rms_m: float, in_force: SerialArm, prior: Array | None
) -> str:
    """Say why the poses do not carry over to the workspace; empty when they do.

    Poses that halve the prior's error throughout the workspace do, however small the change: the
    model in force came from such poses too and is no better known elsewhere.
    """
    if prior is not None and result.estimate.converged:
        left = result.workspace_rms(result.estimate.covariance)
        if left <= 0.5 * result.workspace_rms(prior):
            return ""
    return uninformative(result, current_rms_m, in_force)


def _identify(
    nominal: SerialArm,
    reference: ColdReference,
    data: Measurements,
    method: Method,
    prior: Array | None,
) -> Identification:
    """The model parameters alone, about the cold model; base and targets are the reference's."""
    cell = reference.cell
    layout = make_layout(
        nominal,
        cell.targets,
        geometry=nominal.parameters.names,
        base=False,
        tool=False,
        orientation=False,
    )
    if data.sigma is None:
        raise ValueError("drift needs the measurements' sigma")
    start = replace(cell, arm=nominal.with_mdh(cell.arm.mdh))
    problem = CellProblem(layout, data, cell.targets, data.sigma, 0.0, cell.arm.mdh)
    information = None if prior is None else np.asarray(np.linalg.inv(prior), dtype=np.float64)
    estimate = estimation.solve(problem, start, prior_information=information, noise_known=True)
    return Identification(
        nominal=nominal,
        cell=estimate.state,
        layout=layout,
        method=method,
        estimate=estimate,
        held=(),
        prior_covariance=prior,
        unobservable=tuple(
            describe(direction, layout.names, layout.to_display)
            for direction in estimate.observability.null.T
        ),
        rejected=tuple(data.sample[i] for i in np.flatnonzero(estimate.rejected)),
        noise_m=estimate.scale * float(np.sqrt(np.mean(data.sigma**2))),
    )
