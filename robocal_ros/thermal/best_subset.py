"""The best subset of parameters by Mallows' C_p: the baseline before screening by lambda.

C_p weighs the sum of all squared residuals against the number of parameters, so that a few bad
points can hide in it. The search goes through every subset of the size, a million for 8 or 9 of
24: the many that explain about the same would leave a branch-and-bound search little to skip.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, combinations, islice

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import TooFewSamplesError
from robocal_ros.thermal.drift_history import DriftHistory
from robocal_ros.thermal.subset import entangled

Array = NDArray[np.float64]
Branch = tuple[tuple[int, ...], tuple[int, ...]]

_AT_ONCE = 20_000


@dataclass(frozen=True)
class BestSubset:
    """The subset of its size that explains most.

    Attributes
    ----------
    names : its parameters.
    cp : Mallows' C_p per cycle; a subset without bias has about as much as it has parameters.
    """

    names: tuple[str, ...]
    cp: float


def best_subset(history: DriftHistory, size: int) -> BestSubset:
    """Find the subset of a size with the smallest C_p, exactly (8 of 24: some seconds).

    With the same parameters in all t cycles, C_p = RSS / (t s^2) - 3m + 2p; s^2 is what all
    parameters together leave, per degree of freedom. Only the spots' displacements are used.

    Raises
    ------
    TooFewSamplesError
        When no equations are left over that could show the noise.
    ValueError
        When the size is not between 1 and the number that the poses determine.
    """
    Y, A = history.displacement, history.rows
    branches = tuple(_determined(A, tuple(range(A.shape[1])), ()))
    everything = sum(branches[0], start=())
    freedom = len(A) - len(everything)
    if freedom < 1:
        raise TooFewSamplesError(
            f"{len(A)} equations for {len(everything)} parameters leave none to show the noise: "
            "measure more"
        )
    if not 1 <= size <= len(everything):
        raise ValueError(f"size must be 1 to the {len(everything)} that the poses determine")
    chosen = _most_explaining(A, Y, branches, size)
    noise = _rss(A, Y, everything) / (len(Y) * freedom)
    cp = _rss(A, Y, chosen) / (len(Y) * noise) - len(A) + 2 * size
    return BestSubset(tuple(history.names[i] for i in sorted(chosen)), cp)


def _determined(A: Array, left: tuple[int, ...], kept: tuple[int, ...]) -> Iterator[Branch]:
    """Split the subsets of columns that the equations determine: free columns, and kept ones.

    Every such subset misses a member of an open direction, and by the first that it misses it
    belongs to one branch.
    """
    members = entangled(A, kept + left)
    if not members:
        yield left, kept
        return
    options = tuple(member for member in members if member in left)
    for i, member in enumerate(options):
        before = options[:i]
        rest = tuple(c for c in left if c != member and c not in before)
        yield from _determined(A, rest, kept + before)


def _most_explaining(
    A: Array, Y: Array, branches: tuple[Branch, ...], size: int
) -> tuple[int, ...]:
    """The columns that explain most of Y: the trace of (A_s^T A_s)^-1 A_s^T Y Y^T A_s."""
    length = np.linalg.norm(A, axis=0)
    scaled = A / np.where(length > 0.0, length, 1.0)
    normal, cross = scaled.T @ scaled, scaled.T @ Y.T
    power = cross @ cross.T
    best: tuple[int, ...] = ()
    most = -np.inf
    for subsets in _subsets(branches, size):
        index = subsets[:, :, None], subsets[:, None, :]
        explained = np.einsum("nij,nij->n", np.linalg.inv(normal[index]), power[index])
        i = int(np.argmax(explained))
        if explained[i] > most:
            most, best = float(explained[i]), tuple(int(c) for c in subsets[i])
    return best


def _subsets(branches: tuple[Branch, ...], size: int) -> Iterator[NDArray[np.int64]]:
    """All determined subsets of a size, some thousands (n, size) at once."""
    for left, kept in branches:
        if len(kept) > size:
            continue
        more = (kept + chosen for chosen in combinations(left, size - len(kept)))
        while part := list(islice(more, _AT_ONCE)):
            flat = np.fromiter(chain.from_iterable(part), dtype=np.int64, count=len(part) * size)
            yield flat.reshape(-1, size)


def _rss(A: Array, Y: Array, chosen: tuple[int, ...]) -> float:
    """Sum of the squared residuals of all cycles."""
    Q = np.linalg.qr(A[:, list(chosen)])[0]
    return float(np.sum((Y - Y @ Q @ Q.T) ** 2))
