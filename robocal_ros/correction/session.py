# SPDX-License-Identifier: Apache-2.0
"""Session of the joint correction: taught joints in, corrected ones out, and back. No clock.

It is off until enabled. Whatever changes (enabling, a model, a tool, a posture, a refusal), the
offset of what goes out moves within the limits of `limiter`, and what goes out within the joints'
speeds. What it cannot or must not correct is refused with a reason and counted: `RefusedError`.
A refusal ends a stream that runs: the robot is slowed down (`tail`).
"""

import contextlib
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import NoReturn, TypeVar

import numpy as np

from robocal_ros.correction.bounds import CorrectionConfig, CorrectionGate
from robocal_ros.correction.interface import (
    CorrectionStatus,
    JointCommand,
    OfferedModel,
    OfferedTool,
    Offset,
    Reason,
    RefusedError,
    TrajectoryCommand,
)
from robocal_ros.correction.limiter import (
    FAST_ONE,
    FRAME,
    GIVEN,
    LARGEST,
    MOST,
    REDUCED,
    REMAINING,
    SHIFT,
    STAMP,
    UNCHANGED_ONE,
    UNUSUAL,
    WORST,
    WORST_OUT,
    follow_serialized,
)
from robocal_ros.correction.robot_state import EVERY, Joints, Output
from robocal_ros.correction.sent_path import WITHHELD, SentPath
from robocal_ros.correction.serialized_target import STAMPS, SerializedTarget
from robocal_ros.correction.streams import StreamPhase, TargetStream
from robocal_ros.correction.trajectories import SETTLED, TrajectoryCorrector, require_times
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import CORRECTED, TAUGHT
from robocal_ros.ground.serialized import (
    FIELDS,
    SECOND_NS,
    gather_rows,
    point_places,
    scatter_rows,
)
from robocal_ros.history.history_records import Past
from robocal_ros.kinematics import SerialArm
from robocal_ros.motion.robot_watch import Lateness

Answer = TypeVar("Answer")

# A message this much older than the last one comes from a clock that was set back.
CLOCK_RESET_NS = 1_000_000_000
TARGET: tuple[str, tuple[str, ...]] = "target", ()  # their order is one for all sources
MOST_SOURCES = 64  # of so many drivers the order in time is watched one by one
AHEAD_S = 0.02  # a source's clock may run ahead by so much from one message to the next
# What is dropped without ending a stream, as it is not the stream's: unless nothing came for so
# many periods, and it is in the place of the next message.
INSTEAD = 0.75
# What less of the offset is withheld between the points of a path, rad (prismatic: m), is below
# what a robot repeats: 10 um at 1 m.
COME_IN = 1e-5
DROPPED = {Reason.TIME_BACKWARDS, Reason.OWN_OUTPUT}


class CorrectionSession:
    """Corrects joint targets and trajectories, and un-corrects joint readings.

    ``now_s`` is a steady clock of the caller, the same one in all calls.

    ``nominal``: model that offered models must have been made for.
    ``reference``: model and tool (``T_flange_tool``) that the program was taught with: the nominal
    one for a program made off line, the calibrated cold one for a taught program.
    ``serial``: the robot's.

    The caller asks the ``stream`` of targets for what goes out without a message, and the ``robot``
    where it is.
    """

    def __init__(
        self,
        nominal: SerialArm,
        reference: SerialArm,
        serial: str,
        config: CorrectionConfig | None = None,
    ) -> None:
        config = config or CorrectionConfig()
        n = reference.n
        speed, acceleration = (
            np.broadcast_to(limits, (n,)).astype(np.float64)
            for limits in (config.velocity_limits, config.acceleration_limits)
        )
        config = replace(config, velocity_limits=speed, acceleration_limits=acceleration)
        self._reference, self._config = reference, config
        self._gate = CorrectionGate(nominal, reference, serial, config)
        self.output = output = Output(reference, config)
        self.robot, self._desired = output.robot, output.desired
        self.stream, self._paths = TargetStream(output), TrajectoryCorrector(output)
        self._enabled, self._robot_fault = False, ""
        self._taught = np.full(n, np.nan)  # readings, un-corrected
        self._goal = np.full(n, np.nan)  # taught joints that were commanded last since `resume`
        self._moved = False  # whether any were before it
        self._looked_s = -np.inf  # steady clock of the last `look`
        # of a serialized target that is not noted yet: its stamp, ns, and when it came
        self._unsettled: tuple[int, float] | None = None
        self._held: dict[Reason, str] = {}
        self._interrupts: SentPath | None = None  # the last path that took a stream's place
        # of each kind and source: the last stamp, ns, and when it came; then, where one has gone
        # ahead of it since, the last that did
        self._stamps: dict[tuple[str, tuple[str, ...]], tuple[tuple[int, float], ...]] = {}
        self._lateness: dict[tuple[str, ...], Lateness] = {}
        self.late_s = 0.0  # of the last readings, see `Lateness`
        self._refused: Counter[Reason] = Counter()
        self._last_refusal = ""
        self._overtaken = 0

    def enable(self, on: bool) -> None:
        """Correct from now on, or no more: the offset changes with the next commands.

        Raises `RefusedError` when a robot without speed limits, or another one than is described
        on the graph, is to be corrected.
        """
        if on and self._robot_fault and not self._config.shadow:
            self.refuse(Reason.OTHER_ROBOT, self._robot_fault)
        unlimited = np.flatnonzero(~np.isfinite(self._config.velocity_limits))
        without = [self._reference.joint_names[i] for i in unlimited]
        if on and without and not self._config.shadow:
            self.refuse(
                Reason.NO_SPEED_LIMITS,
                f"{', '.join(without)}: give them in the robot file or in velocity_limits",
            )
        self._enabled = on
        self._want()

    def doubt_robot(self, fault: str) -> None:
        """Correct no more while the robot is another one than its file says; empty: it is that."""
        self._robot_fault = fault
        if fault and not self._config.shadow:
            self.enable(False)

    def acknowledge(self, now_s: float) -> None:
        """End a START_MISMATCH: the next command may begin where the robot stands.

        What moves the robot goes on, and the next command must begin on it.
        """
        path, stands = self.output.path, self.robot.stands(np.arange(self._reference.n), now_s)
        driven = path is not None and path.live(now_s)
        if self.stream.runs(now_s) or (driven and not (stands and self.robot.scaling == 1.0)):
            self.output.mismatch = ""
        elif self.output.mismatch:
            self.output.acknowledge(now_s)
            self.stream.phase = StreamPhase.IDLE
        self._stamps.clear()

    def take_over(self) -> None:
        """Look again at a model or a tool that was refused for its revision or its size."""
        places = self._places(fresh=True)
        for look in (lambda: self._gate.look_again(places), self._gate.tools.look_again):
            with contextlib.suppress(RefusedError):  # counted, and in the status
                self.counted(look)
        self._want()

    def hold(self, reason: Reason, detail: str, now_s: float) -> None:
        """While this lasts no command is taken; a stream that runs is ended in order."""
        self._held[reason] = detail
        self.stream.end(RefusedError(reason, detail), now_s)

    def release(self, reason: Reason) -> None:
        """It is over."""
        self._held.pop(reason, None)

    def offer_model(self, model: OfferedModel) -> None:
        """Take over an accepted model of this robot; refused models change nothing.

        How old it is, and the robot's readings are, is told by the clocks of the last `look`.
        """
        self.counted(lambda: self._gate.take_model(model, self._places(fresh=True)))
        self._want()

    def offer_tool(self, tool: OfferedTool) -> None:
        """Judge a measured tool; refused ones change nothing.

        It is taken over when the robot stands (see `look`) or with the next trajectory, and at
        once while nothing was commanded yet.
        """
        self.counted(lambda: self._gate.take_tool(tool))
        if not (self._moved or np.isfinite(self._goal).any()):
            self._adopt_tool()

    def know_past(self, model: Past, tool: Past) -> None:
        """Tell what was in force before this session: no old message of it comes into use."""
        self._gate.know_past(model, tool)

    def resume(self, now_s: float, now_ns: int) -> None:
        """As `look`, after a time in which nothing was heard.

        Others may have moved the robot: where it was sent before says nothing of it any more.
        """
        self._moved |= bool(np.isfinite(self._goal).any())
        self._goal[:] = np.nan
        self.look(now_s, now_ns)

    def look(self, now_s: float, now_ns: int) -> None:
        """To be called now and then: a tool waits for a robot that stands, a model grows old.

        ``now_ns`` is the clock that stamps the models.
        """
        self._looked_s = now_s
        if self._gate.watch_age(now_ns):
            self._want()
        everything = np.arange(self._reference.n)
        waits = self._gate.tools.waiting is not None
        if waits and not self.moves(now_s) and self.robot.stands(everything, now_s):
            self._adopt_tool()

    def moves(self, now_s: float) -> bool:
        """Whether the robot may still be moving by what was put out."""
        path = self.output.path
        return self.stream.runs(now_s) or (path is not None and path.live(now_s))

    def _adopt_tool(self) -> None:
        tools = self._gate.tools
        tools.in_use, tools.waiting = tools.waiting or tools.in_use, None
        self._want()

    def _places(self, *, fresh: bool = False) -> Array:
        """Taught joints (k, n) where the robot was read last, and where it was sent.

        ``fresh``: readings that are old by now tell nothing.
        """
        old = fresh and self.robot.blind(self._looked_s)
        places = np.stack([self._goal] if old else [self._taught, self._goal])
        return np.asarray(places[np.isfinite(places).all(axis=1)])

    def _want(self) -> None:
        self._desired.want(self._gate.actual, self._enabled)

    def target(self, command: JointCommand, now_s: float) -> JointCommand:
        """Correct one message of a stream of joint targets; itself where nothing is added.

        A `RefusedError` ends a stream that runs: its `tail` slows the robot down.
        """
        stream = self.stream
        try:
            self._require_order(TARGET[0], command, TARGET[1], now_s)
            for reason, detail in self._held.items():
                raise RefusedError(reason, detail)
            index = self.robot.index(command.names)
            self.robot.require_target(command, index)
            q = self.robot.complete(index, command.position, self._taught, now_s)
            if self._config.shadow:
                self._shadow(q[None])
                corrected = command
            else:
                corrected = stream.take(command, index, q, now_s)
        except RefusedError as error:
            if error.reason not in DROPPED or stream.is_due(now_s, INSTEAD):
                stream.end(error, now_s)
            raise self._count(error) from None
        self._goal[:] = q
        return corrected

    def serialized_target(self, came: bytes, now_s: float) -> bytes | None:
        """As `target`, for a serialized message of a stream that runs as usual; None: it is none.

        What is returned goes out first; then it is noted by `settle`, before anything else.
        """
        stream, like = self.stream, self.stream.like
        if like is None or len(came) != like.size or self._held or self._config.shadow:
            return None
        sec, nanosec = STAMPS.unpack_from(came, STAMP)
        stamp, known = sec * SECOND_NS + nanosec, self._stamps.get(TARGET)
        if stamp and not (known and _goes_on(stamp, now_s, *known[0])):
            return None
        became = stream.follow(came, now_s)
        if became == UNUSUAL:
            return None
        if became == FAST_ONE:
            if stamp:
                self._stamps[TARGET] = ((stamp, now_s),)
            try:
                stream.velocity_out()
            except RefusedError as error:
                stream.end(error, now_s)
                raise self._count(error) from None
        self._unsettled = stamp, now_s
        return came if became == UNCHANGED_ONE else like.out.tobytes()

    def settle(self) -> None:
        """Note the last serialized target."""
        if self._unsettled is not None and self.stream.like is not None:
            stamp, now_s = self._unsettled
            self._unsettled = None
            if stamp:
                self._stamps[TARGET] = ((stamp, now_s),)
            self._goal[:] = self.stream.like.room[GIVEN]
            self.stream.settle()

    def trajectory(
        self,
        command: TrajectoryCommand,
        now_s: float,
        starts_in_s: float = 0.0,
        *,
        may_be_rejected: bool = False,
    ) -> TrajectoryCommand:
        """Correct a whole trajectory; the offset changes along its time from start.

        ``starts_in_s``: when it begins, counted from now (its header's stamp); negative for one
        that is under way, 0 for one that begins as it is forwarded: see `SentPath.begin`. With
        ``may_be_rejected`` the output's path is told what became of it.
        """
        waiting = self._gate.tools.waiting, self._gate.tools.in_use
        try:
            self._require_order("trajectory", replace(command, stamp_ns=0), (), now_s)
            for reason, detail in self._held.items():
                raise RefusedError(reason, detail)
            require_times(command)
            index = self.robot.index(command.names)
            self.robot.require_positions(command.names, index, command.position)
            q = self.robot.complete(index, command.position, self._taught, now_s)
            if waiting[0] is not None:
                self._adopt_tool()
            if self._config.shadow:
                self._shadow(q)
                return command
            if self.output.mismatch:
                raise RefusedError(Reason.START_MISMATCH, self.output.mismatch)
            self.stream.come_to_rest(now_s)
            corrected, path = self._paths.correct(command, index, q, now_s, starts_in_s)
        except RefusedError as error:
            if self._gate.tools.waiting is not waiting[0]:
                self._gate.tools.waiting, self._gate.tools.in_use = waiting
                self._want()
            raise self._count(error) from None
        path.replaced = self.output.path if may_be_rejected else None
        path.scale(self.robot.scaling, now_s)
        self.output.path = path
        self._interrupts = path
        self.stream.interrupt()
        self._goal[:] = q[-1]
        withheld, memory = path.known[WITHHELD], self.output.limiter.memory
        size = np.abs(withheld)
        np.maximum(memory[MOST], size.max(axis=0), out=memory[MOST])
        worst = int(np.argmax(size.sum(axis=1)))
        if size[worst].sum() > np.abs(memory[WORST]).sum():  # a row before the points leads there
            memory[WORST] = withheld[worst]
            memory[WORST_OUT] = q[max(worst - (len(withheld) - len(q)), 0)]
        return corrected

    def reject(self, path: SentPath) -> None:
        """The controller did not take a trajectory: what it took the place of goes on there."""
        self.output.reject(path)
        if path is self._interrupts and self.output.path is None:
            self.stream.go_on()

    def stop(self, now_s: float, ahead_s: float) -> TrajectoryCommand | None:
        """A trajectory that stops what was put out last, as a controller takes it; None: it stands.

        Its first point lies ``ahead_s`` ahead. A stream ends by its `tail`.
        """
        self.stream.end(RefusedError(Reason.STOPPED, "a stop was asked for"), now_s)
        stopped = self._paths.stop(now_s, ahead_s)
        if stopped is None:
            return None
        command, path = stopped
        path.scale(self.robot.scaling, now_s)
        self.output.path = path
        return command

    def _shadow(self, q: Array) -> None:
        with contextlib.suppress(RefusedError):  # counted, and in the status
            self.counted(lambda: self._desired.at(q))
            self._desired.count()
        self.output.stage = self._desired.stage

    def reading(self, state: JointCommand, now_s: float, age_s: float = 0.0) -> JointCommand:
        """Un-correct joint readings with what is being put out at ``now_s``.

        ``age_s``: how old they were on arrival, by their stamp. Joints of others pass as they are;
        velocities of which one is not finite are none.
        """
        try:
            self._require_order("reading", state, state.names, now_s)
            index, column = self.robot.find(state)
            late_s = self._late_by(state, now_s, age_s)
            robot, velocity = self.robot, state.velocity
            if velocity is not None:
                velocity = velocity[column] if len(velocity) == len(state.names) else None
            robot.read(index, state.position[column], now_s, age_s, velocity, late_s)
            self.output.note_place(now_s)
            q, position, velocity = self._uncorrected(state, robot.measured, index, column, now_s)
        except RefusedError as error:
            raise self._count(error) from None
        self._taught[:] = q
        return JointCommand(state.names, position, velocity, state.stamp_ns, TAUGHT)

    def _late_by(self, state: JointCommand, now_s: float, age_s: float) -> float:
        """How late readings come; many drivers share one measure."""
        of = self._lateness.get(state.names)
        if of is None:
            names = state.names if len(self._lateness) < MOST_SOURCES else ()
            of = self._lateness.setdefault(names, Lateness("joint states"))
        self.late_s = of.take(state.stamp_ns * 1e-9, now_s, age_s)
        return self.late_s

    def late(self, now_s: float) -> str:
        """That readings come late, in words; empty where they do not."""
        found = (each.words(now_s) for each in self._lateness.values())
        return next(filter(None, found), "")

    def taught(
        self, names: tuple[str, ...], position: Array, velocity: Array | None, now_s: float
    ) -> tuple[Array, Array | None]:
        """Un-correct joints (k,) of any joint state as `reading` does, and remember nothing.

        Joints that are left out are where they were read last. Raises `RefusedError` when a
        position is not finite, a joint is named twice, or numbers differ.
        """
        state = JointCommand(names, position, velocity)
        index, column = self.robot.find(state)
        measured = self.robot.measured.copy()
        measured[index] = position[column]
        return self._uncorrected(state, measured, index, column, now_s)[1:]

    def _uncorrected(
        self, state: JointCommand, measured: Array, index: Joints, column: Joints, now_s: float
    ) -> tuple[Array, Array, Array | None]:
        """All taught joints (n,) of ``measured`` ones, and the state's positions and velocities."""
        velocity = state.velocity
        if velocity is not None and not (
            len(velocity) == len(state.names) and math.isfinite(sum(velocity.tolist()))
        ):
            velocity = None  # a driver that has none says NaN, or gives fewer
        if self._config.shadow:
            return measured, state.position, velocity
        stage, withheld = self.output.correction(now_s)
        taught = self.output.uncorrected(measured, (stage, withheld))
        position = state.position.copy()
        position[column] = taught[index]
        if (
            velocity is not None
            and stage is not None
            and (column is EVERY or len(position[column]))
        ):
            speed, velocity = np.zeros(self._reference.n), velocity.copy()
            speed[index] = velocity[column]
            velocity[column] = stage.taught_velocity_one(measured, speed, taught)[index]
        return taught, position, velocity

    def controller(
        self,
        names: tuple[str, ...],
        position: Array,
        scaling: float | None,
        now_s: float,
        velocity: Array | None = None,
        age_s: float = 0.0,
    ) -> None:
        """Where the controller says that it was ``age_s`` ago, and its speed scaling.

        ``position`` (k,) rad (prismatic: m), with the ``velocity`` (k,) as planned, where it tells
        one. What is not finite, or of another's joint, is left out; so is a scaling of None.
        """
        arm = self._reference.joint_names
        known = [i for i, name in enumerate(names) if name in arm and i < len(position)]
        known = [i for i in known if np.isfinite(position[i])]
        index = self.robot.index(tuple(names[i] for i in known)) if known else np.zeros(0, int)
        rate = None
        if velocity is not None and len(velocity) == len(position):
            rate = velocity[known] if np.isfinite(velocity[known]).all() else None
        before = self.robot.scaling
        self.robot.controller(index, position[known], rate, scaling, now_s - max(age_s, 0.0))
        path = self.output.path if self.robot.scaling != before else None
        while path is not None:  # the one that it may go on with, too
            path.scale(self.robot.scaling, now_s)
            path = path.replaced

    def offset(self, now_s: float) -> Offset:
        """What is added to the taught joints now, and what of it the limiter withholds."""
        output, measured = self.output, self.robot.measured
        withheld = np.zeros(self._reference.n)
        if self._config.shadow:
            stage = self._desired.stage
            places = self._places()
            offset = np.zeros_like(withheld)
            if stage is not None and len(places):
                offset = stage.correct(places[-1:]).q[0] - places[-1]
        elif self.stream.runs(now_s) and output.path is None:
            offset, withheld = output.out - output.taught, output.limiter.withheld
            offset = np.where(np.isfinite(offset), offset, 0.0)
        else:
            stage, withheld = output.correction(now_s)
            offset = measured - output.uncorrected(measured, (stage, withheld))
        tool = self._gate.tools.in_use if self._enabled else None
        return Offset(
            offset=offset,
            withheld=withheld,
            revision=self._gate.revision if self._enabled and not self._gate.stale else None,
            tool_revision=None if tool is None else tool.used_revision,
        )

    def counted(self, act: Callable[[], Answer]) -> Answer:
        """Do something for this session; a refusal is counted with its own."""
        try:
            return act()
        except RefusedError as error:
            raise self._count(error) from None

    def refuse(self, reason: Reason, detail: str) -> NoReturn:
        """Count a refusal with the session's own, and raise it."""
        raise self._count(RefusedError(reason, detail))

    def _count(self, refusal: RefusedError) -> RefusedError:
        if refusal.reason is Reason.TIME_BACKWARDS:
            self._overtaken += 1
        self._refused[refusal.reason] += 1
        self._last_refusal = str(refusal)
        return refusal

    def _require_order(
        self,
        kind: str,
        came: JointCommand | TrajectoryCommand,
        names: tuple[str, ...],
        now_s: float,
    ) -> None:
        """Refuse what carries a mark of a correction, or was overtaken by a newer one.

        Readings have one order in time for each driver, by its joints. A stamp that went ahead by
        more than the time that passed does not bar those after it, unless the next goes on from it.
        """
        mark, stamp = came.mark, came.stamp_ns
        if mark and (mark == CORRECTED or (mark == TAUGHT and kind == "reading")):
            raise RefusedError(Reason.OWN_OUTPUT, f"{kind} with frame_id '{came.mark}'")
        if not stamp:
            return
        key, stamps = (kind, _driver(names) if names else names), self._stamps
        known = stamps.get(key)
        if known is None:
            key = key if len(stamps) < MOST_SOURCES else (kind, ())
            known = stamps.get(key, ((stamp, now_s),))
        last = known[0][0]
        if stamp < last and last - stamp <= CLOCK_RESET_NS:
            detail = f"{kind} is {(last - stamp) * 1e-9:.6f} s older than the one before"
            raise RefusedError(Reason.TIME_BACKWARDS, detail)
        is_next = stamp < last or any(_goes_on(stamp, now_s, *one) for one in known)
        stamps[key] = ((stamp, now_s),) if is_next else (known[0], (stamp, now_s))

    def status(self, now_s: float | None = None) -> CorrectionStatus:
        """What the session does; ``now_s``: while a trajectory is under way, at which instant."""
        desired, tools, output = self._desired, self._gate.tools, self.output
        memory, places = output.limiter.memory, self._places()
        at_s = np.inf if now_s is None else now_s
        stage, withheld = output.correction(at_s)
        come_in = SETTLED if output.path is None else COME_IN
        settled = stage is desired.stage and bool(np.all(np.abs(withheld) <= come_in))
        if output.path is None and stage is None and not withheld.any():  # nothing was put out
            settled = settled or not np.isfinite(output.out).any()
        return CorrectionStatus(
            enabled=self._enabled,
            active=desired.stage is not None or stage is not None or not settled,
            settled=settled,
            revision=self._gate.revision,
            serial=self._gate.serial,
            survey=self._gate.survey,
            waiting_revision=None if self._gate.waiting is None else self._gate.waiting.revision,
            new_tool=tools.T_flange_tool is not None,
            tool_revision=None if tools.in_use is None else tools.in_use.used_revision,
            waiting_tool=None if tools.waiting is None else tools.waiting.revision,
            stale=self._gate.stale,
            payload=self._gate.payload,
            tcp_shift_m=float(desired.figures[SHIFT]),
            largest_shift=float(desired.figures[LARGEST]),
            remaining_m=float(desired.figures[REMAINING]),
            withheld=withheld,
            withheld_most=memory[MOST].copy(),
            withheld_m=self._at_tool(withheld, places[:1]),
            withheld_most_m=self._at_tool(memory[WORST], memory[[WORST_OUT]]),
            lag_s=self.stream.lag_s,
            overtaken=self._overtaken,
            mismatch=output.mismatch,
            held=dict(self._held),
            reduced=int(desired.figures[REDUCED]),
            clamped=dict(desired.clamped),
            passed=dict(desired.passed),
            policy=self._config.policy,
            reference=f"{self._reference.name} {self._reference.model_hash}",
            shadow=self._config.shadow,
            refused=dict(self._refused),
            last_refusal=self._last_refusal,
        )

    def _at_tool(self, withheld: Array, place: Array) -> float:
        """How far the tool is moved by small offsets (n,) at a place (1 or 0, n), m."""
        if not len(place) or not withheld.any():
            return 0.0
        moved = self._reference.fk(np.vstack([place, place + withheld]))
        tips = (moved @ self._reference.T_flange_tool)[:, :3, 3]
        return float(np.linalg.norm(tips[1] - tips[0]))


def _goes_on(stamp: int, now_s: float, last: int, came_s: float) -> bool:
    """Whether a stamp is ahead of one that came before by no more than the time that passed."""
    return last <= stamp <= last + (now_s - came_s + AHEAD_S) * 1e9


@lru_cache(MOST_SOURCES)
def _driver(names: tuple[str, ...]) -> tuple[str, ...]:
    """Who publishes readings, by their joints."""
    return tuple(sorted(names))


def load_kernels(arm: SerialArm) -> None:
    """Call the compiled code once, so that the first command need not wait for it."""
    config, n = CorrectionConfig(), arm.n
    q, zeros, ones = np.zeros((2, n)), np.zeros(n), np.ones(n)
    arm.fk(q)
    output = Output(arm, config)
    desired = output.desired
    given = zeros, zeros, 0.004, 0.004, ones, np.ones((2, n))
    desired.put_out(*given)
    desired.want(arm.with_mdh(arm.mdh + 1e-6), on=True)
    desired.put_out(*given)
    stage = desired.stage
    assert stage is not None
    stage.rates(q, q, q, stage.correct(q))
    stage.taught_velocity_one(zeros, zeros, stage.uncorrect_one(zeros))
    output.limiter.follow(q, np.arange(2.0), np.zeros(2), ones)
    target = JointCommand(arm.joint_names, zeros)
    output.robot.require_target(target, np.arange(n))
    message = bytes(FRAME + 8 * n)
    like = SerializedTarget(target, message, (), (FRAME, 0), message, (FRAME, 0))
    stream = TargetStream(output)
    assert desired.whole_step is not None
    follow_serialized(0.004, *like.given, *stream.step, *desired.whole_step)
    doubles, places = np.zeros(8), np.zeros((1, FIELDS, 2), dtype=np.int64)
    point_places(doubles.view(np.uint32), 0, doubles.nbytes, places, np.zeros(1))
    gather_rows(doubles, places[:, 0], np.empty((1, 1)))
    scatter_rows(np.empty((1, 1)), places[:, 0], doubles)
