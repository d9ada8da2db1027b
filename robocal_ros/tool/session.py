# SPDX-License-Identifier: Apache-2.0
"""From a complete run to its answer: a tool in the history, or the answer of a quick check."""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.ground.errors import Code, ConflictError, InputError, RobocalError
from robocal_ros.ground.frames import Array, Document
from robocal_ros.ground.samples import JOINTS, JointSample, joint_sample
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import (
    HEALTHY_TOOL,
    LASER_FRAME,
    MANDREL,
    THERMAL,
    TOOL,
    Proposal,
)
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_errors import JointErrors, with_joint_errors
from robocal_ros.session import events
from robocal_ros.session.events import (
    OWN,
    Command,
    Handler,
    Outcome,
    SessionBase,
    configured_with,
    recorded_arguments,
    seeded,
)
from robocal_ros.tool.crossed_model import Held, ToolEstimate
from robocal_ros.tool.edges import (
    EDGES,
    MOST_EDGES,
    PARALLEL,
    BeamError,
    EdgeLog,
    EdgeSample,
    StrayEdges,
    edge_sample,
)
from robocal_ros.tool.files import check_document, run_document
from robocal_ros.tool.in_force import ToolInForce
from robocal_ros.tool.judging import (
    SMALL_M,
    Answer,
    KnownTool,
    QuickCheck,
    StationFinding,
    Witness,
    change_between,
    changed_tool,
    difference,
    judge_healthy,
    judge_tool,
    quick_check,
    sideways_check,
    spread_between,
    station_finding,
    tip_errors,
    with_mandrel,
    witness_of,
)
from robocal_ros.tool.run import MeasuringPlan, Mode, PlannedStep, ToolConfig, ToolRun, made_with
from robocal_ros.tool.station import (
    measure_station,
    measurement_document,
    result_document,
    station_shift,
    station_verdict,
)
from robocal_ros.tool.touch_points import HandMeasured, SweepLog, TouchLog

FULL, QUICK, REFERENCE = "full", "quick", "reference"
WITNESS, WITNESS_REFERENCE, LASER = OF_MANDREL = "witness", "witness reference", "laser"
MODES = (FULL, QUICK, REFERENCE, *OF_MANDREL)
WITNESS_NS = 600 * 10**9  # so long a mandrel's answer holds for measurements of the tool after it
TOGETHER_NS = 3600 * 10**9  # so long after a tool a mandrel is first measured with the same station
REMEMBERED = 200  # answers, and calibrations back to which a cycle's id is known
YOUNG = (
    "the mandrel cannot tell, as it was first measured over an hour after the tool that this is "
    "counted from: look at tool and station, then accept it, or measure the healthy tool anew "
    "(mode REFERENCE)"
)
CODE_OF: dict[Answer, Code] = {
    "pass": Code.ACCEPT,
    "recalibrate": Code.LIMIT_EXCEEDED,
    "cannot tell": Code.TOO_FEW_SAMPLES,
}


class ToolResults:
    """Ends runs and remembers what came of them.

    ``current``: what is in force, followed by the session.
    ``software``: version that made the tools.
    """

    def __init__(self, config: ToolConfig, software: str, current: ToolInForce) -> None:
        self._config, self._software, self._current = config, software, current
        self._history = current.history
        self._answers: OrderedDict[tuple[str, str], Outcome] = OrderedDict()
        self._changed: KnownTool | None = None  # last one whose change is not proven the tool's
        # What the mandrel said last: its stamp, ns, and what was seen changed before it.
        self._station: tuple[int, StationFinding, KnownTool | None] | None = None

    def taught(self, mode: str) -> Array:
        """What a mode measures (4, 4), as it was taught: the tool, or the mandrel.

        Raises `ConflictError` when there is no mandrel, or nobody knows how it measures.
        """
        if mode not in OF_MANDREL:
            return self._config.T_flange_taught
        if self._config.mandrel is None:
            raise ConflictError("there is no mandrel: say where it sits on the flange ('mandrel')")
        if mode == WITNESS and self._current.measured_mandrel is None:
            raise ConflictError(
                "how the mandrel measures is not known: measure it in mode WITNESS_REFERENCE "
                "while the beam station stands right"
            )
        return np.array(self._config.mandrel)

    def of_cycle(self, mode: str, cycle_id: str) -> Outcome | None:
        """The answer of a cycle that has ended, None for a new one."""
        if not cycle_id:
            return None
        if (mode, cycle_id) in self._answers:
            return self._answers[mode, cycle_id]
        kinds = {FULL: TOOL, REFERENCE: HEALTHY_TOOL, WITNESS_REFERENCE: MANDREL}
        kind = (kinds | {LASER: LASER_FRAME}).get(mode)
        for entry in self._history.list(REMEMBERED):
            if entry.kind == kind and entry.cycle_id == cycle_id:
                document = self._history.document(entry.id)
                return Outcome(Command(""), entry.code, entry.reason, document, entry.id)
        return None

    def finish(self, run: ToolRun, command: Command, wall_ns: int) -> Outcome:
        """Solve a complete run."""
        ends = {
            FULL: self._full,
            QUICK: self._quick,
            REFERENCE: self._reference,
            WITNESS: self._witness,
            WITNESS_REFERENCE: self._reference,
            LASER: self._laser,
        }
        return self._remembered(run, ends[run.mode](run, command, wall_ns))

    def _remembered(self, run: ToolRun, outcome: Outcome) -> Outcome:
        if run.cycle_id:
            self._answers[run.mode, run.cycle_id] = outcome
            if len(self._answers) > REMEMBERED:
                self._answers.popitem(last=False)
        return outcome

    def _full(self, run: ToolRun, command: Command, wall_ns: int) -> Outcome:
        estimate = run.estimate(Held())
        run.require_like_healthy(estimate)
        found, in_force = KnownTool.measured(estimate), self._in_force()
        taught, healthy = self._config.T_flange_taught, self._current.measured_healthy
        absolute = healthy is None
        if healthy is not None:
            found = changed_tool(taught, healthy, found)
        stands = self._current.tool if self._current.model else in_force
        anchor = self._current.anchor
        since = anchor + in_force.T_flange_tool[:3, 3] - stands.T_flange_tool[:3, 3]
        shift = run.path.at(run.last_edge_s)[0][0, :3, :3] @ difference(found, in_force)[:3]
        witness = witness_of(found, in_force, self._config.bend, since)
        if turned := run.turned(estimate):
            witness = replace(witness, cause="station", reason=turned)
        young = self._mandrel_is_young()
        witness = self._with_mandrel(witness, found, shift, young, command)
        verdict = judge_tool(found, estimate, taught, stands, self._config.limits, witness)
        erring = self._joint_errors(run, estimate, found)
        if erring is not None:
            verdict = with_joint_errors(verdict, erring, "tip")
        document = run_document(found, estimate, run.circles, verdict) | {
            "joint_errors": None if erring is None else erring.document(),
            "change": change_between(stands.T_flange_tool, found.T_flange_tool).document(),
            "absolute": absolute,
            "witness": witness.document(),
        }
        known: Document = {"cause": witness.cause, "mandrel_young": young}
        if witness.cause == "tool" and witness.tip_m <= SMALL_M:  # many of them do not add up
            known["anchor"] = anchor.tolist()
        model = found.document() | known
        kept = self._keep(TOOL, run, command, wall_ns, verdict, document, model)
        return Outcome(command, verdict.code, verdict.reason, document, kept)

    def _joint_errors(
        self, run: ToolRun, estimate: ToolEstimate, found: KnownTool
    ) -> JointErrors | None:
        """What joints that err add to the tip that was found; None where that is not told."""
        size_rad, healthy = self._config.joint_error_rad, self._current.measured_healthy
        if size_rad == 0.0 or found.covariance is None:
            return None
        before = None
        if healthy is not None:
            if (q := self._current.healthy_joints) is None:
                return None
            before = q, healthy.T_flange_tool[:3, 3]
        now = run.last_q, estimate.tip
        return tip_errors(run.arm, size_rad, now, before, found.covariance[:3, :3])

    def _reference(self, run: ToolRun, command: Command, wall_ns: int) -> Outcome:
        """Keep how healthy tool or mandrel measure; in force at once: it moves nothing."""
        run.require_even_readings()
        estimate = run.estimate(Held())
        found = KnownTool.measured(estimate)
        self._station = self._changed = None  # what was said of them before holds no more
        taught, mandrel = self.taught(run.mode), run.mode == WITNESS_REFERENCE
        kind = MANDREL if mandrel else HEALTHY_TOOL
        name = "mandrel" if mandrel else "taught tool"
        verdict = judge_healthy(found, estimate, taught, self._config.limits, name)
        if not mandrel and self._current.model is not None:
            verdict = replace(verdict, reason=f"{verdict.reason}; {self._other_in_force()}")
        document: Document = {**run_document(found, estimate, run.circles, verdict)}
        document["change"] = change_between(taught, found.T_flange_tool).document()
        own: Document = {
            "traits": run.traits(estimate).document(),
            "joints": run.last_q.tolist(),
        }
        if mandrel:
            own = {"mandrel": taught.tolist()}
        kept = self._keep(kind, run, command, wall_ns, verdict, document, found.document() | own)
        if verdict.accept:
            self._accept(kept, command, verdict, wall_ns)
        return Outcome(command, verdict.code, verdict.reason, document, kept)

    def _other_in_force(self) -> str:
        taught, tool = self._config.T_flange_taught, self._current.tool
        away_mm = 1e3 * change_between(taught, tool.T_flange_tool).tip_m
        return (
            f"calibration {self._current.head.calibration_id}, {away_mm:.3f} mm from the taught "
            "tool, is in force still: roll it back, or measure in mode FULL"
        )

    def _accept(self, kept: int, command: Command, verdict: Verdict, wall_ns: int) -> None:
        """Bring into force what moves nothing."""
        by, reason = str(command.arguments.get("by", "")), verdict.reason
        self._history.accept(kept, by=by, reason=reason, expected_head=None, wall_ns=wall_ns)

    def by_hand(self, tool: HandMeasured, command: Command, wall_ns: int) -> Outcome:
        """Propose a tool that was found by touches or sweeps."""
        verdict, document, model = tool.verdict, tool.document, tool.found.document()
        kept = self._keep(
            TOOL, tool, command, wall_ns, verdict, document, model, method=tool.method
        )
        outcome = Outcome(command, verdict.code, verdict.reason, document, kept)
        return replace(outcome, samples=tool.samples)

    def _laser(self, run: ToolRun, command: Command, wall_ns: int) -> Outcome:
        """Where the mandrel finds the beams, against the first time."""
        config, mandrel = self._config, run.plan.T_flange_tool
        found = measure_station(
            run.plan.laser, run.path, run.steps, mandrel, config.mandrel_radius_m, config.noise
        )
        first = self._current.commissioned_station
        shift = station_shift(first or found, found)
        limit_m, trend = config.check.limit_m, self._current.station_trend
        verdict = station_verdict(
            found, None if first is None else shift, limit_m, config.limits.sigma_m
        )
        if verdict.accept:  # a knock is no drift
            trend = trend.after(command.stamp_ns or 0, shift)
        if told := trend.words(limit_m):
            verdict = replace(verdict, reason=f"{verdict.reason}; {told}")
        document = result_document(found, shift, trend, verdict, commissioned=first is not None)
        document["cycle_id"] = run.cycle_id
        measured, before = measurement_document(found), measurement_document(first or found)
        model = measured | {
            "mandrel": mandrel.tolist(),
            "mandrel_radius_m": config.mandrel_radius_m,
            "first": before,
            "trend": trend.model(),
        }
        kept = self._keep(LASER_FRAME, run, command, wall_ns, verdict, document, model)
        if verdict.accept:
            self._accept(kept, command, verdict, wall_ns)
        return Outcome(command, verdict.code, verdict.reason, document, kept)

    def _witness(self, run: ToolRun, command: Command, wall_ns: int) -> Outcome:
        """What the mandrel says of the beam station; for the tool's measurements to come."""
        estimate, reference = run.estimate(Held()), self._current.measured_mandrel
        if reference is None:
            raise ConflictError("how the mandrel measures was forgotten in the run: repeat it")
        found = KnownTool.measured(estimate)
        both = [c for c in (found.own_covariance, reference.own_covariance) if c is not None]
        R = run.path.at(run.last_edge_s)[0][0, :3, :3]
        station = station_finding(found, reference, np.sum(both, axis=0), R)
        self._station = (command.stamp_ns or 0), station, self._changed
        verdict = station.verdict
        return Outcome(command, verdict.code, verdict.reason, station.document())

    def _with_mandrel(
        self, witness: Witness, found: KnownTool, shift: Array, young: bool, command: Command
    ) -> Witness:
        """Ask the mandrel, while its answer is fresh: whose is the change?

        It was measured after this change where what was seen then is within `SMALL_M` of what is
        found now: more cannot have come since. One that is ``young``, first measured later than the
        tool that the change is counted from, says nothing of the time between.
        """
        if self._station is not None:
            stamp_ns, station, changed = self._station
            if 0 <= (command.stamp_ns or 0) - stamp_ns <= WITNESS_NS:
                after = not young and (
                    changed is not None
                    and change_between(changed.T_flange_tool, found.T_flange_tool).tip_m <= SMALL_M
                )
                witness = with_mandrel(witness, station, shift, after=after)
        if witness.cause == "tool":
            return witness
        self._changed = found
        if witness.cause == "doubt" and self._current.measured_mandrel is not None:
            what = YOUNG if young else "measure the mandrel (mode WITNESS), then repeat"
            return replace(witness, reason=f"{witness.reason}; {what}")
        return witness

    def _mandrel_is_young(self) -> bool:
        """Whether the station may have moved between tool and first mandrel's run.

        The change is between two tools, both against the healthy one: the station counts from the
        later of the two.
        """
        current = self._current
        tools = (current.head, current.model), (current.healthy, current.measured_healthy)
        tool_ns = max((current.stamp_ns(head) for head, used in tools if used), default=0)
        return 0 < tool_ns < current.stamp_ns(current.mandrel) - TOGETHER_NS

    def early(self, run: ToolRun, command: Command) -> Outcome | None:
        """The answer of a quick check whose circle says enough; None: go on."""
        if run.mode != QUICK:
            return None
        check = self._checked(sideways_check, run)
        if check.answer != "recalibrate":
            return None
        return self._remembered(run, self._answer(check, command))

    def _quick(self, run: ToolRun, command: Command, wall_ns: int) -> Outcome:
        return self._answer(self._checked(quick_check, run), command)

    def _checked(self, check: Callable[..., QuickCheck], run: ToolRun) -> QuickCheck:
        found = check(
            run.plan.laser,
            run.path,
            run.steps,
            replace(self.expected(), T_flange_tool=run.plan.T_flange_tool),
            self._config.check,
            noise=run.config.noise,
        )
        run.require_like_healthy(found.measured)
        return found

    def _answer(self, check: QuickCheck, command: Command) -> Outcome:
        verdict = Verdict(CODE_OF[check.answer], f"{check.answer}: {check.reason}")
        document = check_document(check, verdict)
        return Outcome(command, verdict.code, verdict.reason, document)

    def expected(self) -> KnownTool:
        """How the tool in force measures: with the healthy tool's own deviation, where known."""
        tool, healthy = self._in_force(), self._current.measured_healthy
        if healthy is None:
            return tool
        taught = KnownTool(self._config.T_flange_taught)
        measures = changed_tool(healthy.T_flange_tool, taught, tool).T_flange_tool
        if tool.against is not None and np.array_equal(tool.against, healthy.T_flange_tool):
            return replace(tool, T_flange_tool=measures)
        return KnownTool(measures, spread_between(tool, healthy))  # of two healthy runs: whole

    def _in_force(self) -> KnownTool:
        """The tool in force, as a change against the healthy tool's run where that is known.

        The taught one is none; of one that beams measured before the healthy tool, what is common
        to both runs goes. What other beams err by is not.
        """
        healthy, tool = self._current.measured_healthy, self._current.tool
        if healthy is None:
            return tool
        if self._current.model is None:
            return KnownTool.taught(self._config.T_flange_taught, healthy)
        if tool.against is None and tool.own_covariance is not None:
            change = changed_tool(self._config.T_flange_taught, healthy, tool)
            return change if self._current.by_these_beams else replace(change, against=None)
        return tool

    def _keep(
        self,
        kind: str,
        run: ToolRun | HandMeasured,
        command: Command,
        wall_ns: int,
        verdict: Verdict,
        document: Document,
        model: Document,
        method: str = "crossed beams",
    ) -> int:
        return self._history.propose(
            Proposal(
                kind=kind,
                model_hash=self._current.nominal.model_hash,
                based_on=self._history.head(kind).revision,
                cycle_id=run.cycle_id,
                stamp_ns=command.stamp_ns or 0,
                created_ns=wall_ns,
                software=self._software,
                method=method,
                code=verdict.code,
                reason=verdict.reason,
                document=document,
                model=model
                | {
                    "thermal_revision": run.thermal_revision,
                    "made_with": made_with(self._config),
                    "stamp_ns": command.stamp_ns or 0,
                },
                inputs=run.inputs,
            )
        )


class ToolSession(SessionBase):
    """Measures the tool of one arm at one station of two crossed beams.

    A command ``measure_tool`` begins a run; each step that `recognised` sees the end of becomes a
    command of its own, so that a recording holds which samples it was made of.

    ``current``: tool, thermal model and healthy tool in force.
    ``run``: the run that is open; None while there is none.
    """

    def __init__(
        self, nominal: SerialArm, history: CalibrationHistory, config: ToolConfig, software: str
    ) -> None:
        self.config = config
        self.current = ToolInForce(history, nominal, config)
        super().__init__(self.current)
        self._results = ToolResults(config, software, self.current)
        self._edges = EdgeLog()
        self._touches, self._sweeps = TouchLog(config), SweepLog(config)
        self._runs = 0
        self._strays = StrayEdges()
        self._over: Command | None = None
        self.run: ToolRun | None = None

    @property
    def awaited(self) -> PlannedStep | None:
        """The step to be driven now; None while nothing is awaited."""
        return None if self.run is None else self.run.awaited

    def add(self, sample: JointSample | EdgeSample) -> None:
        """Take a sample. Raises `InputError` when it cannot be used; the message says why."""
        if isinstance(sample, JointSample):
            self._add_joints(sample)
        else:
            self._add_edge(sample)

    def _add_joints(self, sample: JointSample) -> None:
        jumped, run, newest = self._take_joints(sample), self.run, self.newest_joints_ns
        if jumped:
            self._edges.clear()
            self._sweeps.jumped()
            self._end_early("the clock jumped back", Code.CLOCK_WRONG)
            return
        self._sweeps.come(self.newest_ns, newest)
        for sample_come in self._edges.come(self.newest_ns, newest):
            if run is not None:
                run.watch_edge(sample_come)
        if run is not None and self._over is None and newest > run.from_ns:
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
        waiting = self._edges.ahead or self._sweeps.awaits_joints
        return bool(waiting) or (self.run is not None and self._over is None)

    def _end_early(self, reason: str, code: Code = Code.BEAM_EDGES_WRONG) -> None:
        if self.run is not None:
            arguments = {"code": int(code), "reason": reason}
            self._over = Command(events.BREAK_OFF, arguments, self.newest_joints_ns)

    def _add_edge(self, sample: EdgeSample) -> None:
        if sample.beam in PARALLEL:
            self._sweeps.add_edge(sample, self.newest_ns, self.newest_joints_ns)
            self.received[EDGES] += 1
            return
        if self.config.station and sample.station != self.config.station:
            words = (
                f"edge of station '{sample.station}', the laser frame is of "
                f"'{self.config.station}': connect the right station, or calibrate its beams"
            )
            self._end_early(words)
            raise InputError(words)
        joints_ns = self.newest_joints_ns
        if self.run is not None and joints_ns and (why := self._strays.doubt(sample, joints_ns)):
            self._end_early(why, Code.CLOCK_WRONG)
        self._edges.add(sample, self.newest_ns, self.newest_joints_ns)
        self.received[EDGES] += 1
        if self.run is not None:
            self.run.watch_edge(sample)

    def recognised(self) -> Command | None:
        """The command that follows from the samples: a step is over, or the run is broken off."""
        found, self._over = self._over, None
        return found

    def answered(self, mode: str, cycle_id: str) -> bool:
        """Whether a cycle has ended: its answer is given again, and nothing is driven."""
        return self._results.of_cycle(mode, cycle_id) is not None

    def _handlers(self) -> Mapping[str, Handler]:
        now = self.current
        return {
            events.MEASURE_TOOL: self._measure,
            events.STEP_BEGINS: self._step_begins,
            events.TOOL_STEP: self._take_step,
            events.BREAK_OFF: self._break_off,
            events.TOUCH: lambda command, _: self._touches.add(command, self.stream),
            events.SOLVE_TOUCHES: partial(self._solve, self._touches),
            events.CLEAR_TOUCHES: lambda command, _: self._touches.clear(command),
            events.SWEEP: lambda command, _: self._sweeps.add(command, self.stream, now.arm),
            events.SOLVE_SWEEPS: partial(self._solve, self._sweeps),
            events.CLEAR_SWEEPS: lambda command, _: self._sweeps.clear(command),
        }

    def _solve(self, log: TouchLog | SweepLog, command: Command, wall_ns: int) -> Outcome:
        now = self.current
        tool = log.solve(now.arm, now.tool, now.thermal.revision)
        outcome = self._results.by_hand(tool, command, wall_ns)
        # more touches may mend it; more of a wrong tool, or more sweeps, do not
        if log is self._touches and outcome.status is Code.RESIDUAL_TOO_LARGE:
            words = f"{outcome.message}; the {tool.samples} touches stay: add others, or clear them"
            return replace(outcome, message=words)
        log.clear(command)
        return outcome

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
        config, current = self.config, self.current
        quick = mode == QUICK
        tool = self._results.expected().T_flange_tool if quick else self._results.taught(mode)
        steps: Mode = "quick" if quick else "laser" if mode == LASER else "full"
        plan = MeasuringPlan(steps, config.laser, tool, config.motion, config.spin_rad)
        self._runs += 1
        begun_ns = command.stamp_ns or 0
        arm, revision = current.arm, current.thermal.revision
        healthy = current.healthy_traits if mode in (FULL, QUICK) else None
        self.run = ToolRun(
            self._runs, mode, cycle_id, plan, config, arm, revision, begun_ns, begun_ns, healthy
        )
        self._edges.forget_marked(command.marks or {})
        self._over, self._strays = None, StrayEdges()
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


IN_FORCE = {"model": THERMAL, "tool": TOOL, "healthy": HEALTHY_TOOL}


def configuration(session: ToolSession, topics: Mapping[str, str]) -> Command:
    """Settings and what is in force, so that a replay can start from the same.

    ``topics``: name of each input's topic.
    """
    current = session.current
    in_force = {
        "model": current.thermal.model,
        "tool": current.stamped(current.head),
        OWN["tool"]: current.stamped(current.healthy),
        "mandrel": current.stamped(current.mandrel),
        "station": current.station.model,
    }
    return configured_with(session, topics, session.config.document(), in_force)


def tool_session_as_recorded(
    nominal: SerialArm, history: CalibrationHistory, configured: Command, software: str
) -> ToolSession:
    """Make a session with the recorded settings; an empty history gets what was in force."""
    arguments = recorded_arguments(nominal, configured, tuple(IN_FORCE))
    config = ToolConfig.of_document(arguments["config"])
    in_force = {kind: arguments[name] for name, kind in IN_FORCE.items()}
    for kind, name in ((MANDREL, "mandrel"), (LASER_FRAME, "station")):
        in_force[kind] = configured.arguments.get(name)  # older recordings have none
    seeded(history, nominal, in_force, software)
    return ToolSession(nominal, history, config, software)


def take_tool_message(session: ToolSession, kind: str, message: Any) -> None:
    """Give a message to the session; one that cannot be used is counted with its reason."""
    try:
        if kind == JOINTS:
            session.add(joint_sample(message))
        elif kind == EDGES:
            session.add(edge_sample(message, session.config.beam_names))
    except RobocalError as error:
        session.refuse(kind, error)
