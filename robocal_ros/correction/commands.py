"""Joint targets and trajectories, corrected."""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.samples import CORRECTED
from robocal_ros.correction import memory as of
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.corrector import Corrector
from robocal_ros.correction.courses import Courses
from robocal_ros.correction.incoming import (
    TARGET,
    TRAJECTORY,
    CorrectionGuard,
    JointBook,
    require_finite,
)
from robocal_ros.correction.inputs import JointCommand, TrajectoryCommand, require_few
from robocal_ros.correction.memory import RESPONSE_S, Memory
from robocal_ros.correction.periods import StreamPeriod
from robocal_ros.correction.proposals import Motion
from robocal_ros.correction.refusals import Reason, RefusedError
from robocal_ros.correction.starting import INSTANTS, Sent
from robocal_ros.correction.starts import Starts

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Command = TypeVar("Command", JointCommand, TrajectoryCommand)

# A point of a trajectory is corrected and forwarded within this: one that has a time to begin at
# is entered so much later, and must not have begun to blend by then.
FORWARDED_S = 1e-4


class Commands:
    """From taught joints to corrected ones.

    Attributes
    ----------
    goal : (n,) taught joints that were commanded last, NaN before the first.
    offset : (n,) what was added to the target corrected last; in shadow mode what would have been.
    courses : which trajectory was put out last.
    settled : the last target taken here, when the next ones of its stream are corrected alike.
    """

    def __init__(
        self,
        config: CorrectionConfig,
        joints: JointBook,
        guard: CorrectionGuard,
        corrector: Corrector,
        starts: Starts,
        memory: Memory,
    ) -> None:
        self._config, self._joints, self._guard = config, joints, guard
        self._corrector, self._starts = corrector, starts
        self._stream = StreamPeriod(memory, config.stream_gap_s)
        self._out, self._times = memory.out, memory.times  # of the last target
        self.courses = Courses(corrector, starts, memory)
        self.goal, self.offset = memory.goal, memory.offset
        self.settled: JointCommand | None = None

    def streams(self, now_s: float) -> bool:
        """Whether a stream of targets is under way."""
        return self._stream.goes_on(now_s)

    def stop(self, now_s: float) -> None:
        """What is under way ends, also by a clock that went back."""
        self.settled = None
        now_s = self._guard.not_before(now_s)
        self.courses.stop(now_s)
        self._stream.end()

    def target(self, command: JointCommand, now_s: float) -> JointCommand:
        """Correct one message of a stream; the blend advances with ``now_s``."""
        self.settled = None
        self._guard.require_order(TARGET, command.stamp_ns, command.mark, now_s, command.names)
        q, index = self._joints.complete(command.names, command.position[None], now_s)
        self._guard.require_not_own(TARGET, index, command.position)
        speeds = None if command.velocity is None else command.velocity[None]
        require_finite(command.names, speeds)
        # Messages may come at once after a delay: each has the stream's own period; and a pause
        # does not allow a longer step than two of them.
        mean = self._stream.mean_s
        period = mean if mean > 0.0 else self._config.longest_step_s
        dt_s = np.array([np.clip(now_s - self._times[of.OUT], period, 2.0 * period)])
        motion = self._motion(q, index, dt_s, speeds)
        corrected = self._or_as_it_came(
            command, lambda: self._correct_target(command, motion, index, now_s)
        )
        self._stream.note(now_s)
        self.goal[:] = q[0]
        self._guard.accept_order(TARGET, command.stamp_ns, now_s, command.names)
        out = corrected.position
        self._guard.note_output(TARGET, index, command.position, out)
        self._out[:] = np.nan
        self._out[index], self._times[of.OUT] = out, now_s
        self._starts.note_target(index)
        self.courses.current = None
        self.settled = command if self._is_settled(index) else None
        return corrected

    def _is_settled(self, index: Index) -> bool:
        """Whether a target just put out shows what the next ones of its stream will meet."""
        corrector, whole = self._corrector, len(index) == self._joints.count
        same = corrector.settled and not corrector.waits and not self._config.shadow
        return whole and same and (corrector.idle or not self._starts.bare)

    def _correct_target(
        self, command: JointCommand, motion: Motion, index: Index, now_s: float
    ) -> JointCommand:
        last = self._stream.last_s
        pause = now_s - last if np.isfinite(last) else 0.0
        if self._starts.must_start(now_s) and not self._stream.goes_on(now_s):
            self._starts.start_at(motion.q, self._joints.where(now_s), now_s)
            pause = 0.0
        if self._corrector.passing(now_s):
            self._corrector.pass_on(motion, now_s)
            self.offset[:] = 0.0
            return command
        done = self._corrector.point(motion, now_s, pause)
        self.offset[:] = done.result.q[0] - motion.q[0]
        velocity = None if done.velocity is None else done.velocity[0, index]
        position = done.result.q[0, index]
        return replace(command, position=position, velocity=velocity, mark=CORRECTED)

    def _motion(
        self,
        q: Array,
        index: Index,
        dt_s: Array,
        velocity: Array | None,
        acceleration: Array | None = None,
    ) -> Motion:
        """A command with all joints, and the target before it."""
        qd = None if velocity is None else self._joints.spread(velocity, index)
        qdd = None if acceleration is None else self._joints.spread(acceleration, index)
        whole, before = len(index) == self._joints.count, self._out
        if not whole:
            before = np.full(self._joints.count, np.nan)
            before[index] = self._out[index]
        return Motion(q, qd, qdd, whole, before, dt_s)

    def _or_as_it_came(self, command: Command, correct: Callable[[], Command]) -> Command:
        """Correct a command; in shadow mode that is only tried, and the command passes."""
        if not self._config.shadow:
            return correct()
        with contextlib.suppress(RefusedError):  # counted, and in the status
            self._guard.counted(correct)
        return command

    def trajectory(
        self,
        command: TrajectoryCommand,
        now_s: float,
        starts_in_s: float,
        may_be_rejected: bool = False,
    ) -> TrajectoryCommand:
        """Correct a whole trajectory of at least one point."""
        self.settled = None
        require_few(len(command))
        # The stamp says when it begins, not when it was made: no order follows from it.
        self._guard.require_order(TRAJECTORY, 0, command.mark, now_s)
        times = command.time_from_start_s
        if not np.all(np.isfinite(times)) or times[0] < 0.0 or np.any(np.diff(times) <= 0.0):
            raise RefusedError(Reason.TIME_BACKWARDS, "time_from_start does not increase")
        q, index = self._joints.complete(command.names, command.position, now_s)
        self._guard.require_not_own(TRAJECTORY, index, command.position)
        require_finite(command.names, command.velocity)
        require_finite(command.names, command.acceleration)
        dt_s = np.append(np.inf, np.diff(times))
        motion = self._motion(q, index, dt_s, command.velocity, command.acceleration)
        places = self._starts.leads_from(self._joints.where(now_s), index, now_s)
        motion = self._starts.led_in(motion, places, times[0] + starts_in_s, now_s)
        left = self.courses.left()
        corrected = self._or_as_it_came(
            command, lambda: self._correct_path(command, motion, index, now_s, starts_in_s)
        )
        self._guard.accept_order(TRAJECTORY, 0, now_s)
        out = corrected.position
        self._guard.note_output(TRAJECTORY, index, command.position, out)
        begin, led_from = now_s + starts_in_s, places[1, index]
        sent = Sent(index, begin, times, command.position, out, led_from, now_s)
        self._starts.note_sent(sent, now_s)
        at_once = starts_in_s == 0.0
        self.courses.take(left, at_once=at_once, may_be_rejected=may_be_rejected)
        self._stream.end()
        self._out[:] = np.nan
        self.goal[:] = q[-1]
        return corrected

    def _correct_path(
        self,
        command: TrajectoryCommand,
        motion: Motion,
        index: Index,
        now_s: float,
        starts_in_s: float,
    ) -> TrajectoryCommand:
        times = command.time_from_start_s
        if self._starts.must_start(now_s):
            self._start_path(motion.q, index, times, now_s, starts_in_s)
        if self._corrector.passing(now_s):
            self._corrector.pass_on(motion, now_s)
            return command
        rests_s = 0.0 if starts_in_s == 0.0 else FORWARDED_S * len(times)
        done = self._corrector.path(motion, times, now_s, starts_in_s, rests_s)
        return replace(
            command,
            position=done.result.q[:, index],
            velocity=None if done.velocity is None else done.velocity[:, index],
            acceleration=None if done.acceleration is None else done.acceleration[:, index],
            mark=CORRECTED,
        )

    def _start_path(
        self, q: Array, index: Index, times: Array, now_s: float, starts_in_s: float
    ) -> None:
        """The robot must stand where a trajectory begins, or be led there in time."""
        where, elapsed = self._joints.where(now_s), -starts_in_s
        if elapsed < times[0]:
            self._starts.start_within(q[0], index, where, now_s, float(times[0] - elapsed))
            return
        lately = np.linspace(elapsed, elapsed - RESPONSE_S, INSTANTS)
        begins = np.stack([np.interp(lately, times, column) for column in q.T], axis=1)
        self._starts.start_at(begins, where, now_s)
