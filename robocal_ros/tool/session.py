"""The tool session: edges, joint readings and commands in, measured tools out. No clock, no ROS."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from robocal_ros.ground.errors import Code, ConflictError, InputError, RobocalError
from robocal_ros.ground.proposals import HEALTHY_TOOL, MANDREL, THERMAL, TOOL
from robocal_ros.ground.samples import JOINTS, JointSample, joint_sample
from robocal_ros.kinematics import SerialArm
from robocal_ros.session import events
from robocal_ros.session.base import Handler, SessionBase, configured_with, recorded_arguments
from robocal_ros.session.events import Command, History, Outcome, seeded
from robocal_ros.tool.edges import (
    AHEAD_NS,
    EDGES,
    MOST_EDGES,
    BeamError,
    EdgeLog,
    EdgeSample,
    edge_sample,
)
from robocal_ros.tool.measuring_plan import MeasuringPlan, Mode, PlannedStep
from robocal_ros.tool.results import FULL, MODES, QUICK, ToolInForce, ToolResults
from robocal_ros.tool.run import ToolConfig, ToolRun

AHEAD_S = AHEAD_NS * 1e-9
BEHIND_S = 0.15  # a gateway brings an edge sooner; smaller offsets the edges themselves show
STRAYS = 2


class ToolSession(SessionBase):
    """Measures the tool of one arm at one station of two crossed beams.

    A command ``measure_tool`` begins a run; each step that `recognised` sees the end of becomes a
    command of its own, so that a recording holds which samples it was made of.

    Attributes
    ----------
    run : the run that is open; None while there is none.
    """

    def __init__(
        self, nominal: SerialArm, history: History, config: ToolConfig, software: str
    ) -> None:
        self.config = config
        self._current = ToolInForce(history, nominal, config)
        super().__init__(nominal, history, TOOL, self._current)
        self._results = ToolResults(nominal, history, config, software, self._current)
        self._laser = config.laser
        self._edges = EdgeLog()
        self._runs = 0
        self._strays = 0  # edges of the run that came with a stamp far from the joints'
        self._over: Command | None = None
        self.run: ToolRun | None = None

    # ---- what is in force -----------------------------------------------------------------------

    @property
    def current(self) -> ToolInForce:
        """Tool, thermal model and healthy tool in force."""
        return self._current

    @property
    def awaited(self) -> PlannedStep | None:
        """The step to be driven now; None while nothing is awaited."""
        return None if self.run is None else self.run.awaited

    # ---- samples --------------------------------------------------------------------------------

    def add(self, sample: JointSample | EdgeSample) -> None:
        """Take a sample.

        Raises
        ------
        InputError
            When it cannot be used; the message says why.
        """
        if isinstance(sample, JointSample):
            self._add_joints(sample)
        else:
            self._add_edge(sample)

    def _add_joints(self, sample: JointSample) -> None:
        jumped, run, newest = self._take_joints(sample), self.run, self.newest_joints_ns
        if jumped:
            self._edges.clear()
            self._end_early("the clock jumped back", Code.CLOCK_WRONG)
        elif run is not None and self._over is None and newest > run.from_ns:
            _, q = self.stream.window(newest, newest)
            waited_s, limit_s = run.waited_s(newest), self.config.step_timeout_s
            if run.step_over(newest, q[0]):
                step = run.awaited
                arguments = {"run": run.number, "number": step.number, "step": step.name}
                self._over = Command(events.TOOL_STEP, arguments, newest)
            elif waited_s > limit_s:
                why = (
                    f"not over {limit_s:g} s after its first edge: rest after each step"
                    if run.edges
                    else f"no edge within {limit_s:g} s: the robot did not move through the beams, "
                    "or both are dead"
                )
                self._end_early(f"{run.awaited.name}: {why}")

    def _watches_joints(self) -> bool:
        return self.run is not None and self._over is None

    def _end_early(self, reason: str, code: Code = Code.BEAM_EDGES_WRONG) -> None:
        if self.run is not None:
            arguments = {"code": int(code), "reason": reason}
            self._over = Command(events.BREAK_OFF, arguments, self.newest_joints_ns)

    def _add_edge(self, sample: EdgeSample) -> None:
        if self.config.station and sample.station != self.config.station:
            words = (
                f"edge of station '{sample.station}', the laser frame is of "
                f"'{self.config.station}': connect the right station, or calibrate its beams"
            )
            self._end_early(words)
            raise InputError(words)
        if self.run is not None and self.newest_joints_ns:
            self._watch_clocks((sample.stamp_ns - self.newest_joints_ns) * 1e-9)
        self._edges.add(sample, self.newest_ns, self.newest_joints_ns)
        self.received[EDGES] += 1
        if self.run is not None:
            self.run.watch_edge(sample)

    def _watch_clocks(self, ahead_s: float) -> None:
        """One edge that is stamped far from the joints may be a mistake, a second one is none."""
        self._strays += not -BEHIND_S <= ahead_s <= AHEAD_S
        if self._strays == STRAYS:
            where = "ahead of" if ahead_s > 0.0 else "behind"
            self._end_early(
                f"edges come stamped {abs(ahead_s):.2f} s {where} the joint states: a clock has "
                "jumped, or one of them comes late; stamp both on one clock",
                Code.CLOCK_WRONG,
            )

    # ---- commands -------------------------------------------------------------------------------

    def recognised(self) -> Command | None:
        """The command that follows from the samples: a step is over, or the run is broken off."""
        found, self._over = self._over, None
        return found

    def answered(self, mode: str, cycle_id: str) -> bool:
        """Whether a cycle has ended: its answer is given again, and nothing is driven."""
        return self._results.of_cycle(mode, cycle_id) is not None

    def _handlers(self) -> Mapping[str, Handler]:
        return {
            events.MEASURE_TOOL: self._measure,
            events.STEP_BEGINS: self._step_begins,
            events.TOOL_STEP: self._take_step,
            events.BREAK_OFF: self._break_off,
        }

    def _measure(self, command: Command, wall_ns: int) -> Outcome:
        mode, cycle_id = str(command.arguments["mode"]), str(command.arguments.get("cycle_id", ""))
        if mode not in MODES:
            raise InputError(f"mode '{mode}' is none of {', '.join(MODES)}")
        if (before := self._results.of_cycle(mode, cycle_id)) is not None:
            return replace(before, command=command, repeated=True)
        if self.run is not None:
            raise ConflictError(
                f"run {self.run.number} is open: let it end, or cancel it, before the next one"
            )
        if not self.newest_joints_ns:
            raise ConflictError(f"no joint states yet: does the robot's driver publish {JOINTS}?")
        config, current = self.config, self._current
        quick = mode == QUICK
        tool = self._results.expected().T_flange_tool if quick else self._results.taught(mode)
        steps: Mode = "quick" if quick else "full"
        plan = MeasuringPlan(steps, self._laser, tool, config.motion, config.spin_rad)
        self._runs += 1
        begun_ns = command.stamp_ns or 0
        arm, revision = current.arm, current.thermal.revision
        healthy = current.healthy_traits if mode in (FULL, QUICK) else None
        self.run = ToolRun(
            self._runs, mode, cycle_id, plan, config, arm, revision, begun_ns, begun_ns, healthy
        )
        self._edges.clear()
        self._over, self._strays = None, 0
        words = f"run {self._runs} ({mode}): {', '.join(plan.names)}"
        return Outcome(command, Code.ACCEPT, words)

    def _step_begins(self, command: Command, wall_ns: int) -> Outcome:
        """What was seen on the way to the step does not belong to it."""
        run = self._require_run()
        run.begin_step((command.marks or {}).get(JOINTS, 0))
        return Outcome(command, Code.ACCEPT, f"{run.awaited.name} begins")

    def _take_step(self, command: Command, wall_ns: int) -> Outcome:
        run = self._require_run()
        marks = command.marks or {}
        edges = self._edges.take(run.from_ns, marks)
        stamps, q = self.stream.window(run.from_ns + 1, marks.get(JOINTS, 0))
        step, count = run.awaited, len(edges)
        try:
            if count >= MOST_EDGES:
                raise BeamError(f"{step.name}: {count} edges: a beam flickers; check its alignment")
            run.take(edges, stamps, q)
            early = None if run.complete else self._results.early(run, command)
            if not run.complete and early is None:
                run.begin_step(marks.get(JOINTS, 0))
                words = f"{step.name} ({step.number} of {step.of}) is measured: {count} edges"
                return Outcome(command, Code.ACCEPT, words, samples=count)
            outcome = early or self._results.finish(run, command, wall_ns)
        except (RobocalError, np.linalg.LinAlgError) as error:
            self.run = None
            code = error.code if isinstance(error, RobocalError) else Code.RESIDUAL_TOO_LARGE
            return Outcome(command, code, str(error), samples=count)
        self.run = None
        return replace(outcome, samples=count)

    def _break_off(self, command: Command, wall_ns: int) -> Outcome:
        run = self._require_run()
        self.run = None
        code = Code(int(command.arguments.get("code", Code.CONFLICT)))
        reason = str(command.arguments.get("reason", "cancelled"))
        return Outcome(command, code, f"run {run.number}: {reason}")

    def _require_run(self) -> ToolRun:
        if self.run is None:
            raise ConflictError("no measurement is open: begin one first")
        return self.run


# ---- recorded -----------------------------------------------------------------------------------


IN_FORCE = {"model": THERMAL, "tool": TOOL, "healthy": HEALTHY_TOOL}
OWN = "healthy"  # only a tool session's configuration has it


def configuration(session: ToolSession, topics: Mapping[str, str]) -> Command:
    """Settings and what is in force, so that a replay can start from the same.

    ``topics``: name of each input's topic.
    """
    current = session.current
    in_force = {
        "model": current.thermal.model,
        "tool": current.head.model,
        OWN: current.healthy.model,
        "mandrel": current.mandrel.model,
    }
    return configured_with(session, topics, session.config.document(), in_force)


def is_tool_session(configured: Command | None) -> bool:
    """Whether a configuration was recorded by a tool session."""
    return configured is not None and OWN in configured.arguments


def tool_session_as_recorded(
    nominal: SerialArm, history: History, configured: Command, software: str
) -> ToolSession:
    """Make a session with the recorded settings; an empty history gets what was in force.

    Raises
    ------
    WrongRobotError
        The recording was made with another nominal model.
    InputError
        The configuration cannot be read.
    """
    arguments = recorded_arguments(nominal, configured, tuple(IN_FORCE))
    config = ToolConfig.of_document(arguments["config"])
    in_force = {kind: arguments[name] for name, kind in IN_FORCE.items()}
    in_force[MANDREL] = configured.arguments.get("mandrel")  # older recordings have none
    seeded(history, nominal, in_force, software)
    return ToolSession(nominal, history, config, software)


# ---- messages into the tool session: the same for live topics and for recorded ones -------------


def take_tool_message(session: ToolSession, kind: str, message: Any) -> None:
    """Give a message to the session; one that cannot be used is counted with its reason."""
    try:
        if kind == JOINTS:
            session.add(joint_sample(message))
        elif kind == EDGES:
            session.add(edge_sample(message, session.config.beams))
    except RobocalError as error:
        session.refuse(kind, error)
