"""Session of the joint correction: taught joints in, corrected ones out, and back. No clock.

It is off until enabled. Enabling, disabling, a new model and a new tool all go through a blend
of model and tool parameters that moves no joint faster than a bound. What it cannot or must not
correct is refused with a reason, counted, and nothing is put out for it: `RefusedError`.
"""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.joint_correction.blending import blend_rates
from robocal_ros.core.joint_correction.bounds import CorrectionConfig
from robocal_ros.core.joint_correction.refusals import Reason, RefusedError
from robocal_ros.core.joint_correction.starting import INSTANTS, RESPONSE_S, Sent
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.samples import CORRECTED, TAUGHT
from robocal_ros.sessions.correction.corrector import Corrected, Corrector
from robocal_ros.sessions.correction.incoming import (
    READING,
    TARGET,
    TRAJECTORY,
    CorrectionGuard,
    JointBook,
    require_finite,
)
from robocal_ros.sessions.correction.inputs import (
    CorrectionStatus,
    JointCommand,
    OfferedModel,
    OfferedTool,
    TrajectoryCommand,
)
from robocal_ros.sessions.correction.offers import CorrectionGate

Array = NDArray[np.float64]
Answer = TypeVar("Answer")

_AT_ONCE = np.zeros(1)


class CorrectionSession:
    """Corrects joint targets and trajectories, and un-corrects joint readings.

    ``now_s`` is a steady clock of the caller, the same one in all calls.

    Parameters
    ----------
    nominal : model that offered models must have been made for.
    reference : model and tool (``T_flange_tool``) that the program was taught with: the nominal
        one for a program made off line, the calibrated cold one for a taught program.
    serial : the robot's.
    """

    def __init__(
        self,
        nominal: SerialArm,
        reference: SerialArm,
        serial: str,
        config: CorrectionConfig | None = None,
    ) -> None:
        config = config or CorrectionConfig()
        self._gate = CorrectionGate(nominal, reference, serial, config)
        self._guard = CorrectionGuard()
        self._config = config
        self._joints = JointBook(reference, config.joint_state_age_s)
        self._corrector = Corrector(reference, config)
        self._enabled = False
        self._streamed_s: float | None = None
        self._goal = np.full(reference.n, np.nan)

    # ---- what the operator and the estimators decide --------------------------------------------

    def enable(self, on: bool) -> None:
        """Ask for the correction, or for its end; either blends in.

        Time stamps start afresh; after a mismatch the next command may begin where the robot is;
        a model that waits to be looked at is taken over, if it is not too large.
        """
        self._enabled = on
        self._guard.forget_stamps()
        self._corrector.restart()
        with contextlib.suppress(RefusedError):  # counted, and in the status
            self._guard.counted(lambda: self._gate.look_again(self._places()))
        self._want()

    def offer_model(self, model: OfferedModel) -> None:
        """Take over an accepted model of this robot; refused models change nothing."""
        self._guard.counted(lambda: self._gate.take_model(model, self._places()))
        self._want()

    def offer_tool(self, tool: OfferedTool) -> None:
        """Take over a tool frame; refused ones change nothing."""
        self._guard.counted(lambda: self._gate.take_tool(tool))
        self._want()

    def _places(self) -> Array:
        """Taught joints (k, n) where the robot is, and where it was sent."""
        places = np.stack([self._joints.taught, self._goal])
        return np.asarray(places[np.isfinite(places).all(axis=1)])

    def _want(self) -> None:
        self._corrector.want(self._gate.actual, self._enabled)

    # ---- commands -------------------------------------------------------------------------------

    def target(self, command: JointCommand, now_s: float) -> JointCommand:
        """Correct one message of a stream of joint targets.

        The blend advances with ``now_s``, at most by the configured longest step.
        """
        return self._guard.counted(lambda: self._target(command, now_s))

    def _target(self, command: JointCommand, now_s: float) -> JointCommand:
        self._guard.require_order(TARGET, command.stamp_ns, command.mark, now_s)
        self._guard.require_not_own(TARGET, command.names, command.position)
        q, index = self._joints.complete(command.names, command.position[None], now_s)
        speeds = None if command.velocity is None else command.velocity[None]
        require_finite(command.names, speeds)
        corrected = command
        pause = np.inf if self._streamed_s is None else now_s - self._streamed_s
        if self._must_start(now_s) and pause > self._config.stream_gap_s:
            self._corrector.start_at(q, self._joints.where(now_s), now_s)
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
        self._streamed_s, self._goal = now_s, q[0]
        self._guard.accept_order(TARGET, command.stamp_ns, now_s)
        out = corrected.position
        self._guard.note_output(TARGET, command.names, command.position, out)
        sent = Sent(index, now_s, _AT_ONCE, command.position[None], out[None])
        self._corrector.note_sent(sent, now_s)
        return corrected

    def _must_start(self, now_s: float) -> bool:
        """Whether a command must begin where the robot is; refused after a mismatch."""
        if self._corrector.mismatch:
            raise RefusedError(Reason.START_MISMATCH, self._corrector.mismatch)
        return self._corrector.must_start(now_s)

    def trajectory(
        self, command: TrajectoryCommand, now_s: float, starts_in_s: float = 0.0
    ) -> TrajectoryCommand:
        """Correct a whole trajectory; the blend advances along its time from start.

        ``starts_in_s``: when it begins, counted from now (its header's stamp); negative for one
        that is under way. A trajectory without points is a stop: it passes as it came.
        """
        if len(command) == 0:
            self._corrector.stop(now_s)
            self._streamed_s = None
            return command
        return self._guard.counted(lambda: self._trajectory(command, now_s, starts_in_s))

    def _trajectory(
        self, command: TrajectoryCommand, now_s: float, starts_in_s: float
    ) -> TrajectoryCommand:
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
        if self._must_start(now_s):
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
        self._corrector.note_sent(Sent(index, begin, times, command.position, out), now_s)
        self._streamed_s, self._goal = None, q[-1]
        return corrected

    def _start_path(
        self, q: Array, index: NDArray[np.int64], times: Array, now_s: float, starts_in_s: float
    ) -> None:
        """The robot must stand where a trajectory begins, or be led there in time."""
        where, elapsed = self._joints.where(now_s), -starts_in_s
        if elapsed < times[0]:
            self._corrector.start_within(q[0], index, where, now_s, float(times[0] - elapsed))
            return
        lately = np.linspace(elapsed, elapsed - RESPONSE_S, INSTANTS)
        begins = np.stack([np.interp(lately, times, column) for column in q.T], axis=1)
        self._corrector.start_at(begins, where, now_s)

    def _with_rates(
        self, command: TrajectoryCommand, done: Corrected, q: Array, index: NDArray[np.int64]
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

    # ---- readings -------------------------------------------------------------------------------

    def reading(self, state: JointCommand, now_s: float, age_s: float = 0.0) -> JointCommand:
        """Un-correct joint readings with the model that is being commanded at ``now_s``.

        ``age_s``: how old they were on arrival, by their stamp.
        Joints of others pass as they are.
        """
        return self._guard.counted(lambda: self._reading(state, now_s, age_s))

    def _reading(self, state: JointCommand, now_s: float, age_s: float) -> JointCommand:
        self._guard.require_order(READING, state.stamp_ns, state.mark, now_s)
        index, place = self._joints.read(state, now_s, age_s)
        self._guard.accept_order(READING, state.stamp_ns, now_s)
        passed = replace(state, mark=TAUGHT)
        stage = self._corrector.commanded(now_s)
        if stage is None:
            self._joints.taught = self._joints.measured.copy()
            return passed
        if len(place) == 0:
            return passed
        measured = self._joints.measured
        taught = stage.uncorrect(measured[None], np.ones(1))
        self._joints.taught = taught[0]
        position = state.position.copy()
        position[place] = taught[0, index]
        velocity = state.velocity
        if velocity is not None:
            velocity = velocity.copy()
            speed = self._joints.spread(velocity[None, place], index)
            velocity[place] = stage.taught_velocity(taught, measured[None], speed)[0, index]
        return replace(passed, position=position, velocity=velocity)

    def counted(self, act: Callable[[], Answer]) -> Answer:
        """Do something for this session; a refusal is counted with its own."""
        return self._guard.counted(act)

    def status(self) -> CorrectionStatus:
        """What the session does."""
        corrector, guard = self._corrector, self._guard
        return CorrectionStatus(
            enabled=self._enabled,
            active=not corrector.idle,
            settled=corrector.settled,
            revision=self._gate.revision,
            serial=self._gate.serial,
            survey=self._gate.survey,
            waiting_revision=None if self._gate.waiting is None else self._gate.waiting.revision,
            new_tool=self._gate.new_tool,
            tcp_shift_m=corrector.figures[0],
            largest_shift=corrector.figures[1],
            remaining_m=corrector.figures[2],
            held=corrector.held,
            waits=corrector.waits,
            mismatch=corrector.mismatch,
            reduced=corrector.reduced,
            refused=dict(guard.refused),
            last_refusal=guard.last_refusal,
        )
