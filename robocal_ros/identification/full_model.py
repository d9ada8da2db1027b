# SPDX-License-Identifier: Apache-2.0
"""The full model of an arm: geometry, joint functions and compliances, base and targets together.

Begins with the geometric model (`solve.identify`); then all of it in one robust weighted least
squares, whose prior the evidence chooses. Samples are judged with the functions in: what the
geometry alone misses is no outlier, and what no function explains is not learned.
"""

from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from robocal_ros.estimation.assessment import pose_groups
from robocal_ros.estimation.estimation import FALSE_REJECTION, chi2_quantile
from robocal_ros.ground.errors import RankDeficientError, TooFewSamplesError
from robocal_ros.ground.frames import Array, Index, Mask
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell_model import CellModel, CellProblem, Part
from robocal_ros.identification.joint_functions import (
    EVIDENCE_NEEDED,
    FunctionPrior,
    JointEvidence,
    JointTerms,
    Posterior,
)
from robocal_ros.identification.known_model import (
    FREE,
    KnownModel,
    Rows,
    centred,
    gravity_torque,
    identified_from,
    sparse,
    with_turns,
)
from robocal_ros.identification.solve import BOUND, Identification, Method, identify
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_functions import ArmLoad

_ROBUST_ROUNDS = 2  # by Huber's loss; the first judges samples by the geometry alone
# Huber's loss still lets one that is off by 0.1 m tell more than many sound ones: beyond 8 sigma a
# sample waits until there is a model that says what it should be.
GROSS_WEIGHT = 1.0 / 3.0
# The evidence trusts a noise that is normal and alike everywhere; errors at poses left out do not:
# these must fall, and clearly up to so many poses, which also outnumber the other unknowns.
GAIN, MANY_POSES, CLEAR_GAIN, FEWEST_NUMBERS = 0.97, 100, 0.8, 1.25
INNER, INNER_SQUARES = 0.99, 2.894  # mean of chi-square of 3 below its quantile of 0.99
FOLDS = 5  # of few poses, each of which the others must foretell
CHOSEN_ANEW = 200  # poses, up to which what is stated counts what was chosen for them, too
SMALLEST_SHARE = 0.1  # of the noise that a real robot's geometry leaves: 0.15 to 0.2 are seen
# A half of a logarithm for each number that is chosen (Wilks 1938): amplitude and length.
GAINED_BY_CHANCE = 1.0
_FREE_ROUNDS = 2  # in which a rejected sample may come back
_ROUNDS, SETTLED = 12, 0.05  # of solving and judging the samples anew; share of the noise
MOST_LEVERAGE = 1.0 - SETTLED**2  # so that what is not settled is one sigma of an error left out


@dataclass(frozen=True)
class FullIdentification(Identification):
    """An identification with joint functions and compliances.

    Attributes
    ----------
    known : how well all of it is known.
    gain : (n,) evidence for each joint's function, natural logarithm.
    left_out_rms_m : rms error at measured poses, each left out in turn.
    """

    known: KnownModel
    gain: Array
    left_out_rms_m: float

    def predicted_variance(self, q: Array, target: Index, without: Collection[Part] = ()) -> Array:
        """Covariance (m, 3, 3), m^2, of the predicted target positions.

        Where a joint was not measured its function is zero, give or take the prior.
        """
        return self.known.predicted_variance(q, target, without)


@dataclass(frozen=True)
class _Solution:
    """Where the rounds stand: solved for ``rows``, with residuals ``linear`` (m, c) by these."""

    cell: CellModel
    terms: JointTerms
    prior: FunctionPrior
    posterior: Posterior | None = None
    linear: Array | None = None
    rows: Rows | None = None

    def settled(self, residual: Array) -> bool:
        """Whether residuals (m, c) are those of the linear model, but for a part of the noise."""
        assert self.linear is not None
        return bool(np.std(residual - self.linear) < SETTLED * self.prior.noise)


class _FullProblem:
    """All unknowns against the measurements; a wide ``CellProblem`` linearises the dense part."""

    def __init__(self, start: Identification, data: Measurements, lever_m: float) -> None:
        self.start, self.data = start, data
        self.layout = start.layout
        sigma = np.ones(len(data)) if data.sigma is None else data.sigma
        wide, self.turns = with_turns(start.layout, start.nominal)
        self.problem = CellProblem(wide, data, start.cell.targets, sigma, lever_m, start.nominal)

    def linearise(self, cell: CellModel, terms: JointTerms) -> tuple[Array, Rows]:
        residual, J = self.problem.linearise(cell)
        by_turn = J[:, :, self.turns] * cell.arm.sign
        dense = J[:, :, : len(self.layout.names)]
        return residual, sparse(terms, cell.arm, self.data.q, residual, dense, by_turn)

    def values(self, cell: CellModel, terms: JointTerms) -> Array:
        """All unknowns (k,), from the mean of their prior; of the base zeros."""
        away = self.problem.deviation(cell)[: len(self.layout.names)]
        return np.concatenate([away, terms.values(cell.arm.functions)])

    def moved(self, cell: CellModel, terms: JointTerms, values: Array) -> CellModel:
        """The cell model with these unknowns (k,)."""
        step = values - self.values(cell, terms)
        cell = self.layout.retract(cell, step[: terms.before])
        arm = cell.arm
        return replace(cell, arm=arm.with_model(arm.mdh, terms.functions(values), arm.load))

    def evidence(self, at: _Solution, residual: Array, rows: Rows, weight: Array) -> JointEvidence:
        from scipy.linalg import block_diag

        from robocal_ros.identification import row_kernels

        k = at.terms.size
        normal, pull = np.zeros((k, k)), np.zeros(k)
        row_kernels.normal_equations(rows.J, rows.column, -residual, weight, normal, pull)
        x = self.values(at.cell, at.terms)
        squares = float(weight @ np.sum(residual**2, axis=1) + 2.0 * pull @ x + x @ normal @ x)
        flat = np.zeros(k, dtype=np.bool_)
        flat[: at.terms.before] = True
        start = self.start
        fixed: Array = np.zeros((0, 0))
        if start.prior_covariance is not None:
            fixed = np.asarray(np.linalg.cholesky(start.prior_covariance))
            flat[: len(fixed)] = False
        if start.target_reach_m is not None:
            place = start.layout.tool_places
            fixed = block_diag(fixed, start.target_reach_m * np.eye(len(place)))
            flat[place] = False
        return JointEvidence(
            terms=at.terms,
            normal=normal,
            pull=pull + normal @ x,
            squares=squares,
            count=3.0 * float(np.sum(weight)) * (1.0 + _turn_share(residual)),
            flat=flat,
            fixed=fixed,
            noise_least=self.noise_least,
        )

    @property
    def noise_least(self) -> float:
        """Few poses can be met exactly: their noise is not taken to be functions for the most."""
        if self.data.sigma is not None:
            return 1.0
        return SMALLEST_SHARE * self.start.estimate.scale if self.poses <= MANY_POSES else 0.0

    @cached_property
    def limit(self) -> float:
        """Squared length of a residual, over its covariance, beyond which it is an outlier."""
        components = self.problem.layout.tool_size if self.data.rotation is not None else 3
        return chi2_quantile(1.0 - FALSE_REJECTION / len(self.data), components)

    def robust_weight(self, residual: Array) -> Array:
        """Huber's weights (m,), from the median of the positions' residuals."""
        squared = np.sum(residual[:, :3] ** 2, axis=1)
        scale = np.sqrt(float(np.median(squared)) / chi2_quantile(0.5, 3))
        length = np.sqrt(np.sum(residual**2, axis=1))
        bend = scale * np.sqrt(chi2_quantile(0.95, residual.shape[1]))
        return np.asarray(np.minimum(1.0, bend / np.maximum(length, np.finfo(float).tiny)))

    @cached_property
    def pose(self) -> Index:
        """Number (m,) of each sample's pose: visits of one pose share it."""
        return pose_groups(self.data.q)

    @property
    def poses(self) -> int:
        """How many poses there are, however often each was measured."""
        return 1 + int(self.pose.max())

    @cached_property
    def visit(self) -> Index:
        """Number (m,) of each sample's pose and target."""
        target = self.data.target_index(self.start.cell.targets)
        own = self.pose * (1 + int(target.max())) + target
        return np.asarray(np.unique(own, return_inverse=True)[1])

    def visit_share(self, residual: Array, weight: Array) -> Array:
        """What each visit (m,) of a pose tells, of one sample, when ``weight`` (m,) are in use.

        What no model explains comes back at each visit: n residuals that correlate by rho tell as
        much as n / (1 + (n - 1) rho) that do not.
        """
        used = weight[:, None] * residual[:, :3]
        visits = np.bincount(self.pose, weight > 0.0)
        total = np.stack([np.bincount(self.pose, axis) for axis in used.T], axis=1)
        own, pairs = np.sum(used**2), np.sum(visits * (visits - 1.0))
        rho = 0.0
        if pairs and own:
            shared = (np.sum(total**2) - own) / pairs
            each = own / float(np.sum(weight > 0.0))
            rho = float(np.clip(shared / each, 0.0, 1.0))
        return np.asarray(1.0 / (1.0 + np.maximum(visits[self.pose] - 1.0, 0.0) * rho))

    def left_out(self, at: _Solution, weight: Array) -> tuple[Array, Array]:
        """Residuals (m, c) of a fit without each sample's own pose, and their covariances.

        By the fit with it, of Gaussian unknowns (`weight` zero: it was not in use): what visits of
        a pose have in common pulled the fit towards them. Rows and covariance are of one linear
        model, for a step along what is hardly known changes rows by more than is known of them.
        """
        from robocal_ros.identification import row_kernels

        assert at.posterior is not None
        assert at.linear is not None
        assert at.rows is not None
        residual, rows = at.linear, at.rows
        m, c = residual.shape
        spread = np.empty((m, c, c))
        row_kernels.spreads(rows.J, rows.column, at.posterior.covariance, spread)
        variance = at.prior.noise**2
        total = np.bincount(self.pose, weight)[self.pose]
        own = variance / np.where(total > 0.0, total, 1.0)
        size, axes = np.linalg.eigh(spread)
        used = (weight > 0.0)[:, None]
        leverage = np.where(used, np.minimum(size / own[:, None], MOST_LEVERAGE), 0.0)
        pulled, turned = leverage / (1.0 - leverage), np.swapaxes(axes, 1, 2)
        share = weight / np.maximum(np.bincount(self.visit, weight)[self.visit], 1e-300)
        mean = np.stack([np.bincount(self.visit, share * r) for r in residual.T], axis=1)
        error = (
            residual + (axes @ (pulled[..., None] * (turned @ mean[self.visit][..., None])))[..., 0]
        )
        left = np.where(used, own[:, None] * pulled, size) + variance
        return error, np.asarray((axes * left[:, None]) @ turned)

    def geometric_left_out(self) -> float:
        """The same of the geometric model: rms error, m, at poses left out one by one."""
        start = self.start
        none = np.zeros(start.nominal.n, dtype=np.bool_)
        zeros = np.zeros(start.nominal.n)
        terms = JointTerms(
            len(self.layout.names), zeros, zeros + 1.0, zeros.astype(np.int64), none, zeros
        )
        residual, rows = self.linearise(start.cell, terms)
        prior = FunctionPrior(zeros, zeros, start.estimate.scale)
        posterior = Posterior(zeros, start.estimate.covariance, zeros, zeros, 0.0)
        weight = np.where(start.estimate.rejected, 0.0, 1.0)
        weight *= self.visit_share(residual, weight)
        at = _Solution(start.cell, terms, prior, posterior, residual, rows)
        return self.rms(self.left_out(at, weight)[0])

    def rms(self, error: Array) -> float:
        """Rms length, m, of position errors (m, c), by Huber's loss."""
        weight = self.robust_weight(error)
        return float(np.sqrt(weight @ np.sum(error[:, :3] ** 2, axis=1) / np.sum(weight)))

    def inliers(self, error: Array, expected: Array) -> Mask:
        """Samples (m,) that a fit without them predicts as well as it says; at least half."""
        squared = _squared(error, expected)
        return np.asarray(squared <= max(self.limit, float(np.median(squared))))


def _squared(error: Array, expected: Array) -> Array:
    """Squared length (m,) of errors (m, c) over their covariances (m, c, c)."""
    whitened = np.linalg.solve(expected, error[..., None])[..., 0]
    return np.asarray(np.sum(error * whitened, axis=1))


def _turn_share(residual: Array) -> float:
    """How much orientations scatter, in units of positions: they count by so much as numbers.

    They are given less weight than their noise would allow (`solve._solve`), and so would tell a
    noise that is too small.
    """
    if residual.shape[1] == 3:
        return 0.0
    squared = residual**2
    turn, shift = (float(np.median(np.sum(squared[:, s], axis=1))) for s in (np.s_[3:], np.s_[:3]))
    return min(1.0, turn / shift) if shift > 0.0 else 1.0


def without_masses(arm: SerialArm, found: Identification) -> str:
    """Say what was done where the arm's masses are not known, and what they would give; or empty.

    ``found``: by `identify_full` of this arm.
    """
    if arm.load is not None and not arm.load.found:
        return ""
    sought = (
        "1 kg at the flange of an upright arm" if arm.load is None else "those that it calls found"
    )
    told = (
        "none was worth it; an arm on a wall or a ceiling needs gravity_m_s2, and with masses it "
        "is sought better"
    )
    if found.cell.arm.masses:
        told = (
            "that holds for the payload and the mounting that were measured; with masses it holds "
            "for others too, and leaves less"
        )
    return (
        "the robot file has no masses of the links, so compliances were sought with "
        f"{sought}: {told}; add the masses and centres of the links, and the payload: a factor on "
        "all masses does no harm"
    )


def bare(arm: SerialArm) -> SerialArm:
    """Return the arm without joint functions."""
    return arm.with_model(arm.mdh, None, arm.load)


def identify_full(
    arm: SerialArm,
    data: Measurements,
    *,
    fit: Collection[Part] = ("base", "tool", "geometry"),
    method: Method = "map",
) -> Identification:
    """Identify the full model; functions and compliances only where the evidence wants them.

    Where it wants none, or the geometry is not in ``fit``, the answer is that of `identify`.
    Functions that ``arm`` has are found anew, or held where the data tell less of them.
    Without a ``load`` of the arm compliances are those of a mass at the flange (`ArmLoad.unknown`),
    which is the load of what is found.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        As `identify`.
    """
    if "geometry" not in fit:
        return identify(arm, data, fit=fit, method=method)
    full, rival = _solved(arm, data, fit, method)
    if full is None:
        return rival.start
    left_out, squared = full.left_out
    gain = GAIN if rival.poses > MANY_POSES else CLEAR_GAIN
    if left_out >= gain * rival.geometric_left_out():
        return rival.start
    if rival.poses <= CHOSEN_ANEW:
        foretold = _foretold(arm, data, fit, method, gain)
        if foretold is None:
            return rival.start
        squared = np.where(np.isnan(foretold), squared, foretold)
    stretch = _stretch(squared, full.keep)
    bound = bound_squared(squared, full.keep) / stretch**2
    return replace(full.reported(stretch), bound_squared=bound)


def _foretold(
    arm: SerialArm, data: Measurements, fit: Collection[Part], method: Method, gain: float
) -> Array | None:
    """Squared errors (m,), over their covariances, of full models of the poses of other folds.

    What the evidence chooses from few poses is chosen for these, too: a pose is left out of that
    as well. None where they do not foretell ``gain`` times as well as geometric models. NaN of
    targets of which the other folds have no pose: nothing foretells those.
    """
    errors: list[list[Array]] = [[], []]
    squared = np.full(len(data), np.nan)
    fold, target = pose_groups(data.q) % FOLDS, data.target_index(data.targets)
    for of_target in (target == i for i in range(len(data.targets))):
        if np.ptp(fold[of_target]) == 0:
            fold[of_target] = FOLDS
    for left_out in (fold == i for i in np.unique(fold[fold < FOLDS])):
        rest = data.take(left_out)
        try:
            full, rival = _solved(arm, data.take(~left_out), fit, method)
        except (TooFewSamplesError, RankDeficientError):
            return None
        chosen = rival.start if full is None else full.reported(1.0)
        for own, found in zip(errors, (chosen, rival.start), strict=True):
            own.append(found.cell.residual(rest))
        given = np.ones(len(rest)) if rest.sigma is None else rest.sigma
        noise = (chosen.estimate.scale * given) ** 2
        variance = chosen.predicted_variance(rest.q, rest.target_index(chosen.cell.targets))
        squared[left_out] = _squared(errors[0][-1], variance + noise[:, None, None] * np.eye(3))
    with_functions, without = (rival.rms(np.concatenate(own)) for own in errors)
    return squared if with_functions < gain * without else None


def _stretch(squared: Array, keep: Mask) -> float:
    """By how much sigmas grow, for left-out errors whose squares (m,) over covariances are given.

    Errors that no model explains have longer tails than the normal distribution: sigmas that fit
    their squares are too small for bounds of 95 %, those that fit bounds too large for the squares.
    Between the two, nearer to the bounds; the farthest in a hundred is left out of the squares. One
    in a hundred that was not kept (m,) is such a tail; more are of the tracker, off by any length.
    """
    inner = np.sort(squared[keep])[: int(np.ceil(INNER * len(squared)))]
    tail = np.sort(squared[~keep])[: int((1.0 - INNER) * len(squared))]
    by_squares = float(np.mean(inner)) / INNER_SQUARES
    by_bounds = float(np.quantile(np.append(squared[keep], tail), 0.95)) / chi2_quantile(0.95, 3)
    return float(max(1.0, (by_squares * by_bounds**2) ** (1.0 / 6.0)))


def bound_squared(squared: Array, keep: Mask) -> float:
    """What the square of a new error stays below in 95 % of cases, by those left out (m,).

    No normal distribution is asked for, only that a new pose is drawn as these were: it has any
    rank among the m + 1 with the same chance (split conformal prediction: Vovk, Gammerman and
    Shafer, Algorithmic Learning in a Random World, 2005; of samples left out in turn Barber,
    Candes, Ramdas and Tibshirani, Predictive inference with the jackknife+, Annals of Statistics
    49, 2021). Samples that are not kept (m,) have the highest ranks. Where the rank is theirs, or
    fewer than 19 have none such, it is the farthest one that is kept.

    Tails shorter than normal ones are chance: it is no less than normal errors have.
    """
    own = np.sort(squared[keep])
    rank = min(int(np.ceil(BOUND * (len(squared) + 1))), len(own))
    return max(float(own[rank - 1]), chi2_quantile(BOUND, 3))


def _solved(
    arm: SerialArm, data: Measurements, fit: Collection[Part], method: Method
) -> tuple["_Solved | None", _FullProblem]:
    """The full model, where the evidence wants one, and the problem of the geometric model."""
    start = replace(identify(bare(arm), data, fit=fit, method=method), nominal=arm)
    load = arm.load or ArmLoad.unknown(arm.n)
    data = replace(data, q=np.ascontiguousarray(data.q))
    problem = _FullProblem(start, data, start.lever_m)
    before, rival = len(start.layout.names), problem
    if arm.functions is not None:
        held = identify(arm, data, fit=fit, method=method)
        rival = min(
            problem, _FullProblem(held, data, held.lever_m), key=_FullProblem.geometric_left_out
        )
    told = 3.0 * (1 + int(problem.visit.max()))
    if told < FEWEST_NUMBERS * before or start.estimate.creeping:
        return None, rival
    try:
        return _by_rounds(problem, load), rival
    except np.linalg.LinAlgError:  # data without noise, of which rounding alone is left
        return None, rival


def _by_rounds(problem: _FullProblem, load: ArmLoad) -> "_Solved | None":
    """The full model, of an arm with this load, where the evidence wants one."""
    start, q = problem.start, problem.data.q
    before, arm = len(start.layout.names), start.cell.arm
    torque = gravity_torque(replace(start.nominal, load=load), q)
    at = _Solution(
        replace(start.cell, arm=arm.with_model(arm.mdh, None, load)),
        JointTerms.cover(q, torque, before, coarse=True),
        FunctionPrior.typical(start.nominal.n, start.estimate.scale),
    )
    for _ in range(_ROBUST_ROUNDS):
        residual, rows = problem.linearise(at.cell, at.terms)
        weight = problem.robust_weight(residual)
        weight[weight < GROSS_WEIGHT] = 0.0
        weight *= problem.visit_share(residual, weight)
        at = _round(problem, at, residual, rows, weight)
    keep = problem.inliers(*problem.left_out(at, weight))
    functions, bends = _unwanted(at)
    terms = JointTerms.cover(q, torque, before).without(functions, bends)
    if terms.size == before:
        return None
    amplitude = np.where(functions, 0.0, at.prior.amplitude)
    rigid = replace(at.cell, arm=bare(at.cell.arm))
    at = _Solution(rigid, terms, replace(at.prior, amplitude=amplitude))
    residual, rows = problem.linearise(at.cell, at.terms)
    for attempt in range(_ROUNDS):
        weight = keep * problem.visit_share(residual, keep.astype(np.float64))
        at = _round(problem, at, residual, rows, weight)
        residual, rows = problem.linearise(at.cell, at.terms)
        last, keep = keep, problem.inliers(*problem.left_out(at, weight))
        if attempt >= _FREE_ROUNDS:  # a sample at the limit must not come and go for ever
            keep &= last
        if 2 * np.sum(keep) < len(keep):
            return None
        if np.array_equal(last, keep) and at.settled(residual):
            break
    return _Solved(problem, at, last, weight, residual)


def _round(
    problem: _FullProblem, at: _Solution, residual: Array, rows: Rows, weight: Array
) -> _Solution:
    evidence = problem.evidence(at, residual, rows, weight)
    prior, posterior = evidence.maximise(at.prior)
    cell = problem.moved(at.cell, at.terms, posterior.mean)
    step = np.append(posterior.mean - problem.values(at.cell, at.terms), 0.0)  # of column -1
    linear = residual + np.einsum("mch,mh->mc", rows.J, step[rows.column])
    return _Solution(cell, at.terms, prior, posterior, linear, rows)


def _unwanted(at: _Solution) -> tuple[Mask, Mask]:
    """Joints (n,) whose function, and whose compliance, the evidence does not want.

    No compliance is below zero. Functions must show together that there are any, less what their
    amplitudes and lengths, being the likeliest, gain by chance; then of each it suffices that it is
    more likely there than not.
    """
    assert at.posterior is not None
    posterior, terms = at.posterior, at.terms
    gain = posterior.gain
    shown = float(np.sum(np.maximum(gain - GAINED_BY_CHANCE, 0.0))) >= EVIDENCE_NEEDED
    bent = posterior.mean[terms.before : terms.before + len(posterior.bend_gain)]
    stiff = np.ones(len(terms.count), dtype=np.bool_)
    stiff[terms.bends] = (posterior.bend_gain < EVIDENCE_NEEDED) | (bent <= 0.0)
    return (gain <= 0.0) | (not shown), stiff


@dataclass(frozen=True)
class _Solved:
    """Where the rounds end: samples kept (m,), their weights (m,) and residuals (m, c)."""

    problem: _FullProblem
    at: _Solution
    keep: Mask
    weight: Array
    residual: Array

    @cached_property
    def left_out(self) -> tuple[float, Array]:
        """Rms error, m, of samples left out, and its squares (m,) over their covariances."""
        error, expected = self.problem.left_out(self.at, self.weight)
        return self.problem.rms(error), _squared(error[:, :3], expected[:, :3, :3])

    def reported(self, stretch: float) -> FullIdentification:
        """Put together what is reported, sigmas ``stretch`` times as large."""
        assert self.at.posterior is not None
        start, data, k = self.problem.start, self.problem.data, self.at.terms.before
        residual, left = self.residual, self.at.posterior.left
        known = _known(self.problem, self.at, self.weight, stretch)
        estimate = replace(
            start.estimate,
            state=known.cell,
            covariance=known.covariance[:k, :k],
            scale=stretch * self.at.prior.noise,
            freedom=left,
            residual=residual,
            rejected=~self.keep,
        )
        plain = {field.name: getattr(start, field.name) for field in fields(Identification)}
        plain |= {
            "estimate": estimate,
            "cell": known.cell,
            "rejected": tuple(data.sample[i] for i in np.flatnonzero(~self.keep)),
            "noise_m": known.prior.noise,
        }
        if data.sigma is not None:
            used = self.weight @ np.sum(residual[:, :3] ** 2, axis=1)
            plain["sigma_ratio"] = float(np.sqrt(used / max(left, 1.0)))
        gain = self.at.posterior.gain
        return FullIdentification(**plain, known=known, gain=gain, left_out_rms_m=self.left_out[0])


def _known(problem: _FullProblem, at: _Solution, weight: Array, stretch: float) -> KnownModel:
    """How well it is known, sigmas ``stretch`` times as large; the arm keeps why.

    Functions are of mean zero where theta0 is free: else any constant could be in either.
    """
    assert at.posterior is not None
    start, data, layout = problem.start, problem.data, problem.layout
    prior, to_centred = at.prior, centred(layout, at.terms, at.cell.arm)
    cell = problem.moved(at.cell, at.terms, to_centred @ problem.values(at.cell, at.terms))
    functions = cell.arm.functions
    assert functions is not None
    given = np.ones(len(data)) if data.sigma is None else data.sigma
    scale = 1.0 if data.sigma is None else float(np.sqrt(np.mean(given**2)))
    noise = stretch * scale * prior.noise
    prior = FunctionPrior(prior.length, stretch * prior.amplitude, noise)
    covariance = stretch**2 * to_centred @ at.posterior.covariance @ to_centred.T
    known = KnownModel(layout, cell, at.terms, prior, covariance, np.sort(data.q, axis=0))
    sigma = np.full(at.terms.before, FREE)
    if start.prior_covariance is not None:
        spread = np.sqrt(np.diag(start.prior_covariance))
        sigma[: len(spread)] = np.minimum(stretch * spread, FREE)
    if start.target_reach_m is not None:
        sigma[layout.tool_places] = min(stretch * start.target_reach_m, FREE)
    told = identified_from(
        known,
        data.q,
        data.target_index(cell.targets),
        weight * (scale / given) ** 2,
        0.0 if data.rotation is None else problem.problem.lever_m,
        sigma,
    )
    load = cell.arm.load if np.any(at.terms.bends) else start.nominal.load
    arm = replace(cell.arm, functions=replace(functions, identified_from=told), load=load)
    return replace(known, cell=replace(cell, arm=arm))
