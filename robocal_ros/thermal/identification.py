# SPDX-License-Identifier: Apache-2.0
"""How a robot's parameters drift in time: the prior of the tracker."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import (
    SPREAD_POSES,
    Judgement,
    gross,
    judge,
    judged_errors_document,
    summarise,
    too_narrow,
    verdict_document,
)
from robocal_ros.estimation.estimation import Observability, chi2_quantile, describe, observability
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RankDeficientError, TooFewSamplesError
from robocal_ros.ground.frames import Array, Document, Index
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.judged import cell_document
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import parameters_document, random_postures
from robocal_ros.thermal.reference import SETUP_SIGMA_M, ColdSpots, visit_variance

EXPANSION_PER_K = 12e-6  # steel and cast iron; aluminium links drift up to twice as much
PLAUSIBLE_WARMING_K = 20.0
SMALLEST_LENGTH_M = 0.2  # a joint whose nominal length is zero still has a housing that grows
DRIFT_ANGLE_RAD = float(np.radians(0.005))
DEFAULT_WEIGHT = 10.0  # the default prior counts as so many identified drifts


def drift_prior(arm: SerialArm) -> Array:
    """Covariance (k, k), SI, of the free parameters' thermal drift before it is learned.

    Lengths: link length times expansion coefficient times plausible warming; angles: a fixed
    small value.
    """
    length = np.maximum(np.abs(arm.parameters.read(arm.mdh)), SMALLEST_LENGTH_M)
    grown = length * EXPANSION_PER_K * PLAUSIBLE_WARMING_K
    return np.diag(np.where(arm.parameters.is_length, grown, DRIFT_ANGLE_RAD) ** 2)


def learned_prior(default: Array, drifts: Array, covariances: Array) -> Array:
    """Covariance (k, k) of the drift from identified ones.

    ``default`` (k, k): prior to start from. ``drifts``, ``covariances`` (n, k): identified drifts
    against the cold reference and their (n, k, k) covariances.

    One expectation-maximisation step of a zero-mean Gaussian's covariance with the default as
    its inverse-Wishart prior: the second moment of each drift is its square plus its covariance,
    so that what the measurements never showed keeps its default.
    """
    moments = np.einsum("ni,nj->ij", drifts, drifts) + covariances.sum(axis=0)
    return np.asarray((DEFAULT_WEIGHT * default + moments) / (DEFAULT_WEIGHT + len(drifts)))


# Many cycles at once: all visit the same poses, so that one decomposition serves them all.
_VISIBLE = 1e-6  # share of an undetermined direction that counts as being in it


@dataclass(frozen=True, eq=False)
class SubsetDrift:
    """Drift of p chosen parameters in t cycles.

    ``chosen`` (p,): columns of the parameters. ``drift`` (t, p): since the cold visit, SI.
    ``basis`` (3m, p): orthonormal, of the displacements that the chosen parameters can cause.
    ``inverse`` (p, p): from coordinates in that basis to parameters.
    """

    chosen: Index
    drift: Array
    basis: Array
    inverse: Array

    @property
    def gain(self) -> Array:
        """(p,) standard deviation of each per unit of noise in a coordinate of a displacement."""
        return np.asarray(np.linalg.norm(self.inverse, axis=1))

    @property
    def size(self) -> Array:
        """(p,) rms drift per standard deviation that a unit of noise would give it."""
        return np.asarray(np.sqrt(np.mean(self.drift**2, axis=0)) / self.gain)


def subset_drift(
    displacement: Array, rows: Array, chosen: Sequence[int], names: tuple[str, ...]
) -> SubsetDrift:
    """Solve Y = A X for some columns of A by singular values (thesis eq. 3-8 to 3-10).

    ``displacement`` (t, 3m): of the spots since the cold visit, m, measuring axes. ``rows`` (3m,
    k): the same by each parameter, measuring axes. ``chosen``: columns that may drift; the others
    are held. ``names`` (k,): of all parameters.

    Raises `TooFewSamplesError` with fewer equations than chosen parameters; `RankDeficientError`
    when the poses do not tell the chosen parameters apart.
    """
    columns = np.array(chosen, dtype=np.int64)
    A = rows[:, columns]
    if A.shape[0] < A.shape[1]:
        raise TooFewSamplesError(
            f"{A.shape[0] // 3} poses give {A.shape[0]} equations for {A.shape[1]} parameters: "
            "measure more"
        )
    words = open_directions(rows, chosen, names)
    if words:
        raise RankDeficientError(f"not determined by these poses: {'; '.join(words)}", words)
    length = np.linalg.norm(A, axis=0)
    U, s, Vt = np.linalg.svd(A / length, full_matrices=False)
    inverse = (Vt.T / s) / length[:, None]
    return SubsetDrift(columns, displacement @ U @ inverse.T, U, inverse)


def open_directions(rows: Array, chosen: Sequence[int], names: tuple[str, ...]) -> tuple[str, ...]:
    """What (n, k) rows leave open among chosen columns, in words; weights as they displace."""
    null, own = _null(rows, chosen), tuple(names[i] for i in chosen)
    return tuple(describe(direction, own) for direction in null.T)


def entangled(rows: Array, chosen: Sequence[int]) -> tuple[int, ...]:
    """Those chosen columns of (n, k) rows that the others reproduce; none where all are determined.

    Leaving one of them out takes nothing from what the rest can explain.
    """
    null = np.abs(_null(rows, chosen))
    inside = np.any(null > _VISIBLE * null.max(axis=0, initial=0.0), axis=1)
    return tuple(column for column, member in zip(chosen, inside, strict=True) if member)


def _null(rows: Array, chosen: Sequence[int]) -> Array:
    """Open directions (p, r) of chosen columns, in units of what each column displaces."""
    A = rows[:, list(chosen)]
    length = np.linalg.norm(A, axis=0)
    return observability(A).null * np.where(length > 0.0, length, 1.0)[:, None]


# With ``y ~ N(0, S)`` the error of forecasting part i from the rest is ``(S^-1)_ii^-1 (S^-1
# y)_i``, and its covariance is ``(S^-1)_ii^-1`` (Rasmussen and Williams 2006, section 5.4.2).
FALSE_SAMPLE = 0.001  # chance that a sound cycle loses a sample


def agreeing(y: Array, S: Array, count: int) -> NDArray[np.bool_]:
    """Which of ``count`` samples of three coordinates fit what all others say of them.

    The worst is left out until all fit. ``y`` (3 count,), ``S`` (3 count, 3 count).
    """
    keep = np.ones(count, dtype=np.bool_)
    limit = chi2_quantile(1.0 - FALSE_SAMPLE / count, 3)
    while np.sum(keep) > 1:
        rows = np.repeat(keep, 3)
        pull, own = _parts(y[rows], S[np.ix_(rows, rows)])
        squared = np.einsum("mi,mi->m", pull, np.linalg.solve(own, pull[..., None])[..., 0])
        worst = int(np.argmax(squared))
        if squared[worst] <= limit:
            break
        keep[np.flatnonzero(keep)[worst]] = False
    return keep


def left_out(y: Array, S: Array, keep: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Error (m, 3) at each sample of the forecast from the others, and its rms length (m,)."""
    rows, count = np.repeat(keep, 3), len(keep)
    error, spread = np.empty((count, 3)), np.empty(count)
    pull, own = _parts(y[rows], S[np.ix_(rows, rows)])
    covariance = np.linalg.inv(own)
    error[keep] = (covariance @ pull[..., None])[..., 0]
    spread[keep] = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    if not np.all(keep):  # those left out are forecast from all that are kept
        gain = np.linalg.solve(S[np.ix_(rows, rows)], S[np.ix_(rows, ~rows)]).T
        error[~keep] = (y[~rows] - gain @ y[rows]).reshape(-1, 3)
        rest = S[np.ix_(~rows, ~rows)] - gain @ S[np.ix_(rows, ~rows)]
        spread[~keep] = np.sqrt(np.diag(rest).reshape(-1, 3).sum(axis=1))
    return error, spread


def _parts(y: Array, S: Array) -> tuple[Array, Array]:
    """Parts (m, 3) of S^-1 y and diagonal blocks (m, 3, 3) of S^-1."""
    inverse = np.linalg.inv(S)
    count = len(y) // 3
    blocks = inverse.reshape(count, 3, count, 3)
    each = np.arange(count)
    return np.asarray((inverse @ y).reshape(count, 3)), np.asarray(blocks[each, :, each])


FEWEST_POSES = 2


@dataclass(frozen=True, eq=False)
class CycleDrift:
    """A drift identified from one cycle.

    ``drift``, ``covariance``: (k,) of the free parameters since the cold visit, and (k, k), SI.
    ``prior_covariance`` (k, k): of the drift before the cycle; None where there was none. ``arm``:
    the cold arm with the drift added. ``warm``: the visits, those of one pose averaged; m of them.
    ``left_out`` (m, 3): displacement at each sample less what all other samples say of it, m.
    ``left_out_sigma`` (m,): rms length of the same that the covariances predict, m. ``rejected``
    (m,): samples that the others contradict. ``noise_m``: rms standard deviation of a coordinate of
    the visits. ``seen``, ``unobservable``: what the data alone determine, and what not, in words.
    """

    drift: Array
    covariance: Array
    prior_covariance: Array | None
    arm: SerialArm
    warm: Measurements
    left_out: Array
    left_out_sigma: Array
    rejected: NDArray[np.bool_]
    noise_m: float
    seen: Observability
    unobservable: tuple[str, ...]


def identify_cycle(
    spots: ColdSpots,
    warm: Measurements,
    *,
    prior_covariance: Array,
    sigma_m: float,
    setup_sigma_m: float = SETUP_SIGMA_M,
) -> CycleDrift:
    """Identify all free parameters from one cycle.

    Visits of one pose are averaged first: they share the noise of its cold visit, and none may
    judge another.

    ``prior_covariance``: (k, k), SI, of the drift since the cold visit.
    ``sigma_m``: standard deviation of one coordinate of one visit, of the cold ones and of warm
    ones without a sigma of their own.

    Raises `InputError` when a sample has no cold counterpart; `TooFewSamplesError` with fewer than
    two poses.
    """
    warm = spots.average(warm, sigma_m)
    if len(warm) < FEWEST_POSES:
        raise TooFewSamplesError("one pose cannot show a drift: measure at least five")
    spot, arm = spots.match(warm), spots.cell.arm
    y = spots.drift(warm).ravel()
    parameters, setup = spots.rows(warm.q, spots.target[spot])
    A, B = parameters.reshape(len(y), -1), setup.reshape(len(y), -1)
    variance = visit_variance(spots, spot, warm, sigma_m)
    R = np.diag(np.repeat(variance, 3)) + setup_sigma_m**2 * B @ B.T
    S = A @ prior_covariance @ A.T + R
    keep = agreeing(y, S, len(warm))
    rows = np.repeat(keep, 3)
    gain = np.linalg.solve(S[np.ix_(rows, rows)], A[rows] @ prior_covariance).T
    drift = gain @ y[rows]
    covariance = prior_covariance - gain @ A[rows] @ prior_covariance
    miss, spread = left_out(y, S, keep)
    chosen, seen = arm.parameters, observability(A[rows])
    words = (describe(column, chosen.names, chosen.to_display) for column in seen.null.T)
    return CycleDrift(
        drift=drift,
        covariance=0.5 * (covariance + covariance.T),
        prior_covariance=prior_covariance,
        arm=arm.with_mdh(chosen.add(arm.mdh, drift)),
        warm=warm,
        left_out=miss,
        left_out_sigma=spread,
        rejected=~keep,
        noise_m=float(np.sqrt(variance.mean())),
        seen=seen,
        unobservable=tuple(words),
    )


def require_parameters(arm: SerialArm, names: Sequence[str]) -> None:
    """Refuse names that are not free parameters of ``arm``.

    Raises `InputError`, naming the first of them, and those that there are.
    """
    unknown = [name for name in names if name not in arm.parameters.names]
    if unknown:
        raise InputError(
            f"unknown parameter '{unknown[0]}'; this model has {', '.join(arm.parameters.names)}"
        )


def identify_subset(
    spots: ColdSpots, warm: Measurements, names: Sequence[str], *, sigma_m: float
) -> CycleDrift:
    """Identify some parameters by least squares and hold the others (thesis eq. 3-8 to 3-10).

    Raises `InputError` when a name is unknown, or a sample has no cold counterpart;
    `TooFewSamplesError` or `RankDeficientError` when the poses cannot answer.
    """
    warm = spots.average(warm, sigma_m)
    spot, arm = spots.match(warm), spots.cell.arm
    require_parameters(arm, names)
    rows = spots.rows(warm.q, spots.target[spot])[0].reshape(3 * len(warm), -1)
    chosen = [i for i, name in enumerate(arm.parameters.names) if name in names]
    y = spots.drift(warm).ravel()
    fit = subset_drift(y[None], rows, chosen, arm.parameters.names)
    if len(y) < len(chosen) + 3:
        raise TooFewSamplesError(
            f"{len(warm)} poses give {len(y)} equations for {len(chosen)} parameters, and without "
            "any of them the others must still determine all: measure more"
        )
    variance = float(visit_variance(spots, spot, warm, sigma_m).mean())
    drift, covariance = np.zeros(rows.shape[1]), np.zeros((rows.shape[1],) * 2)
    drift[chosen] = fit.drift[0]
    covariance[np.ix_(chosen, chosen)] = variance * fit.inverse @ fit.inverse.T
    left, spread = _forecasts(y, fit.basis, variance)
    return CycleDrift(
        drift=drift,
        covariance=covariance,
        prior_covariance=None,
        arm=arm.with_mdh(arm.parameters.add(arm.mdh, drift)),
        warm=warm,
        left_out=left,
        left_out_sigma=spread,
        rejected=np.zeros(len(warm), dtype=np.bool_),
        noise_m=float(np.sqrt(variance)),
        seen=observability(rows[:, chosen]),
        unobservable=(),
    )


def _forecasts(y: Array, basis: Array, variance: float) -> tuple[Array, Array]:
    """Each pose less its forecast from the others (m, 3), and its rms length (m,); by leverage."""
    residual = (y - basis @ (basis.T @ y)).reshape(-1, 3)
    rows = basis.reshape(len(residual), 3, -1)
    own = np.linalg.inv(np.eye(3) - rows @ np.swapaxes(rows, 1, 2))
    spread = np.sqrt(variance * np.trace(own, axis1=1, axis2=2))
    return np.einsum("mij,mj->mi", own, residual), spread


# A step that the drift cannot explain is compared with few simple causes, each a linear model of
# the displacement; generalised least squares tells which of them leave no more than noise.
SENSOR = "sensor"
CHANCE = 0.01  # a cause is ruled out where it would leave so much in fewer cases than this
FIXED_FALSE_ALARM = 0.001
SENSOR_WANDER_M = 1e-5  # a sensor that warms up moves by so much without a knock


@dataclass(frozen=True)
class Cause:
    """Something that may have moved.

    ``name``: ``sensor`` (or the robot's base, which looks the same), ``sphere``, or a joint's name;
    of a measuring robot ``spheres`` (or the base), and ``mounting`` of the sensor.
    ``words``: what moved and by how much.
    """

    name: str
    words: str


@dataclass(frozen=True, eq=False)
class FixedSphere:
    """How a sphere that is fixed in the cell has moved since the cold visit.

    ``shift_m`` (3,): in the measuring frame.
    ``moved``: whether by more than noise and the sensor's own wander allow.
    """

    shift_m: Array
    moved: bool


def fixed_sphere(cold: Array, now: Array, sigma_m: float) -> FixedSphere:
    """Compare measured centres (n, 3) of a fixed sphere; ``sigma_m`` of one coordinate of one.

    Medians: a wrong one among three or more does no harm.
    """
    shift = np.median(now, axis=0) - np.median(cold, axis=0)
    each = [(1.0 if len(p) < 3 else np.pi / 2.0) / len(p) for p in (cold, now)]
    variance = sigma_m**2 * sum(each) + SENSOR_WANDER_M**2
    limit = chi2_quantile(1.0 - FIXED_FALSE_ALARM, 3)
    return FixedSphere(shift, bool(shift @ shift > limit * variance))


def possible_causes(
    spots: ColdSpots, warm: Measurements, deviation: Array, covariance: Array
) -> tuple[Cause, ...]:
    """Single causes that explain a deviation (3m,) of covariance (3m, 3m), measuring axes.

    Few poses leave many causes possible.
    """
    target = spots.target[spots.match(warm)]
    parameters, setup = spots.rows(warm.q, target)
    world, own = setup[:, :, :3], setup[:, :, 3:]
    if spots.on_flange:  # a single sphere shows no turn of the cell, each pose one of the sensor
        seen = spots.cell.T_flange_target[target, :3, 3]
        own = np.concatenate([own, -own @ frames.skew(seen)], axis=2)
        moving = (
            ("spheres", "spheres and robot base moved against each other", world),
            ("mounting", "the sensor moved on the flange", own),
        )
    else:
        lever = warm.position - warm.position.mean(axis=0)
        world = np.concatenate([world, -frames.skew(lever)], axis=2)
        moving = (
            (SENSOR, "sensor and robot base moved against each other", world),
            ("sphere", "the sphere moved on the flange", own),
        )
    found = []
    for name, words, rows in moving:
        if (moved := _explains(rows, deviation, covariance)) is not None:
            by = f"{np.linalg.norm(moved[:3]) * 1e3:.2f} mm"
            if len(moved) > 3:
                by += f" and {np.degrees(np.linalg.norm(moved[3:])):.3f} deg"
            found.append(Cause(name, f"{words} by {by}"))
    arm = spots.cell.arm
    names, to_display = arm.parameters.names, arm.parameters.to_display
    for i, joint in enumerate(arm.joint_names, start=1):
        kind, unit = ("d", "mm") if arm.prismatic[i - 1] else ("theta", "deg")
        if (zero := f"{kind}{i}_{unit}") not in names:
            continue
        place = names.index(zero)
        if (moved := _explains(parameters[:, :, [place]], deviation, covariance)) is not None:
            by = f"{to_display[place] * moved[0]:.4f} {unit}"
            found.append(Cause(joint, f"the zero of {joint} changed by {by}"))
    return tuple(found)


def step_words(causes: Sequence[Cause], fixed: FixedSphere | None) -> str:
    """Say what moved, what cannot be told, and what would decide."""
    if fixed is not None and fixed.moved:
        by = f"{np.linalg.norm(fixed.shift_m) * 1e3:.2f} mm"
        return (
            f"the fixed sphere seems to have moved by {by}, so the sensor did: fasten it, then "
            "capture a new cold reference"
        )
    said = "" if fixed is None else "the fixed sphere stands where it was, so the sensor too; "
    if causes:
        said += "or ".join(f"{cause.words}; " for cause in causes)
        said += "the data cannot tell these apart; " if len(causes) > 1 else ""
    else:
        said += "no single cause explains it; "
    if fixed is None and any(cause.name == SENSOR for cause in causes):
        said += (
            "a second sphere, fixed to the floor or the base and measured as "
            "reference_sphere_center, would decide; "
        )
    return f"{said}look at sensor, sphere and robot, then calibrate or capture a new cold reference"


def _explains(rows: Array, deviation: Array, covariance: Array) -> Array | None:
    """Size (h,) of a cause with rows (m, 3, h) that leaves only noise; None where it leaves more.

    Generalised least squares; what is left over is chi-square of 3m - h where the cause is true.
    """
    G = rows.reshape(len(deviation), -1)
    freedom = len(deviation) - G.shape[1]
    L = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(L, np.column_stack([G, deviation]))
    size, *_ = np.linalg.lstsq(whitened[:, :-1], whitened[:, -1], rcond=None)
    left = whitened[:, -1] - whitened[:, :-1] @ size
    if freedom > 0 and left @ left > chi2_quantile(1.0 - CHANCE, freedom):
        return None
    return np.asarray(size)


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
    Poses that halve the prior's error throughout the workspace carry over to it, however small
    the change: the model in force came from such poses too and is no better known elsewhere.
    """
    chosen, cold, spot = spots.cell.arm.parameters, spots.cell.arm, spots.match(data)
    A = spots.rows(data.q, spots.target[spot])[0]
    sound = usable & ~gross(current, after)
    # of the first target by the parameters, throughout the joint limits
    q = random_postures(cold)
    rows = spots.rows(q, np.zeros(len(q), dtype=np.int64))[0]
    moved = rows @ (found.drift - chosen.read(in_force.mdh - cold.mdh))
    change = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
    workspace_rms_m, prior = _rms(rows, found.covariance), found.prior_covariance
    doubt = ""
    if prior is None or workspace_rms_m > 0.5 * _rms(rows, prior):
        current_rms_m = summarise(current[sound]).rms_m
        doubt = too_narrow(workspace_rms_m, change, current_rms_m, SPREAD_POSES)
    return Judgement(
        nominal=summarise(np.linalg.norm(spots.drift(data), axis=1)[sound]),
        current=summarise(current[sound]),
        candidate=summarise(after[sound]),
        predicted_rms_m=_rms(A, found.covariance),
        predicted_total_rms_m=float(np.sqrt(np.mean(spread[sound] ** 2))),
        workspace_rms_m=workspace_rms_m,
        held_out_rejected=tuple(data.sample[i] for i in np.flatnonzero(~sound)),
        verdict=judge(current[sound], after[sound], spots.pose[spot][sound], doubt),
    )


def _rms(rows: Array, covariance: Array) -> float:
    """Rms length, m, of what a covariance (k, k) does to points with rows (m, 3, k)."""
    return float(np.sqrt(np.mean(np.einsum("mik,kl,mil->m", rows, covariance, rows))))
