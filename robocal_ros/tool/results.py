"""From a complete run to its answer: a tool in the history, or the answer of a quick check."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.ground.errors import Code, ConflictError
from robocal_ros.ground.proposals import HEALTHY_TOOL, MANDREL, THERMAL, TOOL, Head, Proposal
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.session.base import HistoryFollower
from robocal_ros.session.events import Command, History, Outcome
from robocal_ros.tool.crossed_model import Held
from robocal_ros.tool.crossed_run import RunTraits
from robocal_ros.tool.judging import (
    KnownTool,
    StationFinding,
    change_between,
    changed_tool,
    difference,
    judge_healthy,
    judge_tool,
    spread_between,
    station_finding,
    with_mandrel,
    witness_of,
)
from robocal_ros.tool.quick_check import (
    Answer,
    QuickCheck,
    change_document,
    check_document,
    quick_check,
    run_document,
    sideways_check,
)
from robocal_ros.tool.run import ToolConfig, ToolRun, made_with
from robocal_ros.tool.witness import SMALL_M, Witness

# ---- the tool in force and the thermal model that its flange poses come from --------------------


Array = NDArray[np.float64]


class ToolInForce(HistoryFollower):
    """What the history has in force for a tool, as of the last look.

    Attributes
    ----------
    head, thermal, healthy, mandrel : heads of the tools, of the thermal models and of the
        measurements of the healthy tool and of the mandrel.
    """

    def __init__(self, history: History, nominal: SerialArm, config: ToolConfig) -> None:
        self._nominal = nominal
        self._mandrel = None if config.mandrel is None else [list(row) for row in config.mandrel]
        self._taught, self._made_with = KnownTool(config.T_flange_taught), made_with(config)
        super().__init__(history, TOOL)

    def _read(self) -> None:
        super()._read()
        self.thermal: Head = self._history.head(THERMAL)
        self.healthy: Head = self._history.head(HEALTHY_TOOL)
        self.mandrel: Head = self._history.head(MANDREL)

    @property
    def arm(self) -> SerialArm:
        """The arm with the thermal model in force."""
        model = self.thermal.model
        return self._nominal if model is None else arm_of(model, self._nominal)

    @property
    def tool(self) -> KnownTool:
        """The tool in force; without one the taught one."""
        model = self.head.model
        return self._taught if model is None else KnownTool.of_document(model)

    @property
    def anchor(self) -> Array:
        """Tip (3,) of the last tool whose cause was known: in force, or before small changes."""
        known = (self.head.model or {}).get("anchor")
        return self.tool.T_flange_tool[:3, 3] if known is None else np.array(known)

    @property
    def measured_healthy(self) -> KnownTool | None:
        """How the healthy tool was measured; None without, or with another tool or station."""
        model = self._healthy_model
        return None if model is None else KnownTool.of_document(model)

    @property
    def healthy_traits(self) -> RunTraits | None:
        """What its run showed beside the tool; None where that is not known."""
        model = self._healthy_model
        traits = None if model is None else model.get("traits")
        return None if traits is None else RunTraits.of_document(traits)

    @property
    def measured_mandrel(self) -> KnownTool | None:
        """How the mandrel was measured; None without, or with another one or another station."""
        model = self.mandrel.model
        if model is None or model["made_with"] != self._made_with:
            return None
        return KnownTool.of_document(model) if model["mandrel"] == self._mandrel else None

    @property
    def _healthy_model(self) -> dict[str, Any] | None:
        model = self.healthy.model
        return None if model is None or model["made_with"] != self._made_with else model


# ---- results ------------------------------------------------------------------------------------


Document = dict[str, Any]

FULL, QUICK, REFERENCE = "full", "quick", "reference"
WITNESS, WITNESS_REFERENCE = "witness", "witness reference"  # of the mandrel
MODES = (FULL, QUICK, REFERENCE, WITNESS, WITNESS_REFERENCE)
WITNESS_NS = 600 * 10**9  # so long a mandrel's answer holds for measurements of the tool after it
REMEMBERED = 200  # answers, and calibrations back to which a cycle's id is known
CODE_OF: dict[Answer, Code] = {
    "pass": Code.ACCEPT,
    "recalibrate": Code.LIMIT_EXCEEDED,
    "cannot tell": Code.TOO_FEW_SAMPLES,
}


class ToolResults:
    """Ends runs and remembers what came of them.

    Parameters
    ----------
    current : what is in force, followed by the session.
    software : version that made the tools.
    """

    def __init__(
        self,
        nominal: SerialArm,
        history: History,
        config: ToolConfig,
        software: str,
        current: ToolInForce,
    ) -> None:
        self._nominal, self._history, self._config = nominal, history, config
        self._software, self._current = software, current
        self._answers: OrderedDict[tuple[str, str], Outcome] = OrderedDict()
        self._changed: KnownTool | None = None  # last one whose change is not proven the tool's
        # What the mandrel said last: its stamp, ns, and what was seen changed before it.
        self._station: tuple[int, StationFinding, KnownTool | None] | None = None

    def taught(self, mode: str) -> Array:
        """What a mode measures (4, 4), as it was taught: the tool, or the mandrel.

        Raises
        ------
        ConflictError
            When there is no mandrel, or nobody knows how it measures.
        """
        if mode not in (WITNESS, WITNESS_REFERENCE):
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
        kind = {FULL: TOOL, REFERENCE: HEALTHY_TOOL, WITNESS_REFERENCE: MANDREL}.get(mode)
        for entry in self._history.list(REMEMBERED):
            if entry.kind == kind and entry.cycle_id == cycle_id:
                document = self._history.document(entry.id)
                return Outcome(Command(""), entry.code, entry.reason, document, entry.id)
        return None

    def finish(self, run: ToolRun, command: Command, wall_ns: int) -> Outcome:
        """Solve a complete run.

        Raises
        ------
        RobocalError
            When no tool explains it, or the result cannot be kept.
        """
        ends = {
            FULL: self._full,
            QUICK: self._quick,
            REFERENCE: self._reference,
            WITNESS: self._witness,
            WITNESS_REFERENCE: self._reference,
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
        anchor = self._current.anchor
        shift = run.path.at(run.last_edge_s)[0][0, :3, :3] @ difference(found, in_force)[:3]
        witness = witness_of(found, in_force, self._config.bend, anchor)
        witness = self._with_mandrel(witness, found, shift, command)
        verdict = judge_tool(found, estimate, taught, in_force, self._config.limits, witness)
        document = run_document(found, estimate, run.circles, verdict) | {
            "change": change_document(change_between(in_force.T_flange_tool, found.T_flange_tool)),
            "absolute": absolute,
            "witness": witness.document(),
        }
        known: Document = {"cause": witness.cause}
        if witness.cause == "tool" and witness.tip_m <= SMALL_M:  # many of them do not add up
            known["anchor"] = anchor.tolist()
        kept = self._keep(TOOL, run, command, wall_ns, verdict, document, found, **known)
        return Outcome(command, verdict.code, verdict.reason, document, kept)

    def _reference(self, run: ToolRun, command: Command, wall_ns: int) -> Outcome:
        """Keep how healthy tool or mandrel measure; in force at once: it moves nothing."""
        run.require_even_readings()
        estimate = run.estimate(Held())
        found = KnownTool.measured(estimate)
        self._station = self._changed = None  # what was said of them before holds no more
        taught, mandrel = self.taught(run.mode), run.mode == WITNESS_REFERENCE
        kind = MANDREL if mandrel else HEALTHY_TOOL
        verdict = judge_healthy(found, estimate, taught)
        document = run_document(found, estimate, run.circles, verdict)
        document["change"] = change_document(change_between(taught, found.T_flange_tool))
        own: Document = {"traits": run.traits(estimate).document()}
        if mandrel:
            own = {"mandrel": taught.tolist()}
        kept = self._keep(kind, run, command, wall_ns, verdict, document, found, **own)
        if verdict.accept:
            by = str(command.arguments.get("by", ""))
            self._history.accept(
                kept, by=by, reason=verdict.reason, expected_head=None, wall_ns=wall_ns
            )
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
        self, witness: Witness, found: KnownTool, shift: Array, command: Command
    ) -> Witness:
        """Ask the mandrel, while its answer is fresh: whose is the change?

        It was measured after this change where what was seen then is within `SMALL_M` of what is
        found now: more cannot have come since.
        """
        if self._station is not None:
            stamp_ns, station, changed = self._station
            if 0 <= (command.stamp_ns or 0) - stamp_ns <= WITNESS_NS:
                after = changed is not None and (
                    change_between(changed.T_flange_tool, found.T_flange_tool).tip_m <= SMALL_M
                )
                witness = with_mandrel(witness, station, shift, after=after)
        if witness.cause == "tool":
            return witness
        self._changed = found
        if witness.cause == "doubt" and self._current.measured_mandrel is not None:
            reason = f"{witness.reason}; measure the mandrel (mode WITNESS), then repeat"
            return replace(witness, reason=reason)
        return witness

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
        """The tool in force, the taught one as no change against the healthy tool's run."""
        healthy = self._current.measured_healthy
        if healthy is None or self._current.head.model is not None:
            return self._current.tool
        return KnownTool.taught(self._config.T_flange_taught, healthy)

    def _keep(
        self,
        kind: str,
        run: ToolRun,
        command: Command,
        wall_ns: int,
        verdict: Verdict,
        document: Document,
        found: KnownTool,
        **beside: Any,
    ) -> int:
        return self._history.propose(
            Proposal(
                kind=kind,
                model_hash=self._nominal.model_hash,
                based_on=self._history.head(kind).revision,
                cycle_id=run.cycle_id,
                stamp_ns=command.stamp_ns or 0,
                created_ns=wall_ns,
                software=self._software,
                method="crossed beams",
                code=verdict.code,
                reason=verdict.reason,
                document=document,
                model=found.document()
                | {"thermal_revision": run.thermal_revision, "made_with": made_with(self._config)}
                | beside,
                inputs=run.arrays(),
            )
        )
