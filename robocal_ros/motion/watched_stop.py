"""A stop that was sent: whether the robot obeys is seen, and it is sent again where it does not.

A controller has no order to stop: it drives on where it is sent nothing or a trajectory without
points, and the cancel of a goal is a dead stop from any speed. What stops it is a motion that
decelerates from where it is.
"""

import numpy as np

from robocal_ros.kinematics import SerialArm
from robocal_ros.motion.limits import MotionLimits
from robocal_ros.motion.plan import JointPlan
from robocal_ros.motion.robot_watch import REST_RAD, VELOCITY_S, RobotWatch
from robocal_ros.motion.stopping import stop

STANDS_S = 0.1  # a robot that has rested for so long stands
# From a message to what the controller says of it (10 ms measured, a cycle, 10 ms at the speed
# before), and to readings that show it: drives lag by some 15 ms, and a speed is of readings that
# are half a span old.
SEEN_S = {True: 0.03, False: 0.045}
SLOW = 2.0 * REST_RAD / VELOCITY_S  # rad/s (m/s); of a robot that rests readings may say so much
SEEN = 0.08  # a planned loss of speed by this share must show, by half at least
PAUSED_S = 0.25  # so often a robot that pauses is sent its stop: what is lost shows when it goes on
AGAIN_S = 0.02  # a stop that is rejected is not sent again sooner
SHORTEST_AGAIN_S = 0.08  # of a stop that is sent again: time was lost
MOST_SENT = 4  # what does not obey that many is stopped by other means
GIVE_UP_S = 1.0  # after the planned end


class WatchedStop:
    """A stop that was sent, until the robot stands; planned anew where it does not obey.

    A message may be lost, and a goal may be rejected or taken over: where the robot stands is the
    only proof.

    Attributes
    ----------
    sent : how often it was sent.
    failed : why the robot is to be stopped by other means; empty: it is not.
    """

    def __init__(self, arm: SerialArm, limits: MotionLimits) -> None:
        self._arm, self._limits = arm, limits
        self._plan: JointPlan | None = None
        self._began_s = self._first_s = self._sent_s = self._speed = 0.0
        self._paused_s = -np.inf  # when the controller's clock was last seen to stand
        self._deaf = 0  # stops that were sent to a clock that runs
        self._rejected = ""
        self.sent, self.failed = 0, ""

    @property
    def under_way(self) -> bool:
        """Whether the robot is yet to stand."""
        return self._plan is not None

    def begin(self, plan: JointPlan, now_s: float) -> None:
        """A stop is sent now."""
        self._began_s = self._first_s = now_s
        self.sent, self._deaf, self.failed = 0, 0, ""
        self._note(plan, now_s)

    def _note(self, plan: JointPlan, now_s: float) -> None:
        self._plan, self._sent_s, self._rejected = plan, now_s, ""
        self._speed = float(np.max(np.abs(plan.qd[0])))
        self.sent += 1
        self._deaf += 1

    def forget(self) -> None:
        """Another motion has begun."""
        self._plan = None

    def rejected(self, words: str) -> None:
        """The controller did not take it, or ended it otherwise."""
        self._rejected = words

    def look(self, robot: RobotWatch, now_s: float) -> JointPlan | None:
        """What is to be sent now, if anything; call it often.

        While the controller's clock stands a robot stands whatever it was sent last: the stop goes
        out again and again, and is not over before the robot has stood with a clock that runs, or
        its controller was seen to hold in place of a motion.
        """
        plan = self._plan
        if plan is None:
            return None
        since_s = now_s - self._sent_s
        blind = robot.silent_s > STANDS_S or not robot.heard
        holds = robot.scaling != 0.0 or robot.held_s > self._first_s
        if not holds:
            self._began_s = self._paused_s = now_s
            self._deaf = 0
            return None if blind or since_s < PAUSED_S else self._again(robot, now_s)
        stood_s = now_s - max(self._sent_s, self._paused_s)
        if not blind and stood_s > STANDS_S and robot.resting(STANDS_S) is not None:
            self._plan = None
            return None
        given_s = GIVE_UP_S + plan.duration_s / max(robot.scaling, 0.1)
        if now_s - self._began_s > given_s or self._deaf > MOST_SENT:
            why = "joint states are missing" if blind else "it still moves"
            words = f"the robot does not stop: {why} after {self.sent} stops {self._rejected}"
            self.failed = self.failed or words.strip()
        if blind or now_s - self._began_s > 5.0 * given_s:
            return None
        return self._again(robot, now_s) if self._disobeyed(robot, now_s) else None

    def _disobeyed(self, robot: RobotWatch, now_s: float) -> bool:
        plan, since_s = self._plan, now_s - max(self._sent_s, self._paused_s)
        if self._rejected:
            return since_s >= AGAIN_S
        lag_s = SEEN_S[robot.reference(now_s) is not None] + robot.silent_s
        planned = (
            0.0 if plan is None else min((since_s - lag_s) * robot.scaling / plan.duration_s, 1.0)
        )
        obeys = max((1.0 - 0.5 * planned) * self._speed, SLOW)
        seen = SEEN if self._speed > SLOW else 1.0 - SEEN  # of a hold no speed is to be lost
        return planned > seen and robot.speed(now_s) > obeys

    def _again(self, robot: RobotWatch, now_s: float) -> JointPlan:
        keeps = robot.reference(now_s) is not None
        state = robot.state(now_s, keeps=keeps)
        plan = stop(self._arm, self._limits, *state, shortest_s=SHORTEST_AGAIN_S)
        self._note(plan, now_s)
        return plan
