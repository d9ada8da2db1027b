# SPDX-License-Identifier: Apache-2.0
"""The maintenance of a cell, without clock and ROS: what the PLC asks in, requests to others out.

Whoever drives it gives what happens (`gap`, `reading`, `measured`, `answered`, `drift`,
`correction`) and calls `tick` often, at least every 20 ms; `tick` gives the requests that are to be
carried out at once, in their order. Times ``now_s`` are of one steady clock, which goes on while
the host is suspended; ``wall_ns`` is the wall clock, for records.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from traceback import extract_tb

from robocal_ros.correction.interface import ToldCorrection
from robocal_ros.ground.errors import Code, ConflictError, InputError, LimitError, RobocalError
from robocal_ros.ground.frames import Array
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL, TOOL
from robocal_ros.kinematics import SerialArm
from robocal_ros.maintenance.accuracy import (
    CycleResult,
    DocumentStore,
    MaintenanceConfig,
    Memory,
    NodeReports,
    accuracy_of,
)
from robocal_ros.maintenance.cycle import CycleRun
from robocal_ros.maintenance.deciding import Decider
from robocal_ros.maintenance.fixture_part import FixturePart, FixtureVisits
from robocal_ros.maintenance.mover import FaultError, Ways
from robocal_ros.maintenance.robot_interface import (
    CellInterface,
    DriverAnswer,
    DriverRequest,
    Script,
)
from robocal_ros.maintenance.thermal_part import ThermalCycle, ThermalPart
from robocal_ros.session.events import Command, Outcome
from robocal_ros.thermal.accuracy import Accuracy
from robocal_ros.tool.session import FULL, LASER, QUICK

ENDED, FAULT = "maintenance_ended", "fault"
UNSAVED_S = 2.0  # a fault is written by then, whatever the robot may be doing
Tell = Callable[[str, dict[str, object], Code, str], None]


class Conductor:
    """The run that is open.

    ``tell``: takes name, arguments, code and words of what happens.
    ``run``: None while nothing runs. ``broken``: why the run is broken off; None while it goes on.
    """

    def __init__(self, cell: CellInterface, memory: Memory, tell: Tell) -> None:
        self._cell, self._memory, self._tell = cell, memory, tell
        self.run: CycleRun | None = None
        self.broken: tuple[Code, str] | None = None
        self._script: Script[None] | None = None
        self._unsaved, self._save_by_s = False, 0.0

    def begin(self, run: CycleRun) -> None:
        """A run begins at the next tick; nothing moves before the tool's driver is disarmed."""
        self._cell.doubt()
        self.run, self._script, self.broken = run, self._whole(run), None
        self._cell.doing = "begins"

    def tick(self, wall_ns: int) -> None:
        """Look after gap and robot, then go on."""
        run, cell = self.run, self._cell
        if self._unsaved and (not cell.stopping or cell.now_s >= self._save_by_s):
            self._save()
        cell.look_after_tool()
        if run is None:
            cell.keep_disarming()
            return
        run.at(wall_ns)
        try:
            if not (cell.robot.moving or cell.tool.armed) and cell.gap.waits(cell.now_s):
                return  # a heartbeat from after the own pause is yet to come
            if why := cell.gap.over(cell.now_s):
                self.give_up(why)
                return
            cell.robot.require_sane(cell.now_s)
            if self._script is not None:
                next(self._script)
        except StopIteration:
            robot = self._cell.robot
            if away := robot.beside_home():
                code = Code.TOO_FEW_SAMPLES if robot.unheard else Code.LIMIT_EXCEEDED
                self.fault(code, f"robot is not at home: {away}")
            elif self._cell.tool.doubted:
                self.fault(Code.CONFLICT, "the tool node may still be armed")
            elif self.broken is not None:
                self._end(*self.broken)
            else:
                self._end(run.result.code, run.result.message)
        except FaultError as error:
            self.fault(error.code, str(error))
        except RobocalError as error:  # refused in the middle of it: home, and end with its code
            end = self.break_off if self.broken is None else self.fault
            end(error.code, str(error))
        except Exception as error:  # a defect: the script is over, and the robot may move
            self.fault(Code.CONFLICT, _defect(error))

    def break_off(self, code: Code, reason: str) -> None:
        """Stop the robot, and bring it home; the run ends with this code."""
        self._close_script()
        self.broken = code, reason
        self._cell.doing = "is broken off"
        self._script = self._cell.after_break()

    def fault(self, code: Code, reason: str, at_once: bool = False) -> None:
        """Stop the robot where it moves, disarm, end the run; nothing more until acknowledged.

        ``at_once``: no tick follows, see `CellInterface.halt`.
        """
        self._close_script()
        cell, run = self._cell, self.run
        if run is not None and run.owes not in reason:
            reason = f"{reason}; {run.owes}"
        try:
            cell.halt(at_once)
        except Exception as error:  # without a stop of ours it must still be disarmed, and told
            reason = f"{reason}; no stop was sent: {_defect(error)}"
        if cell.tool.engaged:
            cell.disengage()
        self.run, cell.doing = None, "fault"
        self._tell(FAULT, {}, code, reason)
        self._note(run, code, reason, fault=reason)
        # A stop, one that is yet to come too, does not wait for the disk: without this write too
        # the next start finds a fault.
        self._unsaved = bool(cell.out or cell.stopping)
        self._save_by_s = cell.now_s + UNSAVED_S
        if not self._unsaved:
            self._save()

    def give_up(self, why: str, at_once: bool = False) -> None:
        """End the run now: at home and disarmed it just ends, anywhere else it is a `fault`.

        ``at_once``: a stop that is still due after a fault goes out too, see `CellInterface.halt`.
        """
        cell = self._cell
        if self.run is None:
            if at_once and cell.stopping:
                cell.halt(at_once)
        elif cell.not_handed_over():
            words = f"{why}, and the robot is not handed over at home"
            self.fault(Code.CONFLICT, words, at_once)
        else:
            self._end(Code.CONFLICT, why)

    def _whole(self, run: CycleRun) -> Script[None]:
        if self._cell.tool.engaged:
            yield from self._cell.disarmed()
        yield from run.script()

    def _end(self, code: Code, message: str) -> None:
        self._close_script()
        run = self.run
        if run is not None and run.owes:
            message = f"{message}; {run.take_back()}"
            if run.owes:
                self.fault(Code.CONFLICT, message)
                return
        self.run = None
        self._cell.doing = ""
        self._note(run, code, message)
        self._save()

    def _note(self, run: CycleRun | None, code: Code, message: str, fault: str = "") -> None:
        if run is None:
            self._memory.set_fault(code, fault)
            return
        result = run.ended(code, message)
        self._tell(ENDED, result.document(), code, message)
        self._memory.end(result, code if fault else Code.NONE, fault)

    def keep(self) -> None:
        """Write what waited for a stop."""
        if self._unsaved:
            self._save()

    def _save(self) -> None:
        self._unsaved, memory = False, self._memory
        try:
            memory.save()
        except RobocalError as error:  # what is in memory holds; it is a fault all the same
            memory.fault_code = error.code
            memory.fault = f"{memory.fault}; {error}" if memory.fault else str(error)

    def _close_script(self) -> None:
        if self._script is not None:
            self._script.close()
        self._script = None
        self._cell.forget_answers()


def _defect(error: Exception) -> str:
    """Where it is, for whoever mends it."""
    place = extract_tb(error.__traceback__)[-1]
    return f"defect in {Path(place.filename).name}:{place.lineno}: {type(error).__name__}: {error}"


class MaintenanceState(IntEnum):
    """Numbers of ``MaintenanceStatus.msg``; 0 is never sent."""

    IDLE = 1
    """Nothing runs; the robot is the PLC's."""
    RUNNING = 2
    """A cycle runs; this node may move the robot."""
    BREAKING_OFF = 3
    """A cycle was cancelled: the robot is stopped and brought home."""
    FAULT = 4
    """A person must look; nothing moves until it is acknowledged."""


@dataclass(frozen=True)
class Status:
    """The maintenance at one instant."""

    state: MaintenanceState
    cycle_id: str  # that runs, or ran last
    doing: str  # in words
    left_s: float  # of the gap; 0 while nothing runs
    # at_home, disarmed: of the robot and of the tool's driver, as far as is known; disarmed is one
    # of which nothing is under way either
    at_home: bool
    disarmed: bool
    last: CycleResult | None  # how the last cycle ended; None before any
    # ..._pending: newest candidates that wait for a decision, of any fixture; 0: none
    thermal_pending: int
    tool_pending: int
    fixture_pending: int
    # fault_code, fault: NONE and empty without one
    fault_code: Code
    fault: str
    beat: int  # counts up with each status that is published; the PLC's heartbeat echoes it
    closed: str = ""  # why the gap counts as closed; empty while it is open
    trouble: str = ""  # why nobody knows what waits; the pending ids are then as last known


RUN, ACKNOWLEDGE = "run_maintenance", "acknowledge"
MOST_ID = 100  # characters of a cycle's name


class MaintenanceSession:
    """Keeps one robot accurate in the gaps that the PLC gives.

    ``record``: takes each command with what came of it.
    ``ways``: the ways that the robot may take. ``memory``: what outlives a restart; read it only.
    ``robot``: where it is, and what its controller says (`Mover.reported`, `Mover.watch`).
    """

    def __init__(
        self,
        nominal: SerialArm,
        history: CalibrationHistory,
        config: MaintenanceConfig,
        keeper: DocumentStore,
        record: Callable[[Command, Outcome], None] = lambda command, outcome: None,
    ) -> None:
        self.config, self.ways = config, Ways(nominal, config)
        self.memory = Memory.load(keeper)
        self.memory.tool = self.memory.tool.of_taught(config.T_flange_tool)
        self._decider = Decider(nominal, history, config)
        fixture = None
        if config.fixture_poses is not None:
            fixture = Ways(nominal, replace(config, poses=config.fixture_poses))
        self._cell = CellInterface(config, self.ways, fixture)
        self.robot = self._cell.robot
        self._cell.doubt()  # whoever ran before may have left the tool's driver armed
        self._book, self._visits = ThermalCycle(), FixtureVisits()
        self._record = record
        self._conductor = Conductor(self._cell, self.memory, self._tell)
        self._reports = NodeReports(config)
        self._second = ""
        self._pending = 0, 0, 0  # thermal, tool, fixture: what waited when it could be read last

    def beat(self, now_s: float) -> int:
        """The next beat, to be published now; 5 Hz. A heartbeat echoes it."""
        return self._cell.gap.count(now_s)

    def gap(self, is_open: bool, echo: int | None, now_s: float) -> None:
        """Take a heartbeat of ``gap_open``, with the beat that it echoes (None: it has none)."""
        self._cell.gap.heard(is_open, echo, now_s)

    def doubt_gap(self, why: str) -> None:
        """The heartbeats do not count, and why; empty: they do."""
        self._cell.gap.doubt(why)

    def reading(self, stamp_s: float, q: Array, now_s: float) -> None:
        """Take joints (n,), in the arm's order; ``stamp_s`` on their own clock."""
        self.robot.reading(stamp_s, q, now_s)

    def slept(self, for_s: float) -> None:
        """The host was suspended; call it before anything else with a time of afterwards."""
        self.robot.watch.slept(for_s)

    def sent(self, now_s: float) -> None:
        """The motion that `tick` gave goes out now: its time begins then, not when planned."""
        self.robot.watch.sent(now_s)

    def second(self, why: str, now_s: float) -> None:
        """Somebody else commands this robot, a second maintenance node too; empty: nobody."""
        self._second, self._cell.now_s = why, now_s
        self._conductor.give_up(why) if why else None

    def measured(self, stamp_s: float, of_fixture: bool = False) -> None:
        """A measurement of the flange's target, or of the fixture, has arrived.

        ``stamp_s``: its stamp, on the joints' clock.
        """
        stamps = self._cell.features if of_fixture else self._cell.measured
        stamps.append(stamp_s)
        del stamps[:-1000]

    def drift(self, drift: Accuracy, now_s: float) -> None:
        """What the thermal part believes of the accuracy."""
        self._reports.told_drift = drift, now_s

    def correction(self, told: ToldCorrection, now_s: float) -> None:
        """What the joint correction says of itself."""
        self._reports.told_correction = told, now_s

    def answered(self, number: int, answer: DriverAnswer) -> None:
        """What came of a request."""
        self._cell.answered(number, answer)

    def run(self, cycle_id: str, gap_s: float, now_s: float, wall_ns: int) -> CycleResult:
        """Begin a cycle; one that runs or has ended gives what it has, and nothing runs twice.

        Raises `RobocalError` when it cannot begin: CONFLICT in a fault, while another one runs or a
        stop was not seen yet, or while the gap is not open; TOO_FEW_SAMPLES while joint states are
        silent; LIMIT_EXCEEDED, and a fault, where the robot is not at home; STORAGE_FAILED.
        """
        if not 0 < len(cycle_id) <= MOST_ID:
            raise InputError(f"cycle id of {len(cycle_id)} characters: 1 to {MOST_ID} are wanted")
        if (known := self.result(cycle_id)) is not None:
            return known
        cell, memory = self._cell, self.memory
        cell.now_s = now_s
        if memory.fault:
            raise ConflictError(f"fault: {memory.fault}; acknowledge it first")
        if (open_run := self._conductor.run) is not None:
            raise ConflictError(f"cycle '{open_run.result.cycle_id}' runs: let it end")
        cell.tool.require_disarmed()
        self.robot.require_stopped()
        if why := self._second or cell.gap.closed(now_s):
            raise ConflictError(f"{why}: the robot is not moved")
        cell.begin(gap_s)
        try:
            self.robot.require_home()
        except LimitError as error:
            self._conductor.fault(error.code, str(error))
            raise
        run = CycleRun(
            memory.begin(cycle_id, wall_ns),
            cell,
            self._book,
            self._visits,
            self._decider,
            memory,
            self._decided,
            lambda: self._reports.drift(cell.now_s),
        )
        run.at(wall_ns)
        self._conductor.begin(run)
        words = f"cycle '{cycle_id}' begins"
        self._tell(RUN, {"cycle_id": cycle_id, "gap_s": gap_s}, Code.ACCEPT, words)
        return run.result

    def cancel(self, reason: str) -> bool:
        """Break the cycle off: the robot stops and is brought home; whether one ran."""
        if self._conductor.run is None:
            return False
        if self._conductor.broken is None:
            self._conductor.break_off(Code.CONFLICT, reason)
        return True

    def decide(self, name: str, calibration_id: int, by: str, why: str, wall_ns: int) -> Outcome:
        """Accept, reject or roll back a calibration.

        Raises `RobocalError` when it is refused; `StaleError` where another revision is in force by
        now.
        """
        outcome = self._decider.decide(name, calibration_id, by, why, wall_ns)
        self._decided(outcome)
        return outcome

    def decide_only(self, name: str, by: str, wall_ns: int) -> Outcome:
        """The same without an id, see `Decider.decide_only`.

        Raises `RobocalError` when there is nothing to decide about; as `decide`.
        """
        outcomes = []
        for outcome in self._decider.decide_only(name, by, wall_ns):
            self._decided(outcome)
            outcomes.append(outcome)
        answer = next((outcome for outcome in outcomes if not outcome.done), outcomes[-1])
        return replace(answer, message="; ".join(outcome.message for outcome in outcomes))

    def acknowledge(self, by: str) -> str:
        """End a fault, in words; without one nothing happens.

        Raises `ConflictError` while the tool node has not confirmed that it is disarmed, and is not
        gone, or what it sent may still be driven, or while a stop was not seen yet;
        `TooFewSamplesError` while joint states are silent; `LimitError` while the robot is not at
        home; `StorageError` when it cannot be kept; the fault stays.
        """
        if not self.memory.fault:
            return "there is no fault"
        self._cell.tool.require_disarmed()
        self.robot.require_stopped()
        self.robot.require_home()
        words = f"acknowledged: {self.memory.fault}"
        self.memory.clear_fault()
        self._cell.doing = ""
        self._tell(ACKNOWLEDGE, {"by": by}, Code.ACCEPT, words)
        return words

    def tick(self, now_s: float, wall_ns: int) -> list[DriverRequest]:
        """Look at everything, and go on; what is to be carried out now, in this order."""
        cell, self._cell.now_s = self._cell, now_s
        cell.gap.look(now_s)
        cell.robot.watch.silence.look(now_s)
        self._conductor.tick(wall_ns)
        return cell.handed_out()

    def give_up(self, reason: str, now_s: float) -> list[DriverRequest]:
        """The driver goes: stop and disarm, to be carried out at once; a fault unless at home.

        Then call `close`.
        """
        self._cell.now_s = now_s
        self._conductor.give_up(reason, at_once=True)
        return self._cell.handed_out()

    def close(self) -> None:
        """Write what waited until the robot was told to stop."""
        self._conductor.keep()

    def worst_cases(self) -> dict[str, float]:
        """How long each step may take at the most, its way home included, s."""
        thermal = ThermalPart(self._cell, self._book)
        found = {"the first measuring pose": thermal.worst_s()} if self.ways.count else {}
        if self.config.T_base_laser is not None:
            worst_s = self._cell.tool_worst_s
            modes = (QUICK, FULL, *([LASER] if self.config.laser_frame_every_s > 0.0 else []))
            found |= {f"tool measurement ({mode})": worst_s(mode) for mode in modes}
        if self.config.fixture_poses is not None:
            found["the first fixture pose"] = FixturePart(self._cell, self._visits).worst_s()
        return found

    def result(self, cycle_id: str) -> CycleResult | None:
        """How a cycle ended, or how far it is; None where it is not known."""
        if (running := self.running) is not None and running.cycle_id == cycle_id:
            return running
        return self.memory.cycles.get(cycle_id)

    @property
    def running(self) -> CycleResult | None:
        """The cycle that runs, as far as it has come."""
        run = self._conductor.run
        return None if run is None else run.result

    @property
    def state(self) -> MaintenanceState:
        """What it is at."""
        if self.memory.fault:
            return MaintenanceState.FAULT
        if self._conductor.run is None:
            return MaintenanceState.IDLE
        return (
            MaintenanceState.RUNNING
            if self._conductor.broken is None
            else MaintenanceState.BREAKING_OFF
        )

    def status(self, now_s: float) -> Status:
        """Everything at once."""
        cell, memory, running = self._cell, self.memory, self.running
        last = next(reversed(memory.cycles.values()), None)
        named = last.cycle_id if last is not None else ""
        trouble = ""
        try:
            newest = *map(self._decider.newest, (THERMAL, TOOL)), self._decider.newest_fixture()
            thermal, tool, fixture = (found.id if found else 0 for found in newest)
            self._pending = thermal, tool, fixture
        except RobocalError as error:
            trouble = str(error)
        thermal, tool, fixture = self._pending
        return Status(
            state=self.state,
            cycle_id=named if running is None else running.cycle_id,
            doing=cell.doing,
            left_s=0.0 if running is None else max(cell.gap.left_s(now_s), 0.0),
            at_home=not cell.robot.beside_home(),
            disarmed=not cell.tool.doubted,
            last=last,
            thermal_pending=thermal,
            tool_pending=tool,
            fixture_pending=fixture,
            fault_code=memory.fault_code,
            fault=memory.fault,
            beat=cell.gap.beat,
            closed=cell.gap.closed(now_s),
            trouble=trouble,
        )

    def accuracy(self, now_s: float, wall_ns: int) -> Accuracy:
        """How accurate the robot is believed to be with model and tool in force."""
        thermal, tool = self._decider.head(THERMAL), self._decider.head(TOOL)
        return accuracy_of(
            self.config,
            self._reports.drift(now_s),
            self._reports.uncorrected(thermal, tool, now_s),
            self.memory,
            tool,
            thermal,
            wall_ns,
        )

    def _decided(self, outcome: Outcome) -> None:
        if not outcome.repeated:
            self._record(outcome.command, outcome)

    def _tell(self, name: str, arguments: dict[str, object], code: Code, words: str) -> None:
        command = Command(name, arguments)
        self._record(command, Outcome(command, code, words))
