"""The thermal session: samples and commands in, judged proposals out. No clock, no ROS."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.assessment import Verdict, summarise
from robocal_ros.core.codes import Code
from robocal_ros.core.documents import (
    arm_of,
    identification_document,
    identified_model_document,
    reference_document,
)
from robocal_ros.core.errors import InputError, RobocalError, TooFewSamplesError
from robocal_ros.core.identification import JudgedIdentification, Method, identify_and_hold_out
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.proposals import THERMAL, Head, Proposal
from robocal_ros.core.samples import JointSample, Measurements, PointSample, PoseSample
from robocal_ros.core.thermal.identification import (
    ColdReference,
    capture_reference,
    identify_drift,
)
from robocal_ros.sessions import events
from robocal_ros.sessions.decisions import decide
from robocal_ros.sessions.events import Command, Outcome
from robocal_ros.sessions.history import History
from robocal_ros.sessions.in_force import REFERENCE, InForce, outside_decision
from robocal_ros.sessions.observations import (
    JOINTS,
    JUMPS,
    Observation,
    ObservationDesk,
    as_measurements,
)
from robocal_ros.sessions.thermal_config import METHODS, ThermalConfig, expected_drift

__all__ = ["ThermalConfig", "ThermalSession"]

SAME_CLOCK_NS = 1_000_000_000


class ThermalSession:
    """Identifies the model of one arm from measurements at standstill.

    Without a cold reference, ``identify`` calibrates base, targets and model from all poses and
    judges on held-out ones; with one, it identifies the drift since then.

    Attributes
    ----------
    prior : (k, k) covariance of the expected drift, fixed for the life of the session.
    """

    def __init__(
        self,
        nominal: SerialArm,
        history: History,
        config: ThermalConfig,
        software: str,
        prior: NDArray[np.float64] | None = None,
    ) -> None:
        self.nominal = nominal
        self.config = config
        self.desk = ObservationDesk(
            nominal.joint_names, config.standstill, config.measuring_frame or None
        )
        self._history = history
        self._software = software
        self._queue: list[Command] = []
        self._current = InForce(history, nominal)
        self.prior = expected_drift(nominal, history, config) if prior is None else prior

    @property
    def in_force(self) -> Head:
        """Head of the history as the session last saw it."""
        return self._current.head

    @property
    def reference(self) -> ColdReference | None:
        """The cold reference, or None."""
        return self._current.reference

    @property
    def reference_id(self) -> int | None:
        """Calibration that is the cold reference, or None."""
        return self._current.reference_id

    @property
    def fault(self) -> str:
        """Why the history could not be read at the last look; empty when it could."""
        return self._current.fault

    @property
    def arm(self) -> SerialArm:
        """The arm with the model in force."""
        model = self.in_force.model
        return self.nominal if model is None else arm_of(model, self.nominal)

    @property
    def reference_model(self) -> dict[str, Any] | None:
        """The cold reference's document, or None."""
        return None if self.reference is None else reference_document(self.reference)

    def add(self, sample: JointSample | PointSample | PoseSample) -> None:
        """Take a sample."""
        if isinstance(sample, JointSample):
            self.desk.add_joints(sample)
        else:
            self.desk.add_measurement(sample)

    def submit(self, command: Command, clock_ns: int | None = None) -> None:
        """Queue a command; ``advance`` carries it out when its samples are complete.

        A command without a stamp gets ``clock_ns`` where that is on the samples' clock (within
        a second after the newest of them), else the newest stamp known.
        """
        if command.stamp_ns is None:
            newest = self.desk.clock_ns
            near = clock_ns is not None and newest <= clock_ns <= newest + SAME_CLOCK_NS
            command = replace(command, stamp_ns=clock_ns if near else newest)
        if command.name == events.IDENTIFY and not command.arguments.get("cycle_id"):
            named = str(np.datetime64((command.stamp_ns or 0) // 1_000_000, "ms"))
            command = replace(command, arguments={**command.arguments, "cycle_id": named})
        self._queue.append(command)

    @property
    def waiting(self) -> int:
        """Number of commands not yet carried out."""
        return len(self._queue)

    def advance(self, *, wall_ns: int, force: bool = False) -> list[Outcome]:
        """Carry out the commands whose samples are complete.

        ``wall_ns`` enters the history's records only; ``force`` carries out all with what is
        there (no more samples will come, or a caller's deadline has passed).
        """
        outcomes: list[Outcome] = []
        while done := self.step(wall_ns=wall_ns, force=force):
            outcomes += done
        return outcomes

    def step(self, *, wall_ns: int, force: bool = False) -> list[Outcome]:
        """Carry out one command, as ``advance``: what was decided outside before it, and it."""
        if not self._queue or not (force or self._ready(self._queue[0])):
            return []
        command = self._queue.pop(0)
        outside = self.poll()
        if command.marks is None:
            command = self._marked(command)
        outcome = self._carry_out(command, wall_ns)
        outside += [
            outside_decision(decision, self.desk.marks) for decision in self._current.look(wall_ns)
        ]
        return [*outside, replace(outcome, revision=self.in_force.revision)]

    def _marked(self, command: Command) -> Command:
        """Return the command with the bounds of its samples, for the record."""
        marks, arguments = self.desk.marks, dict(command.arguments)
        if command.name in (events.IDENTIFY, events.CAPTURE_REFERENCE):
            arguments.setdefault("from_ns", self.desk.from_ns)
        return replace(command, marks=marks, arguments=arguments)

    def _ready(self, command: Command) -> bool:
        newest = self.desk.newest_ns
        if command.marks is not None:
            marks = dict(command.marks)
            jumps = marks.pop(JUMPS, 0)
            reached = all(newest.get(topic, -1) >= stamp for topic, stamp in marks.items())
            return self.desk.jumps > jumps or (self.desk.jumps == jumps and reached)
        if command.name not in (events.IDENTIFY, events.CAPTURE_REFERENCE):
            return True
        wanted = (command.stamp_ns or 0) + int(self.config.lateness_s * 1e9)
        return newest.get(JOINTS, -1) >= wanted

    def _carry_out(self, command: Command, wall_ns: int) -> Outcome:
        handlers: dict[str, Callable[[Command, int], Outcome]] = {
            events.CAPTURE_REFERENCE: self._capture_reference,
            events.IDENTIFY: self._identify,
            events.ACCEPT: self._decide,
            events.REJECT: self._decide,
            events.ROLLBACK: self._decide,
        }
        try:
            if command.name not in handlers:
                raise InputError(f"unknown command '{command.name}'; known: {', '.join(handlers)}")
            return handlers[command.name](command, wall_ns)
        except RobocalError as error:
            return Outcome(command, error.code, str(error))

    def _window(self, command: Command) -> list[Observation]:
        self.desk.drop_far_ahead()
        after = int(command.arguments.get("from_ns", self.desk.from_ns)) - 1
        found = self.desk.window(after, command.stamp_ns or 0, command.marks or {})
        last = int(command.arguments.get("samples", 0))
        if not found:
            lost = {topic: dict(why) for topic, why in self.desk.ignored.items()}
            raise TooFewSamplesError(
                "no measurement with the robot at standstill since the last command"
                + (f"; ignored: {lost}" if lost else "")
            )
        return found[-last:] if last else found

    def _capture_reference(self, command: Command, wall_ns: int) -> Outcome:
        data = as_measurements(self._window(command))
        reference = capture_reference(self.arm, data)
        model = reference_document(reference)
        rms_mm = summarise(reference.cell.residual(reference.data)).rms_m * 1e3
        left_out = f", not fitting: {', '.join(reference.rejected)}" if reference.rejected else ""
        message = (
            f"cold reference of {len(reference.data)} measurements captured, residual "
            f"{rms_mm:.3f} mm rms{left_out}"
        )
        document = {"residual_rms_mm": rms_mm, "rejected": list(reference.rejected)}
        calibration_id = self._propose(
            REFERENCE,
            command,
            wall_ns,
            "lsq",
            Verdict(Code.ACCEPT, message),
            document,
            model,
            data,
        )
        self._history.accept(
            calibration_id,
            by=str(command.arguments.get("by", "")),
            reason="captured",
            expected_head=None,
            wall_ns=wall_ns,
        )
        self.desk.use(command.stamp_ns or 0)
        return Outcome(
            command, Code.ACCEPT, message, calibration_id=calibration_id, samples=len(data)
        )

    def _identify(self, command: Command, wall_ns: int) -> Outcome:
        method = str(command.arguments.get("method") or self.config.method)
        if method not in METHODS:
            raise InputError(f"method '{method}' is not one of {', '.join(METHODS)}")
        data = as_measurements(self._window(command))
        judged = self._solve(data, "lsq" if method == "lsq" else "map")
        document = identification_document(judged)
        cycle_id = str(command.arguments.get("cycle_id", ""))
        document |= {"stamp_ns": command.stamp_ns, "cycle_id": cycle_id}
        verdict = judged.verdict
        model = identified_model_document(judged.identification)
        if self.reference is not None:
            model["reference_mdh"] = self.reference.cell.arm.mdh.tolist()
        calibration_id = self._propose(
            THERMAL, command, wall_ns, method, verdict, document, model, data
        )
        self.desk.use(command.stamp_ns or 0)
        return Outcome(
            command, verdict.code, verdict.reason, document, calibration_id, samples=len(data)
        )

    def _solve(self, data: Measurements, method: Method) -> JudgedIdentification:
        if self.reference is not None:
            return identify_drift(
                self.nominal,
                self.reference,
                data,
                sigma_m=self.config.sigma_m,
                in_force=self.arm,
                prior_covariance=self.prior,
                method=method,
            )
        return identify_and_hold_out(
            self.nominal,
            data,
            share=self.config.hold_out,
            seed=self.config.seed,
            method=method,
            in_force=self.arm if self.in_force.model is not None else None,
        )

    def _propose(
        self,
        kind: str,
        command: Command,
        wall_ns: int,
        method: str,
        verdict: Verdict,
        document: dict[str, Any],
        model: dict[str, Any],
        data: Measurements,
    ) -> int:
        # What it was solved against, though another process may have decided meanwhile.
        thermal = kind == THERMAL
        based_on = self.in_force.revision if thermal else self._history.head(kind).revision
        held_out = document.get("calibrated", {}).get("held_out", {})
        return self._history.propose(
            Proposal(
                kind=kind,
                model_hash=self.nominal.model_hash,
                based_on=based_on,
                cycle_id=str(command.arguments.get("cycle_id", "")),
                stamp_ns=command.stamp_ns or 0,
                created_ns=wall_ns,
                software=self._software,
                method=method,
                code=verdict.code,
                reason=verdict.reason,
                candidate_rms_mm=held_out.get("rms_mm"),
                document=document,
                model=model,
                inputs=data.arrays(),
            )
        )

    def _decide(self, command: Command, wall_ns: int) -> Outcome:
        return decide(self._history, command, self.in_force.revision, wall_ns)

    def poll(self) -> list[Outcome]:
        """Take over what another process decided in the history since the last look."""
        return [outside_decision(decision, self.desk.marks) for decision in self._current.look()]
