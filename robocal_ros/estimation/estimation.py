# SPDX-License-Identifier: Apache-2.0
"""Robust maximum likelihood and maximum a posteriori estimation on manifolds.

Gauss-Newton with Levenberg damping over a problem that linearises itself. A first pass with
Huber's loss finds a scale that outliers cannot inflate; samples beyond it are rejected by name
and the rest is solved by plain (efficient) least squares.
"""

from dataclasses import dataclass
from itertools import count
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.descent import (
    FALSE_REJECTION,
    FIRST_TOLERANCE,
    Descent,
    DescentState,
    Problem,
    information_of,
    rows_of,
)
from robocal_ros.ground.errors import RankDeficientError, TooFewSamplesError
from robocal_ros.ground.frames import Array

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


S = TypeVar("S")

FREE_ATTEMPTS = 5  # in which a rejected sample may come back


@dataclass(frozen=True)
class Estimate(Generic[S]):
    """Outcome of ``solve``.

    ``state``: the estimate.
    ``covariance`` (k, k): of the increments at the estimate, in the problem's units.
    ``scale``: standard deviation of the whitened residual: 1 where sigmas were given, unless the
    residuals are clearly larger; then covariances are widened by it.
    ``freedom``: how many numbers tell the scale: those of the residuals less those that the
    unknowns take up. What the prior holds takes up none.
    ``residual`` (m, c): whitened; ``rejected`` (m,) marks samples not used.
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
    estimated with them.
    ``robust``: whether to look for outliers.
    ``sizes`` (m,): how many of its c components each sample has, where they differ; the residuals
    and Jacobians of the others are zero.
    ``freedom``: how many numbers the sigmas were found from, where they come from these data: then
    a sample must be farther off to be an outlier (F distribution).
    ``false_rejection``: chance that clean data lose any sample.

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
