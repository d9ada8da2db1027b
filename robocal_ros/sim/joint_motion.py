"""Joints that follow trajectories as a joint trajectory controller makes them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.core.errors import InputError

if TYPE_CHECKING:
    from scipy.interpolate import BPoly

Array = NDArray[np.float64]

EARLIER_S = 5e-3  # a motion may be asked for where it was so long before its begin
ROOM = 0.05  # above the greatest speed: a correction adds a little to the programme's
BRAKES_S = 0.4  # from the greatest speed to rest
LOOKS = np.linspace(0.0, 1.0, 17)  # of each stretch: its peak is missed by less than 1 %


class JointMotion:
    """What the joints do: one trajectory at a time, before and after it they stand still.

    Between points lie lines, cubics or quintics, as the points carry positions alone, velocities
    too, or accelerations too: as joint_trajectory_controller interpolates. A trajectory with a
    joint faster than its drive by more than `ROOM` is a drive fault: none of it is followed, the
    robot brakes. Nobody is answered: who commands sees it in the readings alone.

    Parameters
    ----------
    q : (n,) where the joints stand at time 0, rad (prismatic: m).
    fastest : (n,) or one for all: the drives' greatest speeds, rad/s (prismatic: m/s).

    Attributes
    ----------
    end_s : when the last trajectory ends.
    peak : (n,) greatest speeds that were commanded, followed or not, rad/s (prismatic: m/s).
    faults : number of drive faults; ``fault``: what the last one was.
    """

    def __init__(self, q: ArrayLike, fastest: ArrayLike = np.inf) -> None:
        here = np.asarray(q, dtype=np.float64)
        self._fastest = np.broadcast_to(np.asarray(fastest, dtype=np.float64), here.shape)
        self.peak, self.faults, self.fault = np.zeros_like(here), 0, ""
        self._stand(0.0, here)

    @property
    def peak_share(self) -> float:
        """The greatest speed that was commanded, over that of its drive."""
        return float(np.max(self.peak / self._fastest))

    def follow(
        self,
        now_s: float,
        time_s: ArrayLike,
        q: ArrayLike,
        qd: ArrayLike | None = None,
        qdd: ArrayLike | None = None,
    ) -> bool:
        """Follow another trajectory from ``now_s`` on, wherever the joints are and move by then.

        ``time_s`` (k,) on the motion's own clock; ``q``, ``qd``, ``qdd`` (k, n). Points that lie
        at ``now_s`` or before give way to where the joints really are; from there it goes to the
        first point that is left. False: a drive fault, the robot brakes.

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
        path = BPoly(_bernstein(knots, points), knots)
        if self._too_fast(path.derivative(), knots):
            self._brake(now_s, here[0], moving[0])
            return False
        self._go(path)
        return True

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

    def _too_fast(self, rate: "BPoly", knots: Array) -> bool:
        """Look at the speeds of a trajectory; whether they are a drive fault."""
        looks = knots[:-1, None] + np.diff(knots)[:, None] * LOOKS
        speed = np.max(np.abs(rate(looks.ravel())), axis=0)
        self.peak = np.maximum(self.peak, speed)
        joint = int(np.argmax(speed / self._fastest))
        if speed[joint] <= (1.0 + ROOM) * self._fastest[joint]:
            return False
        self.faults += 1
        self.fault = (
            f"drive fault: joint {joint + 1} is sent at {speed[joint]:.3g} rad/s (sliding: m/s), "
            f"its drive reaches {self._fastest[joint]:.3g}; the robot brakes: send a trajectory "
            "that is slower and begins where the robot is"
        )
        return True

    def _brake(self, now_s: float, q: Array, qd: Array) -> None:
        """All joints slow down evenly and come to rest together."""
        from scipy.interpolate import BPoly

        long_s = BRAKES_S * float(np.max(np.abs(qd) / self._fastest))
        if long_s == 0.0:
            self._stand(now_s, q)
            return
        rest = q + 0.5 * long_s * qd
        self._go(BPoly(np.stack([q, rest, rest])[:, None], [now_s, now_s + long_s]))

    def _go(self, path: "BPoly") -> None:
        self._path, self._rate = path, path.derivative()
        self._begin_s, self.end_s = float(path.x[0]), float(path.x[-1])

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
