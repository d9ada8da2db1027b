"""Joint targets and trajectories, corrected."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.joint_correction.blending import blend_rates
from robocal_ros.core.joint_correction.bounds import CorrectionConfig
from robocal_ros.core.joint_correction.refusals import Reason, RefusedError
from robocal_ros.core.joint_correction.starting import INSTANTS, RESPONSE_S, Sent
from robocal_ros.core.samples import CORRECTED
from robocal_ros.sessions.correction.corrector import Corrected, Corrector
from robocal_ros.sessions.correction.incoming import (
    TARGET,
    TRAJECTORY,
    CorrectionGuard,
    JointBook,
    require_finite,
)
from robocal_ros.sessions.correction.inputs import JointCommand, TrajectoryCommand
from robocal_ros.sessions.correction.periods import StreamPeriod
from robocal_ros.sessions.correction.starts import Starts

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_AT_ONCE = np.zeros(1)


class Commands:
    """From taught joints to corrected ones.

    Attributes
    ----------
    goal : (n,) taught joints that were commanded last, NaN before the first.
    """

    def __init__(
        self,
        config: CorrectionConfig,
        joints: JointBook,
        guard: CorrectionGuard,
        corrector: Corrector,
        starts: Starts,
    ) -> None:
        self._config, self._joints, self._guard = config, joints, guard
        self._corrector, self._starts = corrector, starts
        self._stream = StreamPeriod(config.stream_gap_s)
        self.goal = np.full(joints.count, np.nan)

    def streams(self, now_s: float) -> bool:
        """Whether a stream of targets is under way."""
        return self._stream.goes_on(now_s)

    def stop(self, now_s: float) -> None:
        """What is under way ends."""
        self._corrector.stop(now_s)
        self._starts.stop(now_s)
        self._stream.end()

    def target(self, command: JointCommand, now_s: float) -> JointCommand:
        """Correct one message of a stream; the blend advances with ``now_s``."""
        self._guard.require_order(TARGET, command.stamp_ns, command.mark, now_s)
        self._guard.require_not_own(TARGET, command.names, command.position)
        q, index = self._joints.complete(command.names, command.position[None], now_s)
        speeds = None if command.velocity is None else command.velocity[None]
        require_finite(command.names, speeds)
        corrected = command
        last = self._stream.last_s
        pause = 0.0 if last is None else now_s - last
        if self._starts.must_start(now_s) and not self._stream.goes_on(now_s):
            self._starts.start_at(q, self._joints.where(now_s), now_s)
            pause = 0.0
        if not self._corrector.passes(q, now_s):
            whole = len(index) == self._joints.count
            done = self._corrector.point(q, now_s, pause, whole)
            velocity = None
            if speeds is not None:
                qd = self._joints.spread(speeds, index)
                still = np.zeros_like(q)
                rates = done.stage.rates(q, qd, still, done.s, np.zeros(1), done.result)
                velocity = rates[0][0, index]
            position = done.result.q[0, index]
            corrected = replace(command, position=position, velocity=velocity, mark=CORRECTED)
        self._stream.note(now_s)
        self.goal = q[0]
        self._guard.accept_order(TARGET, command.stamp_ns, now_s)
        out = corrected.position
        self._guard.note_output(TARGET, command.names, command.position, out)
        sent = Sent(index, now_s, _AT_ONCE, command.position[None], out[None])
        self._starts.note_sent(sent, now_s)
        return corrected

    def trajectory(
        self, command: TrajectoryCommand, now_s: float, starts_in_s: float
    ) -> TrajectoryCommand:
        """Correct a whole trajectory of at least one point."""
        # The stamp says when it begins, not when it was made: no order follows from it.
        self._guard.require_order(TRAJECTORY, 0, command.mark, now_s)
        times = command.time_from_start_s
        if not np.all(np.isfinite(times)) or times[0] < 0.0 or np.any(np.diff(times) <= 0.0):
            raise RefusedError(Reason.TIME_BACKWARDS, "time_from_start does not increase")
        self._guard.require_not_own(TRAJECTORY, command.names, command.position)
        q, index = self._joints.complete(command.names, command.position, now_s)
        require_finite(command.names, command.velocity)
        require_finite(command.names, command.acceleration)
        corrected = command
        if self._starts.must_start(now_s):
            self._start_path(q, index, times, now_s, starts_in_s)
        if not self._corrector.passes(q, now_s):
            whole = len(index) == self._joints.count
            done = self._corrector.path(q, times, now_s, starts_in_s, whole)
            position = done.result.q[:, index]
            corrected = replace(command, position=position, mark=CORRECTED)
            if command.velocity is not None:
                corrected = self._with_rates(corrected, done, q, index)
        self._guard.accept_order(TRAJECTORY, 0, now_s)
        out = corrected.position
        self._guard.note_output(TRAJECTORY, command.names, command.position, out)
        begin = now_s + starts_in_s
        self._starts.note_sent(Sent(index, begin, times, command.position, out), now_s)
        self._stream.end()
        self.goal = q[-1]
        return corrected

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

    def _with_rates(
        self, command: TrajectoryCommand, done: Corrected, q: Array, index: Index
    ) -> TrajectoryCommand:
        """Correct the velocities and accelerations of a command whose positions are corrected."""
        zero = np.zeros_like(q)
        given = (command.velocity, command.acceleration)
        qd, qdd = (zero if x is None else self._joints.spread(x, index) for x in given)
        speed = blend_rates(command.time_from_start_s, done.s)
        velocity, acceleration = done.stage.rates(q, qd, qdd, done.s, speed, done.result)
        return replace(
            command,
            velocity=velocity[:, index],
            acceleration=None if command.acceleration is None else acceleration[:, index],
        )
