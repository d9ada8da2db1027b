"""Which corner of a profile is which corner of the staircase.

A profile may show more corners than are wanted (concave ones, the block's rear edge, the table) or
fewer. First each profile is laid along the target by the distances between its corners; the pose
that comes of this then tells, for every profile, where each corner must be.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.polyline import CornerFit

Array = NDArray[np.float64]
Index = NDArray[np.int64]

CLEAR = 1.5  # times better than the next, from which a place along the target is sure
NEAR = 0.35  # of the distance between neighbours: farther than this is another corner


@dataclass(frozen=True, eq=False)
class Match:
    """Corners of a profile (rows of its fit) and the target's that they are."""

    rows: Index
    corners: Index

    @property
    def turned(self) -> "Match":
        """The same the other way round, for a profile that shows the whole target."""
        return Match(self.rows, self.corners[::-1])


def along(fit: CornerFit, target: Array) -> Match | None:
    """Lay a profile's corners along all corners (k, 3) of a target; None where it is not clear."""
    k = len(target)
    spacing = np.linalg.norm(np.diff(target, axis=0), axis=1)
    every = np.arange(len(fit.points))
    found: list[tuple[float, Index]] = []
    for rows in (every, every[fit.convex], every[~fit.convex]):
        for first in range(len(rows) - k + 1):
            window = rows[first : first + k]
            own = np.linalg.norm(np.diff(fit.points[window], axis=0), axis=1)
            off = min(_difference(own, spacing), _difference(own, spacing[::-1]))
            if not any(np.array_equal(window, other) for _, other in found):
                found.append((off, window))
    found.sort(key=lambda pair: pair[0])
    if not found or (len(found) > 1 and found[1][0] < CLEAR * found[0][0]):
        return None
    return Match(found[0][1], np.arange(k))


def _difference(own: Array, spacing: Array) -> float:
    """How unlike distances are, a common scale counting little: a tilted plane stretches them."""
    if not len(own):
        return 0.0
    ratio = own / spacing
    return float(np.std(ratio) + 0.1 * abs(np.mean(ratio) - 1.0))


def nearest(fit: CornerFit, predicted: Array) -> Match:
    """The corners that lie where the target's (k, 2) are predicted, sensor frame, m."""
    gap = np.linalg.norm(fit.points[:, None] - predicted[None], axis=2)
    apart = np.linalg.norm(predicted[:, None] - predicted[None], axis=2)
    apart[np.diag_indices_from(apart)] = np.inf
    rows = np.argmin(gap, axis=0)
    least = gap[rows, np.arange(len(predicted))]
    mine = np.argmin(gap, axis=1)[rows] == np.arange(len(predicted))
    near = mine & (least < NEAR * apart.min(axis=1))
    return Match(rows[near].astype(np.int64), np.flatnonzero(near).astype(np.int64))
