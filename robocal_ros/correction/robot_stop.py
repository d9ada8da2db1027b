"""Brings a moving robot to rest by a motion, watches that it does, and sends it again if not.

A controller has no order for "stop": one that is sent nothing, or a trajectory without points, goes
on to where it was sent, and the cancel of a goal is a dead stop from any speed. What stops it
smoothly is a cubic from where it is to rest, some tenths of a second ahead.
"""

from collections import deque
from collections.abc import Callable

import numpy as np

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction.inputs import Array, JointCommand
from robocal_ros.correction.output import SentPath
from robocal_ros.correction.robot_state import RESPONSE_S
from robocal_ros.motion.limits import MotionLimits
from robocal_ros.motion.plan import JointPlan
from robocal_ros.motion.stopping import SHORTEST_STOP_S, stop

TRACK_S = 0.1  # readings of so long tell speed and standstill
LEAST_TRACK_S = 0.02  # shorter ones tell no speed
REACTION_S = 0.01  # from a message to what the controller makes of it (8 to 10 ms measured)
LAG_S = 0.03  # by so much the robot, and what is known of it, may follow a stop late
FOLLOWED = 25  # instants of a path that a place is compared with
SEEN = 0.08  # of the fastest speed: a planned loss of so much must show, at least by half
GIVE_UP_S = 5.0  # a robot that still moves then is stopped by a person
DECELERATION = {False: 10.0, True: 1.0}  # turning rad/s^2, sliding m/s^2, where none is known


class RobotTrack:
    """Where the robot is and how fast it moves, by its controller's own readings.

    Parameters
    ----------
    near : (n,) one that moved by less within `TRACK_S` stands, rad (prismatic: m).
    age_limit_s : older readings tell nothing.
    """

    def __init__(self, arm: SerialArm, near: Array, age_limit_s: float) -> None:
        self._number = {name: i for i, name in enumerate(arm.joint_names)}
        self._near, self._age_limit_s = near, age_limit_s
        self._q, self._qd = np.full(arm.n, np.nan), np.full(arm.n, np.nan)
        self._read_s = np.full(arm.n, -np.inf)
        self._track: deque[tuple[float, Array]] = deque()
        self._place, self._place_s = np.full(arm.n, np.nan), np.inf  # where it stands, since when
        self._turning = ~arm.prismatic & ~(np.isfinite(arm.lower) & np.isfinite(arm.upper))
        self._names: tuple[str, ...] = ()
        self._index = self._column = np.empty(0, dtype=np.int64)

    def read(self, state: JointCommand, now_s: float) -> None:
        """Take readings; joints of others, and numbers that are not finite, are none."""
        if state.names != self._names:
            columns = [i for i, name in enumerate(state.names) if name in self._number]
            self._names, self._column = state.names, np.array(columns, dtype=np.int64)
            self._index = np.array([self._number[state.names[i]] for i in columns], dtype=np.int64)
        if len(state.position) != len(state.names) or not len(self._index):
            return
        was_silent = self._silent(now_s)
        self._q[self._index] = state.position[self._column]
        self._qd[self._index] = np.nan
        if state.velocity is not None and len(state.velocity) == len(state.names):
            self._qd[self._index] = state.velocity[self._column]
        self._read_s[self._index] = now_s
        self._track.append((now_s, self._q.copy()))
        while len(self._track) > 2 and self._track[1][0] <= now_s - TRACK_S:
            self._track.popleft()
        if was_silent or not np.all(np.abs(self._q - self._place) < self._near):
            self._place, self._place_s = self._q.copy(), now_s

    def _silent(self, now_s: float) -> bool:
        return not now_s - float(np.min(self._read_s)) <= self._age_limit_s

    def here(self, now_s: float) -> tuple[Array, Array] | None:
        """Joints and speeds (n,) now; None where they were not all read lately."""
        if self._silent(now_s):
            return None
        age_s = now_s - float(np.min(self._read_s))
        last_s = self._track[-1][0]
        earlier = [place for place in self._track if last_s - place[0] >= LEAST_TRACK_S]
        qd = self._qd
        if not (np.isfinite(qd).all() and qd.any()):  # there are drivers that say 0 in motion
            if not earlier:
                return None
            since_s, before = earlier[-1]
            qd = (self._q - before) / (last_s - since_s)
        here = self._q + qd * age_s
        return (here, qd) if np.isfinite(here).all() else None

    def stands(self, now_s: float) -> bool:
        """Whether all joints were read lately, and have not moved for `TRACK_S`."""
        if self.here(now_s) is None or self._track[0][0] > now_s - TRACK_S:
            return False
        places = np.array([q for _, q in self._track])
        return bool(np.all(np.ptp(places, axis=0) < self._near))

    def stood_s(self, now_s: float) -> float:
        """How long the joints have stood in one place; 0 where they were not all read lately."""
        return 0.0 if self._silent(now_s) else now_s - self._place_s

    def follows(self, path: SentPath, now_s: float) -> bool:
        """Whether the robot is where a path has it, or was lately; True where it is not known."""
        if self.here(now_s) is None:
            return True
        read_s = float(np.min(self._read_s))
        times = np.linspace(read_s - RESPONSE_S, now_s + LAG_S, FOLLOWED)
        places = np.array([path.place(t) for t in times])
        q, near = self._q[path.index], self._near[path.index]
        turns = np.round((q - places[-1]) / (2.0 * np.pi))
        q = q - 2.0 * np.pi * np.where(self._turning[path.index], turns, 0.0)
        return bool(np.all((q > places.min(axis=0) - near) & (q < places.max(axis=0) + near)))


class RobotStop:
    """A stop under way, from `begin` until the robot stands.

    Parameters
    ----------
    acceleration : (n,) largest, rad/s^2 (prismatic: m/s^2); NaN where none is known.
    send : puts a plan out; the plan's first point after its begin is ahead of now.

    Attributes
    ----------
    why : of the stop under way; empty when none is.
    fault : why the robot did not stop; empty when it did.
    sent : how often the stop was sent.
    """

    def __init__(
        self,
        arm: SerialArm,
        acceleration: Array,
        track: RobotTrack,
        send: Callable[[JointPlan], None],
    ) -> None:
        assumed = np.where(arm.prismatic, DECELERATION[True], DECELERATION[False])
        known = np.isfinite(acceleration) & (acceleration > 0.0)
        self._limits = MotionLimits(stop_deceleration=np.where(known, acceleration, assumed))
        self._arm, self._track, self._send = arm, track, send
        self._began_s = self._sent_s = 0.0
        self._times = self._speeds = np.zeros(1)
        self.why = self.fault = ""
        self.sent = 0

    def begin(self, why: str, now_s: float) -> bool:
        """Send a stop; False, with the fault, where the robot's place is not known."""
        if not self.why:
            self._began_s, self.sent = now_s, 0
        self.why = why
        if self._again(now_s):
            self.fault = ""
            return True
        self.why = ""
        self.fault = f"{why}: no stop can be planned, the joint states are missing or too old"
        return False

    def watch(self, why: str, times: Array, speeds: Array, now_s: float) -> None:
        """Watch a stop that was sent by others, and send one of its own where it is not obeyed.

        ``times``, ``speeds``: (m,) of its points from now on, of the fastest joint.
        """
        here = self._track.here(now_s)
        measured = 0.0 if here is None else float(np.max(np.abs(here[1])))
        self._began_s = self._sent_s = now_s
        self._times = np.append(0.0, times * max(SHORTEST_STOP_S / times[-1], 1.0))
        self._speeds, self.sent = np.append(measured, speeds), 1
        self.why, self.fault = why, ""

    def look(self, now_s: float, scaling: float = 1.0) -> bool:
        """Whether a stop is under way; sent again where the robot does not obey.

        ``scaling``: how fast the controller's clock runs, 0 to 1.
        """
        if not self.why:
            return False
        since_s = now_s - self._sent_s
        if since_s > TRACK_S and self._track.stands(now_s):
            self.why = ""
            return False
        if now_s - self._began_s > GIVE_UP_S / max(scaling, 0.1):
            self.fault = f"{self.why}: the robot still moves, stop it by hand"
            self.why = ""
            return False
        here = self._track.here(now_s)
        planned = float(np.interp((since_s - LAG_S) * scaling, self._times, self._speeds))
        fastest = float(np.max(self._speeds))
        if here is not None and planned < (1.0 - SEEN) * fastest:
            speed = float(np.max(np.abs(here[1])))
            if speed > 0.5 * (fastest + planned) and not self._track.stands(now_s):
                self._again(now_s)
        return True

    def _again(self, now_s: float) -> bool:
        here = self._track.here(now_s)
        if here is None:
            return False
        q, qd = here
        plan = stop(self._arm, self._limits, q + qd * REACTION_S, qd)
        self._times, self._speeds = plan.time_s, np.abs(plan.qd).max(axis=1)
        self._sent_s = now_s
        self.sent += 1
        self._send(plan)
        return True
