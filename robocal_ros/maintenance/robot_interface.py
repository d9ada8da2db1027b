# SPDX-License-Identifier: Apache-2.0
"""What a cycle does with robot and nodes: requests to the driver, and waits for the answers.

A script is a generator: it yields whenever it has to wait, and is resumed at the next tick.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from itertools import count
from typing import Any, TypeVar

import numpy as np

from robocal_ros.ground.errors import Code, ConflictError, LimitError
from robocal_ros.ground.frames import Array
from robocal_ros.maintenance.accuracy import MaintenanceConfig
from robocal_ros.maintenance.mover import HOME, STATION, FaultError, Mover, Route, Ways
from robocal_ros.motion.plan import JointPlan
from robocal_ros.motion.robot_watch import Gap
from robocal_ros.tool.driving import SETTLED_S, STANDS_S
from robocal_ros.tool.session import LASER, QUICK


@dataclass(frozen=True)
class DriverRequest:
    """Asked of the driver; ``number`` comes back with the answer."""

    number: int


@dataclass(frozen=True)
class BeginCycle(DriverRequest):
    """Open a thermal cycle (`ThermalSession`, `thermal_node` ``~/begin_cycle``)."""

    cycle_id: str


@dataclass(frozen=True)
class EndCycle(DriverRequest):
    """End it and identify the model; the answer carries the candidate."""

    cycle_id: str


@dataclass(frozen=True)
class BeginFixture(DriverRequest):
    """Let the fixture's points count from now (`FixtureSession`, `fixture_node` ``~/start``)."""


@dataclass(frozen=True)
class MeasureFixture(DriverRequest):
    """Judge them; the answer carries the candidate."""


@dataclass(frozen=True)
class Arm(DriverRequest):
    """Let the tool's driver move the robot (`ToolDriver.arm`, `tcf_node` ``~/arm``)."""


@dataclass(frozen=True)
class Disarm(DriverRequest):
    """Forbid it; a motion of its own is stopped at once."""


@dataclass(frozen=True)
class Measure(DriverRequest):
    """Measure the tool; ``mode`` of `tool.session`. Answered when the run has ended."""

    mode: str
    cycle_id: str


@dataclass(frozen=True)
class CancelMeasure(DriverRequest):
    """Break the open tool run off; its `Measure` is answered."""


@dataclass(frozen=True)
class Move(DriverRequest):
    """Send a plan to the controller; reported by `MaintenanceSession.reported`.

    ``worst_s``: until the robot is back at home at the latest, counted from now.
    """

    plan: JointPlan
    worst_s: float


@dataclass(frozen=True)
class Stop(DriverRequest):
    """Send a stop to the controller."""

    plan: JointPlan


@dataclass(frozen=True)
class HardStop(DriverRequest):
    """Stop a robot that does not obey its controller by other means, where there are any."""

    why: str


@dataclass(frozen=True)
class DriverAnswer:
    """What came of a request."""

    code: Code  # ACCEPT when done, else why not; a verdict where there is one
    message: str = ""
    candidate_id: int = 0  # calibration in the history, else 0
    missing: tuple[int, ...] = ()  # numbers, from 1, of the cold poses that were not measured
    has_result: bool = False  # whether a measurement reached one
    answer: str = ""  # of a quick check: "pass", "recalibrate", "cannot tell"
    # deviation_mm, sigma_mm: of the tip from the tool in force
    deviation_mm: float = 0.0
    sigma_mm: float = 0.0
    left_plan: bool = False  # the robot was stopped because it left its plan
    absent: bool = False  # the request reached nobody, as the node is not there
    visited: int | None = None  # number of those that were; None where that is not told

    @property
    def done(self) -> bool:
        """Whether it did what was asked."""
        return self.code is Code.ACCEPT


R = TypeVar("R")
Script = Generator[None, None, R]


class SilentError(ConflictError):
    """A node did not answer in time."""


class Asking:
    """What was asked and who waits for an answer; times of a steady clock.

    ``now_s``: of the tick. ``out``: requests that wait to be carried out.
    """

    # of all in a process: a late answer to one that is gone is not taken for another's
    _numbers = count(1)

    def __init__(self) -> None:
        self.now_s = 0.0
        self.out: list[DriverRequest] = []
        self._waiting: dict[int, DriverAnswer | None] = {}

    def handed_out(self) -> list[DriverRequest]:
        """The requests that wait; they are somebody else's now."""
        found, self.out = self.out, []
        return found

    def request(self, kind: Callable[..., DriverRequest], *given: Any) -> int:
        """Ask, without waiting; its number."""
        number = next(self._numbers)
        self.out.append(kind(number, *given))
        return number

    def answered(self, number: int, answer: DriverAnswer) -> None:
        """An answer came; one that nobody waits for is none."""
        if number in self._waiting:
            self._waiting[number] = answer

    def expect(self, kind: Callable[..., DriverRequest], *given: Any) -> int:
        """Ask; `waited_for` gives the answer."""
        number = self.request(kind, *given)
        self._waiting[number] = None
        return number

    def waited_for(self, number: int, within_s: float, what: str) -> Script[DriverAnswer]:
        """Wait for an answer. Raises `SilentError` when it does not come in time."""
        until_s = self.now_s + within_s
        while (answer := self._waiting[number]) is None:
            if self.now_s >= until_s:
                del self._waiting[number]
                raise SilentError(f"{what}: no answer within {within_s:g} s")
            yield
        del self._waiting[number]
        return answer

    def ask(self, within_s: float, what: str, kind: Any, *given: Any) -> Script[DriverAnswer]:
        """Ask and wait, as `waited_for`."""
        return (yield from self.waited_for(self.expect(kind, *given), within_s, what))

    def forget_answers(self) -> None:
        """Nobody waits any more."""
        self._waiting.clear()


# Safety case: nothing moves, and no fault is acknowledged, while another node might move the
# robot. Only its own confirmation ends that doubt; a node that hangs gives none, and may be
# moving. One that is not there at all can give none either, and would block the cell for ever. It
# is let go where it cannot move anything: its service has not existed for `GONE_S`, with each
# disarm that was asked (a node that starts is found sooner, and starts disarmed); this node has
# not armed it since the last confirmed disarm, so that no motion that was asked for here can be
# under way, not the rest of a dead node's trajectory either; and the robot rests at home
# (`CellInterface` looks).
#
# A node that was started anew confirms too, but knows nothing of that trajectory. So a
# confirmation tells what will be sent; what was sent before it is over where the measurement has
# been answered, or was stopped from here, and the robot rests: until then it is in doubt as well.


AGAIN_S = 0.5
GONE_S = 5.0
MOST_ASKED = 20  # that may be answered yet: of those that wait for a node DDS keeps ten
SENT = "what the tool node sent may still be driven"


class Disarming:
    """What is known of the tool's driver; times of a steady clock.

    ``engaged``: it may be armed. ``armed``: this node armed it, and what it was to move may still
    be under way.
    """

    def __init__(self) -> None:
        self.engaged = self.armed = False
        self._asked: set[int] = set()
        self._newest, self._heard = 0, False
        self._asked_s = -np.inf
        self._absent_from_s = np.inf

    def doubt(self) -> None:
        """Nobody knows; what is still to come of older disarms was carried out before this."""
        self.engaged, self._heard = True, False
        self._asked.clear()

    def asked(self, number: int, now_s: float) -> None:
        """A disarm was asked for; one before that nobody answered is the silence of a node."""
        if self._newest in self._asked:
            self._absent_from_s = np.inf
        self._asked.add(number)
        if len(self._asked) > MOST_ASKED:  # the node hangs, for days perhaps
            self._asked.remove(min(self._asked))
        self._newest, self._heard, self._asked_s = number, False, now_s

    def answered(self, number: int, answer: DriverAnswer, now_s: float) -> None:
        """What came of a disarm; of anything else nothing follows."""
        if number not in self._asked:
            return
        self._asked.discard(number)
        self._heard |= number == self._newest
        if answer.done:
            self.engaged = False
        self._absent_from_s = min(self._absent_from_s, now_s) if answer.absent else np.inf

    def again(self, now_s: float) -> bool:
        """Whether to ask again."""
        return self.engaged and now_s >= self._asked_s + AGAIN_S

    @property
    def doubted(self) -> bool:
        """Whether it may move the robot, or the controller what it sent."""
        return self.engaged or self.armed

    @property
    def absent(self) -> bool:
        """Whether the driver is not there, as far as the newest answer tells."""
        return bool(self._absent_from_s < np.inf)

    def gone(self, now_s: float) -> bool:
        """Whether it cannot move a robot that rests at home."""
        return self._heard and not self.armed and now_s >= self._absent_from_s + GONE_S

    def advice(self) -> str:
        """What a person can do."""
        if self.absent:
            return "the tool node is not there: start it, or leave 'laser' empty"
        return "the tool node is silent: wait for it, or start it anew"

    def require_disarmed(self) -> None:
        """Refuse, with a `ConflictError`, what needs a robot that nothing moves from there."""
        if self.engaged:
            words = "the tool node has not confirmed that it is disarmed"
            raise ConflictError(f"{words}; {self.advice()}")
        if self.armed:
            raise ConflictError(f"{SENT}: wait until the robot rests")


DEAF_S = 0.1  # a driver that has not confirmed a disarm by then may not be stopping the robot


class CellInterface(Asking):
    """Robot, gap and the requests to other nodes; times of a steady clock.

    ``tool``: whether the tool's driver may move the robot. ``gap_s``: length of the gap as it was
    called. ``left_home``: whether something may
    have moved the robot since the run began. ``measured``: stamps of measurements of the flange's
    target, on the joints' clock, newest last; ``features``: of the fixture. ``doing``: what goes
    on, in words. ``tool_home_s``: for the way home from the beams; the longest so far where that
    took longer. ``ways``, ``fixture_ways``: the rings of the measuring poses and of the fixture's
    (None: it is not measured); ``robot.ways``: the one that it is on.
    """

    def __init__(
        self, config: MaintenanceConfig, ways: Ways, fixture_ways: Ways | None = None
    ) -> None:
        super().__init__()
        self.config, self.ways, self.fixture_ways = config, ways, fixture_ways
        self.robot = Mover(config, ways)
        self.gap = Gap(config.times.stale_s)
        self.tool = Disarming()
        self.gap_s = 0.0
        self.left_home = False
        self.measured: list[float] = []
        self.features: list[float] = []
        self.doing = ""
        self.tool_home_s = config.times.tool_home_s
        self._deaf_s = np.inf  # from when on the robot is stopped in the driver's place
        self._told_s = -np.inf  # newest reading at the last confirmation, or stop in its place
        self._failed = ""  # of the last stop, as it was acted upon
        self._measuring = 0  # number of the measurement that the driver has not answered

    def fits(self, worst_s: float) -> bool:
        """Whether something that lasts so long at the most, way home included, fits the gap."""
        lasts_s = self.robot.lasts_s(worst_s)
        return lasts_s + self.config.times.reserve_s <= self.gap.left_s(self.now_s)

    def too_short(self, worst_s: float) -> str:
        """By how much the gap is too short for something, and which would do; empty: it fits."""
        if self.fits(worst_s):
            return ""
        needs_s = self.robot.lasts_s(worst_s) + self.config.times.reserve_s
        short_s = needs_s - self.gap.left_s(self.now_s)
        would_s = np.ceil(self.gap_s + short_s + 0.5)  # with what went before in this one
        return f"the gap is {short_s:.1f} s too short, one of {would_s:.0f} s would do"

    def run_s(self, mode: str) -> float:
        """How long a tool measurement may take at the most."""
        times = self.config.times
        return {QUICK: times.check_s, LASER: times.laser_frame_s}.get(mode, times.full_s)

    def tool_worst_s(self, mode: str) -> float:
        """A tool measurement, from home or the station, and home: all that may go wrong in it."""
        times = self.config.times
        # Stand, arm, run, its end after a cancel, disarm, stand twice, way home, rest.
        return self.run_s(mode) + 3.0 * times.answer_s + 4.0 * times.rest_s + self.tool_home_s

    def begin(self, gap_s: float) -> None:
        """A run is to begin, with the robot at home."""
        self.gap.begin(gap_s, self.now_s)
        self.gap_s = gap_s
        self.robot.place, self.left_home, self.robot.ways = (HOME, HOME), False, self.ways

    def not_handed_over(self) -> bool:
        """Whether the robot is not at rest at home with nobody who may move it."""
        robot = self.robot
        rests = robot.watch.resting(STANDS_S) is not None and not robot.moving
        return self.tool.doubted or not rests or bool(robot.beside_home())

    def doubt(self) -> None:
        """Nobody knows whether the tool's driver is armed; without a station there is none."""
        if self.config.T_base_laser is not None:
            self.tool.doubt()

    def answered(self, number: int, answer: DriverAnswer) -> None:
        """An answer came; one that nobody waits for is none."""
        doubted = self.tool.engaged
        self.tool.answered(number, answer, self.now_s)
        if doubted and not self.tool.engaged:
            self._told_s = self.robot.newest_s
        if number == self._measuring:
            self._measuring = 0
        super().answered(number, answer)

    def arm(self) -> Script[DriverAnswer]:
        """Arm the tool's driver; from now on it may have the robot anywhere at the station."""
        self.doubt()
        self.tool.armed, self._deaf_s, self.left_home = True, np.inf, True
        self.robot.place = STATION
        answer = yield from self.ask(self.config.times.answer_s, "tool node, arm", Arm)
        self.tool.armed = not answer.absent
        return answer

    def disengage(self) -> None:
        """Break its run off and disarm it, at once; again and again until it is confirmed."""
        self.request(CancelMeasure)
        self._ask_disarm()

    def look_after_tool(self) -> None:
        """Stop what its driver does not; do not wait for one that is gone, see `disarming`.

        Who has not answered its measurement may be another one: a robot that stands may then be at
        a corner of what was sent before, where plans rest for a while, and is held.
        """
        tool, robot, stopping = self.tool, self.robot, self.robot.stopping
        if (plan := stopping.look(robot.watch, self.now_s)) is not None:
            self.request(Stop, plan)  # the robot does not obey: sent again
        if stopping.failed != self._failed:
            self._failed = stopping.failed
            if self._failed:
                self.request(HardStop, self._failed)
        rests = robot.watch.resting(STANDS_S) is not None
        self._told_s = min(self._told_s, robot.newest_s)  # their clock may have begun anew
        since_s = robot.newest_s - self._told_s  # readings that are late do not count against it
        if tool.armed and tool.engaged:
            if self.now_s >= self._deaf_s:
                self._stop_measured()
        elif tool.armed:
            tool.armed = not rests or since_s < STANDS_S or self._measuring > 0
            moves = robot.watch.resting(SETTLED_S) is None or self._measuring > 0
            if moves and since_s >= robot.stops_within_s:
                self._stop_measured()
        if tool.gone(self.now_s) and not robot.beside_home():
            tool.engaged &= not rests

    @property
    def stopping(self) -> bool:
        """Whether the stop of what the tool's driver moves may still be this node's to send."""
        return self.tool.armed and (not self.tool.engaged or self._deaf_s < np.inf)

    def keep_disarming(self) -> None:
        """Ask again where nobody confirmed."""
        if self.tool.again(self.now_s):
            self._ask_disarm()

    def disarmed(self) -> Script[None]:
        """Wait until it is confirmed.

        Raises `FaultError` when it is not: then the robot must not be moved from here.
        """
        self._ask_disarm()
        until_s = self.now_s + self.config.times.answer_s
        while self.tool.engaged:
            if self.now_s >= until_s:
                words = f"the tool node does not confirm that it disarmed; {self.tool.advice()}"
                raise FaultError(Code.CONFLICT, words)
            yield

    def _ask_disarm(self) -> None:
        self.tool.asked(self.request(Disarm), self.now_s)

    def measure(self, mode: str, cycle_id: str, limit_s: float) -> Script[DriverAnswer]:
        """Let the armed driver measure, for a limited time; a longer run is broken off.

        The time is that of the robot's clock, which a speed scaling that is told stretches.

        Raises `SilentError` when it did not end in time, and not after it was broken off either.
        """
        number = self._measuring = self.expect(Measure, mode, cycle_id)
        before_s = self.now_s
        while self._waiting[number] is None and limit_s > 0.0:
            yield
            limit_s -= (self.now_s - before_s) * self.robot.watch.scaling
            before_s = self.now_s
        if self._waiting[number] is None:
            self.disengage()
        return (yield from self.waited_for(number, self.config.times.answer_s, f"tool, {mode}"))

    def stand(self, span_s: float = SETTLED_S) -> Script[Array]:
        """Wait until the robot rests, and nothing that this node armed moves it; its joints (n,).

        Raises `FaultError` when joint states are silent, it does not come to rest, or is not handed
        over.
        """
        until_s = self.now_s + self.config.times.rest_s
        while (q := self.robot.watch.resting(span_s)) is None or self.tool.armed:
            if self.now_s >= until_s:
                self.robot.require_heard("so that nobody knows whether the robot rests")
                moves = "the robot does not come to rest"
                words = moves if q is None else f"the robot rests, but {SENT}"
                raise FaultError(Code.CONFLICT, words)
            yield
        return q

    def measured_at(self, q: Array, stamps: list[float]) -> Script[bool]:
        """Stand at joints (n,) until the measurements are there; False: their time is over.

        ``stamps``: `measured` or `features`.
        """
        times, count = self.config.times, self.config.measurements
        from_s = self.robot.newest_s + times.settle_s
        until_s = self.now_s + times.measure_s
        stamps.clear()
        while self.now_s < until_s:
            self.robot.require_at(q)
            fresh = sorted(stamp for stamp in stamps if stamp >= from_s)
            enough = fresh[:count]  # more may come, faster than the stay ends
            if len(enough) == count and self.robot.newest_s >= enough[-1] + times.stay_s:
                return True
            yield
        return False

    def drive(self, route: Route, worst_s: float) -> Script[None]:
        """Send a route and wait until it is over; supervised by the session.

        Raises `FaultError` when the robot does not rest where the route begins, on a taught way;
        `LimitError` when the robot is so slow or so late that the step does not fit the gap any
        more.
        """
        self.robot.require_heard("where the way of the robot begins")
        q = self.robot.watch.resting(SETTLED_S)
        if q is None:
            raise FaultError(Code.CONFLICT, "the robot does not rest where its way begins")
        self.robot.require_at(route.plan.q[0])
        self.robot.require_taught(q)
        self.robot.start(route, self.now_s)
        self.left_home = True
        self.request(Move, route.plan, worst_s)
        while not self.robot.arrived(self.now_s):
            if self.robot.worst_left_s(worst_s, self.now_s) > self.gap.left_s(self.now_s):
                raise LimitError("the robot is slower than planned: this step does not fit the gap")
            yield

    def halt(self, at_once: bool = False) -> None:
        """Stop what this node moves; what the tool's driver moves only where that is deaf.

        A driver that hears stops by itself, from its own plan. The readings lag behind that, so
        that a stop from them steps back. ``at_once``: nobody will be there to see it deaf.
        """
        if (plan := self.robot.stop(self.now_s)) is not None:
            self.request(Stop, plan)
        elif self.tool.armed and at_once:
            self._stop_measured()
        elif self.tool.engaged and self.tool.armed:
            self._deaf_s = self.now_s + DEAF_S

    def _stop_measured(self) -> None:
        if (plan := self.robot.stop_measured(self.now_s)) is not None:
            self._deaf_s, self._told_s, self._measuring = np.inf, self.robot.newest_s, 0
            self.request(Stop, plan)

    def go_home(self) -> Script[None]:
        """Bring the robot home, from wherever this run may have left it; one that never left stays.

        Raises `FaultError` when there is no way, or it does not fit any more.
        """
        robot = self.robot
        near = not robot.beside_home()
        if near:
            robot.place = (HOME, HOME)
            if not self.left_home:
                return
        self.doing = "on its way home"
        q = yield from self.stand()
        if robot.exactly_home(q):
            return
        try:
            route = robot.ways.home(robot.place, q)
        except LimitError as error:
            raise FaultError(error.code, f"no way home: {error}") from error
        duration_s, left_s = self.robot.lasts_s(route.plan.duration_s), self.gap.left_s(self.now_s)
        if robot.place == STATION:
            self.tool_home_s = max(self.tool_home_s, route.plan.duration_s)
        if duration_s >= left_s and near:
            return  # the next run begins from here
        if duration_s >= left_s:
            words = f"the way home takes {duration_s:.1f} s, {max(left_s, 0.0):.1f} s are left"
            words = "; ".join(filter(None, (words, self.longer_way_home())))
            raise FaultError(Code.LIMIT_EXCEEDED, words)
        yield from self.drive(route, route.plan.duration_s)

    def longer_way_home(self) -> str:
        """That the way home from the beams took longer than was set, and what to set; or empty."""
        set_s = self.config.times.tool_home_s
        if self.tool_home_s <= set_s:
            return ""
        took = f"the way home from the beams takes {self.tool_home_s:.1f} s"
        return f"tool_home_s = {set_s:g} s: {took}; set {np.ceil(self.tool_home_s + 0.5):g} s"

    def after_break(self) -> Script[None]:
        """Stop everything, wait until it stands and is disarmed, then bring the robot home."""
        self.halt()
        if self.tool.engaged:
            self.disengage()
            yield from self.disarmed()
        yield from self.stand(STANDS_S)
        yield from self.go_home()
