"""Where the robot is, against the plan that it was sent."""

from bisect import bisect_right
from collections import deque
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.motion.cell import MotionCell
from robocal_ros.motion.driving_config import DrivingConfig
from robocal_ros.motion.measuring import start_near
from robocal_ros.motion.plan import JointPlan
from robocal_ros.motion.silence import Silence

Array = NDArray[np.float64]

VELOCITY_S = 0.03  # span of the readings that give a velocity
LEAST, OLDEST_S = 5, 0.2  # of them, if not too old: one wild reading is outvoted
REST_RAD = 1e-4  # a robot that rests moves less
BACK_S = 1.0  # stamps that go back by more began anew
FARTHEST = 1e9  # rad or m; of what is beyond no speed is finite
APART_S = 0.00375  # instants of the plan that a reading is compared with


class RobotWatch:
    """Readings of the joints as they arrive, and the plan in force; times of a steady clock.

    Parameters
    ----------
    driving : how far the robot may lag behind its plan, and how fast its joints are.

    Attributes
    ----------
    silence : how long no new reading came.
    """

    def __init__(self, arm: SerialArm, driving: DrivingConfig) -> None:
        self._arm, self._late_s = arm, driving.late_s
        self._fastest = driving.limits.of_joints(arm)[0]
        self.silence = Silence()
        self._heard_s = self._sent_s = 0.0
        self._readings: deque[tuple[float, Array]] = deque(maxlen=512)
        self._plan: JointPlan | None = None
        self._cell: MotionCell | None = None

    def reading(self, stamp_s: float, q: Array, now_s: float) -> None:
        """Take joints (n,); ``stamp_s`` on their own clock."""
        if self._readings and stamp_s <= self._readings[-1][0]:
            if stamp_s > self._readings[-1][0] - BACK_S:
                return  # a clock that stands still is heard as silence
            self._readings.clear()
        self._readings.append((stamp_s, np.clip(q, -FARTHEST, FARTHEST)))
        self._heard_s = now_s
        self.silence.heard(now_s)

    def follow(self, plan: JointPlan, cell: MotionCell, now_s: float) -> None:
        """A plan was sent."""
        self._plan, self._cell, self._sent_s = plan, cell, now_s

    def sent(self, now_s: float) -> None:
        """When the plan really was sent."""
        self._sent_s = now_s

    def slept(self, for_s: float) -> None:
        """The host was suspended for so long, and the plan with it: its controller is there too."""
        self._sent_s += for_s
        self._heard_s += for_s

    def forget(self) -> None:
        """No plan is in force any more."""
        self._plan = None

    @property
    def heard(self) -> bool:
        """Whether there is any reading."""
        return bool(self._readings)

    @property
    def newest(self) -> tuple[float, Array] | None:
        """Stamp and joints (n,) of the newest reading that counts; None before any."""
        return self._readings[-1] if self._readings else None

    @property
    def silent_s(self) -> float:
        """How long the joint states have been silent."""
        return self.silence.lasts_s if self._readings else np.inf

    def driven_s(self, now_s: float) -> float:
        """How long the plan has been driven."""
        return now_s - self._sent_s

    def overdue_s(self, now_s: float) -> float:
        """How long ago the plan ended; negative before."""
        return -np.inf if self._plan is None else self.driven_s(now_s) - self._plan.duration_s

    def at_end(self, now_s: float) -> bool:
        """Whether the plan has ended, with the robot where it ends."""
        if self._plan is None or not self._readings:
            return True
        there = np.all(np.abs(self._plan.q[-1] - self._readings[-1][1]) < start_near(self._arm))
        return self.overdue_s(now_s) >= 0.0 and bool(there)

    def resting(self, span_s: float) -> Array | None:
        """The joints where the robot has rested for so long; None while it moves."""
        recent = self._since(span_s)
        if recent is None:
            return None
        spread = np.ptp(np.array([q for _, q in recent]), axis=0)
        return recent[-1][1] if np.max(spread) < REST_RAD else None

    def away(self) -> tuple[float, float]:
        """How far tip (m) and turning joints (rad) are from the plan, where it is nearest."""
        if self._plan is None or self._cell is None or not self._readings:
            return 0.0, 0.0
        at_s, q = self._heard_s - self._sent_s, self._readings[-1][1]
        count = round(self._late_s / APART_S) + 1
        times = np.linspace(at_s - self._late_s, at_s, count)
        times = np.clip(times, 0.0, self._plan.duration_s)
        planned, _ = self._plan.at(times)
        joints = np.max(np.abs(planned - q) * ~self._arm.prismatic, axis=1)
        T = self._cell.arm.fk(np.vstack([planned, q]))
        tips = T[:, :3, :3] @ self._cell.tool.p_tip + T[:, :3, 3]
        nearest = int(np.argmin(np.linalg.norm(tips[:-1] - tips[-1], axis=1)))
        return float(np.linalg.norm(tips[nearest] - tips[-1])), float(joints[nearest])

    def state(self, now_s: float, *, keeps: bool) -> tuple[Array, Array]:
        """Joints and velocities (n,) to stop from: the plan's, where the robot keeps to it.

        Readings lag behind what the controller commands; a stop from there would throw it back.
        One that does not keep to its plan is where most of its last readings have it (Theil-Sen:
        the medians of the slopes of all pairs, and of where each reading puts it): a stop from a
        single wild reading would be a motion of its own.
        """
        if self._plan is not None and keeps:
            return self._plan.at(self.driven_s(now_s))
        times, q = self._latest()
        velocity = np.zeros(q.shape[1])
        if times[0] <= times[-1] - VELOCITY_S:
            i, j = np.triu_indices(len(times), 1)
            slopes = (q[j] - q[i]) / (times[j] - times[i])[:, None]
            velocity = np.clip(np.median(slopes, axis=0), -self._fastest, self._fastest)
        return np.median(q + (times[-1] - times)[:, None] * velocity, axis=0), velocity

    def _latest(self) -> tuple[Array, Array]:
        """Stamps (m,) and joints (m, n) of the readings that tell where it is and how fast."""
        count = max(len(self._since(VELOCITY_S) or ()), LEAST)
        oldest_s = self._readings[-1][0] - OLDEST_S
        recent = [reading for reading in list(self._readings)[-count:] if reading[0] >= oldest_s]
        return np.array([at_s for at_s, _ in recent]), np.array([q for _, q in recent])

    def tells_speed(self, within_s: float) -> bool:
        """Whether the readings that give a velocity span no more than this."""
        recent = self._since(VELOCITY_S)
        return recent is not None and recent[-1][0] - recent[0][0] <= within_s

    def _since(self, span_s: float) -> list[tuple[float, Array]] | None:
        """Readings of the last ``span_s``; None before there are enough."""
        readings = list(self._readings)
        first_s = readings[-1][0] - span_s if readings else np.inf
        if not readings or readings[0][0] > first_s:
            return None
        return readings[bisect_right(readings, first_s, key=itemgetter(0)) - 1 :]
