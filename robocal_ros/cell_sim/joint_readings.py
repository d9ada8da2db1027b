"""Joint readings at their own rate, and what faults make of them."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.cell_faults import Faults
from robocal_ros.cell_sim.draws import Draws, Stream
from robocal_ros.cell_sim.joint_motion import JointMotion
from robocal_ros.cell_sim.motion import COUNT_RAD

Array = NDArray[np.float64]

PAGE = 128  # readings whose random numbers belong together
KEPT = 4  # pages


class JointReadings:
    """Reads encoders at ``k / rate_hz``; ``noise_rad``: of a reading, 0 makes it exact."""

    def __init__(
        self, rate_hz: float, noise_rad: float, faults: Faults, draws: Draws, n: int
    ) -> None:
        self._rate, self._noise, self._n = rate_hz, noise_rad, n
        self._faults, self._draws = faults, draws
        self._next, self._stamp_s = 0, 0.0
        self._stuck: float | None = None
        self._page = lru_cache(KEPT)(self._page_of)

    def due(self, now_s: float) -> NDArray[np.int64]:
        """Numbers of the readings since the last call."""
        first = self._next
        self._next = int(np.floor(now_s * self._rate * (1.0 + 1e-12))) + 1
        return np.arange(first, self._next)

    def read(self, number: NDArray[np.int64], motion: JointMotion) -> tuple[Array, Array, Array]:
        """Stamps (k,), joints and velocities (k, n) of what is told of these readings."""
        time = number / self._rate
        q, qd = motion.at(time)
        if self._noise > 0.0:
            noise = self._paged(Stream.READINGS, number, self._n)
            q = np.round((q + self._noise * noise) / COUNT_RAD) * COUNT_RAD
        self._freeze(q, qd)
        told = self._told(number)
        return self._stamps(time)[told], q[told], qd[told]

    def _told(self, number: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which readings get through."""
        faults = self._faults
        if "lost_messages" in faults:
            chance = self._paged(Stream.LOST_READINGS, number, 1, uniform=True)[:, 0]
            return np.asarray(chance >= faults.size("lost_messages"))
        return np.full(len(number), "joints_silent" not in faults)

    def _stamps(self, time_s: Array) -> Array:
        if "frozen_clock" in self._faults:
            return np.full(len(time_s), self._stamp_s)
        if len(time_s):
            self._stamp_s = float(time_s[-1])
        return time_s + self._faults.size("clock_jump")

    def _freeze(self, q: Array, qd: Array) -> None:
        """One encoder shows what it showed when the fault began."""
        joint = min(int(self._faults.size("frozen_encoder")), self._n) - 1
        if joint < 0:
            self._stuck = None
        elif len(q):
            if self._stuck is None:
                self._stuck = float(q[0, joint])
            q[:, joint], qd[:, joint] = self._stuck, 0.0

    def _paged(
        self, stream: Stream, number: NDArray[np.int64], width: int, uniform: bool = False
    ) -> Array:
        """Random numbers (k, width) that belong to these readings."""
        rows = np.empty((len(number), width))
        pages = number // PAGE
        for page in np.unique(pages).tolist():
            drawn = self._page(stream, page, width, uniform)
            rows[pages == page] = drawn[number[pages == page] % PAGE]
        return rows

    def _page_of(self, stream: Stream, page: int, width: int, uniform: bool) -> Array:
        rng, shape = self._draws.of(stream, page), (PAGE, width)
        return rng.random(shape) if uniform else rng.standard_normal(shape)
