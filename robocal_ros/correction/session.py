"""Session of the joint correction: taught joints in, corrected ones out, and back. No clock.

It is off until enabled. Enabling, disabling, a new model and a new tool all go through a blend
of model and tool parameters that moves no joint faster than a bound. What it cannot or must not
correct is refused with a reason, counted, and nothing is put out for it: `RefusedError`.
"""

import contextlib
from collections.abc import Callable
from typing import NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.commands import Commands
from robocal_ros.correction.corrector import Corrector
from robocal_ros.correction.courses import Course
from robocal_ros.correction.incoming import CorrectionGuard, JointBook
from robocal_ros.correction.inputs import (
    JointCommand,
    OfferedModel,
    OfferedTool,
    TrajectoryCommand,
)
from robocal_ros.correction.memory import blank
from robocal_ros.correction.offers import CorrectionGate
from robocal_ros.correction.plain_streams import Limits, PlainReadings, PlainTargets
from robocal_ros.correction.readings import Readings
from robocal_ros.correction.refusals import Reason, RefusedError
from robocal_ros.correction.starts import Starts
from robocal_ros.correction.status import CorrectionStatus, Offset
from robocal_ros.correction.wire import JointWire

Array = NDArray[np.float64]
Answer = TypeVar("Answer")


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
        self._reference = reference
        self._gate = CorrectionGate(nominal, reference, serial, config)
        self._block, memory = blank(reference.n)
        self._guard = CorrectionGuard(memory)
        self._config = config
        self._joints = JointBook(reference, config.joint_state_age_s, memory)
        self._corrector = Corrector(reference, config, memory)
        self._enabled = False
        self._starts = Starts(reference, config, self._corrector, memory)
        self._commands = Commands(
            config, self._joints, self._guard, self._corrector, self._starts, memory
        )
        self._readings = Readings(self._joints, self._guard, self._corrector, config.shadow)
        limits = Limits(reference, config, self._joints.doubtful)
        self._plain = limits, self._block, self._guard, self._corrector

    # ---- what the operator and the estimators decide --------------------------------------------

    def enable(self, on: bool) -> None:
        """Ask for the correction, or for its end; either blends in.

        Time stamps start afresh; after a mismatch the next command may begin where the robot is;
        a model or a tool that waits to be looked at is taken over, if it is not too large.
        """
        self._enabled = on
        self._guard.forget_stamps()
        self._starts.restart()
        for look in (lambda: self._gate.look_again(self._places()), self._gate.tools.look_again):
            with contextlib.suppress(RefusedError):  # counted, and in the status
                self._guard.counted(look)
        self._want()

    def offer_model(self, model: OfferedModel) -> None:
        """Take over an accepted model of this robot; refused models change nothing."""
        self._guard.counted(lambda: self._gate.take_model(model, self._places()))
        self._want()

    def offer_tool(self, tool: OfferedTool) -> None:
        """Judge a measured tool; refused ones change nothing.

        It is taken over when the robot stands (see `look`) or with the next trajectory, and at
        once while nothing was commanded yet.
        """
        self._guard.counted(lambda: self._gate.take_tool(tool))
        if not self._starts.started:
            self._adopt_tool()

    def look(self, now_s: float, now_ns: int) -> None:
        """To be called now and then: a tool waits for a robot that stands, a model grows old.

        ``now_ns`` is the clock that stamps the models; what it does moves no blend.
        """
        if self._gate.watch_age(now_ns):
            self._want()
        if self._gate.tools.waiting is not None and self._stands(now_s):
            self._adopt_tool()

    def _stands(self, now_s: float) -> bool:
        """Whether nothing is commanded, and the robot has not moved for its response time."""
        near = self._config.start_near(self._reference)
        busy = self._commands.streams(now_s) or self._starts.under_way(now_s)
        return not busy and self._joints.at_rest(now_s, near)

    def _adopt_tool(self) -> None:
        self._gate.tools.adopt()
        self._want()

    def _places(self) -> Array:
        """Taught joints (k, n) where the robot is, and where it was sent."""
        places = np.stack([self._joints.taught, self._commands.goal])
        return np.asarray(places[np.isfinite(places).all(axis=1)])

    def _want(self) -> None:
        self._commands.settled = None
        self._corrector.want(self._gate.actual, self._enabled)

    # ---- commands -------------------------------------------------------------------------------

    def target(self, command: JointCommand, now_s: float) -> JointCommand:
        """Correct one message of a stream of joint targets.

        The blend advances with ``now_s``, at most by the configured longest step.
        """
        return self._guard.counted(lambda: self._commands.target(command, now_s))

    @property
    def course(self) -> Course | None:
        """The trajectory that was put out last, to tell what becomes of it; None after others."""
        return self._commands.courses.current

    def plain_targets(self, wire: JointWire) -> PlainTargets:
        """A shorter way for the settled messages of a topic; each is to be offered there first."""
        return PlainTargets(self._commands, *self._plain, wire)

    def plain_readings(self, wire: JointWire) -> PlainReadings:
        """As `plain_targets`, for readings."""
        return PlainReadings(self._readings, *self._plain, wire)

    def trajectory(
        self,
        command: TrajectoryCommand,
        now_s: float,
        starts_in_s: float = 0.0,
        *,
        may_be_rejected: bool = False,
    ) -> TrajectoryCommand:
        """Correct a whole trajectory; the blend advances along its time from start.

        ``starts_in_s``: when it begins, counted from now (its header's stamp); negative for one
        that is under way, 0 for one that begins as it is forwarded: see `Course.begin`. With
        ``may_be_rejected`` the `course` says what became of it. A trajectory without points is a
        stop: it passes as it came.
        """
        if len(command) == 0:
            self._commands.stop(now_s)
            return command
        return self._guard.counted(
            lambda: self._with_waiting_tool(
                lambda: self._commands.trajectory(command, now_s, starts_in_s, may_be_rejected)
            )
        )

    def _with_waiting_tool(self, act: Callable[[], Answer]) -> Answer:
        """Begin something with the tool that waits, if there is one; a refusal lets it wait on."""
        tools = self._gate.tools
        before, waiting = tools.in_use, tools.waiting
        if waiting is None:
            return act()
        self._adopt_tool()
        try:
            return act()
        except RefusedError:
            tools.in_use, tools.waiting = before, waiting
            self._want()
            raise

    # ---- readings -------------------------------------------------------------------------------

    def reading(self, state: JointCommand, now_s: float, age_s: float = 0.0) -> JointCommand:
        """Un-correct joint readings with the model that is being commanded at ``now_s``.

        ``age_s``: how old they were on arrival, by their stamp.
        Joints of others pass as they are.
        """
        return self._guard.counted(lambda: self._readings.take(state, now_s, age_s))

    def taught(
        self, names: tuple[str, ...], position: Array, velocity: Array | None, now_s: float
    ) -> tuple[Array, Array | None]:
        """Un-correct joints (k,) of any joint state as `reading` does, and remember nothing.

        Joints that are left out are where they were read last.

        Raises
        ------
        RefusedError
            When a value is not finite, a joint is named twice, or numbers differ.
        """
        return self._readings.taught(names, position, velocity, now_s)

    def offset(self, now_s: float) -> Offset:
        """What is added to the taught joints now.

        While targets stream: to the last of them; else where the robot was read last.
        """
        streams = self._commands.streams(now_s)
        tool = self._gate.tools.in_use if self._enabled else None
        return Offset(
            names=self._reference.joint_names,
            offset=self._commands.offset.copy() if streams else self._readings.offset(now_s),
            revision=self._gate.revision if self._enabled and not self._gate.stale else None,
            tool_revision=None if tool is None else tool.revision,
            s=self._corrector.progress(now_s),
        )

    def counted(self, act: Callable[[], Answer]) -> Answer:
        """Do something for this session; a refusal is counted with its own."""
        return self._guard.counted(act)

    def refuse(self, reason: Reason, detail: str) -> NoReturn:
        """Count a refusal with the session's own, and raise it."""
        raise self._guard.count(RefusedError(reason, detail))

    def status(self) -> CorrectionStatus:
        """What the session does."""
        corrector, guard, tools = self._corrector, self._guard, self._gate.tools
        return CorrectionStatus(
            enabled=self._enabled,
            active=not corrector.idle,
            settled=corrector.settled,
            revision=self._gate.revision,
            serial=self._gate.serial,
            survey=self._gate.survey,
            waiting_revision=None if self._gate.waiting is None else self._gate.waiting.revision,
            new_tool=tools.T_flange_tool is not None,
            tool_revision=None if tools.in_use is None else tools.in_use.revision,
            waiting_tool=None if tools.waiting is None else tools.waiting.revision,
            stale=self._gate.stale,
            tcp_shift_m=float(corrector.figures[0]),
            largest_shift=float(corrector.figures[1]),
            remaining_m=float(corrector.figures[2]),
            held=corrector.held,
            waits=corrector.waits,
            mismatch=self._starts.mismatch,
            reduced=corrector.reduced,
            clamped=dict(corrector.clamped),
            passed=dict(corrector.passed),
            policy=self._config.policy,
            reference=f"{self._reference.name} {self._reference.model_hash}",
            shadow=self._config.shadow,
            refused=dict(guard.refused),
            last_refusal=guard.last_refusal,
        )
