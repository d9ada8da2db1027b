"""Motions of the flange at a beam station: circles with a rippling speed, plunges, sweeps.

Each gives T_base_flange (m, 4, 4) at times (m,); the orientation is held.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def _moved(T_base_flange: Array, shift: Array) -> Array:
    T = np.tile(T_base_flange, (len(shift), 1, 1))
    T[:, :3, 3] += shift
    return T


@dataclass(frozen=True, eq=False)
class Circle:
    """One turn, from ``start_s``, with a run-up and a run-out of ``ramp_s`` along the circle.

    Attributes
    ----------
    T_base_centre : (4, 4) the flange at the centre.
    R_base_laser : (3, 3) the circle lies in its x-y plane; ``start_rad`` counts from x.
    ripple : relative amplitude of the speed, ``ripples`` times a turn.
    """

    T_base_centre: Array
    R_base_laser: Array
    radius: float
    period_s: float
    start_s: float = 0.0
    start_rad: float = float(np.pi / 4.0)
    direction: int = 1
    ripple: float = 0.0
    ripples: int = 7
    phase_rad: float = 0.0
    ramp_s: float = 0.2

    @property
    def window(self) -> tuple[float, float]:
        """The turn at full speed."""
        return self.start_s, self.start_s + self.period_s

    @property
    def span(self) -> tuple[float, float]:
        """From rest to rest."""
        return self.start_s - self.ramp_s, self.start_s + self.period_s + self.ramp_s

    def starting(self, start_s: float) -> "Circle":
        """The same turn, begun at another time."""
        return replace(self, start_s=start_s)

    def __call__(self, time_s: Array) -> Array:
        """T_base_flange (m, 4, 4)."""
        t = time_s - self.start_s
        before = np.clip(t, -self.ramp_s, 0.0)
        after = np.clip(t - self.period_s, 0.0, self.ramp_s)
        run = np.clip(t, 0.0, self.period_s) + before + after
        run += (before**2 - after**2) / (2.0 * self.ramp_s)
        turn = 2.0 * np.pi * run / self.period_s
        turn = turn + self.ripple / self.ripples * np.sin(self.ripples * turn + self.phase_rad)
        angle = self.start_rad + self.direction * turn
        flat = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
        return _moved(self.T_base_centre, self.radius * flat @ self.R_base_laser.T)


@dataclass(frozen=True, eq=False)
class Plunge:
    """Down and up again along ``down`` (3,), base, at ``speed`` but for the ramps at each end."""

    T_base_top: Array
    down: Array
    depth: float
    speed: float
    start_s: float = 0.0
    ramp_s: float = 0.1

    @property
    def window(self) -> tuple[float, float]:
        """From rest to rest."""
        return self.start_s, self.start_s + 2.0 * self._one_way_s

    @property
    def span(self) -> tuple[float, float]:
        """The same."""
        return self.window

    @property
    def _one_way_s(self) -> float:
        return self.depth / self.speed + self.ramp_s

    def __call__(self, time_s: Array) -> Array:
        """T_base_flange (m, 4, 4)."""
        whole, ramp = self._one_way_s, self.ramp_s
        t = whole - np.abs(np.clip(time_s - self.start_s, 0.0, 2.0 * whole) - whole)
        t = np.clip(t, 0.0, whole)
        to_go = whole - t
        depth = np.where(
            to_go < ramp,
            self.depth - self.speed * to_go**2 / (2.0 * ramp),
            np.where(t < ramp, self.speed * t**2 / (2.0 * ramp), self.speed * (t - 0.5 * ramp)),
        )
        return _moved(self.T_base_top, depth[:, None] * self.down)


@dataclass(frozen=True, eq=False)
class Sweep:
    """At constant speed along ``along`` (3,), base, m; backwards where ``duration_s`` < 0."""

    T_base_start: Array
    along: Array
    duration_s: float

    @property
    def window(self) -> tuple[float, float]:
        """From begin to end."""
        return min(self.duration_s, 0.0), max(self.duration_s, 0.0)

    def __call__(self, time_s: Array) -> Array:
        """T_base_flange (m, 4, 4)."""
        return _moved(self.T_base_start, (time_s / self.duration_s)[:, None] * self.along)
