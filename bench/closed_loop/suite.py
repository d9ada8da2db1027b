# SPDX-License-Identifier: Apache-2.0
"""The sessions that keep a cell accurate, joined as their nodes join them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.cell_samples import Sample
from bench.closed_loop import setting
from bench.closed_loop.carrying import Carrier
from bench.closed_loop.words import model_of, told_by, tool_of
from robocal_ros import __version__
from robocal_ros.cell_sim.fixture import FRAME as FEATURE_FRAME
from robocal_ros.cell_sim.fixture import T_FLANGE_SENSOR
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import JointCommand
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.fixture.session import FixturePointSample, FixtureSession
from robocal_ros.ground.errors import RobocalError
from robocal_ros.ground.samples import (
    JOINTS,
    MEASURED_POINT,
    SPHERE_CLOUD,
    JointSample,
    PointSample,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import hand_eye_kind
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_description
from robocal_ros.maintenance.session import MaintenanceSession
from robocal_ros.motion.plan import JointPlan
from robocal_ros.motion.robot_watch import Gap
from robocal_ros.session import events
from robocal_ros.session.events import Command, Outcome
from robocal_ros.thermal.accuracy import Accuracy, LearnedProcess, process_document
from robocal_ros.thermal.drift_following import EXPECTED
from robocal_ros.thermal.session import ThermalSession
from robocal_ros.tool.driving import ToolDriver
from robocal_ros.tool.edges import EDGES, EdgeSample
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.session import ToolSession

Array = NDArray[np.float64]

NS = 1_000_000_000
POLL_S = 0.1
ENDS_RUN = (events.TOOL_STEP, events.BREAK_OFF)
Record = Callable[[str, Command, Outcome | None], None]


def unrecorded(node: str, command: Command, outcome: Outcome | None) -> None:
    """Keep nothing of a command."""


class Shelf:
    """Keeps the maintenance's memory."""

    def __init__(self) -> None:
        self.document: Mapping[str, Any] | None = None

    def load(self) -> Mapping[str, Any] | None:
        """What was kept last."""
        return self.document

    def save(self, document: Mapping[str, Any]) -> None:
        """Keep it."""
        self.document = dict(document)


@dataclass(frozen=True)
class Clock:
    """The suite's clocks, s and ns: the steady one is the cell's."""

    now_s: float
    now_ns: int


class Suite:
    """Samples in, plans for the robot out.

    Parameters
    ----------
    send : gives a plan to the robot's controller.
    record : takes each command of a session (``thermal``, ``tool``, ``maintenance``) with its
        outcome.
    expected : drift that earlier shifts have taught; None: the default.
    fixture : one is measured in each gap, by a sensor on the flange whose place is known.

    Attributes
    ----------
    history : of all sessions.
    correction : None until the cold reference is there, with which the program was taught.
    """

    def __init__(
        self,
        nominal: SerialArm,
        history: CalibrationHistory,
        laser: LaserFrame,
        send: Callable[[JointPlan], None],
        record: Record = unrecorded,
        expected: LearnedProcess | None = None,
        fixture: bool = False,
    ) -> None:
        self._nominal, self._send, self._record = nominal, send, record
        self.history = history
        self._expected = expected
        config = replace(setting.THERMAL, prior="learned" if expected else "default")
        self.thermal = ThermalSession(nominal, history, config, __version__)
        self.fixture: FixtureSession | None = None
        if fixture:
            place = {"parent": setting.FLANGE, "child": FEATURE_FRAME}
            place |= {"T_parent_sensor": T_FLANGE_SENSOR.tolist()}
            kind = hand_eye_kind(FEATURE_FRAME)
            events.bring_into_force(history, kind, nominal, place, "commissioning")
            told = setting.fixture_config()
            self.fixture = FixtureSession(nominal, history, told, __version__)
        self.tool = ToolSession(nominal, history, setting.tool_config(laser), __version__)
        self._gap = Gap(setting.STALE_S)
        self.driver = ToolDriver(self.tool, setting.DRIVING, send, self.tool_command, self._closed)
        self.maintenance = MaintenanceSession(
            nominal,
            history,
            setting.maintenance_config(laser, fixture),
            Shelf(),
            lambda command, outcome: record("maintenance", command, outcome),
        )
        self._carrier = Carrier(
            self.maintenance,
            self.tool,
            self.driver,
            send,
            self.thermal_command,
            self.tool_command,
            self.fixture_command,
        )
        self.correction: CorrectionSession | None = None
        self.last_tool: Outcome | None = None  # of a run that has ended
        self.last_thermal: Outcome | None = None
        self.last_fixture: Outcome | None = None
        self._names = nominal.joint_names
        self._clock = Clock(0.0, 0)
        self._polled_s = -np.inf
        self._offered: tuple[int, int] = (-1, -1)

    # ---- samples --------------------------------------------------------------------------------

    def gap(self, is_open: bool, now_s: float) -> None:
        """Take a heartbeat of the PLC, which the maintenance and the tool's driver both hear."""
        beat = self.maintenance.beat(now_s)
        self._gap.saw(beat, now_s)
        self._gap.heard(is_open, beat, now_s)
        self.maintenance.gap(is_open, beat, now_s)

    def _closed(self, now_s: float) -> str:
        self._gap.look(now_s)
        return self._gap.closed(now_s)

    def step(self, samples: list[Sample], clock: Clock) -> None:
        """Take what has happened, and carry out what follows."""
        self._clock = clock
        self._gap.look(clock.now_s)
        newest = None
        for sample in samples:
            self._take(sample)
            newest = sample if isinstance(sample, JointSample) else newest
        if self.correction is not None:
            if newest is not None:
                age_s = (clock.now_ns - newest.stamp_ns) / NS
                state = JointCommand(newest.names, newest.position, None, newest.stamp_ns)
                self.correction.reading(state, clock.now_s, max(age_s, 0.0))
            self.correction.look(clock.now_s, clock.now_ns)
        self._thermal_goes_on()
        self._fixture_goes_on()
        self.driver.tick(clock.now_s)
        if clock.now_s >= self._polled_s + POLL_S:
            self.poll()
        for request in self.maintenance.tick(clock.now_s, clock.now_ns):
            self._carrier.carry_out(request, clock.now_s)

    def _take(self, sample: Sample) -> None:
        now_s = self._clock.now_s
        if isinstance(sample, JointSample):
            stamp_s = sample.stamp_ns / NS
            self.driver.reading(stamp_s, sample.position, now_s)
            self.maintenance.reading(stamp_s, sample.position, now_s)
            self.thermal.add(sample)
            self._to_tool(sample)
            if self.fixture is not None:
                self.fixture.add(sample)
        elif isinstance(sample, EdgeSample):
            self.driver.beam(sample.blocked)
            self._to_tool(sample)
        elif isinstance(sample, FixturePointSample):
            if self.fixture is not None:
                self.fixture.add(sample)
                self.maintenance.measured(sample.stamp_ns / NS, of_fixture=True)
        else:
            self.thermal.add(sample)
            if isinstance(sample, PointSample) and sample.topic in (MEASURED_POINT, SPHERE_CLOUD):
                self.maintenance.measured(sample.stamp_ns / NS)

    def _to_tool(self, sample: JointSample | EdgeSample) -> None:
        try:
            self.tool.add(sample)
        except RobocalError as error:
            kind = JOINTS if isinstance(sample, JointSample) else EDGES
            self.tool.ignored.add(kind, str(error))
        if (command := self.tool.recognised()) is not None:
            self.tool_command(command)

    # ---- commands -------------------------------------------------------------------------------

    def thermal_command(self, command: Command) -> None:
        """Ask the thermal session; carried out once its measurements are complete."""
        if self._expected is not None and command.name == events.CAPTURE_REFERENCE:
            learned = process_document(self._expected)
            known = {EXPECTED: learned, "expected_from": "earlier shifts"}
            command = replace(command, arguments={**command.arguments, **known})
        self.thermal.submit(command, self._clock.now_ns)

    def _thermal_goes_on(self) -> None:
        for outcome in self.thermal.advance(wall_ns=self._clock.now_ns):
            self._record("thermal", outcome.command, outcome)
            self.last_thermal = outcome
            self._carrier.thermal_ended(outcome)

    def fixture_command(self, command: Command) -> None:
        """Ask the fixture session; carried out once its points are complete."""
        if self.fixture is not None:
            self.fixture.submit(command, self._clock.now_ns)

    def _fixture_goes_on(self) -> None:
        if self.fixture is None:
            return
        for outcome in self.fixture.step(wall_ns=self._clock.now_ns):
            self._record("fixture", outcome.command, outcome)
            self.last_fixture = outcome
            self._carrier.fixture_ended(outcome)

    def tool_command(self, command: Command) -> Outcome | None:
        """Ask the tool session, at once."""
        self.tool.submit(command)
        last = None
        for outcome in self.tool.step(wall_ns=self._clock.now_ns):
            self._record("tool", outcome.command, outcome)
            last = outcome
        if last is not None and last.command.name in ENDS_RUN and self.tool.run is None:
            self._tool_ended(last)
        return last

    def _tool_ended(self, outcome: Outcome) -> None:
        self.last_tool = outcome
        if outcome.document is None:
            self.driver.run_failed(outcome.message, self._clock.now_s)
        self._carrier.tool_ended(outcome)

    # ---- what is in force -----------------------------------------------------------------------

    def poll(self) -> None:
        """Take over what was decided, and offer what is in force to the correction."""
        self._polled_s = self._clock.now_s
        for node, session in (("thermal", self.thermal), ("tool", self.tool)):
            for outcome in session.poll():
                self._record(node, outcome.command, outcome)
        if self.maintenance.running is not None:
            self._tell_drift()
        if self.correction is None:
            return
        heads = self.thermal.in_force.revision, self.tool.in_force.revision
        if heads[0] != self._offered[0]:
            self.correction.offer_model(model_of(self.thermal, self._clock.now_ns))
        if heads[1] != self._offered[1]:
            self.correction.offer_tool(tool_of(self.tool, self._clock.now_ns))
        if heads != self._offered:
            self._offered = heads
            self.accuracy()  # the node looks each second

    def enable(self) -> None:
        """Correct from now on; the program was taught with the robot as the cold reference has it.

        Raises
        ------
        ValueError
            Before there is a cold reference.
        """
        if self.thermal.reference is None:
            raise ValueError("capture the cold reference first")
        taught = replace(
            self.thermal.reference.cell.arm, T_flange_tool=self.tool.config.T_flange_taught
        )
        robot = load_description("kr150_r3100")
        limits = CorrectionConfig(
            velocity_limits=robot.max_velocity, acceleration_limits=robot.max_acceleration
        )
        self.correction = CorrectionSession(self._nominal, taught, setting.SERIAL, limits)
        self.poll()
        self.correction.enable(True)

    def accuracy(self) -> Accuracy:
        """What the line reads now."""
        self._tell_drift()
        if self.correction is not None:
            self.maintenance.correction(told_by(self.correction), self._clock.now_s)
        return self.maintenance.accuracy(self._clock.now_s, self._clock.now_ns)

    def _tell_drift(self) -> None:
        drift = self.thermal.accuracy(self._clock.now_ns)
        self.maintenance.drift(drift, self._clock.now_s)
