# SPDX-License-Identifier: Apache-2.0
"""A simulated robot with a thermal and a tool node that may fail in any way, under one session."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from driven_robot import AheadMotion
from shift import warmed
from tool_driver import TAUGHT, noisy_cell
from tool_driver import config_of as tool_config

from robocal_ros.cell_sim.beams import joints_at
from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.history.history_records import THERMAL, TOOL, Proposal
from robocal_ros.kinematics.arm import model_document
from robocal_ros.maintenance import robot_interface as ask
from robocal_ros.maintenance.accuracy import MaintenanceConfig, Times
from robocal_ros.maintenance.mover import STATION, Ways
from robocal_ros.maintenance.robot_interface import DriverAnswer
from robocal_ros.maintenance.session import MaintenanceSession, MaintenanceState
from robocal_ros.motion.cell import DrivingConfig, Housing
from robocal_ros.motion.plan import JointPlan
from robocal_ros.thermal.accuracy import Accuracy, AccuracyLevel, ToolError
from robocal_ros.tool.judging import KnownTool
from robocal_ros.tool.run import made_with

TICK_S = 0.02
LAG_S = 0.02  # of the controller
BEAT_S = 0.2
STALE_S = 0.5
LATE_S = 0.04  # after a pause, until the beat that waited is delivered
WALL_NS = 1_700_000_000_000_000_000
LONG_S = 120.0  # a gap in which all fits
OK, REFUSED, SILENT, SLOW = "ok", "refused", "silent", "slow"
KNOWN = Accuracy(AccuracyLevel.OK, "95 % below", ToolError(1e-5, 2e-5), 600.0)

CELL = noisy_cell()
ARM = CELL.arm
HOUSING = Housing(clear_radius_m=0.06, top_m=0.03, floor_m=-0.12, retract_m=0.05)
DRIVING = DrivingConfig(HOUSING, 0.1, 0.008, 0.05)


def _above(height_m: float) -> np.ndarray:
    pose = CELL.pose(TAUGHT, 0.0)
    pose[:3, 3] += height_m * CELL.up
    return joints_at(ARM, pose[None], CELL.q_near)[0]


HOME, AT_BEAMS = _above(0.10), _above(0.004)
POSES = HOME + np.radians([[20.0, 5, 0, 0, 0, 0], [25.0, 0, 10, 0, 5, 0], [10.0, 0, 10, 0, 0, 8]])
MANY_POSES = np.tile(POSES, (3, 1))  # more than fit the shortest gap that does
FIXTURE_POSES = HOME + np.radians([[-15.0, 4, 0, 0, 0, 0], [-25.0, 0, 8, 0, 5, 0]])
TIMES = Times(
    answer_s=0.5,
    solve_s=0.5,
    settle_s=0.1,
    stay_s=0.1,
    measure_s=0.5,
    check_s=6.0,
    full_s=8.0,
    tool_home_s=3.5,
    reserve_s=0.3,
    rest_s=2.0,
    stale_s=STALE_S,
)


def config_of(**changes: Any) -> MaintenanceConfig:
    settings = {
        "home": HOME,
        "poses": POSES,
        "T_flange_tool": TAUGHT,
        "driving": DRIVING,
        "T_base_laser": CELL.laser.T_base_laser,
        "times": TIMES,
        "correction_silent_s": 0.0,  # the controller takes model and tool itself
    }
    return MaintenanceConfig(**(settings | changes))


def backwards(plan: JointPlan) -> JointPlan:
    return JointPlan(
        plan.time_s[-1] - plan.time_s[::-1], plan.q[::-1], -plan.qd[::-1], plan.qdd[::-1]
    )


DOWN = backwards(Ways(ARM, config_of()).home(STATION, AT_BEAMS).plan)  # as the tool node goes


class Shelf:
    """Keeps a document; may be full, or slow: ``takes`` passes the time of a write."""

    path = Path("shelf")

    def __init__(self) -> None:
        self.document: dict[str, Any] | None = None
        self.takes: Callable[[], None] = lambda: None

    def load(self) -> dict[str, Any] | None:
        return self.document

    def save(self, document: Any) -> None:
        self.takes()
        self.document = dict(document)


@dataclass
class NeverError(Exception):
    """The session did what it must never do."""

    words: str


@dataclass
class ToolNode:
    """Moves the robot by itself, once armed."""

    there: bool = True
    armed: bool = False
    measuring: int = 0  # number of the request
    until_s: float = 0.0


@dataclass
class Cell:
    """Robot, nodes and PLC around one session, in steps of `TICK_S`."""

    history: Any
    config: MaintenanceConfig = field(default_factory=config_of)
    shelf: Shelf = field(default_factory=Shelf)
    services: dict[str, str] = field(default_factory=dict)
    thermal: DriverAnswer = field(
        default_factory=lambda: DriverAnswer(Code.NO_SIGNIFICANT_GAIN, "warm")
    )
    check: DriverAnswer = field(default_factory=lambda: passed())
    fixture: DriverAnswer = field(
        default_factory=lambda: DriverAnswer(Code.ACCEPT, "plate moved by 0.50 mm", 9)
    )
    full: Callable[["Cell"], DriverAnswer] = field(default=lambda cell: same_tool())
    drift: Accuracy | None = None  # told by the thermal node
    silent: bool = False  # joint states
    measures_every: int = 5  # ticks
    planning_s: float = 0.0  # to make and send the next motion

    def __post_init__(self) -> None:
        self.now_s = 10.0
        self.motion = AheadMotion(HOME)
        self.coming: list[tuple[float, JointPlan]] = []
        self.due: list[tuple[float, int, DriverAnswer]] = []
        self.tool = ToolNode()
        self.is_open, self.beating, self.beat_s, self.heard = False, True, -np.inf, False
        self.beats_every_s = BEAT_S
        # a heartbeat with its echo, and when it is delivered
        self.waiting: tuple[float, bool, int] | None = None
        self.counted_s, self.read = -np.inf, 0  # the newest beat: when it was counted; as read
        self.offset = np.zeros(ARM.n)
        self.clock_s = 0.0  # the joints' own clock, ahead of all others
        self.log: list[ask.DriverRequest] = []
        self.events: list[tuple[str, Any]] = []
        self.begun: list[str] = []
        self.ends_s = -np.inf
        self.q = HOME.copy()
        self.moved_s = -np.inf  # when the true robot last moved
        self.restart()

    def restart(self) -> None:
        """Another session on the same shelf; answers to the one before may still come."""
        self.tool.measuring *= -1
        self.session = MaintenanceSession(ARM, self.history, self.config, self.shelf, self._event)

    def _event(self, command: Any, outcome: Any) -> None:
        self.events.append((command.name, outcome))

    # ---- the PLC --------------------------------------------------------------------------------

    def open_gap(self) -> None:
        self.is_open = self.beating = True
        self.pass_time(3.0 * BEAT_S)  # a beat, its reading, its echo

    def run(self, cycle_id: str, gap_s: float) -> Code:
        """Call; a run that truly begins is noted."""
        known, begin_s = self.session.result(cycle_id) is not None, self.now_s
        try:
            self.session.run(cycle_id, gap_s, begin_s, self.wall_ns)
        except RobocalError as error:
            return error.code
        if not known:
            if cycle_id in self.begun:
                raise NeverError(f"cycle {cycle_id} ran twice")
            self.begun.append(cycle_id)
            self.ends_s = begin_s + gap_s
        return Code.ACCEPT

    def finish(self, within_s: float = 200.0) -> Any:
        """Until the run has ended; its result."""
        end_s = self.now_s + within_s
        while self.state in (MaintenanceState.RUNNING, MaintenanceState.BREAKING_OFF):
            self.step()
            assert self.now_s < end_s, self.session.status(self.now_s)
        return self.session.status(self.now_s).last

    def ran(self, cycle_id: str, gap_s: float = LONG_S) -> Any:
        """A whole run; its result."""
        self.run(cycle_id, gap_s)
        return self.finish()

    def broken_off(self, cycle_id: str, pose: int) -> Any:
        """A run that is cancelled on the robot's way to a measuring pose; its result."""
        self.run(cycle_id, LONG_S)
        while f"way to measuring pose {pose}" not in self.session.status(self.now_s).doing:
            self.step()
        self.session.cancel("by hand")
        return self.finish()

    @property
    def state(self) -> MaintenanceState:
        return self.session.state

    @property
    def wall_ns(self) -> int:
        return WALL_NS + round(self.now_s * 1e9)

    # ---- time -----------------------------------------------------------------------------------

    def pause(self, seconds: float) -> None:
        """The session's process stands still; of the beats that come the newest waits for it."""
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += TICK_S
            self._controller_goes_on()
            if self._beat_is_due():
                self.beat_s = self.now_s
                self.waiting = end_s + LATE_S, self.is_open, self.read

    def pass_time(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.step()

    def step(self) -> None:
        self.now_s += TICK_S
        self._beat()
        self._controller_goes_on()
        self._tool_goes_on()
        if not self.silent:
            self.session.reading(self.now_s + self.clock_s, self.q + self.offset, self.now_s)
        due = round(self.now_s / TICK_S) % self.measures_every == 0
        if due and self.services.get("sensor") != SILENT:
            self.session.measured(self.now_s)
        if due and self.services.get("features") != SILENT:
            self.session.measured(self.now_s, of_fixture=True)
        for item in [item for item in self.due if item[0] <= self.now_s]:
            self.due.remove(item)
            self.session.answered(item[1], item[2])
        for request in self.session.tick(self.now_s, self.wall_ns):
            self._carry_out(request)

    def _controller_goes_on(self) -> None:
        while self.coming and self.coming[0][0] <= self.now_s:
            at_s, plan = self.coming.pop(0)
            time_s, q, qd = plan.points()
            self.motion.follow(self.now_s, time_s + at_s, q, qd)
        q = self.motion.now(self.now_s)
        if np.max(np.abs(q - self.q)) > 1e-7:
            self.moved_s = self.now_s
        self.q = q

    def _beat_is_due(self) -> bool:
        return self.beating and self.now_s >= self.beat_s + self.beats_every_s

    def _beat(self) -> None:
        if self.waiting is not None and self.now_s >= self.waiting[0]:
            (_, self.heard, echo), self.waiting = self.waiting, None
            self.session.gap(self.heard, echo, self.now_s)
        if self._beat_is_due():
            self.beat_s, self.heard = self.now_s, self.is_open
            self.session.gap(self.is_open, self.read, self.now_s)
        if self.now_s >= self.counted_s + BEAT_S:  # the PLC reads it in its next cycle
            self.counted_s, self.read = self.now_s, self.session.beat(self.now_s)
        if self.drift is not None:
            self.session.drift(self.drift, self.now_s)

    # ---- the nodes ------------------------------------------------------------------------------

    def _carry_out(self, request: ask.DriverRequest) -> None:
        self.log.append(request)
        if isinstance(request, ask.Move | ask.Arm | ask.Measure):
            self._require_allowed(request)
        if isinstance(request, ask.Move):
            self._require_fit(request)
            self._require_taught(request.plan)
        match request:
            case ask.Move():
                self.pause(self.planning_s)
                self.planning_s = 0.0
                self.coming.append((self.now_s + LAG_S, request.plan))
                self.session.sent(self.now_s)
            case ask.Stop():
                self.coming.append((self.now_s + LAG_S, request.plan))
            case ask.Arm() | ask.Disarm() if not self.tool.there:
                gone = DriverAnswer(Code.CONFLICT, "not there: start its node", absent=True)
                self.session.answered(request.number, gone)
            case ask.BeginCycle() | ask.EndCycle():
                self._answer("thermal", request.number, self.thermal)
                if isinstance(request, ask.BeginCycle):
                    self._answer("thermal", request.number, DriverAnswer(Code.ACCEPT))
            case ask.BeginFixture():
                self._answer("fixture", request.number, DriverAnswer(Code.ACCEPT))
            case ask.MeasureFixture():
                self._answer("fixture", request.number, self.fixture)
            case ask.Arm():
                if self.services.get("arm", OK) in (OK, SLOW):
                    self.tool.armed = True
                self._answer("arm", request.number, DriverAnswer(Code.ACCEPT))
            case ask.Disarm():
                if self.services.get("disarm", OK) != SILENT:
                    self._halt_tool("disarmed")
                    self.tool.armed = False
                    self._answer("disarm", request.number, DriverAnswer(Code.ACCEPT))
            case ask.CancelMeasure():
                if self.services.get("cancel", OK) == OK:
                    self._halt_tool("cancelled")
            case ask.Measure():
                self._measure(request)

    def _answer(self, service: str, number: int, answer: DriverAnswer) -> None:
        how = self.services.get(service, OK)
        if how == SILENT or any(item[1] == number for item in self.due):
            self.due = [i if i[1] != number else (i[0], number, answer) for i in self.due]
            return
        if how == REFUSED:
            answer = DriverAnswer(Code.CONFLICT, f"{service} refuses")
        self.due.append((self.now_s + (0.4 if how == SLOW else 0.03), number, answer))

    def _measure(self, request: ask.Measure) -> None:
        how = self.services.get("measure", OK)
        if not self.tool.armed or how == REFUSED:
            self.due.append(
                (self.now_s + 0.03, request.number, DriverAnswer(Code.CONFLICT, "not armed"))
            )
            return
        self.tool.measuring = request.number
        long = {SLOW: 60.0, SILENT: np.inf}.get(how, 1.0)
        self.tool.until_s = self.now_s + DOWN.duration_s + long
        self.mode = request.mode
        if np.max(np.abs(self.q - HOME)) < 0.01:
            self.motion.follow(self.now_s, DOWN.time_s + self.now_s, DOWN.q, DOWN.qd)

    def tool_dies(self) -> None:
        """Its process ends; what it sent to the controller is driven to its end."""
        self.tool = ToolNode(there=False)

    def _tool_goes_on(self) -> None:
        if self.tool.measuring and self.now_s >= self.tool.until_s:
            found = self.check if self.mode == "quick" else self.full(self)
            self.due.append((self.now_s, self.tool.measuring, found))
            self.tool.measuring, self.tool.armed = 0, False

    def _halt_tool(self, why: str) -> None:
        if self.tool.measuring:
            self.motion.hold(self.now_s)
            self.due.append(
                (self.now_s + 0.03, self.tool.measuring, DriverAnswer(Code.CONFLICT, why))
            )
            self.tool.measuring, self.tool.armed = 0, False

    # ---- what must never be ---------------------------------------------------------------------

    def _require_allowed(self, request: ask.DriverRequest) -> None:
        if not self.heard or self.now_s - self.beat_s > STALE_S:
            raise NeverError(f"{type(request).__name__} while the gap is closed or stale")
        if isinstance(request, ask.Move) and self.tool.armed:
            raise NeverError("a motion while the tool node is armed")

    def _require_fit(self, request: ask.Move) -> None:
        """The plan, and the straight way home from its end at full speed, within what is left."""
        plan = request.plan
        velocity = np.max(np.asarray(DRIVING.limits.joint_velocity))
        shortest_s = float(np.max(np.abs(plan.q[-1] - HOME)) / velocity)
        if self.now_s + plan.duration_s + shortest_s > self.ends_s:
            raise NeverError("a motion that does not fit the gap with the way home")
        if request.worst_s < plan.duration_s or self.now_s + request.worst_s > self.ends_s:
            raise NeverError("a step whose worst case does not fit the gap")

    def _require_taught(self, plan: JointPlan) -> None:
        """A way to a pose follows the taught lines, all of it."""
        if np.max(np.abs(plan.q[-1] - HOME)) < 1e-9:
            return
        rings = [self.config.poses, self.config.fixture_poses]
        lines = [
            line
            for poses in rings
            if poses is not None
            for line in pairwise(np.vstack([HOME, poses, HOME]))
            if len(poses)
        ]
        beside = np.full(len(plan.q), np.inf)
        for start, end in lines:
            share = np.clip((plan.q - start) @ (end - start) / np.sum((end - start) ** 2), 0.0, 1.0)
            away = np.max(np.abs(start + share[:, None] * (end - start) - plan.q), axis=1)
            beside = np.minimum(beside, away)
        if np.max(beside) > self.config.home_near + 1e-6:
            raise NeverError("a way that nobody taught")

    def at_home(self) -> bool:
        return bool(np.max(np.abs(self.q - HOME)) <= self.config.home_near)


def opened(history: Any, **changes: Any) -> Cell:
    """A cell in an open gap, after what every start does."""
    cell = Cell(history, **changes)
    cell.open_gap()
    assert kinds(cell) == ["Disarm"]  # whatever the node before it left
    cell.log.clear()
    return cell


def kinds(cell: Cell) -> list[str]:
    return [type(request).__name__ for request in cell.log]


def kept(history: Any, kind: str, model: dict[str, Any], code: Code = Code.ACCEPT) -> int:
    """A candidate; one that may be accepted."""
    return history.propose(
        Proposal(
            kind=kind, model_hash=ARM.model_hash, based_on=history.head(kind).revision,
            cycle_id="", stamp_ns=0, created_ns=0, software="", method="", code=code,
            reason="", document={}, model=model,
        )
    )  # fmt: skip


def thermal_proposed(history: Any, kelvin: float) -> int:
    """A thermal candidate: a robot with grown links."""
    return kept(history, THERMAL, model_document(warmed(ARM, kelvin)))


def proposed(
    history: Any,
    shift_m: Sequence[float] = (1e-3, 0.0, 0.0),
    thermal_revision: int | None = None,
    cause: str = "tool",
    **made_otherwise: Any,
) -> int:
    """A tool candidate beside the taught one, as the tool node keeps it."""
    tool = KnownTool(TAUGHT.copy())
    tool.T_flange_tool[:3, 3] += shift_m
    if thermal_revision is None:
        thermal_revision = history.head(THERMAL).revision
    made = made_with(tool_config(CELL, **made_otherwise))
    model = {"thermal_revision": thermal_revision, "made_with": made, "cause": cause}
    return kept(history, TOOL, tool.document() | model)


def new_tool(number: int) -> DriverAnswer:
    """The answer of a full measurement that led to a candidate."""
    return DriverAnswer(Code.ACCEPT, "a new tool", number, (), True, "", 1.0, 0.03)


def passed() -> DriverAnswer:
    return DriverAnswer(Code.ACCEPT, "pass: 0.05 mm", 0, (), True, "pass", 0.05, 0.03)


def bent() -> DriverAnswer:
    return DriverAnswer(Code.LIMIT_EXCEEDED, "recalibrate", 0, (), True, "recalibrate", 1.5, 0.03)


def same_tool() -> DriverAnswer:
    return DriverAnswer(Code.NO_SIGNIFICANT_GAIN, "same tool", 1, (), True, "", 0.02, 0.03)


def wrong_tool() -> DriverAnswer:
    return DriverAnswer(Code.WRONG_TOOL, "5 mm too thick: another tool is mounted")


def over(cell: Cell, *, fault: bool = False) -> None:
    """The robot stands and is disarmed; at home where there is no fault."""
    cell.pass_time(1.5)
    assert not cell.tool.armed
    assert cell.now_s - cell.moved_s > 1.0
    assert (cell.state is MaintenanceState.FAULT) == fault
    assert fault or cell.at_home()


def until_moving(cell: Cell, which: str) -> None:
    cell.run("c1", LONG_S)
    if which == "tool":
        while not cell.tool.measuring:
            cell.step()
        cell.pass_time(1.0)
    else:
        while cell.motion.at([cell.now_s])[1].max() < 0.1:
            cell.step()
