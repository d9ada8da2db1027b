"""Own output that comes back."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction import memory as of
from robocal_ros.correction.joint_correction import plain
from robocal_ros.correction.memory import Memory

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Echoes:
    """The last corrected positions, to know them when they come back; without a memory one.

    They are kept in the arm's order.
    """

    def __init__(self, memory: Memory | None = None) -> None:
        self._memory = memory
        self._joints = np.zeros(0, dtype=np.int64)
        self._shape: tuple[int, ...] = ()
        self._positions = np.zeros((1, 0))
        self._within = np.full(1, -1.0) if memory is None else memory.within
        self._kept = np.zeros(1, dtype=np.int64)
        if memory is not None:
            self._kept = memory.counts[of.ECHOED : of.ECHOED + 1]

    def remember(self, index: Index, taught: Array, corrected: Array) -> None:
        """Keep ``corrected`` for a while; one that equals ``taught`` is no echo."""
        order = np.argsort(index)
        if not np.array_equal(index[order], self._joints) or corrected.shape != self._shape:
            self._joints, self._shape = index[order], corrected.shape
            self._positions = np.zeros((1, corrected.size))
            if self._memory is not None:
                room = self._memory.echoes.reshape(-1)[: of.ECHOES * corrected.size]
                self._positions = room.reshape(of.ECHOES, -1)
            self._within[:] = -1.0
        flat = (plain(row[..., order].reshape(-1)) for row in (taught, corrected))
        of.remember_echo(self._positions, self._within, int(self._kept[0]), *flat)
        self._kept += 1

    def holds(self, index: Index, position: Array) -> bool:
        """Whether a position of joints ``index`` is one of them, up to rounding."""
        order = np.argsort(index)
        if position.shape != self._shape or not np.array_equal(index[order], self._joints):
            return False
        flat = plain(position[..., order].reshape(-1))
        return of.is_echo(self._positions, self._within, flat)
