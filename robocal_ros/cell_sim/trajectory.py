"""A joint trajectory, and what a joint trajectory controller reads from it at a time.

As `Trajectory` of ros2_controllers' joint_trajectory_controller 4.42.1 does
(joint_trajectory_controller/src/trajectory.cpp).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Index = NDArray[np.int64]

WITH_SPEED, WITH_BOTH, WITHOUT_SPEED = 1, 3, 2  # what both ends of a stretch have beside positions


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Points for joints ``names``, as a message holds them.

    Attributes
    ----------
    time_s : (k,) from the start.
    q, qd, qdd : (k, n) rad, rad/s, rad/s² (prismatic: m); zeros where a point has none.
    has_qd, has_qdd : (k,) which points have them.
    start_s : when it starts; None: when the controller first samples it.
    """

    names: tuple[str, ...]
    time_s: Array
    q: Array
    qd: Array
    qdd: Array
    has_qd: Flags
    has_qdd: Flags
    start_s: float | None = None

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        time_s: ArrayLike,
        q: ArrayLike,
        qd: ArrayLike | None = None,
        qdd: ArrayLike | None = None,
        start_s: float | None = None,
    ) -> "Trajectory":
        """Make one whose points all have the same."""
        time, rows = np.asarray(time_s, dtype=np.float64), np.asarray(q, dtype=np.float64)
        given = [np.full(len(time), part is not None) for part in (qd, qdd)]
        qd, qdd = (
            np.zeros_like(rows) if part is None else np.asarray(part, dtype=np.float64)
            for part in (qd, qdd)
        )
        return cls(tuple(names), time, rows, qd, qdd, given[0], given[1], start_s)


class SampledPath:
    """A trajectory with where the joints were when it was first sampled.

    Between points lie lines, cubics or quintics, as both have positions alone, velocities too, or
    accelerations too. The first stretch begins at ``q``, ``qd`` (n,), at ``before_s`` where that
    is not ``now_s``, when it is first sampled; a controller
    whose drives give no velocities (``qd`` None) takes them as 0 where the first point has some.
    Accelerations without velocities give 0 for everything, as they do in the original.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        now_s: float,
        q: Array,
        qd: Array | None,
        before_s: float | None = None,
    ) -> None:
        of = trajectory
        start_s = now_s if of.start_s is None else of.start_s
        self.start_s, self.count, self._points_s = start_s, len(of.time_s), start_s + of.time_s
        self._knots = np.append(now_s if before_s is None else before_s, self._points_s)
        zeros = np.zeros_like(q)
        begin = (q, zeros if qd is None else qd, zeros)
        rows = [
            np.vstack([first, part])
            for first, part in zip(begin, (of.q, of.qd, of.qdd), strict=True)
        ]
        has_qd = np.append(qd is not None or of.has_qd[0], of.has_qd)
        has_qdd = np.append(of.has_qdd[0], of.has_qdd)
        ends = [has_qd[:-1] & has_qd[1:], has_qdd[:-1] & has_qdd[1:]]
        kind = ends[0] * WITH_SPEED + ends[1] * WITHOUT_SPEED
        # A first point that has been passed already has no stretch before it.
        long_s = np.diff(self._knots)
        long_s[0] = max(long_s[0], 1e-9)
        self._polynomials = _coefficients(long_s[:, None], rows, kind)
        self._last = np.stack([part[-1] for part in rows])

    @property
    def end_s(self) -> float:
        """When its last point is due."""
        return float(self._points_s[-1])

    def sample(self, time_s: Array) -> tuple[Array, Array, Array, Index]:
        """Positions, velocities, accelerations (m, n) at times (m,), and how many are past."""
        past = np.searchsorted(self._points_s, time_s, side="right")
        stretch = np.minimum(past, len(self._points_s) - 1)
        t = (time_s - self._knots[stretch])[:, None]
        c = self._polynomials[:, stretch]
        q = c[0] + t * (c[1] + t * (c[2] + t * (c[3] + t * (c[4] + t * c[5]))))
        qd = c[1] + t * (2.0 * c[2] + t * (3.0 * c[3] + t * (4.0 * c[4] + t * 5.0 * c[5])))
        qdd = 2.0 * c[2] + t * (6.0 * c[3] + t * (12.0 * c[4] + t * 20.0 * c[5]))
        over = past == len(self._points_s)
        q[over], qd[over], qdd[over] = self._last
        return q, qd, qdd, past


def _coefficients(h: Array, rows: list[Array], kind: Index) -> Array:
    """Polynomials (6, k - 1, n) by powers of the time since each stretch's begin.

    ``h`` (k - 1, 1) their lengths, s; ``rows``: positions, velocities, accelerations (k, n).
    """
    q0, v0, a0 = (part[:-1] for part in rows)
    q1, v1, a1 = (part[1:] for part in rows)
    c = np.zeros((6, *q0.shape))
    way = q1 - q0
    line, cubic, quintic = kind == 0, kind == WITH_SPEED, kind == WITH_BOTH
    c[0, kind != WITHOUT_SPEED] = q0[kind != WITHOUT_SPEED]
    c[1, line] = (way / h)[line]
    c[1, cubic | quintic] = v0[cubic | quintic]
    c[2, cubic] = ((3.0 * way - (2.0 * v0 + v1) * h) / h**2)[cubic]
    c[3, cubic] = ((-2.0 * way + (v0 + v1) * h) / h**3)[cubic]
    c[2, quintic] = 0.5 * a0[quintic]
    bend = (a1 - 3.0 * a0) * h**2
    c[3, quintic] = ((20.0 * way - (12.0 * v0 + 8.0 * v1) * h + bend) / (2.0 * h**3))[quintic]
    bend = (3.0 * a0 - 2.0 * a1) * h**2
    c[4, quintic] = ((-30.0 * way + (16.0 * v0 + 14.0 * v1) * h + bend) / (2.0 * h**4))[quintic]
    bend = (a1 - a0) * h**2
    c[5, quintic] = ((12.0 * way - 6.0 * (v0 + v1) * h + bend) / (2.0 * h**5))[quintic]
    return c
