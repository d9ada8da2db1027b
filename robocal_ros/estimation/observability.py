"""What data determine: rank, condition, and the directions they leave open, in words."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RANK_TOLERANCE = 1e-8  # of the largest singular value, columns scaled to unit length
_CLEAR = 1e-10  # squared singular value above which normal equations, being quicker, suffice


@dataclass(frozen=True)
class Observability:
    """What the data alone determine, with every column scaled to unit length.

    Attributes
    ----------
    rank, condition : of the scaled Jacobian; the condition leaves out the null space.
    null : (k, k - rank) unobservable directions in the problem's own units, each of unit
        length after scaling.
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
    return Observability(rank, condition, _sparse(Vt[rank:].T) / scale[:, None])


def _sparse(null: Array) -> Array:
    """Basis (k, r) of the same space in which r unknowns appear in one direction each."""
    chosen: list[int] = []
    rest = null.copy()
    for _ in range(null.shape[1]):
        pivot = int(np.argmax(np.einsum("ij,ij->i", rest, rest)))
        chosen.append(pivot)
        row = rest[pivot] / np.linalg.norm(rest[pivot])
        rest = rest - np.outer(rest @ row, row)
    basis = null @ np.linalg.inv(null[chosen]) if chosen else null
    return np.asarray(basis / np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny))


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
