"""Recorded cycles in which the spots and, apart from them, check points were measured."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.ground.samples import Measurements
from robocal_ros.thermal.spots import ColdSpots
from robocal_ros.thermal.subset import subset_drift

Array = NDArray[np.float64]

THRESHOLD_M = 1e-4
FEWEST_CYCLES = 21  # as many as the test of stationarity needs


@dataclass(frozen=True, eq=False)
class DriftHistory:
    """Displacements since the cold visit in t cycles, in order of time.

    Attributes
    ----------
    names : (k,) parameters.
    displacement, rows : (t, 3m) at the spots, m, and (3m, k) the same by each parameter, in
        measuring axes. They identify.
    check, check_rows : (t, 3c) and (3c, k) at the check points, in axes of their own if need
        be. They judge.
    """

    names: tuple[str, ...]
    displacement: Array
    rows: Array
    check: Array
    check_rows: Array

    def __post_init__(self) -> None:
        k, t = len(self.names), len(self.displacement)
        shapes = ((self.displacement, self.rows), (self.check, self.check_rows))
        if any(y.shape != (t, len(A)) or A.shape[1] != k for y, A in shapes):
            raise ValueError("displacements must be (t, n) with rows (n, k) of the k names")

    @classmethod
    def of(
        cls, spots: ColdSpots, cycles: Sequence[Measurements], checks: Sequence[Measurements]
    ) -> "DriftHistory":
        """Collect cycles: what each measured to identify, and what to judge by.

        A cycle without one of the poses is left out. Visits of a spot in one cycle are averaged.

        Raises
        ------
        InputError
            When a sample has no cold counterpart, or serves both ends.
        TooFewSamplesError
            With fewer than 21 complete cycles.
        """
        seen = [_by_spot(spots, cycle) for cycle in cycles]
        told = [_by_spot(spots, cycle) for cycle in checks]
        own, other = (tuple(sorted(set().union(*group))) for group in (seen, told))
        if set(own) & set(other):
            raise InputError("a pose that identifies cannot judge: name check poses apart")
        complete = [
            i
            for i, (a, b) in enumerate(zip(seen, told, strict=True))
            if len(a) == len(own) and len(b) == len(other)
        ]
        if len(complete) < FEWEST_CYCLES or not own or not other:
            raise TooFewSamplesError(
                f"{len(complete)} of {len(seen)} cycles visited all {len(own)} poses and "
                f"{len(other)} check poses: screening needs {FEWEST_CYCLES} such cycles"
            )
        return cls(
            spots.cell.arm.parameters.names,
            np.array([np.concatenate([seen[i][spot] for spot in own]) for i in complete]),
            _rows(spots, own),
            np.array([np.concatenate([told[i][spot] for spot in other]) for i in complete]),
            _rows(spots, other),
        )

    def residual(self, chosen: Sequence[int]) -> Array:
        """What is left (t, 3c) at the check points with some parameters (columns) identified.

        Raises
        ------
        TooFewSamplesError, RankDeficientError
            When the spots do not determine them.
        """
        if not len(chosen):
            return self.check
        found = subset_drift(self.displacement, self.rows, chosen, self.names)
        return np.asarray(self.check - found.drift @ self.check_rows[:, found.chosen].T)


def share_within(residual: Array, threshold_m: float = THRESHOLD_M) -> float:
    """The share lambda of residual coordinates (any shape), m, below a threshold.

    Each cycle, check point and axis (x, y, z apart) counts once. The source counts each axis of
    each point once for all cycles (7.95 % is 7 of its 88 directions) and does not say how it
    sums the cycles up; counted apart, none hides behind the others.
    """
    return float(np.mean(np.abs(residual) < threshold_m))


def _by_spot(spots: ColdSpots, cycle: Measurements) -> dict[int, Array]:
    """Mean displacement (3,) at each spot that a cycle visited."""
    spot, drift = spots.match(cycle), spots.drift(cycle)
    return {int(s): drift[spot == s].mean(axis=0) for s in np.unique(spot)}


def _rows(spots: ColdSpots, own: tuple[int, ...]) -> Array:
    index = np.array(own, dtype=np.int64)
    return spots.rows(spots.q[index], spots.target[index])[0].reshape(3 * len(own), -1)
