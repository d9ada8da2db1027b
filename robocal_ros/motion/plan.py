"""A motion of the joints over time, as a trajectory controller will interpolate it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

REACTION_S = 0.01  # from a message to what the controller makes of it (8 to 10 ms measured)
LEAD_S = 0.05
"""First point of what is sent, ahead of its arrival.

joint_trajectory_controller 4.42.1 commands a first point at time 0 at once, wherever the robot is;
one ahead of now begins where the controller is, without a jump. 0.05 s are five cycles of a slow
controller (100 Hz), and more than the 10 ms from a message to what becomes of it. From rest the
cubic to that point is the plan itself.
"""


@dataclass(frozen=True, eq=False)
class JointPlan:
    """Points of a joint trajectory, at rest at its end.

    Between points it is the cubic through positions and velocities: what a trajectory controller
    makes of points that carry these two. ``qdd`` is the exact path's; sent along, it would turn
    the cubic into a quintic.

    Attributes
    ----------
    time_s : (k,) from the start, increasing, the first 0.
    q, qd, qdd : (k, n) joints, rad (prismatic: m), and their derivatives.
    """

    time_s: Array
    q: Array
    qd: Array
    qdd: Array

    @property
    def duration_s(self) -> float:
        """From its start to rest."""
        return float(self.time_s[-1])

    @cached_property
    def _cubics(self) -> Array:
        """Factors (4, k - 1, n) of the cubics from each point on, of the third power first."""
        h = np.diff(self.time_s)[:, None]
        way, before, after = np.diff(self.q, axis=0) / h, self.qd[:-1], self.qd[1:]
        bend, twist = (3.0 * way - 2.0 * before - after) / h, (before + after - 2.0 * way) / h**2
        return np.stack([twist, bend, before, self.q[:-1]])

    def _since(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Factors (4, ..., n) of the cubics at times, and the times (..., 1) since they begin."""
        t = np.clip(np.asarray(time_s, dtype=np.float64), 0.0, self.duration_s)
        k = np.clip(np.searchsorted(self.time_s, t, side="right") - 1, 0, len(self.time_s) - 2)
        return self._cubics[:, k], (t - self.time_s[k])[..., None]

    def places(self, time_s: ArrayLike) -> Array:
        """Joints (..., n) alone, as `at`."""
        (a, b, c, d), u = self._since(time_s)
        return np.asarray(d + u * (c + u * (b + u * a)))

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Joints (..., n) and their velocity; before the start as there, after the end at rest."""
        (a, b, c, d), u = self._since(time_s)
        moves = np.asarray(time_s)[..., None] <= self.duration_s
        velocity = np.where(moves, c + u * (2.0 * b + u * 3.0 * a), 0.0)
        return d + u * (c + u * (b + u * a)), velocity

    def peaks(self) -> tuple[Array, Array]:
        """Largest speed and acceleration (n,) of each joint, exactly, between points too."""
        h = np.diff(self.time_s)[:, None]
        way, before, after = np.diff(self.q, axis=0) / h, self.qd[:-1], self.qd[1:]
        first = (6.0 * way - 4.0 * before - 2.0 * after) / h
        last = (4.0 * after + 2.0 * before - 6.0 * way) / h
        # The velocity is a parabola, with its vertex between the points where these differ in sign.
        turns = first * last < 0.0
        vertex = before + 0.5 * h * first**2 / np.where(turns, first - last, np.inf)
        speed = np.maximum(np.max(np.abs(self.qd), axis=0), np.max(np.abs(vertex), axis=0))
        return speed, np.max(np.maximum(np.abs(first), np.abs(last)), axis=0)

    def going_on(self, lead_s: float) -> "JointPlan":
        """The same way after a time at the speed of its begin, and so much further on."""
        further = np.concatenate([self.q[:1], self.q + lead_s * self.qd[0]])
        rates = (np.concatenate([part[:1], part]) for part in (self.qd, self.qdd))
        return JointPlan(np.concatenate([[0.0], self.time_s + lead_s]), further, *rates)

    def points(self) -> tuple[Array, Array, Array]:
        """Times (k,), joints and velocities (k, n) that a controller is sent; first: `LEAD_S`."""
        time = np.concatenate([[LEAD_S], self.time_s[self.time_s > LEAD_S + 1e-4]])
        q, qd = self.at(time)
        qd[-1] = 0.0  # exactly: a controller rejects a trajectory that does not end at rest
        return time, q, qd

    def slower(self, factor: float) -> "JointPlan":
        """The same way in ``factor`` times the time."""
        return JointPlan(
            self.time_s * factor, self.q, self.qd / factor, self.qdd / (factor * factor)
        )


def joined(plans: Sequence[JointPlan]) -> JointPlan:
    """Plans one after the other; each begins where the one before came to rest."""
    starts = np.cumsum([0.0, *(plan.duration_s for plan in plans[:-1])])
    rest = [slice(None), *([slice(1, None)] * (len(plans) - 1))]
    return JointPlan(
        np.concatenate([p.time_s[r] + t for p, r, t in zip(plans, rest, starts, strict=True)]),
        *(
            np.concatenate([getattr(p, name)[r] for p, r in zip(plans, rest, strict=True)])
            for name in ("q", "qd", "qdd")
        ),
    )
