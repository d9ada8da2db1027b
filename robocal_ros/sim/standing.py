"""When a robot stands, counted in ticks."""

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]

FEWEST = 4  # ticks: a shorter stop, as where a plunge turns, is no rest


class Standing:
    """Looks at what moved, from tick to tick."""

    def __init__(self) -> None:
        self._moved = -FEWEST - 1

    def look(self, tick: int, moved: NDArray[np.bool_]) -> tuple[Index, Index]:
        """Ticks at which a motion begins, and for how many ticks it stood at each (k,).

        ``moved`` (k,): whether it moved until each of the ticks after ``tick``.
        """
        ticks = tick + 1 + np.arange(len(moved))
        last = np.maximum.accumulate(np.where(moved, ticks, self._moved))
        before = np.append(self._moved, last[:-1])
        self._moved = int(last[-1])
        return ticks[moved & (ticks - 1 - before >= FEWEST)] - 1, ticks - last
