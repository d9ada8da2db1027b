# SPDX-License-Identifier: Apache-2.0
"""Robot, PLC and suite on one clock: commissioning, gaps, production."""

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.cell_samples import CellSamples, Sample, programme
from bench.closed_loop import setting
from bench.closed_loop.suite import Clock, Record, Suite, unrecorded
from robocal_ros.cell_sim.cell import Happened, SimulatedCell, poses
from robocal_ros.correction.interface import RefusedError, TrajectoryCommand
from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.maintenance.accuracy import CycleResult
from robocal_ros.maintenance.mover import STATION
from robocal_ros.motion.cell import joint_way
from robocal_ros.motion.plan import JointPlan
from robocal_ros.session import events
from robocal_ros.session.events import Command, Outcome
from robocal_ros.thermal.accuracy import LearnedProcess
from robocal_ros.tool.session import REFERENCE

Array = NDArray[np.float64]

STEP_S = 0.016
WORK_STEP_S = 0.5  # while nothing is measured
BEAT_S = 0.2  # of gap_open
LISTEN_S = 0.5  # readings before a gap and before a programme
ROUNDS = 3  # of the cold robot
DWELL_S = 1.0  # at each of its poses
REST_S = 0.2  # after a pass
WITHIN_S = 120.0  # a commissioning step
FIXTURE_GAP_S = 300.0  # in which a fixture is measured too
WORK, HOME, CYCLE = poses("work"), poses("home")[0], poses("cycle")
LEAD = 2  # rests at home, a second each: after a gap the offset begins at 0 and grows by 2 deg/s
PROGRAMME = programme(HOME, [*[HOME] * LEAD, *WORK, HOME])
AT_WORK = slice(2 * LEAD, 2 * (LEAD + len(WORK)), 2)  # where it arrives at the working poses
PASS_S = float(PROGRAMME[0][-1])

Heard = Callable[[Happened, list[Sample]], None]


@dataclass(frozen=True)
class GapReport:
    """How a gap ended.

    Attributes
    ----------
    result : of its maintenance; None without a suite, or where it was refused.
    fault : what the maintenance says is wrong; NONE and empty without.
    over_s : by how much the robot was moved, or the maintenance ran, beyond its end.
    """

    result: CycleResult | None = None
    fault_code: Code = Code.NONE
    fault: str = ""
    over_s: float = 0.0


@dataclass
class Plant:
    """The cell with or without its suite.

    Attributes
    ----------
    every_reading : the sessions take all joint readings, also those of the production.
    heard : takes everything that the cell tells, as it came and as samples for the sessions.
    begin_s : of the shift, once it has begun.
    commanded : joints (k, n) to which the last pass went for the working poses; None before.
    is_open : what the PLC's heartbeat says of the gap.
    refused : what the correction refused, with the times.
    """

    cell: SimulatedCell
    suite: Suite | None
    every_reading: bool = False
    heard: Heard = lambda came, samples: None
    refused: list[tuple[float, str]] = field(default_factory=list)
    begin_s: float = np.inf
    commanded: Array | None = None
    is_open: bool = False
    _beat_s: float = -np.inf

    def __post_init__(self) -> None:
        names, sphere = self.cell.plan.arm.joint_names, setting.THERMAL.sphere
        self.samples = CellSamples(names, sphere, station=setting.STATION, frame=setting.FRAME)

    @property
    def now_s(self) -> float:
        """Of the cell."""
        return self.cell.now_s

    @property
    def _q(self) -> Array:
        return np.asarray(self.cell.motion.at([self.now_s])[0][0])

    @property
    def clock(self) -> Clock:
        """Of the suite."""
        return Clock(self.now_s, self.samples.ns(self.now_s))

    # ---- time -----------------------------------------------------------------------------------

    def send(self, plan: JointPlan, stop: bool = False) -> None:
        """Follow a plan, or a stop, at once; a point at 0 would make the robot jump there."""
        self.cell.follow(self.now_s + plan.time_s[1:], plan.q[1:], plan.qd[1:])

    def step(self, step_s: float = STEP_S) -> None:
        """A step of time with everything listening."""
        came = self.cell.advance(self.now_s + step_s)
        if self.suite is None:
            return
        if self.now_s >= self._beat_s + BEAT_S:
            self._beat_s = self.now_s
            self.suite.gap(self.is_open, self.now_s)
        self._take(self.suite, came)

    def _take(self, suite: Suite, came: Happened) -> None:
        samples = self.samples.of(came, self.cell.faults)
        self.heard(came, samples)
        suite.step(samples, self.clock)

    def listen(self, until_s: float, step_s: float = STEP_S) -> None:
        """Step until a time."""
        while self.now_s < until_s - 1e-9:
            self.step(step_s)

    def work(self, until_s: float) -> None:
        """Let time pass in which the robot produces; without readings where none are wanted."""
        if self.suite is None:
            self.cell.advance(until_s, readings=False)
            return
        if self.every_reading:
            self.listen(until_s - LISTEN_S - WORK_STEP_S, WORK_STEP_S)
        elif until_s - LISTEN_S > self.now_s:
            self._take(self.suite, self.cell.advance(until_s - LISTEN_S, readings=False))
        self.listen(until_s)

    # ---- commissioning --------------------------------------------------------------------------

    def commission(self) -> None:
        """Place the sensor, capture the cold reference, measure the healthy tool.

        Raises
        ------
        RobocalError
            When a step is refused.
        """
        suite = self.suite
        if suite is None:
            return
        self.listen(self.now_s + 1.0)
        self._show_ball(suite, ROUNDS)
        for name in (events.CALIBRATE_SENSOR, events.CAPTURE_REFERENCE):
            self._thermal(suite, Command(name, {"by": "commissioning"}))
        measured = self.measure_tool(suite, REFERENCE, "commissioning")
        if not measured.done:
            raise RobocalError(f"commissioning of the tool: {measured}")
        self.home_from_station(suite)
        if suite.fixture is not None:
            self._teach_fixture(suite)

    def _teach_fixture(self, suite: Suite) -> None:
        """By the points of a gap, which says that it is not taught, as docs/maintenance_node.md."""
        untaught = self.gap("untaught", FIXTURE_GAP_S)
        suite.fixture_command(Command(events.CALIBRATE, {"teach": True}))
        before = suite.last_fixture
        self._until(lambda: suite.last_fixture is not before)
        suite.fixture_command(Command(events.ACCEPT, {"choose": "only", "by": "commissioning"}))
        before = suite.last_fixture
        self._until(lambda: suite.last_fixture is not before)
        if suite.last_fixture is None or not suite.last_fixture.done:
            raise RobocalError(f"teaching: {suite.last_fixture}, after {untaught}")

    def measure_drift(self, suite: Suite, cycle_id: str) -> Outcome:
        """A thermal cycle from home to home, outside any gap.

        Raises
        ------
        RobocalError
            When it does not end.
        """
        told = {"cycle_id": cycle_id}
        self._thermal(suite, Command(events.BEGIN_CYCLE, told))
        self._show_ball(suite, 1)
        return self._thermal(suite, Command(events.END_CYCLE, told))

    def measure_tool(self, suite: Suite, mode: str, cycle_id: str) -> Outcome:
        """Open a gap and let the tool's driver measure; the robot stays where that ends.

        Raises
        ------
        RobocalError
            When it is refused, or does not end.
        """
        before = suite.last_tool
        self.is_open = True
        suite.gap(True, self.now_s)
        suite.driver.arm(self.now_s)
        arguments = {"mode": mode, "cycle_id": cycle_id, "by": "commissioning"}
        suite.tool_command(Command(events.MEASURE_TOOL, arguments))
        self._until(lambda: suite.last_tool is not before and not suite.driver.armed)
        if suite.last_tool is None:
            raise RobocalError(f"{cycle_id}: no answer")
        return suite.last_tool

    def home_from_station(self, suite: Suite) -> None:
        """Drive home from wherever the tool's driver left the robot, and close the gap."""
        self.listen(self.now_s + 1.0)
        self.send(suite.maintenance.ways.home(STATION, self._q).plan)
        self.listen(self.cell.motion.end_s + 1.0)
        self.is_open = False

    def _show_ball(self, suite: Suite, rounds: int) -> None:
        # Each round from home, as a cycle: so backlash cancels.
        for pose in np.tile(np.vstack([CYCLE, HOME]), (rounds, 1)):
            self.send(joint_way(suite.maintenance.ways.cell, self._q, pose))
            self.listen(self.cell.motion.end_s)
            self.listen(self.now_s + DWELL_S)

    def _thermal(self, suite: Suite, command: Command) -> Outcome:
        before = suite.last_thermal
        suite.thermal_command(command)
        self._until(lambda: suite.last_thermal is not before)
        if suite.last_thermal is None:
            raise RobocalError(f"{command.name}: no answer")
        return suite.last_thermal

    def _until(self, done: Callable[[], bool]) -> None:
        end_s = self.now_s + WITHIN_S
        while not done():
            self.step()
            if self.now_s > end_s:
                raise RobocalError(f"commissioning: not done within {WITHIN_S:g} s")

    # ---- the PLC --------------------------------------------------------------------------------

    def gap(self, cycle_id: str, gap_s: float) -> GapReport:
        """Open a gap of a length, run the maintenance in it, close it at its end."""
        end_s = self.now_s + gap_s
        if self.suite is None:
            self.work(end_s)
            return GapReport()
        maintenance, result = self.suite.maintenance, None
        self.is_open = True
        self.listen(self.now_s + LISTEN_S)
        try:
            left_s = end_s - self.now_s
            result = maintenance.run(cycle_id, left_s, self.now_s, self.clock.now_ns)
            while result is not None and result.code is Code.NONE:
                if self.now_s > end_s + WITHIN_S:
                    raise RuntimeError(f"{cycle_id}: not over {WITHIN_S:g} s after the gap's end")
                self.is_open = self.now_s < end_s
                self.step()
                result = maintenance.result(cycle_id)
        except RobocalError as error:
            self.refused.append((self.now_s, f"{cycle_id}: {error}"))
        over_s = max(self.now_s, self.cell.motion.end_s) - end_s
        self.is_open = False
        self.work(max(end_s, self.now_s))
        said = maintenance.status(self.now_s)
        return GapReport(result, said.fault_code, said.fault, max(over_s, 0.0))

    def begin_pass(self) -> Array | None:
        """Begin a pass of the programme, corrected where there is a suite; `PASS_S` long.

        Joints (k, n) at the working poses; None where the correction refuses: the robot stands.
        """
        time_s, q, qd, qdd = PROGRAMME
        begin_s = self.now_s
        if self.suite is not None and self.suite.correction is not None:
            names = self.cell.plan.arm.joint_names
            taught = TrajectoryCommand(names, q, time_s, qd, qdd)
            try:
                sent = self.suite.correction.trajectory(taught, begin_s)
            except RefusedError as error:
                self.refused.append((begin_s, str(error)))
                return None
            self.cell.follow(begin_s + time_s, sent.position, sent.velocity, sent.acceleration)
            q = sent.position
        else:
            self.cell.follow(begin_s + time_s, q, qd, qdd)
        self.commanded = np.asarray(q[AT_WORK])
        return self.commanded


@contextmanager
def equipped(
    nominal: SerialArm,
    cell: SimulatedCell,
    record: Record = unrecorded,
    expected: LearnedProcess | None = None,
) -> Iterator[tuple[Plant, Suite]]:
    """A plant with its suite, before the commissioning; what the suite keeps ends with it."""
    with (
        tempfile.TemporaryDirectory() as folder,
        CalibrationHistory.open(
            setting.SERIAL, model_hash=nominal.model_hash, state_dir=Path(folder)
        ) as history,
    ):
        plant = Plant(cell, None)
        laser = setting.laser_of(cell.plan)
        fixture = cell.plan.fixture is not None
        plant.suite = Suite(nominal, history, laser, plant.send, record, expected, fixture)
        yield plant, plant.suite


@contextmanager
def own_history(suite: Suite) -> Iterator[None]:
    """In a forked process, the history having been closed before: go on with a copy of its file.

    An SQLite connection must not be carried across a fork (sqlite.org/howtocorrupt.html, 2.6).
    """
    history = suite.history
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(history.path, folder)
        with CalibrationHistory.open(setting.SERIAL, state_dir=Path(folder)) as own:
            vars(history).update(path=own.path, _file=vars(own)["_file"])
            yield
