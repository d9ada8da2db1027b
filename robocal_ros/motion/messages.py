"""How a stop is worded for a trajectory controller, by what the controller says of itself.

A stop is a plan that first goes on as the robot moves now (`REACTION_S`). Where the controller
tells its reference, the message is stamped with the controller's own time of the plan's begin: then
the command goes on along the plan without a step, whatever the hardware tells and however it lags,
and a stop that comes after its end is rejected. Else it begins when it arrives, where the robot is
measured; as lines, where the hardware tells no velocities: the controller would begin cubics with
a speed of 0 (Trajectory::set_point_before_trajectory_msg, ros2_controllers 4.42.1).
"""

from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration, Time
from numpy.typing import ArrayLike, NDArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.ground.samples import stamp_ns
from robocal_ros.motion.plan import LEAD_S, REACTION_S, JointPlan
from robocal_ros.ros.conversions import NS

Array = NDArray[np.float64]

LINES_S = 0.01  # between points for a controller that has no velocities
STATED_S = 0.05  # a controller's state that is older, or so far off in its stamp, is not gone by
SPOKEN_S = 1.0  # a controller whose state is newer tells whether there are velocities
BESIDE = 1e-3  # rad (m); a plan that passes the controller's reference further off is not of it
GRID_S = 1e-3  # instants of a plan that a reference is looked for at
PACE_S = 0.01  # of two instants as near to it the one counts that is as fast
AT_REST = 5e-3  # rad/s (m/s); slower references move nothing


class StatedController:
    """What a controller says of itself; times of a steady clock.

    Attributes
    ----------
    velocities : whether the hardware has any, as far as it is told.
    held_s : when one that pauses was last seen to give up a motion: its reference came to rest.
    """

    def __init__(self) -> None:
        self._heard_s, self._ahead_s = -np.inf, np.inf
        self._stated: tuple[int, tuple[str, ...], Array, Array] | None = None
        self._paused_speed = 0.0  # of the reference, in a pause
        self.velocities, self.held_s = True, -np.inf

    def take(self, message: Any, scaling: float | None, now_s: float) -> None:
        """Take a ``JointTrajectoryControllerState``; ``scaling``: None where nobody tells it."""
        names, reference = tuple(message.joint_names), message.reference
        self._tells(np.array(message.feedback.velocities, dtype=np.float64), len(names))
        at_ns, before_s = stamp_ns(message.header.stamp), self._ahead_s
        self._heard_s, self._ahead_s, self._stated = now_s, at_ns / NS - now_s, None
        if len(reference.positions) != len(names) or len(reference.velocities) != len(names):
            return  # a controller that holds may leave them out
        q, qd = np.array(reference.positions), np.array(reference.velocities)
        if not (np.isfinite(q).all() and np.isfinite(qd).all()):
            return
        if abs(self._ahead_s - before_s) < STATED_S:
            self._stated = at_ns, names, q, qd
        before, self._paused_speed = self._paused_speed, 0.0
        if scaling == 0.0:
            self._paused_speed = float(np.max(np.abs(qd), initial=0.0))
            if self._paused_speed < AT_REST <= before:
                self.held_s = now_s

    def hear(self, velocity: ArrayLike, count: int, now_s: float) -> None:
        """Take velocities of ``count`` joint states: they count where the controller is silent.

        Some hardware says 0 in motion; a stop of a robot that stands may be of either kind.
        """
        if now_s - self._heard_s > SPOKEN_S:
            self._tells(np.asarray(velocity, dtype=np.float64), count)

    def _tells(self, speeds: Array, count: int) -> None:
        self.velocities = bool(len(speeds) == count and np.isfinite(speeds).all() and speeds.any())

    def reference(
        self, names: Sequence[str], now_s: float, scaling: float | None
    ) -> tuple[Array, Array] | None:
        """Joints and unscaled velocities (k,) where the controller is now; None: not known."""
        if (found := self._find(names, now_s)) is None:
            return None
        _, q, qd = found
        gone_s = (now_s - self._heard_s) * (1.0 if scaling is None else scaling)
        return q + qd * gone_s, qd

    def _find(self, names: Sequence[str], now_s: float) -> tuple[int, Array, Array] | None:
        if self._stated is None or now_s - self._heard_s > STATED_S:
            return None
        at_ns, of, q, qd = self._stated
        if not set(names) <= set(of):
            return None
        index = [of.index(name) for name in names]
        return at_ns, q[index], qd[index]

    def stop_message(
        self,
        plan: JointPlan,
        names: Sequence[str],
        now_s: float,
        scaling: float | None,
        *,
        at_s: float = 0.0,
        first_s: float = LEAD_S,
        trusted: bool = True,
    ) -> JointTrajectory:
        """A stop by a plan that is at its time ``at_s`` now, and still goes on for `REACTION_S`.

        ``first_s``: first point of a message that is not stamped, ahead of its arrival;
        ``trusted``: whether it may be stamped.
        """
        begin_ns = self._begin_ns(plan, names, now_s, scaling, at_s) if trusted else None
        if begin_ns is not None:
            message = joint_trajectory(names, plan.time_s, plan.q, plan.qd)
            message.header.stamp = Time(sec=begin_ns // NS, nanosec=begin_ns % NS)
            return message
        since_s = at_s + REACTION_S
        last_s = plan.duration_s - since_s
        first_s = min(first_s, last_s)
        if self.velocities:
            ahead = plan.time_s - since_s
            times = np.append(first_s, ahead[ahead > first_s + 1e-4])
        else:
            times = np.linspace(first_s, last_s, int(np.ceil((last_s - first_s) / LINES_S)) + 1)
        q, qd = plan.at(times + since_s)
        qd[-1] = 0.0  # exactly: a controller rejects a trajectory that does not end at rest
        return joint_trajectory(names, times, q, qd if self.velocities else None)

    def _begin_ns(
        self,
        plan: JointPlan,
        names: Sequence[str],
        now_s: float,
        scaling: float | None,
        at_s: float,
    ) -> int | None:
        """When the controller is where the plan begins, by its own clock; None: not known.

        Where the plan, before its begin at the speed of its begin, passes the reference. A scaled
        clock counts from a stamp on as if it were not.
        """
        found = self._find(names, now_s)
        if found is None or scaling not in (None, 1.0):
            return None
        stated_ns, q, qd = found
        times = np.arange(-STATED_S, at_s + STATED_S, GRID_S)
        places, speeds = plan.at(np.maximum(times, 0.0))
        places = places + np.minimum(times, 0.0)[:, None] * plan.qd[0]
        away = np.sum((places - q) ** 2 + (PACE_S * (speeds - qd)) ** 2, axis=1)
        k = int(np.argmin(away))
        way, speed = q - places[k], speeds[k]
        if not (qd @ qd > 0.0 and speed @ speed > 0.0):
            return None
        after_s = float(way @ speed) / float(speed @ speed)
        if abs(after_s) > GRID_S or np.max(np.abs(way - after_s * speed)) > BESIDE:
            return None
        return stated_ns - round((times[k] + after_s) * NS)


def joint_trajectory(
    names: Sequence[str], times: Array, q: Array, qd: Array | None
) -> JointTrajectory:
    """Points at times (k,) with joints (k, n), and velocities where there are any."""
    message = JointTrajectory(joint_names=list(names))
    for i, ns in enumerate(np.round(times * NS).astype(np.int64).tolist()):
        point = JointTrajectoryPoint(positions=array("d", q[i].tobytes()))
        if qd is not None:
            point.velocities = array("d", qd[i].tobytes())
        point.time_from_start = Duration(sec=ns // NS, nanosec=ns % NS)
        message.points.append(point)
    return message
