"""Some of the parameters by least squares, the others held: the classic identification.

Many cycles at once: all visit the same poses, so that one decomposition serves them all.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import describe, observability
from robocal_ros.ground.errors import RankDeficientError, TooFewSamplesError

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_VISIBLE = 1e-6  # share of an undetermined direction that counts as being in it


@dataclass(frozen=True, eq=False)
class SubsetDrift:
    """Drift of p chosen parameters in t cycles.

    Attributes
    ----------
    chosen : (p,) columns of the parameters.
    drift : (t, p) since the cold visit, SI.
    basis : (3m, p) orthonormal, of the displacements that the chosen parameters can cause.
    inverse : (p, p) from coordinates in that basis to parameters.
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

    Parameters
    ----------
    displacement : (t, 3m) of the spots since the cold visit, m, measuring axes.
    rows : (3m, k) the same by each parameter, measuring axes.
    chosen : columns that may drift; the others are held.
    names : (k,) of all parameters.

    Raises
    ------
    TooFewSamplesError
        With fewer equations than chosen parameters.
    RankDeficientError
        When the poses do not tell the chosen parameters apart.
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
