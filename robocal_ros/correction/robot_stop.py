"""Brings a moving robot to rest by a motion, watches that it does, and sends it again if not.

A controller has no order for "stop": one that is sent nothing, or a trajectory without points, goes
on to where it was sent, and the cancel of a goal is a dead stop from any speed. What stops it
smoothly is a motion from where it is to rest, some tenths of a second ahead.
"""

from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from robocal_ros.correction.interface import Array, JointCommand, TrajectoryCommand
from robocal_ros.correction.robot_state import RESPONSE_S, SentPath
from robocal_ros.kinematics import SerialArm
from robocal_ros.motion.plan import REACTION_S, SHORTEST_STOP_S, JointPlan, MotionLimits, stop

TRACK_S = 0.1  # readings of so long tell speed and standstill
LEAST_TRACK_S = 0.02  # shorter ones tell no speed
VELOCITY_S = 0.05  # span of the readings that give a velocity
LEAST = 5  # of them: a single wild one is outvoted
FARTHEST = 1e9  # rad or m; of what is beyond no speed is finite
LAG_S = 0.03  # by so much the robot, and what is known of it, may follow a stop late
FOLLOWED = 25  # instants of a path that a place is compared with
SEEN = 0.08  # of the fastest speed: a planned loss of so much must show, at least by half
SLOW = 1e-3  # rad/s (m/s); a robot that was held, and moves faster, does not obey
GIVE_UP_S = 5.0  # a robot that still moves then is stopped by a person
PAUSED_S = 0.25  # so often a robot that pauses is sent its stop: what is lost shows when it goes on
AHEAD_S = 0.06  # where the controller is by then a stop on its path begins to slow down
SPACING_S = 0.01  # of the points until then
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
        changes = np.where(arm.prismatic, DECELERATION[True], DECELERATION[False])
        self._turned = 0.5 * VELOCITY_S * changes + near / LEAST_TRACK_S
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
        if was_silent:  # what it did meanwhile is not known
            self._track.clear()
        self._q[self._index] = np.clip(state.position[self._column], -FARTHEST, FARTHEST)
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

    @property
    def velocity(self) -> Array:
        """(n,) as read last; NaN where there is none."""
        return self._qd

    def here(self, now_s: float) -> tuple[Array, Array] | None:
        """Joints and speeds (n,) now; None where they were not all read lately."""
        if self._silent(now_s):
            return None
        q, qd = self._newest()
        here = q + qd * (now_s - float(np.min(self._read_s)))
        return (here, qd) if np.isfinite(here).all() else None

    def _newest(self) -> tuple[Array, Array]:
        """Joints and speeds (n,) as read last, where the readings of before bear them out.

        Else those of most readings (Theil-Sen: the medians of the slopes of pairs, and of where
        each reading puts it): a stop from a single wild reading would be a motion of its own.
        """
        read = self._qd if self._qd.any() else np.nan * self._qd  # some drivers say 0 in motion
        since_s = self._track[-1][0] - VELOCITY_S
        count = max(sum(at_s >= since_s for at_s, _ in self._track), LEAST)
        recent = list(self._track)[-count:]
        times, q = np.array([at_s for at_s, _ in recent]), np.array([place for _, place in recent])
        i, j = np.triu_indices(len(times), 1)
        apart = times[j] - times[i] >= LEAST_TRACK_S
        if not apart.any():
            return self._q, read
        i, j = i[apart], j[apart]
        slope = np.median((q[j] - q[i]) / (times[j] - times[i])[:, None], axis=0)
        place = np.median(q + (times[-1] - times)[:, None] * slope, axis=0)
        speed = np.where(np.abs(read - slope) <= self._turned, read, slope)
        beside = self._turned * max(float(times[-1] - times[0]), LEAST_TRACK_S)
        return np.where(np.abs(self._q - place) <= beside, self._q, place), speed

    def behind(self, told: tuple[Array, Array], here: tuple[Array, Array]) -> bool:
        """Whether the robot is where a controller has it, but for its lag."""
        reach = LAG_S * (np.abs(told[1]) + np.abs(here[1])) + self._near
        return bool(np.all(np.abs(told[0] - here[0]) < reach))

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
    acceleration, velocity : (n,) largest, rad/s^2, rad/s (prismatic: m/s^2 ...); NaN or infinite
        where none is known.
    send : puts a plan out, which goes on for `REACTION_S` from now.
    reference : joints and unscaled velocities (n,) where the controller is; None: not known.

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
        velocity: ArrayLike = np.inf,
        reference: Callable[[float], tuple[Array, Array] | None] = lambda now_s: None,
    ) -> None:
        assumed = np.where(arm.prismatic, DECELERATION[True], DECELERATION[False])
        known = np.isfinite(acceleration) & (acceleration > 0.0)
        self._limits = MotionLimits(stop_deceleration=np.where(known, acceleration, assumed))
        self._fastest = np.where(np.isnan(velocity), np.inf, velocity)
        self._arm, self._track, self._send, self._reference = arm, track, send, reference
        self._began_s = self._first_s = self._sent_s = 0.0
        self._paused_s = -np.inf  # when the controller's clock was last seen to stand
        self._times = self._speeds = np.zeros(1)
        self.why = self.fault = ""
        self.sent = 0

    def begin(self, why: str, now_s: float, scaling: float = 1.0) -> bool:
        """Send a stop; False, with the fault, where the robot's place is not known."""
        if not self.why:
            self._began_s = self._first_s = now_s
            self.sent = 0
        self.why = why
        if self._again(now_s, scaling):
            self.fault = ""
            return True
        self.why = ""
        self.fault = f"{why}: no stop can be planned, the joint states are missing or too old"
        return False

    def forget(self) -> None:
        """Another motion has been sent."""
        self.why = ""

    def watch(self, why: str, times: Array, speeds: Array, now_s: float) -> None:
        """Watch a stop that was sent by others, and send one of its own where it is not obeyed.

        ``times``, ``speeds``: (m,) of its points from now on, of the fastest joint.
        """
        here = self._track.here(now_s)
        measured = 0.0 if here is None else float(np.max(np.abs(here[1])))
        self._began_s = self._first_s = self._sent_s = now_s
        self._times = np.append(0.0, times * max(SHORTEST_STOP_S / times[-1], 1.0))
        self._speeds, self.sent = np.append(measured, speeds), 1
        self.why, self.fault = why, ""

    def look(self, now_s: float, scaling: float = 1.0, held_s: float = -np.inf) -> bool:
        """Whether a stop is under way; sent again where the robot does not obey.

        ``scaling``: how fast the controller's clock runs, 0 to 1. While it pauses a robot stands
        whatever it was sent last: the stop goes out again and again, and is not over before the
        robot has stood with a clock that runs, or the controller was seen, at ``held_s``, to hold
        in place of a motion.
        """
        if not self.why:
            return False
        stands = self._track.stands(now_s)
        if scaling == 0.0:
            self._began_s = self._paused_s = now_s
            if now_s - self._sent_s > TRACK_S and held_s > self._first_s and stands:
                self.why = ""
            elif now_s - self._sent_s >= PAUSED_S:
                self._again(now_s, scaling)
            return bool(self.why)
        since_s = now_s - self._sent_s
        if now_s - max(self._sent_s, self._paused_s) > TRACK_S and stands:
            self.why = ""
            return False
        if now_s - self._began_s > GIVE_UP_S / max(scaling, 0.1):
            self.fault = f"{self.why}: the robot still moves, stop it by hand"
            self.why = ""
            return False
        here = self._track.here(now_s)
        planned = float(np.interp((since_s - LAG_S) * scaling, self._times, self._speeds))
        fastest = max(float(np.max(self._speeds)), SLOW)
        if here is not None and since_s > LAG_S and planned < (1.0 - SEEN) * fastest:
            speed = float(np.max(np.abs(here[1])))
            if speed > 0.5 * (fastest + planned) and not stands:
                self._again(now_s, scaling)
        return True

    def _again(self, now_s: float, scaling: float) -> bool:
        state = self._state(now_s)
        if state is None:
            return False
        q, qd = state
        qd = np.clip(qd, -self._fastest, self._fastest) if scaling > 0.0 else 0.0 * qd
        plan = stop(self._arm, self._limits, q, qd)
        self._times, self._speeds = plan.time_s, np.abs(plan.qd).max(axis=1)
        self._sent_s = now_s
        self.sent += 1
        self._send(plan.going_on(REACTION_S))
        return True

    def _state(self, now_s: float) -> tuple[Array, Array] | None:
        """Joints and speeds (n,) to stop from: the controller's, where the robot follows it."""
        here, told = self._track.here(now_s), self._reference(now_s)
        if here is None or told is None:
            return here
        return told if self._track.behind(told, here) else here


def on_its_path(path: SentPath, planned: TrajectoryCommand, now_s: float) -> JointPlan:
    """A stop ``planned`` on a path, with its way since `AHEAD_S` before now: so far it is now."""
    at_s = now_s + np.arange(-AHEAD_S, AHEAD_S - 1e-9, SPACING_S)
    h = 1e-4
    before, q, after = (np.array([path.place(at + d) for at in at_s]) for d in (-h, 0.0, h))
    assert planned.velocity is not None
    return JointPlan(
        np.concatenate([at_s - at_s[0], AHEAD_S + planned.time_from_start_s]),
        np.concatenate([q, planned.position]),
        np.concatenate([(after - before) / (2.0 * h), planned.velocity]),
        np.zeros((len(at_s) + len(planned.position), q.shape[1])),
    )
