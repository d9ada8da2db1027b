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
from robocal_ros.estimation.descent import FALSE_REJECTION, chi2_quantile
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
    gravity_torque,
    identified_from,
    sparse,
    with_turns,
)
from robocal_ros.identification.solve import Identification, Method, identify
from robocal_ros.kinematics import SerialArm

_ROBUST_ROUNDS = 2  # by Huber's loss; the first judges samples by the geometry alone
# The evidence trusts a noise that is normal and alike everywhere; errors at poses left out do not:
# these must fall, and clearly up to so many poses, which also outnumber the other unknowns.
GAIN, MANY_POSES, CLEAR_GAIN, FEWEST_NUMBERS = 0.97, 100, 0.8, 1.25
FOLDS = 5  # of few poses, each of which the others must foretell
SMALLEST_SHARE = 0.1  # of the noise that a real robot's geometry leaves: 0.15 to 0.2 are seen
_FREE_ROUNDS = 2  # in which a rejected sample may come back
_ROUNDS, SETTLED = 12, 0.05  # of solving and judging the samples anew; share of the noise


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
    """Where the rounds stand, and the residuals (m, c) that a linear model would have there."""

    cell: CellModel
    terms: JointTerms
    prior: FunctionPrior
    posterior: Posterior | None = None
    linear: Array | None = None

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
        return SMALLEST_SHARE * self.start.estimate.scale if len(self.data) <= MANY_POSES else 0.0

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

    def left_out(
        self, residual: Array, rows: Rows, at: _Solution, weight: Array
    ) -> tuple[Array, Array]:
        """Residuals (m, c) of a fit without each sample's own pose, and their covariances.

        By the fit with it, of Gaussian unknowns (`weight` zero: it was not in use).
        """
        from robocal_ros.identification import row_kernels

        assert at.posterior is not None
        m, c = residual.shape
        spread = np.empty((m, c, c))
        row_kernels.spreads(rows.J, rows.column, at.posterior.covariance, spread)
        variance, unit = at.prior.noise**2, np.eye(c)
        total = np.bincount(self.pose, weight)[self.pose]
        pose_variance = (variance / np.where(total > 0.0, total, 1.0))[:, None, None] * unit
        used = (weight > 0.0)[:, None, None]
        loose = (1.0 + 1e-6) * pose_variance
        gain = pose_variance @ np.linalg.inv(np.where(used, loose - spread, pose_variance))
        error = (gain @ residual[..., None])[..., 0]
        expected = np.where(used, gain @ pose_variance - pose_variance, spread) + variance * unit
        return np.asarray(error), np.asarray(expected)

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
        at = _Solution(start.cell, terms, prior, posterior)
        return self.rms(self.left_out(residual, rows, at, weight)[0])

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
    Compliances need the arm's ``load``.

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
    needed = GAIN if len(data) > MANY_POSES else CLEAR_GAIN
    better = full.left_out_rms_m < needed * rival.geometric_left_out()
    if better and len(data) <= MANY_POSES:
        better = _foretells(arm, data, fit, method)
    return full if better else rival.start


def _foretells(arm: SerialArm, data: Measurements, fit: Collection[Part], method: Method) -> bool:
    """Whether full models of some poses foretell the others clearly better than geometric ones.

    What the evidence chooses from few poses is chosen for these, too: a pose is left out of that
    as well.
    """
    errors: list[list[Array]] = [[], []]
    fold = pose_groups(data.q) % FOLDS
    for left_out in (fold == i for i in range(FOLDS)):
        rest = data.take(left_out)
        try:
            full, rival = _solved(arm, data.take(~left_out), fit, method)
            for own, found in zip(errors, (full or rival.start, rival.start), strict=True):
                own.append(found.cell.residual(rest))
        except (TooFewSamplesError, RankDeficientError):
            return False
    with_functions, without = (rival.rms(np.concatenate(own)) for own in errors)
    return with_functions < CLEAR_GAIN * without


def _solved(
    arm: SerialArm, data: Measurements, fit: Collection[Part], method: Method
) -> tuple[FullIdentification | None, _FullProblem]:
    """The full model, where the evidence wants one, and the problem of the geometric model."""
    start = identify(bare(arm), data, fit=fit, method=method)
    torque = gravity_torque(arm, data.q)
    q = np.ascontiguousarray(data.q)
    data = replace(data, q=q)
    problem = _FullProblem(start, data, start.lever_m)
    before, rival = len(start.layout.names), problem
    if arm.functions is not None:
        held = identify(arm, data, fit=fit, method=method)
        rival = min(
            problem, _FullProblem(held, data, held.lever_m), key=_FullProblem.geometric_left_out
        )
    if 3.0 * len(data) < FEWEST_NUMBERS * before or start.estimate.creeping:
        return None, rival
    at = _Solution(
        start.cell,
        JointTerms.cover(q, torque, before, coarse=True),
        FunctionPrior.typical(arm.n, start.estimate.scale),
    )
    for _ in range(_ROBUST_ROUNDS):
        residual, rows = problem.linearise(at.cell, at.terms)
        weight = problem.robust_weight(residual)
        weight *= problem.visit_share(residual, weight)
        at = _round(problem, at, residual, rows, weight)
    keep = problem.inliers(*problem.left_out(*problem.linearise(at.cell, at.terms), at, weight))
    functions, bends = _unwanted(at)
    terms = JointTerms.cover(q, torque, before).without(functions, bends)
    if terms.size == before:
        return None, rival
    amplitude = np.where(functions, 0.0, at.prior.amplitude)
    rigid = replace(at.cell, arm=bare(at.cell.arm))
    at = _Solution(rigid, terms, replace(at.prior, amplitude=amplitude))
    for attempt in range(_ROUNDS):
        residual, rows = problem.linearise(at.cell, at.terms)
        weight = keep * problem.visit_share(residual, keep.astype(np.float64))
        at = _round(problem, at, residual, rows, weight)
        residual, rows = problem.linearise(at.cell, at.terms)
        last, keep = keep, problem.inliers(*problem.left_out(residual, rows, at, weight))
        if attempt >= _FREE_ROUNDS:  # a sample at the limit must not come and go for ever
            keep &= last
        if np.array_equal(last, keep) and at.settled(residual):
            break
    return _reported(problem, at, last, weight), rival


def _round(
    problem: _FullProblem, at: _Solution, residual: Array, rows: Rows, weight: Array
) -> _Solution:
    evidence = problem.evidence(at, residual, rows, weight)
    prior, posterior = evidence.maximise(at.prior)
    cell = problem.moved(at.cell, at.terms, posterior.mean)
    step = np.append(posterior.mean - problem.values(at.cell, at.terms), 0.0)  # of column -1
    linear = residual + np.einsum("mch,mh->mc", rows.J, step[rows.column])
    return _Solution(cell, at.terms, prior, posterior, linear)


def _unwanted(at: _Solution) -> tuple[Mask, Mask]:
    """Joints (n,) whose function, and whose compliance, the evidence does not want.

    No compliance is below zero. Functions must show together that there are any; then of each it
    suffices that it is more likely there than not.
    """
    assert at.posterior is not None
    posterior, terms = at.posterior, at.terms
    gain = posterior.gain
    shown = float(np.sum(gain[gain > 0.0])) >= EVIDENCE_NEEDED
    bent = posterior.mean[terms.before : terms.before + len(posterior.bend_gain)]
    stiff = np.ones(len(terms.count), dtype=np.bool_)
    stiff[terms.bends] = (posterior.bend_gain < EVIDENCE_NEEDED) | (bent <= 0.0)
    return (gain <= 0.0) | (not shown), stiff


def _reported(
    problem: _FullProblem, at: _Solution, keep: Mask, weight: Array
) -> FullIdentification:
    """Put together what is reported, with covariances that samples left out confirm.

    Errors that no model explains are neither equal everywhere nor normal: where more than one in
    twenty left-out samples lies beyond its bound of 95 %, all sigmas grow until it is one.
    """
    assert at.posterior is not None
    start, data, k = problem.start, problem.data, at.terms.before
    residual, rows = problem.linearise(at.cell, at.terms)
    error, expected = problem.left_out(residual, rows, at, weight)
    squared = np.maximum(_squared(error[:, :3], expected[:, :3, :3]), 0.0)
    stretch = max(1.0, np.sqrt(float(np.quantile(squared, 0.95)) / chi2_quantile(0.95, 3)))
    known = _known(problem, at, weight, stretch)
    estimate = replace(
        start.estimate,
        state=known.cell,
        covariance=known.covariance[:k, :k],
        scale=stretch * at.prior.noise,
        freedom=at.posterior.left,
        residual=residual,
        rejected=~keep,
    )
    plain = {field.name: getattr(start, field.name) for field in fields(Identification)}
    plain |= {
        "estimate": estimate,
        "cell": known.cell,
        "rejected": tuple(data.sample[i] for i in np.flatnonzero(~keep)),
        "noise_m": known.prior.noise,
    }
    if data.sigma is not None:
        used = weight @ np.sum(residual[:, :3] ** 2, axis=1)
        plain["sigma_ratio"] = float(np.sqrt(used / max(at.posterior.left, 1.0)))
    return FullIdentification(
        **plain,
        known=known,
        gain=at.posterior.gain,
        left_out_rms_m=problem.rms(error),
    )


def _known(problem: _FullProblem, at: _Solution, weight: Array, stretch: float) -> KnownModel:
    """How well it is known, sigmas ``stretch`` times as large; the arm keeps why."""
    assert at.posterior is not None
    start, data, layout = problem.start, problem.data, problem.layout
    functions, prior = at.cell.arm.functions, at.prior
    assert functions is not None
    given = np.ones(len(data)) if data.sigma is None else data.sigma
    scale = 1.0 if data.sigma is None else float(np.sqrt(np.mean(given**2)))
    noise = stretch * scale * prior.noise
    prior = FunctionPrior(prior.length, stretch * prior.amplitude, noise)
    covariance, readings = stretch**2 * at.posterior.covariance, np.sort(data.q, axis=0)
    known = KnownModel(layout, at.cell, at.terms, prior, covariance, readings)
    sigma = np.full(at.terms.before, FREE)
    if start.prior_covariance is not None:
        spread = np.sqrt(np.diag(start.prior_covariance))
        sigma[: len(spread)] = np.minimum(stretch * spread, FREE)
    if start.target_reach_m is not None:
        sigma[layout.tool_places] = min(stretch * start.target_reach_m, FREE)
    told = identified_from(
        known,
        data.q,
        data.target_index(at.cell.targets),
        weight * (scale / given) ** 2,
        0.0 if data.rotation is None else problem.problem.lever_m,
        sigma,
    )
    arm = at.cell.arm
    arm = arm.with_model(arm.mdh, replace(functions, identified_from=told), arm.load)
    return replace(known, cell=replace(at.cell, arm=arm))
