"""The thermal session: samples and commands in, judged proposals out. No clock, no ROS."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.documents import reference_document
from robocal_ros.core.errors import InputError, RobocalError, TooFewSamplesError
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.proposals import Head
from robocal_ros.core.samples import JointSample, Measurements, PointSample, PoseSample
from robocal_ros.core.thermal.reference import ColdReference
from robocal_ros.sessions import events
from robocal_ros.sessions.decisions import decide
from robocal_ros.sessions.events import Command, Outcome
from robocal_ros.sessions.history import History
from robocal_ros.sessions.in_force import InForce, outside_decision
from robocal_ros.sessions.observation import as_measurements
from robocal_ros.sessions.observations import JOINTS, JUMPS, ObservationDesk
from robocal_ros.sessions.proposing import Proposer
from robocal_ros.sessions.thermal_config import ThermalConfig, expected_drift

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
        self._queue: list[Command] = []
        self._current = InForce(history, nominal)
        self.prior = expected_drift(nominal, history, config) if prior is None else prior
        self._proposer = Proposer(nominal, history, config, software, self._current, self.prior)

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
        return self._current.arm

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

    def _window(self, command: Command) -> Measurements:
        self.desk.drop_far_ahead()
        after = int(command.arguments.get("from_ns", self.desk.from_ns)) - 1
        found = self.desk.window(after, command.stamp_ns or 0, command.marks or {})
        last = int(command.arguments.get("samples", 0))
        if not found:
            raise TooFewSamplesError(self.desk.why_nothing())
        drift = command.name == events.IDENTIFY and self.reference is not None
        sigma_m = self.config.sigma_m if drift else None  # a calibration finds its noise itself
        return as_measurements(found[-last:] if last else found, sigma_m)

    def _capture_reference(self, command: Command, wall_ns: int) -> Outcome:
        outcome = self._proposer.capture(command, self._window(command), wall_ns)
        self.desk.use(command.stamp_ns or 0)
        return outcome

    def _identify(self, command: Command, wall_ns: int) -> Outcome:
        method = self._proposer.method(command)
        outcome = self._proposer.identify(command, self._window(command), method, wall_ns)
        self.desk.use(command.stamp_ns or 0)
        return outcome

    def _decide(self, command: Command, wall_ns: int) -> Outcome:
        return decide(self._history, command, self.in_force.revision, wall_ns)

    def poll(self) -> list[Outcome]:
        """Take over what another process decided in the history since the last look."""
        return [outside_decision(decision, self.desk.marks) for decision in self._current.look()]
