# SPDX-License-Identifier: Apache-2.0
"""A stop that was sent, watched until the robot stands.

A controller has no order to stop: it drives on where it is sent nothing or a trajectory without
points, and the cancel of a goal is a dead stop from any speed. What stops it is a motion that
decelerates from where it is. A message may be lost, and a goal may be rejected or taken over: where
the robot stands is the only proof, by a clock that nobody sets.
"""

import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm
from robocal_ros.motion.plan import JointPlan, MotionLimits, stop
from robocal_ros.motion.robot_watch import REST_RAD, STANDS_S, VELOCITY_S

SLOW = 2.0 * REST_RAD / VELOCITY_S  # rad/s (m/s); of a robot that rests readings may say so much
SEEN = 0.08  # a planned loss of speed by this share must show, by half at least
HELD = 0.25  # of a stop that has no speed to lose: what still moves then does not obey
REPEAT_S = 0.25  # so often a robot that pauses is sent its stop: what is lost shows when it goes on
AGAIN_S = 0.02  # a stop that is rejected is not sent again sooner
SHORTEST_AGAIN_S = 0.08  # of a stop that is sent again: time was lost
MOST_SENT = 4  # what does not obey that many is stopped by other means
GIVE_UP_S = 1.0  # after the planned end


class SteadyClock:
    """Seconds that no setting of the clock changes, those of a suspended host included.

    What was heard before it was suspended is old when it wakes. A motion is not: the controller of
    the same host stood still with it.

    ``slept``: takes for how long the host was suspended, before a time of afterwards is given out.
    """

    def __init__(self, slept: Callable[[float], None]) -> None:
        self._slept = slept
        self._asleep_s = _both()[1]

    def now_s(self) -> float:
        """What it shows."""
        now_s, asleep_s = _both()
        if asleep_s > self._asleep_s:
            for_s, self._asleep_s = asleep_s - self._asleep_s, asleep_s
            self._slept(for_s)
        return now_s


def _both() -> tuple[float, float]:
    """The time, and how much of it the host was asleep, at least.

    The second clock is read later: what passes in between makes it less, never more.
    """
    now_s = time.clock_gettime(time.CLOCK_BOOTTIME)
    return now_s, now_s - time.clock_gettime(time.CLOCK_MONOTONIC)


class StoppedRobot(Protocol):
    """What is known of the robot, by a steady clock.

    ``scaling``: how fast the controller's clock runs, 0 to 1; ``held_s``: when a controller that
    pauses was last seen to give up a motion. The ``speed`` is that of the fastest joint in terms of
    the plan, NaN where it is not known; `to_stop` gives joints and velocities (n,), None where they
    are not known. What the robot is sent shows ``seen_s`` late. ``heard_s``: of when its readings
    are, however late they came.
    """

    scaling: float
    held_s: float

    @property
    def heard_s(self) -> float: ...  # noqa: D102

    def blind(self, now_s: float) -> bool: ...  # noqa: D102
    def at_rest(self, now_s: float) -> bool: ...  # noqa: D102
    def seen_s(self, now_s: float) -> float: ...  # noqa: D102
    def speed(self, now_s: float) -> float: ...  # noqa: D102
    def to_stop(self, now_s: float) -> tuple[Array, Array] | None: ...  # noqa: D102


class WatchedStop:
    """A stop until the robot stands; planned anew where it does not obey.

    ``again_s``: a stop that is sent again lasts no shorter.

    ``sent``: how often it was sent. ``failed``: why the robot is to be stopped by other means;
    empty: it is not.
    """

    def __init__(
        self, arm: SerialArm, limits: MotionLimits, again_s: float = SHORTEST_AGAIN_S
    ) -> None:
        self._arm, self._limits, self._again_s = arm, limits, again_s
        self.under_way = False  # the robot is yet to stand
        self._times = self._speeds = np.zeros(1)  # of the fastest joint, as it is to slow down
        self._began_s = self._first_s = self._sent_s = 0.0
        self._paused_s = -np.inf  # when the controller's clock was last seen to stand
        self._deaf = 0  # stops that were sent to a clock that runs
        self._rejected = ""
        self.sent, self.failed = 0, ""

    def begin(self, state: tuple[Array, Array], now_s: float) -> JointPlan:
        """The stop from joints and velocities (n,), which is sent now."""
        plan = stop(self._arm, self._limits, *state)
        self.watch(plan.time_s, np.abs(plan.qd).max(axis=1), now_s)
        return plan

    def watch(self, times: Array, speeds: Array, now_s: float) -> None:
        """Watch a stop that is sent now: ``times`` (m,) from 0 on, ``speeds`` (m,) of any joint."""
        if not self.under_way:
            self._began_s = self._first_s = now_s
            self.sent, self.failed = 0, ""
        self._deaf = 0
        self._note(times, speeds, now_s)

    def _note(self, times: Array, speeds: Array, now_s: float) -> None:
        self.under_way, self._sent_s, self._rejected = True, now_s, ""
        self._times, self._speeds = times, speeds
        self.sent += 1
        self._deaf += 1

    def forget(self) -> None:
        """Another motion has begun."""
        self.under_way = False

    def rejected(self, words: str) -> None:
        """The controller did not take it, or ended it otherwise."""
        self._rejected = words

    def look(self, robot: StoppedRobot, now_s: float) -> JointPlan | None:
        """What is to be sent now, if anything; call it often.

        While the controller's clock stands a robot stands whatever it was sent last: the stop goes
        out again and again, and is not over before the robot has stood with a clock that runs, or
        its controller was seen to hold in place of a motion.
        """
        if not self.under_way:
            return None
        blind = robot.blind(now_s)
        if robot.scaling == 0.0 and robot.held_s <= self._first_s:
            self._began_s = self._paused_s = now_s
            self._deaf = 0
            due = not blind and now_s - self._sent_s >= REPEAT_S
            return self._again(robot, now_s) if due else None
        read_s = robot.heard_s - max(self._sent_s, self._paused_s)
        if not blind and read_s > STANDS_S and robot.at_rest(now_s):
            self.under_way = False
            return None
        given_s = GIVE_UP_S + float(self._times[-1]) / max(robot.scaling, 0.1)
        if now_s - self._began_s > given_s or self._deaf > MOST_SENT:
            why = "joint states are missing" if blind else "it still moves"
            words = f"the robot does not stop: {why} after {self.sent} stops {self._rejected}"
            self.failed = self.failed or words.strip()
        if blind or now_s - self._began_s > 5.0 * given_s:
            return None
        return self._again(robot, now_s) if self._disobeyed(robot, now_s) else None

    def _disobeyed(self, robot: StoppedRobot, now_s: float) -> bool:
        since_s = now_s - max(self._sent_s, self._paused_s)
        if self._rejected:
            return since_s >= AGAIN_S
        at_s = (since_s - robot.seen_s(now_s)) * robot.scaling
        fastest = float(np.max(self._speeds))
        planned = float(np.interp(at_s, self._times, self._speeds))
        if at_s <= (0.0 if fastest > SLOW else HELD * self._times[-1]):
            return False
        loses = fastest <= SLOW or planned < (1.0 - SEEN) * fastest
        return loses and robot.speed(now_s) > max(0.5 * (fastest + planned), SLOW)

    def _again(self, robot: StoppedRobot, now_s: float) -> JointPlan | None:
        if (state := robot.to_stop(now_s)) is None:
            return None
        plan = stop(self._arm, self._limits, *state, shortest_s=self._again_s)
        self._note(plan.time_s, np.abs(plan.qd).max(axis=1), now_s)
        return plan
