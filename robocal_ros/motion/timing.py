"""A way over time: from rest to a constant speed and back to rest, smoothly."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHORTEST_RAMP_S = 0.07  # a controller smooths over some of its cycles
SPACING_S = 0.01  # of points; the cubic between two of a circle of 12 mm misses by nanometres
MOST_POINTS = 200  # of one phase


@dataclass(frozen=True)
class Ride:
    """A way of ``length_m`` at ``speed_m_s`` but for two ramps of ``ramp_s``.

    On a ramp the speed is v (3 u^2 - 2 u^3), u from 0 to 1: its acceleration begins and ends at
    zero, and is 1.5 v / ramp_s at most.
    """

    length_m: float
    speed_m_s: float
    ramp_s: float

    @classmethod
    def within(cls, length_m: float, speed_m_s: float, acceleration_m_s2: float) -> "Ride":
        """The fastest within bounds; a short way does not reach the speed."""
        reached = min(
            speed_m_s,
            length_m / SHORTEST_RAMP_S,
            float(np.sqrt(length_m * acceleration_m_s2 / 1.5)),
        )
        return cls(length_m, reached, ramp_of(reached, acceleration_m_s2))

    @property
    def cruise_s(self) -> float:
        """At constant speed."""
        if self.speed_m_s == 0.0:
            return 0.0
        return max(self.length_m / self.speed_m_s - self.ramp_s, 0.0)

    @property
    def duration_s(self) -> float:
        """From rest to rest."""
        return self.cruise_s + 2.0 * self.ramp_s

    def times(self) -> Array:
        """Times (k,) for points: dense enough for cubics, and where a phase begins or ends."""
        ends = np.cumsum([0.0, self.ramp_s, self.cruise_s, self.ramp_s])
        phases = [np.zeros(1)]
        for start, end in pairwise(ends):
            count = min(int(np.ceil((end - start) / SPACING_S - 1e-6)), MOST_POINTS)
            phases.append(np.linspace(start, end, count + 1)[1:])
        return np.concatenate(phases)

    def __call__(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Way, speed and acceleration (k,) along it."""
        v, ramp = self.speed_m_s, self.ramp_s
        to_go = self.duration_s - time_s
        late = to_go < time_s  # the second half mirrors the first
        t = np.where(late, to_go, time_s)
        u = np.clip(t / ramp, 0.0, 1.0)
        way = v * (ramp * (u**3 - 0.5 * u**4) + np.maximum(t - ramp, 0.0))
        push = 6.0 * v / ramp * (u - u * u)
        return (
            np.where(late, self.length_m - way, way),
            v * (3.0 * u**2 - 2.0 * u**3),
            np.where(late, -push, push),
        )


def ramp_of(speed_m_s: float, acceleration_m_s2: float) -> float:
    """Duration of a ramp up to a speed, s."""
    return max(SHORTEST_RAMP_S, 1.5 * speed_m_s / acceleration_m_s2)
