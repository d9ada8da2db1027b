"""Where the joints are at any time: a path of way points with rests, and readings of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

JITTER_RAD = 1e-6  # of a resting joint's reading: servo hum and encoder counts
COUNT_RAD = 1e-6


@dataclass(frozen=True, eq=False)
class Path:
    """Way points in order of time; between them the joints run smoothly (minimum jerk).

    Attributes
    ----------
    arrive, depart : (w,) times of each way point, s.
    q : (w, n) joint values there, rad.
    """

    arrive: Array
    depart: Array
    q: Array

    def at(self, time_s: Array) -> Array:
        """Joint values (k, n) at times (k,); resting before the first and after the last point."""
        after = np.clip(np.searchsorted(self.arrive, time_s), 1, len(self.arrive) - 1)
        start, end = self.depart[after - 1], self.arrive[after]
        s = np.clip((time_s - start) / (end - start), 0.0, 1.0)[:, None]
        share = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        return np.asarray(self.q[after - 1] + share * (self.q[after] - self.q[after - 1]))


def readings(path: Path, time_s: Array, rng: np.random.Generator) -> Array:
    """Encoder readings (k, n) at times (k,), in whole counts."""
    q = path.at(time_s)
    q = q + JITTER_RAD * rng.standard_normal(q.shape)
    return np.asarray(np.round(q / COUNT_RAD) * COUNT_RAD)
