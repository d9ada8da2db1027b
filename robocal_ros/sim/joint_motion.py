"""Joints that follow trajectories as a joint trajectory controller makes them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.core.errors import InputError

Array = NDArray[np.float64]

EARLIER_S = 5e-3  # a motion may be asked for where it was so long before its begin


class JointMotion:
    """What the joints do: one trajectory at a time, before and after it they stand still.

    Between points lie lines, cubics or quintics, as the points carry positions alone, velocities
    too, or accelerations too: as joint_trajectory_controller interpolates.

    Parameters
    ----------
    q : (n,) where the joints stand at time 0, rad (prismatic: m).

    Attributes
    ----------
    end_s : when the last trajectory ends.
    """

    def __init__(self, q: ArrayLike) -> None:
        self._stand(0.0, np.asarray(q, dtype=np.float64))

    def follow(
        self,
        now_s: float,
        time_s: ArrayLike,
        q: ArrayLike,
        qd: ArrayLike | None = None,
        qdd: ArrayLike | None = None,
    ) -> None:
        """Follow another trajectory from ``now_s`` on, wherever the joints are and move by then.

        ``time_s`` (k,) on the motion's own clock; ``q``, ``qd``, ``qdd`` (k, n). Points that lie
        at ``now_s`` or before give way to where the joints really are; from there it goes to the
        first point that is left.

        Raises
        ------
        InputError
            When shapes differ, numbers are not finite, times do not increase, or no point is left.
        """
        from scipy.interpolate import BPoly

        here, moving = self.at([now_s])
        begin = [here[0], moving[0], np.zeros_like(here[0])]
        given = [np.asarray(rows, dtype=np.float64) for rows in (q, qd, qdd) if rows is not None]
        time = np.asarray(time_s, dtype=np.float64)
        for rows in given:
            if rows.shape != (len(time), len(here[0])):
                wanted = (len(time), len(here[0]))
                raise InputError(f"the trajectory's rows have shape {rows.shape}, not {wanted}")
        if not all(np.all(np.isfinite(rows)) for rows in (time, *given)):
            raise InputError("the trajectory holds a number that is not finite")
        if np.any(np.diff(time) <= 0.0):
            raise InputError("the times of the trajectory do not increase")
        left = time > now_s
        if not np.any(left):
            raise InputError("all points of the trajectory lie in the past: there is no way left")
        knots = np.append(now_s, time[left])
        points = [np.vstack([first, part[left]]) for first, part in zip(begin, given, strict=False)]
        self._path = BPoly(_bernstein(knots, points), knots)
        self._rate = self._path.derivative()
        self._begin_s, self.end_s = now_s, float(time[-1])

    def hold(self, now_s: float) -> None:
        """Stand still where the joints are at ``now_s``, at once: no deceleration is simulated."""
        self._stand(now_s, self.at([now_s])[0][0])

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Joints (k, n) and their velocities at times (k,) from the last trajectory's begin on."""
        t = np.asarray(time_s, dtype=np.float64)
        moving = (t < self.end_s)[:, None]
        return self.joints(t), np.where(moving, self._rate(self._inside(t)), 0.0)

    def joints(self, time_s: Array) -> Array:
        """The joints (k, n) alone."""
        return np.asarray(self._path(self._inside(time_s)))

    def _inside(self, time_s: Array) -> Array:
        return np.clip(time_s, self._begin_s - EARLIER_S, self.end_s)

    def _stand(self, now_s: float, q: Array) -> None:
        from scipy.interpolate import BPoly

        self._begin_s = self.end_s = now_s
        self._path = BPoly(np.tile(q, (1, 1, 1)), [now_s, now_s + 1.0])
        self._rate = BPoly(np.zeros((1, 1, len(q))), [now_s, now_s + 1.0])


def _bernstein(time_s: Array, rows: Sequence[Array]) -> Array:
    """Coefficients (2 r, k - 1, n) of the polynomials through points (k,) with r ``rows`` (k, n).

    ``rows``: positions, velocities, accelerations, of which the later ones may be missing.
    """
    h = np.diff(time_s)[:, None]
    degree = 2 * len(rows) - 1
    start, end = [rows[0][:-1]], [rows[0][1:]]
    if len(rows) > 1:
        start.append(start[0] + rows[1][:-1] * h / degree)
        end.append(end[0] - rows[1][1:] * h / degree)
    if len(rows) > 2:
        bend = h**2 / (degree * (degree - 1))
        start.append(2.0 * start[1] - start[0] + rows[2][:-1] * bend)
        end.append(2.0 * end[1] - end[0] + rows[2][1:] * bend)
    return np.stack([*start, *reversed(end)])
