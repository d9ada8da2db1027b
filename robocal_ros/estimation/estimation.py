# SPDX-License-Identifier: Apache-2.0
"""Robust maximum likelihood and maximum a posteriori estimation on manifolds.

Gauss-Newton with Levenberg damping over a problem that linearises itself. A first pass with
Huber's loss finds a scale that outliers cannot inflate; samples beyond it are rejected by name
and the rest is solved by plain (efficient) least squares.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import count
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import RankDeficientError, TooFewSamplesError
from robocal_ros.ground.frames import Array

# ---- what a descent minimises: squared residuals, robust or plain, and a Gaussian prior ---------


S = TypeVar("S")

MOST_ROUNDS = 50
CLOSE = 1e-12  # relative
SMALLEST_SHARE = 1e-9  # of the numbers, so that a fit that takes up all of them is no division by 0
TINY = 1e-200
ROUNDING = 1e-15
LOST = 1e-11  # of the largest: a sum of data and prior has lost digits of what is so small
NEITHER = 1e-13  # of the largest: what neither data nor prior hold
ROUNDINGS = 2e-14  # share of a direction's information that data must have, over the least of all
NO_MEAN = 2.0  # up to so many numbers a squared error over its reported variance (F) has no mean


@dataclass(frozen=True)
class Freedom:
    """What a fit under a prior leaves of N residuals, by the noise.

    A direction that the prior holds takes up nothing. With noise of the standard deviation s, data
    of the information W / s^2 and a prior P the fit takes up trace(W (W + s^2 P)^-1) of the
    numbers, of those that tell the noise trace(A (W + s^2 P)^-1) (MacKay, Bayesian interpolation,
    1992: the number of well-determined parameters).

    ``count``: N numbers tell the noise. ``told``, ``data`` (k,): diagonals of A and W in directions
    in which W + unit P is one. ``unit``: a variance at which data and prior weigh alike.
    """

    count: int
    told: Array
    data: Array
    unit: float

    @classmethod
    def of(cls, count: int, told: Array, data: Array, prior: Array) -> "Freedom":
        """From A, W and P (k, k); what neither data nor prior determine takes up nothing."""
        unit, share, V, _ = _both_diagonal(data, prior)
        shown = np.clip(share, 0.0, 1.0) if np.any(prior) else np.ones(len(data))
        tells = np.where(shown > ROUNDING, np.sum(V * (told @ V), axis=0), 0.0)
        return cls(count, tells, shown, unit)

    @classmethod
    def flat(cls, count: int, unknowns: int) -> "Freedom":
        """Without a prior, all numbers telling the noise: each unknown takes up one."""
        return cls(count, np.ones(unknowns), np.ones(unknowns), 1.0)

    def at(self, squared: float) -> float:
        """Numbers that are left with a variance of the noise."""
        return self.count - float(np.sum(self.told / (self.data + self._held(squared))))

    def scale(self, total: float) -> float:
        """Standard deviation s with s^2 = total / (numbers left at s^2).

        ``total``: sum of the squared residuals. The right side falls where s^2 grows, by a lower
        power: there is one solution. Newton's method in the logarithms, on log(s^2) less that of
        the right side, which has a slope between 1 and 2.
        """
        squared = max(total, TINY) / self.count
        for _ in range(MOST_ROUNDS if self.by_prior else 1):
            left = max(self.at(squared), SMALLEST_SHARE * self.count)
            held = self._held(squared)
            slope = 1.0 + float(np.sum(self.told * held / (self.data + held) ** 2)) / left
            step = float(np.log(max(total, TINY) / left / squared)) / slope
            squared *= float(np.exp(step))
            if abs(step) < CLOSE:
                break
        return float(np.sqrt(squared))

    @property
    def by_prior(self) -> bool:
        """Whether a prior holds anything."""
        return bool(np.any(self.data < 1.0))

    def _held(self, squared: float) -> Array:
        return (1.0 - self.data) * (squared / self.unit)


def _both_diagonal(data: Array, prior: Array) -> tuple[float, Array, Array, float]:
    """Directions (k, k), columns V, in which W + unit P is one and W the diagonal ``share`` (k,).

    ``unit``: a variance at which data W and prior P (k, k) weigh alike; last: the least eigenvalue
    of W + unit P, over the greatest, with a diagonal of ones.
    """
    pinned = float(np.trace(prior))
    unit = float(np.trace(data)) / pinned if pinned else 1.0
    whole = data + unit * prior
    size = 1.0 / np.sqrt(np.maximum(np.diag(whole), TINY))
    weight, axes = np.linalg.eigh(whole * np.outer(size, size))
    root = size[:, None] * axes / np.sqrt(np.maximum(weight, ROUNDING * weight[-1]))
    share, turn = np.linalg.eigh(root.T @ data @ root)
    return unit, share, root @ turn, float(weight[0] / weight[-1])


def require_told(left: float) -> None:
    """Refuse noise that too few numbers tell.

    Raises `TooFewSamplesError` with `NO_MEAN` numbers or fewer.
    """
    if left <= NO_MEAN:
        raise TooFewSamplesError(
            f"the unknowns take up what these samples tell: {NO_MEAN:.0f} numbers or fewer are "
            "left to find the noise from; measure more poses, or give each sample's sigma (column "
            "sigma_mm)"
        )


class Problem(Protocol[S]):
    """Residuals of m samples with c components each, linearised at a state."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names (k) of the increments, for reports."""

    def linearise(self, state: S) -> tuple[Array, Array]:
        """Residual (m, c), prediction minus measurement over sigma, and Jacobian (m, c, k)."""

    def retract(self, state: S, step: Array) -> S:
        """Move the state by an increment (k,)."""

    @property
    def scale_components(self) -> int:
        """How many of the c components tell the noise when it is unknown (the first ones)."""

    def deviation(self, state: S) -> Array:
        """Distance (k,) of the state from the prior's mean; zero where the prior is flat."""


@dataclass(frozen=True)
class DescentState(Generic[S]):
    """Where a descent stands: the state, its residual (m, c) and Jacobian (m, c, k)."""

    state: S
    residual: Array
    jacobian: Array
    iterations: int
    converged: bool


@dataclass(frozen=True)
class Loss(Generic[S]):
    """Of one step of a descent.

    ``prior`` (k, k): information about the unknowns. ``keep`` (m,): samples in use. ``scale``:
    standard deviation of a whitened residual. ``huber`` (m,): length of each sample's residual, in
    scales, from which it counts linearly.
    """

    problem: Problem[S]
    prior: Array
    keep: NDArray[np.bool_]
    scale: float
    huber: Array | None

    def at(self, state: S, residual: Array) -> float:
        """The loss itself."""
        distance = _lengths(residual[self.keep]) / self.scale
        near = distance if self.huber is None else np.minimum(distance, self.huber[self.keep])
        away = self.problem.deviation(state)
        return float(np.sum(near * (2.0 * distance - near)) + away @ self.prior @ away)

    def gradient(self, run: DescentState[S]) -> Array:
        """Half of it, (k,)."""
        J = run.jacobian.reshape(-1, run.jacobian.shape[2])
        weighted = (run.residual * self._weight(run.residual)[:, None]).ravel()
        by_data = J.T @ weighted / self.scale**2
        return np.asarray(by_data + self.prior @ self.problem.deviation(run.state))

    def information(self, run: DescentState[S]) -> Array:
        """Half of the second derivative (k, k), without the curvature of the residuals."""
        weight = self._weight(run.residual)
        return information_of(run.jacobian, weight) / self.scale**2 + self.prior

    def _weight(self, residual: Array) -> Array:
        weight = np.where(self.keep, 1.0, 0.0)
        if self.huber is not None:
            distance = np.maximum(_lengths(residual), np.finfo(float).tiny)
            weight *= np.minimum(1.0, self.huber * self.scale / distance)
        return weight


def rows_of(jacobian: Array, keep: NDArray[np.bool_]) -> Array:
    """Rows (N, k) of the samples to keep, copied only when some are left out."""
    used = jacobian if np.all(keep) else jacobian[keep]
    return used.reshape(-1, jacobian.shape[2])


def information_of(jacobian: Array, weight: NDArray[np.float64 | np.bool_]) -> Array:
    """Normal matrix (k, k) of a Jacobian (m, c, k) whose samples have weights (m,)."""
    used = jacobian
    if not np.all(weight == 1.0):
        used = jacobian * np.sqrt(weight)[:, None, None]
    J = used.reshape(-1, jacobian.shape[2])
    return np.asarray(J.T @ J)


def _lengths(rows: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("mc,mc->m", rows, rows)))


# ---- damped Gauss-Newton on a manifold, robust or plain, and the test of each sample ------------


FALSE_REJECTION = 0.01  # chance that a clean data set loses any sample
MOST_ITERATIONS = 50
OVERSHOT = 0.5  # slope behind a step, of that before it: then whole steps take too many to settle
# weak directions curve long before the others do: damped as little as will do
DAMPINGS = (0.0, *(10.0**power for power in range(-10, 7)))
SOUND_FIT = 0.999  # residuals beyond this quantile say that given sigmas are too small
CLEAR_STRETCH = 1.6  # beyond the scatter of a median of six samples
STEP_TOLERANCE = 1e-4  # of a standard deviation
FIRST_TOLERANCE = 1e-2  # the same for the pass that only looks for outliers
SMALLEST_SCALE = 1e-9  # whitened residual; keeps noise-free data solvable


@lru_cache(maxsize=1024)
def chi2_quantile(probability: float, dof: float) -> float:
    """Quantile of the chi-square distribution."""
    from scipy.special import gammaincinv

    return float(2.0 * gammaincinv(0.5 * dof, probability))


def found_noise_quantile(probability: float, dof: float, freedom: float) -> float:
    """The same in units of a noise that was itself found from ``freedom`` numbers."""
    from scipy.special import fdtri

    return dof * float(fdtri(dof, freedom, probability))


@dataclass(frozen=True)
class Descent(Generic[S]):
    """Gauss-Newton on one problem; ``scale_components`` is 0 where the noise is known.

    ``sizes`` (m,): how many of its c components each sample has; the others are zero.
    ``freedom``: how many numbers the noise was found from, where it was found from these data.
    ``false_rejection``: chance that clean data lose any sample.
    """

    problem: Problem[S]
    prior: Array
    scale_components: int
    sizes: NDArray[np.int64]
    freedom: float = np.inf
    false_rejection: float = FALSE_REJECTION

    def run(
        self,
        run: DescentState[S],
        keep: NDArray[np.bool_],
        huber: Array | None = None,
        tolerance: float = STEP_TOLERANCE,
    ) -> DescentState[S]:
        """Minimise the cost until a step is far below a standard deviation.

        ``huber`` (m,): length of each sample's residual from which it counts linearly.
        """
        k = run.jacobian.shape[2]
        left = self._left(run.jacobian, keep)  # hardly changes on the way
        first = 0  # of the dampings that a step tries: two below the last that would do
        for _ in range(MOST_ITERATIONS):
            scale_of = self._plain_scale if huber is None else self._robust_scale
            scale = scale_of(run.residual[keep], left)
            loss = Loss(self.problem, self.prior, keep, scale, huber)
            information, gradient = loss.information(run), loss.gradient(run)
            here = loss.at(run.state, run.residual)
            step = _damped_step(information, gradient, 0.0)
            to_go = float(step @ information @ step)
            if to_go < tolerance**2 * k:
                near = run.residual + run.jacobian @ step  # exact enough so near
                state = self.problem.retract(run.state, step)
                return DescentState(state, near, run.jacobian, run.iterations + 1, True)
            for number, damping in enumerate(DAMPINGS[first:], first):
                if damping:
                    step = _damped_step(information, gradient, damping)
                trial = self._moved(run, step)
                if loss.at(trial.state, trial.residual) <= here:
                    first = max(0, number - 2)
                    break
            else:  # no step of any length helps: trusted only where all of it is far below a sigma
                return replace(run, converged=to_go < FIRST_TOLERANCE**2 * k)
            run = self._shortened(loss, run, trial, step, gradient)
        return run

    def _moved(self, run: DescentState[S], step: Array) -> DescentState[S]:
        state = self.problem.retract(run.state, step)
        return DescentState(state, *self.problem.linearise(state), run.iterations + 1, False)

    def _shortened(
        self,
        loss: Loss[S],
        run: DescentState[S],
        trial: DescentState[S],
        step: Array,
        gradient: Array,
    ) -> DescentState[S]:
        """Where the step ends; short of that if the way down has long been passed there.

        Residuals that curve, as those of a path through noisy readings, let Gauss-Newton's steps
        go nearly twice as far as they should, for ever. The slope's zero along a step is nearer.
        """
        ahead = -float(step @ gradient)
        passed = float(step @ loss.gradient(trial))
        if passed <= OVERSHOT * ahead:
            return trial
        shorter = self._moved(run, ahead / (ahead + passed) * step)
        better = loss.at(shorter.state, shorter.residual) < loss.at(trial.state, trial.residual)
        return shorter if better else trial

    def _left(
        self, jacobian: Array, keep: NDArray[np.bool_], information: Array | None = None
    ) -> Freedom | None:
        """What the unknowns leave of the numbers that tell the noise; None where it is known.

        ``information`` (k, k): of the samples in use, where it is known already.
        """
        c, k = jacobian.shape[1:]
        count = int(np.sum(keep)) * self.scale_components
        if not count:
            return None
        all_tell = c == self.scale_components
        if all_tell and not np.any(self.prior):
            return Freedom.flat(count, k)
        data = information_of(jacobian, keep) if information is None else information
        told = data if all_tell else information_of(jacobian[:, : self.scale_components], keep)
        return Freedom.of(count, told, data, self.prior)

    def _plain_scale(self, used: Array, left: Freedom | None) -> float:
        """Standard deviation of residuals in use, unknowns counted; 1 where it is known."""
        if left is None:
            return 1.0
        total = float(np.sum(used[:, : self.scale_components] ** 2))
        return _found(left, total)

    def _robust_scale(self, used: Array, left: Freedom | None) -> float:
        """The same from the median, which outliers cannot inflate."""
        if left is None:
            return 1.0
        squared = np.sum(used[:, : self.scale_components] ** 2, axis=1)
        middle = float(np.median(squared)) / chi2_quantile(0.5, self.scale_components)
        return _found(left, middle * left.count)

    def final_scale(
        self, run: DescentState[S], keep: NDArray[np.bool_], information: Array
    ) -> tuple[float, float]:
        """The estimated scale; with given sigmas 1, or the misfit where chi-square rejects 1.

        And how many numbers tell it.
        """
        used, left = run.residual[keep], self._left(run.jacobian, keep, information)
        if left is not None:
            scale = self._plain_scale(used, left)
            return scale, left.at(scale**2)
        explained = float(np.trace(information @ self.posterior(information, 1.0)))
        freedom = float(np.sum(self.sizes[keep])) - explained
        misfit = float(np.sum(used**2))
        if freedom < 1.0 or misfit <= chi2_quantile(SOUND_FIT, freedom):
            return 1.0, freedom
        return float(np.sqrt(misfit / freedom)), freedom

    def quantiles(self, probability: float) -> Array:
        """Quantile (m,) of each sample's chi-square distribution."""
        sizes, which = np.unique(self.sizes, return_inverse=True)
        return np.array([chi2_quantile(probability, int(n)) for n in sizes])[which]

    def posterior(self, normal: Array, scale: float) -> Array:
        """Covariance (k, k) of the unknowns from the data's normal matrix.

        The sum of an almost exact normal matrix and a prior has lost what only the prior holds:
        then by the directions in which both are diagonal. Not a number where neither holds one.
        """
        information = normal / scale**2 + self.prior
        unit = 1.0 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
        scaled = information * np.outer(unit, unit)
        if np.any(self.prior) and np.linalg.eigvalsh(scaled)[0] < LOST:
            balance, share, axes, least = _both_diagonal(normal, self.prior)
            if least < NEITHER:
                return np.full_like(normal, np.nan)
            share = np.where(share > ROUNDINGS / least, np.minimum(share, 1.0), 0.0)
            return np.asarray(axes / (share / scale**2 + (1.0 - share) / balance) @ axes.T)
        inverse = np.linalg.inv(scaled)
        return np.asarray(0.5 * (inverse + inverse.T) * np.outer(unit, unit))

    def inliers(self, run: DescentState[S], keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Samples whose residual fits its own predicted covariance (studentised, chi-square)."""
        from scipy.special import fdtri

        m, c, _ = run.jacobian.shape
        J, information = run.jacobian, information_of(run.jacobian, keep)
        scale = self._robust_scale(run.residual[keep], self._left(J, keep, information))
        JC = (J.reshape(m * c, -1) @ self.posterior(information, scale)).reshape(J.shape)
        spread = JC @ np.swapaxes(J, 1, 2)
        sign = np.where(keep, -1.0, 1.0)[:, None, None]  # a rejected sample did not pull the fit
        expected = (1.0 + 1e-6) * scale**2 * np.eye(c) + sign * spread
        whitened = np.linalg.solve(expected, run.residual[..., None])[..., 0]
        squared = np.sum(run.residual * whitened, axis=1)
        probability = 1.0 - self.false_rejection / m
        if self.freedom == np.inf:
            largest = self.quantiles(probability)
        else:  # the noise itself is uncertain
            largest = self.sizes * fdtri(self.sizes, self.freedom, probability)
        stretch = 1.0  # by which distances are larger than given sigmas explain
        if not self.scale_components:  # from their median, which outliers cannot inflate
            share = squared[keep] / self.quantiles(0.5)[keep]
            stretch = float(np.sqrt(max(float(np.median(share)), 0.0)))
        inlier = squared < largest * (stretch if stretch > CLEAR_STRETCH else 1.0) ** 2
        enough = 2 * np.sum(inlier) > m
        return np.asarray(inlier) if enough else keep


def _found(left: Freedom, total: float) -> float:
    """Scale of residuals with this sum of squares.

    Under a prior that is wider than the noise, unknowns without end explain few data ever better:
    refused before the scale goes to zero.
    """
    scale = max(left.scale(total), SMALLEST_SCALE)
    if left.by_prior:
        require_told(left.at(scale**2))
    return scale


def _damped_step(normal: Array, gradient: Array, damping: float) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    scaled = normal * np.outer(scale, scale)
    if damping:
        np.einsum("ii->i", scaled)[:] += damping
    try:
        step = np.linalg.solve(scaled, -gradient * scale)
    except np.linalg.LinAlgError:  # nothing shows a direction: it is left alone
        step = np.linalg.lstsq(scaled, -gradient * scale, rcond=None)[0]
    return np.asarray(step * scale)


# ---- what data determine: rank, condition, and the directions they leave open, in words ---------


RANK_TOLERANCE = 1e-8  # of the largest singular value, columns scaled to unit length
_CLEAR = 1e-10  # squared singular value above which normal equations, being quicker, suffice


@dataclass(frozen=True)
class Observability:
    """What the data alone determine, with every column scaled to unit length.

    ``rank``, ``condition``: of the scaled Jacobian; the condition leaves out the null space.
    ``null`` (k, k - rank): unobservable directions in the problem's own units, each of unit length
    after scaling.
    """

    rank: int
    condition: float
    null: Array


def observability(jacobian: Array, normal: Array | None = None) -> Observability:
    """Rank, condition and null space of a Jacobian (N, k).

    ``normal`` (k, k): its normal matrix J^T J, if it is known.
    """
    information = jacobian.T @ jacobian if normal is None else normal
    length = np.sqrt(np.diag(information))
    scale = np.where(length > 0.0, length, 1.0)
    squared = np.linalg.eigvalsh(information / np.outer(scale, scale))
    if squared[0] > _CLEAR * squared[-1]:
        condition = float(np.sqrt(squared[-1] / squared[0]))
        return Observability(len(scale), condition, np.empty((len(scale), 0)))
    triangle = np.linalg.qr(jacobian / scale, mode="r")
    _, s, Vt = np.linalg.svd(triangle)
    s = np.concatenate([s, np.zeros(Vt.shape[0] - len(s))])
    rank = int(np.sum(s > RANK_TOLERANCE * max(s[0], np.finfo(float).tiny)))
    condition = float(s[0] / s[rank - 1]) if rank else np.inf
    # the basis of the null space in which as many unknowns appear in one direction each
    null, chosen = Vt[rank:].T, []
    rest = null.copy()
    for _ in range(null.shape[1]):
        pivot = int(np.argmax(np.einsum("ij,ij->i", rest, rest)))
        chosen.append(pivot)
        row = rest[pivot] / np.linalg.norm(rest[pivot])
        rest = rest - np.outer(rest @ row, row)
    basis = null @ np.linalg.inv(null[chosen]) if chosen else null
    basis = basis / np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny)
    return Observability(rank, condition, basis / scale[:, None])


def describe(direction: Array, names: tuple[str, ...], size: Array | None = None) -> str:
    """Put a direction (k,) into words: the members above a tenth of the largest, with weights.

    ``size`` (k,) scales the members so that lengths and angles compare.
    """
    weight = direction if size is None else direction * size
    weight = weight / np.max(np.abs(weight))
    order = [int(i) for i in np.argsort(-np.abs(weight)) if abs(weight[i]) > 0.1]
    sign = np.sign(weight[order[0]])
    terms = [f"{sign * weight[i]:+.2g} {names[i]}" for i in order[:6]]
    return " ".join(terms).removeprefix("+1 ") + (" …" if len(order) > 6 else "")


# ---- robust maximum likelihood and maximum a posteriori estimation on manifolds -----------------


FREE_ATTEMPTS = 5  # in which a rejected sample may come back


@dataclass(frozen=True)
class Estimate(Generic[S]):
    """Outcome of ``solve``.

    ``state``: the estimate. ``covariance`` (k, k): of the increments at the estimate, in the
    problem's units. ``scale``: standard deviation of the whitened residual: 1 where sigmas were
    given, unless the residuals are clearly larger; then covariances are widened by it. ``freedom``:
    how many numbers tell the scale: those of the residuals less those that the unknowns take up.
    What the prior holds takes up none. ``residual`` (m, c): whitened; ``rejected`` (m,) marks
    samples not used.
    """

    state: S
    names: tuple[str, ...]
    covariance: Array
    scale: float
    freedom: float
    residual: Array
    rejected: NDArray[np.bool_]
    observability: Observability
    iterations: int
    converged: bool

    @property
    def creeping(self) -> str:
        """Say why the state is no solution; empty when it is one."""
        if self.converged:
            return ""
        return (
            f"the solution still crept after {self.iterations} iterations along directions that "
            "the poses hardly show"
        )

    def settled(self) -> S:
        """The state.

        Raises `RankDeficientError` where it still crept.
        """
        if self.creeping:
            raise RankDeficientError(self.creeping)
        return self.state


def solve(
    problem: Problem[S],
    start: S,
    *,
    prior_information: Array | None = None,
    noise_known: bool = True,
    robust: bool = True,
    sizes: NDArray[np.int64] | None = None,
    freedom: float = np.inf,
    false_rejection: float = FALSE_REJECTION,
) -> Estimate[S]:
    """Find the most likely state.

    ``prior_information`` (k, k): inverse covariance of the prior, or None (zeros) for a flat one.
    ``noise_known``: whether residuals are in units of their true sigma; otherwise a common scale is
    estimated with them. ``robust``: whether to look for outliers. ``sizes`` (m,): how many of its c
    components each sample has, where they differ; the residuals and Jacobians of the others are
    zero. ``freedom``: how many numbers the sigmas were found from, where they come from these data:
    then a sample must be farther off to be an outlier (F distribution). ``false_rejection``: chance
    that clean data lose any sample.

    Raises `TooFewSamplesError`: without a prior, fewer equations than unknowns;
    `RankDeficientError` when the data, and the prior where there is one, leave a direction
    undetermined; `ValueError` when the residuals at the start are not finite.
    """
    residual, jacobian = problem.linearise(start)
    if not (np.all(np.isfinite(residual)) and np.all(np.isfinite(jacobian))):
        raise ValueError("the residuals at the start are not finite")
    m, c, k = jacobian.shape
    counts = np.full(m, c, dtype=np.int64) if sizes is None else sizes
    prior = np.zeros((k, k)) if prior_information is None else prior_information
    flat = not np.any(prior)
    if flat:
        equations = int(np.sum(counts))
        if equations < k:
            raise TooFewSamplesError(f"{m} samples give {equations} equations for {k} unknowns")
        _require_full_rank(observability(jacobian.reshape(-1, k)), problem.names)
    unscaled = 0 if noise_known else problem.scale_components
    descent = Descent(problem, prior, unscaled, counts, freedom, false_rejection)
    run, keep = _settle(descent, DescentState(start, residual, jacobian, 0, False), robust, flat)
    information = information_of(run.jacobian, keep)
    seen = observability(rows_of(run.jacobian, keep), information)
    if flat:
        _require_full_rank(seen, problem.names)
    scale, left = descent.final_scale(run, keep, information)
    covariance = descent.posterior(information, scale)
    if not np.all(np.diag(covariance) > 0.0):
        raise RankDeficientError(
            f"the data determine {seen.rank} of {len(problem.names)} unknowns, and the prior not "
            "the rest: measure at more and different poses",
            [describe(column, problem.names) for column in seen.null.T],
        )
    return Estimate(
        state=run.state,
        names=problem.names,
        covariance=covariance,
        scale=scale,
        freedom=left,
        residual=run.residual,
        rejected=~keep,
        observability=seen,
        iterations=run.iterations,
        converged=run.converged,
    )


def _settle(
    descent: Descent[S], run: DescentState[S], robust: bool, flat: bool
) -> tuple[DescentState[S], NDArray[np.bool_]]:
    """Descend and reject in turn until the samples in use no longer change."""
    keep = np.ones(len(run.jacobian), dtype=np.bool_)
    if robust:
        limit = np.sqrt(descent.quantiles(0.95))
        run = descent.run(run, keep, huber=limit, tolerance=FIRST_TOLERANCE)
        keep = descent.inliers(run, keep)
    for attempt in count():
        if flat and not np.all(keep):
            seen = observability(rows_of(run.jacobian, keep))
            _require_full_rank(seen, descent.problem.names)
        run = descent.run(run, keep)
        update = descent.inliers(run, keep) if robust else keep
        if attempt >= FREE_ATTEMPTS:  # a sample at the limit must not come and go for ever
            update = update & keep
        if np.array_equal(update, keep):
            break
        keep = update
    return run, keep


def _require_full_rank(seen: Observability, names: tuple[str, ...]) -> None:
    if seen.null.shape[1]:
        words = [describe(column, names) for column in seen.null.T]
        raise RankDeficientError(
            f"the data determine {seen.rank} of {len(names)} unknowns; not determined: "
            + "; ".join(words),
            words,
        )


def correlation(residual: Array) -> float:
    """How many neighbours in a stream (n, c) count as one: 1 + 2 sum of autocorrelations.

    Summed up to the first pair of lags that is not positive (Geyer 1992).
    """
    r = residual - residual.mean(axis=0)
    n = len(r)
    power = np.abs(np.fft.rfft(r, 2 * n, axis=0)) ** 2
    lagged = np.fft.irfft(power.sum(axis=1))[:n]
    if lagged[0] <= 0.0:
        return 1.0
    rho = lagged / lagged[0]
    pairs = rho[0 : n - n % 2 : 2] + rho[1 : n + n % 2 : 2][: n // 2]
    until = int(np.argmax(pairs <= 0.0)) if np.any(pairs <= 0.0) else len(pairs)
    return max(float(2.0 * pairs[:until].sum() - 1.0), 1.0)
