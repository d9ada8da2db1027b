"""When a robot stands, counted in ticks."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.profile_station import ProfileStation
from robocal_ros.cell_sim.sphere_station import SphereStation
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]
Index = NDArray[np.int64]

TICK_S = 8e-3  # the cell works in whole ticks, so that it does not matter when it is asked
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


def standstills(
    station: SphereStation | ProfileStation, arm: SerialArm, ticks: Index, q: Array, stood: Index
) -> list[int]:
    """Ticks at which a station near the robot measures: it has ``stood`` (k,) for so many ticks.

    ``q`` (k, n) joints at ``ticks`` (k,).
    """
    settle, period = round(station.settle_s / TICK_S), round(station.period_s / TICK_S)
    due = np.flatnonzero((stood >= settle) & ((stood - settle) % period == 0))
    return [int(ticks[i]) for i in due if station.near(arm.fk(q[i]))]
