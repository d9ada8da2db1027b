"""How far the robot is off this time: anew for each motion, reached smoothly."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SETTLE_S = 0.05  # another one is reached smoothly: the flange never jumps
KEPT = 32  # motions in one stretch of time that is looked at


class Scatter:
    """Offsets (k,) over time, each from a motion's begin on."""

    def __init__(self, size: int) -> None:
        self._time_s = np.array([-np.inf])
        self._before = self._after = np.zeros((1, size))

    @property
    def settled_s(self) -> float:
        """When the last one is reached."""
        return float(self._time_s[-1]) + SETTLE_S

    def begin(self, time_s: float, offset: Array) -> None:
        """Another offset (k,), from a time on that is not before the last one."""
        before = self.at(np.array([time_s]))
        self._time_s = np.append(self._time_s, time_s)[-KEPT:]
        self._before = np.vstack([self._before, before])[-KEPT:]
        self._after = np.vstack([self._after, offset])[-KEPT:]

    def at(self, time_s: Array) -> Array:
        """Offsets (m, k) at times (m,)."""
        i = np.maximum(np.searchsorted(self._time_s, time_s, side="right") - 1, 0)
        share = np.clip((time_s - self._time_s[i]) / SETTLE_S, 0.0, 1.0)[:, None]
        smooth = share**2 * (3.0 - 2.0 * share)
        return np.asarray(self._before[i] + smooth * (self._after[i] - self._before[i]))
