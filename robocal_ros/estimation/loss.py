"""What a descent minimises: squared residuals, robust or plain, and a Gaussian prior."""

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
S = TypeVar("S")


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

    Attributes
    ----------
    prior : (k, k) information about the unknowns.
    keep : (m,) samples in use.
    scale : standard deviation of a whitened residual.
    huber : (m,) length of each sample's residual, in scales, from which it counts linearly.
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
