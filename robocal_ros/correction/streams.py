# SPDX-License-Identifier: Apache-2.0
"""A stream of joint targets: as new as its newest message, within the speeds, ended in order."""

from bisect import bisect_right
from collections import deque
from dataclasses import replace
from enum import Enum
from itertools import accumulate
from typing import Any

import numpy as np

from robocal_ros.correction.bounds import require_limits
from robocal_ros.correction.interface import JointCommand, Reason, RefusedError
from robocal_ros.correction.limiter import (
    ACTIVE,
    ADDS,
    BEFORE,
    FASTEST,
    GIVEN,
    LONGEST_STEP_S,
    MOST_BELIEVED,
    OFFSET,
    OFFSET_RATE,
    PACE,
    ROUNDING,
    TOO_FAST,
    UNUSUAL,
    VELOCITY,
    follow_serialized,
)
from robocal_ros.correction.robot_state import Output, hold_speeds
from robocal_ros.correction.serialized_target import SerializedTarget
from robocal_ros.ground.frames import Array, Index
from robocal_ros.ground.samples import CORRECTED

CATCH_UP_S = 0.1  # what came in may be so far ahead, at the joints' speeds; more is not followed
HELD_PERIODS = 2.0  # after so long the controller holds the last output, and the robot stands
RESUME_S = 1.0  # after a longer silence a stream is over
# The period is that of the last intervals between messages. Those that follow one within a share of
# it came in a burst with it; so many may be stalls, which are no period, however long they are.
INTERVALS, BURST, STALLS = 16, 0.125, 2
SAME_PERIOD = INTERVALS // 2  # it is found anew after so many intervals that agree with it
# How fast what was held up is caught up with: at so much more than the stream's own speed, but at
# no less than this share of the joints' speeds, which counts where the stream stands.
CATCH_UP, LEAST = 1.05, 0.1
RATE_S = 1e-3  # so far ahead on a path it is looked at how fast its offset changes
SPEED_S = 0.2  # in which the stream's own speed is looked at
# The same of what goes out, for how it is slowed down; at least so many periods, and outputs.
SENT_S, SENT_PERIODS, SENT = 0.1, 8.0, 4
MOST_KEPT = 1000  # of either: 0.2 s of messages that come faster than anybody sends
END_S = 0.5  # a joint without limits slows down so long from its full speed
SPARE = 1.0  # rad/s (prismatic: m/s): so much faster than its stream a joint without a limit may be
LATE = 0.8  # of `CATCH_UP_S`: one that lags more catches up at the joints' speeds
TRIES = 8  # a step that is too long is shortened so often; each makes it shorter than the last


class StreamPhase(Enum):
    """What a stream does."""

    IDLE = "nothing goes out"
    RUNNING = "targets go out"
    ENDING = "the robot is slowed down"


RUNNING = StreamPhase.RUNNING  # of an enumeration each look takes its time


class TargetStream:
    """Targets of a stream, each corrected and put out at once.

    ``period_s`` of its messages is NaN before two have come; ``lag_s`` is how long the fastest
    joint needs from what was put out to what came in. ``like``: how the last target of all joints
    was serialized; ``is_usual``: whether the last one was of all joints and went out as it was
    wanted; ``step``: the arguments of `follow_serialized` that are the stream's.
    """

    def __init__(self, output: Output) -> None:
        self._output, self._robot, self._desired = output, output.robot, output.desired
        self._arm = arm = output.arm
        config = output.config
        self._fastest, self._slowdown = config.velocity_limits, config.acceleration_limits
        self._pause_s = config.stream_gap_s
        self._unlimited = ~np.isfinite(self._fastest)
        self._joints = np.zeros((4, arm.n))  # as `follow_serialized` takes them
        self._joints[PACE : FASTEST + 1] = config.velocity_limits
        self._joints[MOST_BELIEVED] = output.robot.doubtful
        self._active = self._joints[ACTIVE]  # 1 where a joint is commanded
        self._speeds = self._joints[PACE : FASTEST + 1]  # in a step and ever
        self.step: tuple[Any, ...] = self._joints, output.limiter.memory, output.limiter.limits
        self._velocity = np.zeros(arm.n)  # of the newest message
        self.phase, self.lag_s = StreamPhase.IDLE, 0.0
        self._interrupted = StreamPhase.IDLE  # what it goes on with, if the path is rejected
        self._why: RefusedError | None = None
        self._goal = np.full(arm.n, np.nan)  # of the newest message
        self._came_s = self._beat_s = -np.inf  # it, and the first of its burst
        self._intervals: deque[float] = deque(maxlen=INTERVALS)
        self.period_s, self._as_usual = np.nan, 0  # and so many intervals since it was found
        self._step_period_s = LONGEST_STEP_S  # it, or what stands for it before two messages came
        self._command: JointCommand | None = None  # its last message, or one like it
        self.is_usual = False
        self.like: SerializedTarget | None = None
        self._index, self._whole = np.zeros(0, dtype=np.int64), False  # of all joints, in order
        self._held_up = False  # and lags since
        self._credit_s = 0.0  # time that one that is held up has not used
        # targets of the last `SPEED_S`, and what went out lately, but for the last
        self._way: deque[tuple[float, Array]] = deque(maxlen=MOST_KEPT)
        self._sent: deque[tuple[float, Array]] = deque(maxlen=MOST_KEPT)
        self._step_s = 0.0  # time that the last output used
        self._before = np.full(arm.n, np.nan)  # what was put out before it
        # of a serialized target, while it is not noted: when it came, the period then, and how
        # long the output before it has been out
        self._unnoted: tuple[float, tuple[float, int] | None, float] | None = None
        # of the slow-down: from where, how fast, how long, and how much of that has gone out
        self._end_out, self._end_speed = np.empty(0), np.empty(0)
        self._lasts_s, self._slowed_s = 0.0, 0.0

    def runs(self, now_s: float) -> bool:
        """Whether it is under way."""
        if self.phase is StreamPhase.ENDING:
            return True
        return self.phase is StreamPhase.RUNNING and now_s - self._came_s <= self._gap_s()

    def interrupt(self) -> None:
        """A path takes its place."""
        self._interrupted, self.phase = self.phase, StreamPhase.IDLE

    def go_on(self) -> None:
        """That path was rejected: it goes on, unless it began anew or was ended meanwhile."""
        if self.phase is StreamPhase.IDLE:
            self.phase = self._interrupted

    def _period_at(self, now_s: float) -> tuple[float, int] | None:
        """The period when a message comes now, and since how many intervals; None in a burst.

        Half of the time is in intervals that are so long or longer. So it is the time from burst to
        burst, messages that are lost do not make it longer, and of a stream that slows down a few
        long intervals count at once.
        """
        interval, period = now_s - self._beat_s, self.period_s
        if interval <= 0.0 or interval < BURST * period:
            return None
        if self._as_usual + 1 < SAME_PERIOD and abs(interval - period) < 0.2 * period:
            return period, self._as_usual + 1
        lengths = sorted([*self._intervals, interval][-INTERVALS:])
        pause = max(self._pause_s, 2.0 * lengths[len(lengths) // 2])
        while lengths[-1] > pause:
            lengths.pop()
        usual = max(len(lengths) - STALLS, 1)
        lengths[usual:] = [lengths[usual - 1]] * (len(lengths) - usual)
        sums = list(accumulate(lengths))
        return lengths[bisect_right(sums, 0.5 * sums[-1])], 0

    def _note_period(self, period: tuple[float, int] | None, now_s: float) -> None:
        if period is not None:
            self._intervals.append(now_s - self._beat_s)
            self._beat_s, (self.period_s, self._as_usual) = now_s, period
            self._step_period_s = self.period_s

    def _gap_s(self) -> float:
        """A longer silence is a pause."""
        period = self.period_s
        return max(self._pause_s, 2.0 * period if period > 0.0 else 0.0)

    def is_due(self, now_s: float, periods: float) -> bool:
        """Whether its last message came so long ago."""
        return now_s - self._came_s > periods * self._step_period_s

    def _holds(self, elapsed_s: float) -> bool:
        """Whether the robot stands, as nothing went out for so long: the controller holds."""
        return elapsed_s > HELD_PERIODS * self._step_period_s

    def follow(self, came: bytes, now_s: float) -> int:
        """As `take`, for a serialized target of a stream of all joints that runs as usual.

        What became of it; `UNUSUAL`: nothing, it is for `take`. Where it led is noted by
        `settle`, which can wait until it is out.
        """
        like, output, desired = self.like, self._output, self._desired
        given, elapsed = desired.whole_step, now_s - output.out_s
        if (
            like is None
            or given is None
            or not self.is_usual
            or self.phase is not RUNNING
            or not 0.0 < elapsed <= self._pause_s
            or output.path is not None
            or output.mismatch
        ):
            return UNUSUAL
        period = self._period_at(now_s)
        if elapsed > HELD_PERIODS * (self._step_period_s if period is None else period[0]):
            return UNUSUAL
        like.came[:] = came
        became = follow_serialized(elapsed, *like.given, *self.step, *given)
        if became != UNUSUAL:
            self._unnoted = now_s, period, elapsed
            self._came_s = output.out_s = now_s
        return became

    def settle(self) -> None:
        """Note the last serialized target."""
        if self._unnoted is not None and self.like is not None:
            now_s, period, elapsed = self._unnoted
            self._unnoted, room = None, self.like.room
            self._note_period(period, now_s)
            self._goal, self._command = room[GIVEN].copy(), self.like.command
            self._output.stage, self._desired.made = self._desired.stage, True
            self._note(self._way, self._goal, now_s)
            self._note(self._sent, room[BEFORE].copy(), now_s - elapsed)

    def take(self, command: JointCommand, index: Index, q: Array, now_s: float) -> JointCommand:
        """Correct a target (all taught joints ``q`` (n,), of which ``index`` go out).

        Raises `RefusedError` when it cannot be corrected, nothing may begin there, or it is too
        far ahead; to `end` the stream is for the caller.
        """
        if self.phase is StreamPhase.ENDING and self._why is not None:
            raise RefusedError(self._why.reason, f"the stream is ended for: {self._why.detail}")
        output = self._output
        if output.mismatch:
            raise RefusedError(Reason.START_MISMATCH, output.mismatch)
        pause = now_s - self._came_s
        if self.phase is StreamPhase.RUNNING and pause > self._gap_s():
            self._look_after_pause(q, pause, now_s)
        if begins := self.phase is StreamPhase.IDLE:
            self._interrupted = StreamPhase.IDLE
            self._active[:] = 0.0
            self._intervals.clear()
            self._way.clear()
            self._sent.clear()
            self.period_s, self._step_period_s, self._beat_s = np.nan, LONGEST_STEP_S, now_s
        self._note_period(self._period_at(now_s), now_s)
        kept = self._index, self._whole, self._active.copy(), self._command
        if begins or index is not self._index:
            new = index[self._active[index] == 0.0]
            if len(new):
                self._begin(new, q, now_s)
            self._active[:] = 0.0
            self._active[index] = 1.0
            self._index, self._whole = index, np.array_equal(index, np.arange(self._arm.n))
        self._goal, velocity = q, command.velocity
        self._note(self._way, q, now_s)
        self._velocity[:] = 0.0
        if velocity is not None:
            self._velocity[index] = velocity
        self._came_s, self._command, self.phase = now_s, command, StreamPhase.RUNNING
        self.is_usual = False
        try:
            self._advance(now_s)
            self.is_usual = self._whole and self.lag_s == 0.0 and not self._held_up
            message = self._message(command)
        except RefusedError:  # what is slowed down then are the joints that went out
            self._index, self._whole, self._active[:], self._command = kept
            raise
        output.path = None  # which the controller goes on with where the target is refused
        return message

    def _look_after_pause(self, q: Array, pause_s: float, now_s: float) -> None:
        """Go on after a pause only where the robot is where it was left, and can be there soon.

        Else it is a new begin.
        """
        chosen = self._active > 0.0
        self._robot.require_fresh(np.flatnonzero(chosen), now_s)
        output, near = self._output, self._output.near[chosen]
        place, _ = output.place(np.flatnonzero(chosen), output.out[chosen], now_s)
        spare = np.maximum(self._pace() - self._own_speed(), 0.0)[chosen] * CATCH_UP_S
        ahead, moved = np.abs(q - output.taught)[chosen], np.abs(place - output.out[chosen])
        known = np.isfinite(ahead).all() and np.isfinite(moved).all()
        if not known or pause_s > RESUME_S or np.any(ahead > spare + near) or np.any(moved > near):
            self.phase = StreamPhase.IDLE

    def _begin(self, new: Index, q: Array, now_s: float) -> None:
        """Joints begin where the controller is; the offset of a path that is left goes on."""
        output, limiter = self._output, self._output.limiter
        begins = self._desired.begins(q)
        output.take_up(now_s)
        offset, rate = output.begin_at(new, q, begins, now_s), np.zeros(len(new))
        if output.path is not None:
            driven = np.isin(new, output.path.index)
            change = output.path.offset(now_s + RATE_S)[0] - limiter.state[OFFSET]
            rate[driven] = change[new[driven]] / RATE_S
        limiter.begin(new, offset, begins[0, new])
        limiter.state[OFFSET_RATE, new] = rate
        output.taught[new], output.out[new] = q[new], q[new] + offset
        for _, out in self._sent_lately():
            out[new] = output.out[new]
        if self.phase is StreamPhase.IDLE:
            output.out_s = now_s

    def come_to_rest(self, now_s: float) -> None:
        """The offset stands where nothing went out for so long that the controller holds."""
        self.settle()
        if self.phase is not StreamPhase.ENDING and self._holds(now_s - self._output.out_s):
            self._output.limiter.state[OFFSET_RATE] = 0.0

    def _advance(self, now_s: float) -> None:
        """Put out what came in last, or as much of the way there as the speeds allow."""
        output, period_s = self._output, self._step_period_s
        elapsed = longest = max(now_s - output.out_s, 0.0)
        before, held_up = output.out.copy(), self._held_up
        if elapsed > HELD_PERIODS * period_s:  # a robot that stands makes no longer step
            output.limiter.state[OFFSET_RATE] = 0.0
            longest, self._held_up = period_s, True
            self._sent.clear()  # the time in which it stood is no part of its motion
        elif self.lag_s == 0.0:
            self._held_up = False
        self._note(self._sent, before, now_s - longest)
        if self._held_up:
            late = self.lag_s >= LATE * CATCH_UP_S
            self._speeds[0] = self._pace() if late else self._catching_up(elapsed, longest)
        elif held_up:
            self._speeds[0] = self._fastest
        q, fraction, limiter = self._goal, 1.0, output.limiter
        for _ in range(TRIES):
            share = self._desired.put_out(
                q, self._velocity, elapsed, longest, self._active, self._speeds
            )
            if share < 0.0:
                require_limits(limiter.memory[-1:], self._arm)
            if share <= 1.0 + ROUNDING:
                break
            if fraction == 1.0:
                self._require_near(longest)
            fraction *= 0.999 / share
            way = (self._goal - output.taught) * self._active
            q = np.where(self._active > 0.0, output.taught, self._goal) + fraction * way
        else:
            limiter.state[OFFSET_RATE] = 0.0
        self._before, self._step_s, output.out_s = before, longest, now_s
        output.stage = self._desired.stage if self._desired.made else None
        self.lag_s = 0.0
        if fraction < 1.0:
            self.lag_s = self._ahead_s()

    def _note(self, way: deque[tuple[float, Array]], q: Array, now_s: float) -> None:
        """Keep places (n,); of several in a burst the last one, at the time of the first."""
        if way and now_s - way[-1][0] < 0.5 * self._step_period_s:
            way[-1] = way[-1][0], q
        else:
            way.append((now_s, q))

    def _own_speed(self) -> Array:
        """How fast its targets moved lately (n,), but for the last, which may begin a burst."""
        way = _lately(self._way, SPEED_S)
        (begin_s, begin), (end_s, end) = way[0], way[-2 if len(way) > 2 else -1]
        return np.abs(end - begin) / (end_s - begin_s) if end_s > begin_s else 0.0 * end

    def _sent_lately(self) -> deque[tuple[float, Array]]:
        return _lately(self._sent, max(SENT_S, SENT_PERIODS * self._step_period_s))

    def _sent_speed(self) -> Array:
        """How fast the joints are sent now (k,), but none the other way than lately.

        By a parabola through what went out: a stream may be slowing down, and the times of its
        messages are uneven.
        """
        output, index = self._output, self._index
        self._note(self._sent, output.out.copy(), output.out_s)
        sent = self._sent_lately()
        t = np.array([t for t, _ in sent])
        way = np.array([out[index] for _, out in sent]) - output.out[index]
        lasts = t[-1] - t[0]
        if lasts <= 0.0:
            return np.zeros(len(index))
        mean = -way[0] / lasts
        if len(t) < SENT:
            return np.asarray(mean)
        speed, pace = np.polyfit((t - t[-1]) / lasts, way, 2)[1] / lasts, self._pace()[index]
        return np.where(speed * mean > 0.0, np.clip(speed, -pace, pace), 0.0)

    def _pace(self) -> Array:
        """The joints' speeds (n,); of those without a limit what is taken for one."""
        if not self._unlimited.any():
            return self._fastest
        return np.where(self._unlimited, self._own_speed() + SPARE, self._fastest)

    def _ahead_s(self) -> float:
        """How long the joints need from what was put out to what came in."""
        way = np.abs(self._goal - self._output.taught) * self._active
        return float(np.max(way / self._pace()))

    def _catching_up(self, elapsed_s: float, longest_s: float) -> Array:
        """Speeds (n,) of a step, so that what a controller's cycle adds up is no burst.

        Messages that were late or early share their time, but none uses more than a period.
        """
        period = self._step_period_s
        credit = longest_s if longest_s < elapsed_s else self._credit_s + elapsed_s
        usable = min(credit, period)
        self._credit_s = min(credit, 1.5 * period) - usable
        speed = np.maximum(CATCH_UP * self._own_speed(), LEAST * self._pace())
        share = usable / longest_s if longest_s > 0.0 else 0.0
        return np.minimum(speed * share, self._fastest)

    def _require_near(self, longest_s: float) -> None:
        """Refuse a target that the joints do not come near: none of the way there goes out."""
        ahead_s = self._ahead_s() - longest_s
        if ahead_s > CATCH_UP_S:
            raise RefusedError(
                Reason.VELOCITY_LIMIT,
                f"the stream is {ahead_s:.3f} s ahead at the joints' speeds, allowed "
                f"{CATCH_UP_S:g} s",
            )

    def _message(self, command: JointCommand) -> JointCommand:
        """What goes out for a command; itself where nothing is added."""
        index, velocity = self._index, command.velocity
        if velocity is not None:
            velocity = self.velocity_out()
        if self.lag_s == 0.0 and not self._desired.figures[ADDS]:
            return command
        out = self._output.out
        position = out.copy() if self._whole else out[index]
        return JointCommand(command.names, position, velocity, command.stamp_ns, CORRECTED)

    def velocity_out(self) -> Array:
        """Velocities (k,) that go out for those of the last target; `RefusedError` for a high one.

        Those of the correction where the offset is the desired one, else by what went out, or the
        limiter's rates.
        """
        output, index = self._output, self._index
        if self.lag_s > 0.0 and self._step_s > 0.0:
            velocity = (output.out - self._before)[index] / self._step_s
        else:
            velocity = output.limiter.memory[VELOCITY]
            velocity = velocity.copy() if self._whole else velocity[index]
            if not self._desired.figures[TOO_FAST]:
                return velocity
        names = [self._arm.joint_names[i] for i in index]
        hold_speeds(names, velocity[None], self._fastest[index])
        return velocity

    def end(self, why: RefusedError, now_s: float) -> None:
        """End it: the robot is slowed down from where and as fast as it was sent lately.

        After a silence the controller has held the last target since: the robot stands, and
        nothing more goes out, which would set it in motion again.
        """
        self.settle()
        self._interrupted = StreamPhase.IDLE
        if self.phase is not StreamPhase.RUNNING:
            return
        output, index, self._why = self._output, self._index, why
        speed = np.zeros(len(index))
        if self._sent and not self._holds(now_s - output.out_s):
            speed = self._sent_speed()
        slowdown = self._slowdown
        if self._unlimited.any():
            slowdown = np.where(np.isfinite(slowdown), slowdown, self._pace() / END_S)
        lasts = np.max(np.abs(speed) / slowdown[index], initial=0.0)
        self.lag_s = 0.0
        if not self._step_period_s < lasts < np.inf:  # what takes one step is none
            self.phase = StreamPhase.IDLE
            return
        self.phase, self._lasts_s, self._slowed_s = StreamPhase.ENDING, float(lasts), 0.0
        self._end_out, self._end_speed = output.out[index].copy(), speed

    @property
    def has_tail(self) -> bool:
        """Whether it goes on without a message: slowed down, or behind its last target."""
        return self.phase is StreamPhase.ENDING or (
            self.phase is StreamPhase.RUNNING and self.lag_s > 0.0
        )

    def tail(self, now_s: float) -> JointCommand | None:
        """What must go out now without a message; None when nothing must."""
        self.settle()
        if self._command is None:
            return None
        if self.phase is StreamPhase.RUNNING and self.lag_s > 0.0 and self.is_due(now_s, 1.5):
            goal = self._goal[self._index]
            command = replace(self._command, position=goal, velocity=None, stamp_ns=0)
            self.is_usual = False
            self._note(self._way, self._goal, now_s)
            try:
                self._advance(now_s)
                return self._message(command)
            except RefusedError as error:  # another model has come, or the bounds are narrower
                self.end(error, now_s)
        return self._slowed(self._command, now_s) if self.phase is StreamPhase.ENDING else None

    def _slowed(self, command: JointCommand, now_s: float) -> JointCommand | None:
        """The slow-down, as far as it is by the time since the last output."""
        output, index = self._output, self._index
        elapsed = max(now_s - output.out_s, 0.0)
        if self._holds(elapsed):  # it was held up itself
            self.phase = StreamPhase.IDLE
            return None
        self._slowed_s = min(self._slowed_s + elapsed, self._lasts_s)
        t = self._slowed_s
        place = self._end_out + self._end_speed * (t - 0.5 * t * t / self._lasts_s)
        place = np.clip(place, self._arm.lower[index], self._arm.upper[index])
        output.taught[index] += place - output.out[index]
        output.out[index], output.out_s = place, now_s
        output.limiter.state[OFFSET_RATE, index] = 0.0
        velocity = None
        if command.velocity is not None:
            velocity = self._end_speed * (1.0 - t / self._lasts_s)
        if t >= self._lasts_s:
            self.phase = StreamPhase.IDLE
        return replace(command, position=place, velocity=velocity, mark=CORRECTED, stamp_ns=0)


def _lately(way: deque[tuple[float, Array]], window_s: float) -> deque[tuple[float, Array]]:
    """What was kept in the last ``window_s``, and one from before it; at least two."""
    while len(way) > 2 and way[1][0] <= way[-1][0] - window_s:
        way.popleft()
    return way
