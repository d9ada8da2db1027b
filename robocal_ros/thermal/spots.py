"""The measuring poses of a cold reference, and what a warm visit shows against them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import pose_groups
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell import CellModel, make_layout

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SAME_VISIT_RAD = float(np.radians(0.5))
FEWEST_TO_JUDGE = 3  # visits of a spot, so that the others outvote a wrong one
CONTRADICTION = 8.0  # median distances from the spot's median; noise alone stays below 5


@dataclass(frozen=True, eq=False)
class ColdSpots:
    """Each pose and target of a cold visit once.

    Attributes
    ----------
    cell : the cold model with base and targets.
    q : (s, n) mean joints.
    target : (s,) index into the cell's targets.
    error : (s, 3) mean of predicted minus measured position, m; the arm's static errors.
    visits : (s,) how many cold measurements went into it.
    first : (s,) the first of them.
    rejected : names of cold measurements that other visits of the same spot contradict.
    """

    cell: CellModel
    q: Array
    target: Index
    error: Array
    visits: Index
    first: Index
    rejected: tuple[str, ...] = ()

    @classmethod
    def of(cls, cell: CellModel, data: Measurements) -> "ColdSpots":
        """Average the visits of each pose and target, without those that others contradict."""
        target = data.target_index(cell.targets)
        _, spot = np.unique(pose_groups(data.q) * len(cell.targets) + target, return_inverse=True)
        error = cell.residual(data)
        keep = _consistent(error, spot)
        visits = np.bincount(spot[keep])
        mean = np.zeros((len(visits), len(data)))
        mean[spot[keep], np.flatnonzero(keep)] = 1.0 / visits[spot[keep]]
        first = np.array([int(np.flatnonzero(spot == s)[0]) for s in range(len(visits))])
        rejected = tuple(data.sample[i] for i in np.flatnonzero(~keep))
        return cls(cell, mean @ data.q, target[first], mean @ error, visits, first, rejected)

    def knows(self, q: Array) -> NDArray[np.bool_]:
        """Which joint readings (m, n) are those of a cold visit: all joints within 0.5 deg."""
        away = np.max(np.abs(q[:, None] - self.q), axis=2)
        return np.asarray(np.min(away, axis=1) < SAME_VISIT_RAD)

    @cached_property
    def _pose(self) -> Index:
        """Number (s,) of each spot's pose, from 1 in the order of the cold visit."""
        group = pose_groups(self.q)
        first = [int(self.first[group == g].min()) for g in range(int(group.max()) + 1)]
        return np.asarray(1 + np.argsort(np.argsort(first))[group], dtype=np.int64)

    @property
    def poses(self) -> int:
        """How many poses were visited cold."""
        return int(self._pose.max())

    def visited(self, q: Array) -> tuple[int, ...]:
        """Numbers of the cold poses, from 1 in their order, that joint readings (m, n) are at."""
        if not len(q):
            return ()
        away = np.max(np.abs(q[:, None] - self.q), axis=2)
        near = np.argmin(away, axis=1)[np.min(away, axis=1) < SAME_VISIT_RAD]
        return tuple(np.unique(self._pose[near]).tolist())

    def common(self, warm: Measurements) -> Measurements:
        """Those of the measurements that `match` finds a spot for."""
        away = np.max(np.abs(warm.q[:, None] - self.q), axis=2)
        same = np.array(warm.target)[:, None] == np.array(self.cell.targets)[self.target]
        return warm.take(np.any(same & (away < SAME_VISIT_RAD), axis=1))

    def match(self, warm: Measurements) -> Index:
        """The spot (m,) that each warm measurement visits again: all joints within 0.5 deg.

        Raises
        ------
        InputError
            When a measurement has no cold counterpart.
        """
        target = warm.target_index(self.cell.targets)
        away = np.max(np.abs(warm.q[:, None] - self.q), axis=2)
        away[target[:, None] != self.target] = np.inf
        spot = np.argmin(away, axis=1)
        lost = np.flatnonzero(away[np.arange(len(warm)), spot] >= SAME_VISIT_RAD)
        if len(lost):
            i = int(lost[0])
            raise InputError(
                f"sample {warm.sample[i]} of target '{warm.target[i]}' was not measured in the "
                "cold reference: visit the reference poses, or capture a new reference"
            )
        return np.asarray(spot, dtype=np.int64)

    def average(self, warm: Measurements, sigma_m: float) -> Measurements:
        """Average the visits of each spot; ``sigma`` is of the mean.

        ``sigma_m``: of one visit, where the measurements have none of their own.

        Raises
        ------
        InputError
            When a measurement has no cold counterpart.
        """
        _, place, count = np.unique(self.match(warm), return_inverse=True, return_counts=True)
        mean = np.zeros((len(count), len(warm)))
        mean[place, np.arange(len(warm))] = 1.0 / count[place]
        sigma = np.full(len(warm), sigma_m) if warm.sigma is None else warm.sigma
        rows = [np.flatnonzero(place == i) for i in range(len(count))]
        return Measurements(
            q=mean @ warm.q,
            position=mean @ warm.position,
            target=tuple(warm.target[row[0]] for row in rows),
            sample=tuple("+".join(warm.sample[i] for i in row) for row in rows),
            sigma=np.sqrt(mean**2 @ sigma**2),
        )

    def drift(self, warm: Measurements) -> Array:
        """Displacement (m, 3) of the targets since the cold visit, m, measuring axes.

        The joints of both visits are taken as measured: that they differ a little is no drift.
        """
        return np.asarray(self.error[self.match(warm)] - self.cell.residual(warm))

    def rows(self, q: Array, target: Index) -> tuple[Array, Array]:
        """Displacement by the arm's parameters (m, 3, k) and by a shifted set-up (m, 3, 6).

        The set-up's six: sensor (measuring axes), and target on the flange (flange axes).
        """
        arm = self.cell.arm
        layout = make_layout(
            arm,
            self.cell.targets,
            geometry=arm.parameters.names,
            base=False,
            tool=False,
            orientation=False,
        )
        T, J = layout.jacobian(self.cell, np.ascontiguousarray(q), target)
        T_target_flange = np.linalg.inv(self.cell.T_flange_target[:, :3, :3])
        own = T[:, :3, :3] @ T_target_flange[target]
        return J, np.concatenate([np.broadcast_to(np.eye(3), own.shape), own], axis=2)


def _consistent(error: Array, spot: Index) -> NDArray[np.bool_]:
    """Which cold errors (m, 3) agree with the median of their spot (three visits or more)."""
    count = np.bincount(spot)
    median = np.array([np.median(error[spot == s], axis=0) for s in range(len(count))])
    away = np.linalg.norm(error - median[spot], axis=1)
    judged = count[spot] >= FEWEST_TO_JUDGE
    if not np.any(judged):
        return np.ones(len(error), dtype=np.bool_)
    return np.asarray(~judged | (away <= CONTRADICTION * np.median(away[judged])))
