"""A maintenance cycle: the thermal measurement, the tool, and what became of both."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.ground.proposals import THERMAL, TOOL
from robocal_ros.maintenance.deciding import BY, Decider, is_accepted, patiently, settled
from robocal_ros.maintenance.memory import CycleResult, Drift, Memory, ToolRecord
from robocal_ros.maintenance.mover import HOME, FaultError
from robocal_ros.maintenance.robot_interface import (
    BeginCycle,
    DriverAnswer,
    EndCycle,
    Hands,
    Script,
    SilentError,
)
from robocal_ros.session.events import LEAVE, ROLLBACK, Command, Outcome
from robocal_ros.thermal.accuracy import AccuracyLevel, ToolError
from robocal_ros.thermal.reference import SAME_VISIT_RAD
from robocal_ros.tool.driving import STANDS_S
from robocal_ros.tool.session import FULL, QUICK

Array = NDArray[np.float64]

NODE = "thermal node"
MEASUREMENT = "thermal measurement"
NONE_BETTER = (Code.NO_SIGNIFICANT_GAIN, Code.WORSE_THAN_CURRENT)
FOUND = (Code.ACCEPT, *NONE_BETTER)  # verdicts that tell the drift; any other one leaves it unknown


@dataclass
class ThermalCycle:
    """The thermal cycle that is open; over several gaps where one is too short."""

    id: str = ""  # empty: none
    visited: set[int] = field(default_factory=set)  # poses that are done, from 1; measured or not
    unmeasured: set[int] = field(default_factory=set)  # of these, with too few measurements
    last_s: float = -np.inf  # when the last one was
    moved: bool = False  # the last cycle that ended found that the sensor or the robot has moved

    def forget(self) -> None:
        """No cycle is open."""
        self.id, self.visited, self.unmeasured, self.last_s = "", set(), set(), -np.inf


class ThermalPart:
    """Measures the drift; what does not fit is done in the next gap."""

    def __init__(self, hands: Hands, book: ThermalCycle) -> None:
        self._hands, self._book = hands, book
        self._times = hands.config.times

    def worst_s(self) -> float:
        """The longest first step of a gap, before it is planned: one pose, with its way home."""
        ways = self._hands.ways
        homes = max((ways.home_s(i) for i in range(1, ways.count + 1)), default=0.0)
        return self._first_s(ways.longest_line_s(), homes)

    def drop_old(self) -> str:
        """Give up an open cycle whose last pose is too old, and say so; empty: there is none."""
        book, within_s = self._book, self._hands.config.resume_within_s
        age_s = self._hands.now_s - book.last_s
        if not book.id or age_s <= within_s:
            return ""
        words = (
            f"cycle '{book.id}' with {len(book.visited)} of {self._hands.ways.count} poses is "
            f"dropped and begins anew: its last pose is {age_s:.0f} s old (resume_within_s = "
            f"{within_s:g} s)"
        )
        book.forget()
        return words

    def script(self, cycle_id: str) -> Script[tuple[DriverAnswer | None, str]]:
        """The answer of the cycle's end, None where it is not reached, and what is left.

        Raises
        ------
        SilentError
            The thermal node did not answer; the robot may be away from home.
        """
        hands, book = self._hands, self._book
        todo = [i for i in range(1, hands.ways.count + 1) if i not in book.visited]
        if todo:
            way_s = hands.ways.to((HOME, HOME), hands.config.home, todo[0]).plan.duration_s
            if not hands.fits(self._first_s(way_s, hands.ways.home_s(todo[0]))):
                return None, f"{MEASUREMENT}, {len(todo)} poses"
            begun = yield from self._begin(cycle_id)
            if not begun.done:
                return begun, MEASUREMENT
            left = yield from self._visit(todo)
            yield from hands.go_home()
            if left:
                return None, f"{MEASUREMENT}, {left} poses"
        if not hands.fits(self._times.solve_s):
            return None, "end of the thermal cycle"
        unmeasured, measured = ", ".join(map(str, sorted(book.unmeasured))), self._places()
        answer = yield from self._end()
        if answer.code not in FOUND:
            return answer, MEASUREMENT
        lacking = [f"{MEASUREMENT} at pose {unmeasured}"] if unmeasured else []
        if answer.visited is not None and answer.visited < measured:
            # it was started anew meanwhile, its clock jumped, or they are not of the cold reference
            has = f"of which the thermal node has {answer.visited}"
            lacking.append(f"{MEASUREMENT} at {measured} poses, {has}")
        return answer, "; ".join(lacking)

    def _places(self) -> int:
        """At how many places this cycle measured; the thermal node takes near ones for one."""
        found: list[Array] = []
        for pose in sorted(self._book.visited - self._book.unmeasured):
            q = self._hands.config.poses[pose - 1]
            if all(np.max(np.abs(q - other)) >= SAME_VISIT_RAD for other in found):
                found.append(q)
        return len(found)

    def _begin(self, cycle_id: str) -> Script[DriverAnswer]:
        book, hands = self._book, self._hands
        hands.doing = "thermal cycle begins"
        name = book.id or cycle_id
        answer = yield from hands.ask(self._times.answer_s, NODE, BeginCycle, name)
        if answer.done:
            book.id, book.last_s = name, hands.now_s
        return answer

    def _visit(self, todo: list[int]) -> Script[int]:
        """How many poses did not fit."""
        hands = self._hands
        yield from hands.stand(STANDS_S)
        for done, pose in enumerate(todo):
            q = yield from hands.stand()
            route = hands.ways.to(hands.robot.place, q, pose)
            worst_s = self._step_s(route.plan.duration_s, hands.ways.home_s(pose))
            if not hands.fits(worst_s):
                return len(todo) - done
            hands.doing = f"on its way to measuring pose {pose} of {hands.ways.count}"
            yield from hands.drive(route, worst_s)
            q = yield from hands.stand()
            hands.doing = f"measuring pose {pose} of {hands.ways.count}"
            if not (yield from self._measured(q)):
                self._book.unmeasured.add(pose)
            self._book.visited.add(pose)
            self._book.last_s = hands.now_s
        return 0

    def _measured(self, q: Array) -> Script[bool]:
        """Stand at joints (n,) until the measurements are there; False: their time is over."""
        hands, times = self._hands, self._times
        from_s = hands.robot.newest_s + times.settle_s
        until_s = hands.now_s + times.measure_s
        hands.measured.clear()
        while hands.now_s < until_s:
            hands.robot.require_at(q)
            fresh = sorted(stamp for stamp in hands.measured if stamp >= from_s)
            enough = fresh[: hands.config.measurements]  # more may come, faster than the stay ends
            if (
                len(enough) == hands.config.measurements
                and hands.robot.newest_s >= enough[-1] + times.stay_s
            ):
                return True
            yield
        return False

    def _end(self) -> Script[DriverAnswer]:
        book, hands = self._book, self._hands
        hands.doing = "thermal cycle ends"
        name = book.id
        book.forget()
        try:
            answer = yield from hands.ask(self._times.solve_s, NODE, EndCycle, name)
        except SilentError as error:
            return DriverAnswer(Code.CONFLICT, str(error))
        book.moved = answer.code is Code.SENSOR_OR_ROBOT_MOVED
        return answer

    def _first_s(self, way_s: float, home_s: float) -> float:
        """The cycle begins before it."""
        return 2.0 * self._times.answer_s + STANDS_S + self._step_s(way_s, home_s)

    def _step_s(self, way_s: float, home_s: float) -> float:
        """At the most: a rest at each arrival, before the measurement and after it.

        What stands before a pose that does not fit need not stand again before its way home.
        """
        return way_s + home_s + 4.0 * self._times.rest_s + self._times.measure_s


FAILED = (  # without a result they say that something is wrong with the tool, or its measurement
    Code.WRONG_TOOL,
    Code.CLOCK_WRONG,
    Code.BEAM_EDGES_WRONG,
    Code.RESIDUAL_TOO_LARGE,
    Code.LIMIT_EXCEEDED,
)


@dataclass
class ToolOutcome:
    """What came of it.

    Attributes
    ----------
    first, last : of the first and the last measurement; None before any.
    checked : the last quick check's answer.
    bent : another tool than the one in force was found, and not just as due by the calendar.
    candidate_id : of the full measurement; 0 without.
    accepted : whether it was accepted without a person, and stayed.
    fault : an accepted tool failed its check and is still in force, and why; empty: none is.
    told : why not, or what a person must know.
    left : what did not fit.
    """

    first: DriverAnswer | None = None
    last: DriverAnswer | None = None
    checked: str = ""
    bent: bool = False
    candidate_id: int = 0
    accepted: bool = False
    fault: str = ""
    told: str = ""
    left: str = ""

    def came(self, answer: DriverAnswer) -> None:
        """Of a measurement."""
        self.first, self.last = self.first or answer, answer

    @property
    def found_code(self) -> Code:
        """What was found of the tool as the gap began, also where that is mended since."""
        if self.last and self.last.code is Code.STATION_MOVED:
            return self.last.code
        if self.bent:
            return Code.LIMIT_EXCEEDED
        return self.first.code if self.first else Code.NONE

    def words(self) -> list[str]:
        """What was found first, what came last, and what else there is to say; each once."""
        said = [each.message for each in (self.first, self.last) if each] + [self.told]
        said = list(dict.fromkeys(filter(None, said)))
        return [words for words in said if not any(words in o for o in said if o is not words)]


class ToolMeasuring:
    """Measures the tool, from home and back."""

    def __init__(
        self,
        hands: Hands,
        decider: Decider,
        memory: Memory,
        drift: Callable[[], ToolError | None],
    ) -> None:
        self._hands, self._decider, self._memory = hands, decider, memory
        self._drift = drift
        self._through = 0  # thermal model that gave the flange poses
        self.outcome = ToolOutcome()
        self.revision = self.wall_ns = 0

    def measured(self, mode: str, cycle_id: str) -> Script[DriverAnswer | None]:
        """The answer; None where it did not fit, or gave no result for the tool in force.

        Raises
        ------
        FaultError
            When the robot was stopped because it left its plan, or as `Hands` do.
        """
        hands, times, outcome = self._hands, self._hands.config.times, self.outcome
        yield  # what was kept just before may have taken its time: the gap is looked at again
        if hands.tool.absent:
            outcome.left = f"tool measurement ({mode})"
            outcome.came(DriverAnswer(Code.CONFLICT, hands.tool.words(), absent=True))
            return None
        if not hands.fits(hands.tool_worst_s(mode)):
            outcome.left = f"tool measurement ({mode})"
            return None
        hands.doing = f"tool measurement ({mode})"
        yield from hands.stand(STANDS_S)
        self.revision, self._through = self._decider.revision(TOOL), self._decider.thermal_id()
        try:
            answer = yield from hands.arm()
            if answer.done:
                limit_s = times.check_s if mode == QUICK else times.full_s
                answer = yield from hands.measure(mode, cycle_id, limit_s)
        except SilentError as error:
            answer = DriverAnswer(Code.CONFLICT, str(error))
        before = self._memory.tool
        self._learn(mode, answer)
        yield from hands.disarmed()
        yield from hands.stand(STANDS_S)
        if answer.left_plan:  # held, or it hit something: nobody drives it on unseen
            raise FaultError(answer.code, answer.message)
        yield from hands.go_home()
        return self._credited(mode, answer, before)

    def _learn(self, mode: str, answer: DriverAnswer) -> None:
        """Remember it at once: the run may be broken off on the way home."""
        outcome = self.outcome
        outcome.came(answer)
        if answer.code is Code.STATION_MOVED:
            self._failed(answer)
        elif answer.has_result and mode == FULL:
            same = answer.code is Code.NO_SIGNIFICANT_GAIN
            candidate = answer.candidate_id if answer.done else 0
            self._note(answer, "pass" if same else "recalibrate", candidate)
            self._memory.note_tool(full_ns=self.wall_ns)
            if answer.done and (drift := self._drift()) is not None:
                self._memory.note_tool(drift_rms_m=drift.rms_m, drift_bound_m=drift.bound_m)
        elif answer.has_result:
            self._note(answer, answer.answer)
            if outcome.accepted and answer.answer == "recalibrate":
                failed = f"tool {outcome.candidate_id} failed its check and is still in force"
                outcome.fault = f"{failed}: take it back"
        elif answer.code in FAILED:
            self._failed(answer)

    def _failed(self, answer: DriverAnswer) -> None:
        """What an older check found of the tool holds no more."""
        self._memory.note_tool(
            answer="failed",
            words=answer.message,
            revision=self.revision,
            thermal_id=self._through,
            candidate=0,
        )

    def _note(self, answer: DriverAnswer, verdict: str, candidate: int = 0) -> None:
        self._memory.note_tool(
            answer=verdict,
            words=answer.message,
            deviation_mm=answer.deviation_mm,
            sigma_mm=answer.sigma_mm,
            revision=self.revision,
            thermal_id=self._through,
            candidate=candidate,
            postponed=False,
            wall_ns=self.wall_ns,
        )

    def _credited(self, mode: str, answer: DriverAnswer, before: ToolRecord) -> DriverAnswer | None:
        """The answer, where it is of the tool in force; kept at home, where nothing moves."""
        outcome = self.outcome
        current = self.revision == self._decider.revision(TOOL)
        if answer.has_result and not current:
            self._memory.tool, outcome.fault = before, ""
        self._memory.save()
        if answer.has_result and current:
            return answer
        outcome.left = f"tool measurement ({mode})"
        outcome.told = f"{outcome.left}: {answer.message}"
        if answer.has_result:
            outcome.told = f"{outcome.left} is discarded: another tool came into force"
        return None


NS = 1_000_000_000
MOVED = "the sensor or the robot has moved, and a robot that has looks like a bent tool"
LATE = "its check does not fit this gap any more, and it is accepted in a gap where that fits"


class ToolPart:
    """Keeps the tool right; what does not fit is done in the next gap."""

    def __init__(
        self,
        hands: Hands,
        book: ThermalCycle,
        decider: Decider,
        memory: Memory,
        decided: Callable[[Outcome], None],
        unsure: Callable[[], str],
        drift: Callable[[], ToolError | None],
    ) -> None:
        self._hands, self._book, self._decider, self._memory = hands, book, decider, memory
        self._decided, self._unsure = decided, unsure
        self._measuring = ToolMeasuring(hands, decider, memory, drift)
        self._late = False  # nothing but the time for its check was against the last candidate

    @property
    def outcome(self) -> ToolOutcome:
        """What came of it."""
        return self._measuring.outcome

    def at(self, wall_ns: int) -> None:
        """Tell the time, for what is kept."""
        self._measuring.wall_ns = wall_ns

    def wants(self) -> str:
        """The measurement that is due: FULL or QUICK; empty: none."""
        record, config = self._memory.tool, self._hands.config
        if config.T_base_laser is None or self._decider.newest(TOOL):
            return ""
        known = 0 < record.wall_ns <= self._measuring.wall_ns
        known = known and record.revision == self._decider.revision(TOOL)
        known = known and record.thermal_id == self._decider.thermal_id()
        if known and record.answer in ("recalibrate", "cannot tell"):
            return FULL
        known = known and record.answer != "failed"
        due = not known or self._age_s(record.wall_ns) >= config.check_every_s
        return QUICK if due else ""

    def script(self, cycle_id: str) -> Script[None]:
        """Everything that is due and fits."""
        wanted = self.wants()
        if not wanted:
            if waiting := self._decider.newest(TOOL):
                yield from self._found_waiting(waiting.id, cycle_id)
            return
        optional = False
        if wanted == QUICK:
            if not (yield from self._check(f"{cycle_id}/check")):
                return
            optional = self._memory.tool.answer == "pass"
            if optional and not self._full_is_due():
                return
        if optional and not self._hands.fits(self._hands.tool_worst_s(FULL)):
            return  # only when time allows
        yield from self._full(cycle_id)

    def take_back(self) -> None:
        """Take a tool back that failed its check, where the run was broken off before."""
        try:
            self._took_back(self._returned())
        except RobocalError as error:
            self._stays(str(error))

    def _full_is_due(self) -> bool:
        every_s = self._hands.config.full_every_s
        return every_s > 0.0 and not 0.0 <= self._age_s(self._memory.tool.full_ns) < every_s

    def _check(self, name: str) -> Script[bool]:
        """A quick check; whether it gave an answer."""
        answer = yield from self._measuring.measured(QUICK, name)
        if answer is None:
            return False
        self.outcome.checked = answer.answer
        return True

    def _full(self, cycle_id: str) -> Script[None]:
        outcome = self.outcome
        answer = yield from self._measuring.measured(FULL, f"{cycle_id}/full")
        if answer is None:
            return
        outcome.candidate_id = answer.candidate_id
        if answer.code is Code.NO_SIGNIFICANT_GAIN:
            return
        outcome.bent = answer.done and outcome.checked != "pass"
        if not answer.done:
            outcome.told = f"tool measurement {answer.candidate_id}: {answer.message}"
            return
        yield from self._settle(cycle_id)

    def _found_waiting(self, number: int, cycle_id: str) -> Script[None]:
        """A candidate of an earlier gap: it waits for a person, or for a gap with time enough."""
        record = self._memory.tool
        if record.postponed and record.candidate == number:
            self.outcome.candidate_id = number
            yield from self._settle(cycle_id)
        else:
            self.outcome.told = f"tool candidate {number} waits for a decision"

    def _settle(self, cycle_id: str) -> Script[None]:
        """Accept the candidate and check it, or leave it."""
        outcome, self._late = self.outcome, False
        number = outcome.candidate_id
        found = yield from settled(
            self._hands, self._decider, TOOL, number, self._doubt, self._measuring.wall_ns
        )
        self._decided(found)
        if is_accepted(found):
            outcome.accepted = True
            yield from self._verify(cycle_id)
            return
        outcome.told = found.message
        if self._late:
            outcome.left = f"acceptance of tool candidate {number}"
            self._memory.note_tool(postponed=True)

    def _doubt(self) -> str:
        """Why a candidate inside the bounds is not accepted now; empty: nothing is against it."""
        why = MOVED if self._book.moved else self._unsure()
        self._late = not why and not self._hands.fits(self._hands.tool_worst_s(QUICK))
        return LATE if self._late else why

    def _verify(self, cycle_id: str) -> Script[None]:
        """Check the tool that was just accepted; one that is not right is taken back."""
        outcome = self.outcome
        verified = yield from self._check(f"{cycle_id}/verify")
        if verified and outcome.checked == "cannot tell":
            verified = yield from self._check(f"{cycle_id}/verify again")
        if outcome.fault:
            yield from self._take_back()
        elif not self._decider.in_force(TOOL, outcome.candidate_id):
            outcome.accepted = False  # somebody chose another one
        elif not verified or outcome.checked != "pass":
            outcome.left = "verification of the accepted tool"

    def _take_back(self) -> Script[None]:
        try:
            back = yield from patiently(self._hands, self._returned)
        except RobocalError as error:
            self._stays(str(error))
        else:
            self._took_back(back)

    def _returned(self) -> Outcome:
        """The tool from before the accepted one is in force again."""
        if not self._decider.in_force(TOOL, self.outcome.candidate_id):
            # a try before did it, or somebody else
            words = "the accepted tool failed its check and is no longer in force"
            return Outcome(Command(ROLLBACK, {}), Code.ACCEPT, words, repeated=True)
        why, revision = "its check failed", self._measuring.revision
        return self._decider.roll_back(TOOL, revision, BY, why, self._measuring.wall_ns)

    def _took_back(self, back: Outcome) -> None:
        """Of the tool that is back nothing is known: two measurements contradict each other."""
        outcome = self.outcome
        self._decided(back)
        if not back.done:
            self._stays(back.message)
            return
        outcome.accepted, outcome.fault, outcome.told = False, "", back.message
        if not back.repeated:
            outcome.told = "the accepted tool failed its check and was taken back: look at it"
            self._memory.note_tool(answer="failed", revision=back.revision, words=outcome.told)

    def _stays(self, why: str) -> None:
        number = self.outcome.candidate_id
        words = f"tool {number} failed its check and could not be taken back: {why}"
        self.outcome.fault = words

    def _age_s(self, wall_ns: int) -> float:
        return (self._measuring.wall_ns - wall_ns) / NS


UNSURE = "this cycle brought no thermal result into force, and a drift looks like a bent tool"


class CycleRun:
    """The script of a cycle, and its result as it grows."""

    def __init__(
        self,
        result: CycleResult,
        hands: Hands,
        book: ThermalCycle,
        decider: Decider,
        memory: Memory,
        decided: Callable[[Outcome], None],
        drift: Callable[[], Drift | None],
    ) -> None:
        self.result = result
        self._hands, self._decider, self._decided = hands, decider, decided
        self._drift = drift
        self._thermal = ThermalPart(hands, book)
        self._tool = ToolPart(
            hands, book, decider, memory, decided, self._unsure, self._drift_error
        )
        self.wall_ns = 0
        self._words: list[str] = []

    def at(self, wall_ns: int) -> None:
        """Tell the time, for what is kept."""
        self.wall_ns = wall_ns
        self._tool.at(wall_ns)

    @property
    def owes(self) -> str:
        """An accepted tool that failed its check is still in force, in words; empty: none is."""
        return self._tool.outcome.fault

    def take_back(self) -> str:
        """Do it where the script did not come to it, at home; in words what came of it."""
        self._tool.take_back()
        return self.owes or self._tool.outcome.told

    def ended(self, code: Code, message: str) -> CycleResult:
        """The result, at its end."""
        self._fold()
        self.result = replace(self.result, code=code, message=message, stamp_ns=self.wall_ns)
        return self.result

    def script(self) -> Script[None]:
        """Everything that fits, in its order; ends at home."""
        if self._hands.ways.count:
            yield from self._measure_thermal()
        yield from self._measure_tool()
        words = "; ".join(self._words) or "nothing was due"
        left = self.result.left
        self.result = replace(
            self.result,
            code=Code.ACCEPT,
            complete=not left,
            message=words + (f"; left for the next gap: {', '.join(left)}" if left else ""),
        )

    def _measure_thermal(self) -> Script[None]:
        if dropped := self._thermal.drop_old():
            self._tell(f"thermal: {dropped}")
        try:
            answer, left = yield from self._thermal.script(self.result.cycle_id)
        except SilentError as error:
            answer, left = DriverAnswer(Code.CONFLICT, str(error)), MEASUREMENT
            yield from self._hands.go_home()
        if left:
            self._left(left)
        if answer is None:
            return
        self._tell(f"thermal: {answer.message}")
        if answer.missing:
            poses = ", ".join(map(str, answer.missing))
            self._tell(f"without pose {poses} of the cold reference")
        self.result = replace(self.result, thermal_code=answer.code, thermal_id=answer.candidate_id)
        if not (answer.done and answer.candidate_id):
            return
        # EXPIRED was said before this measurement, and must not keep its result waiting.
        found = yield from settled(
            self._hands,
            self._decider,
            THERMAL,
            answer.candidate_id,
            lambda: self._unsound(AccuracyLevel.FAULT),
            self.wall_ns,
        )
        self._decided(found)
        self._tell(found.message)
        if is_accepted(found):
            self._accepted(answer.candidate_id)

    def _measure_tool(self) -> Script[None]:
        yield from self._tool.script(self.result.cycle_id)
        found = self._tool.outcome
        if found.left:
            self._left(found.left)
        for words in found.words():
            self._tell(f"tool: {words}")
        if told := self._hands.home_told():
            self._tell(told)
        if found.fault:
            raise FaultError(Code.CONFLICT, found.fault)

    def _fold(self) -> None:
        """The tool part into the result, also where it was broken off."""
        found = self._tool.outcome
        self.result = replace(
            self.result,
            tool_found_code=found.found_code,
            tool_code=found.last.code if found.last else Code.NONE,
            tool_id=found.candidate_id,
            tool_answer=found.checked,
        )
        if found.accepted:
            self._accepted(found.candidate_id)

    def _unsure(self) -> str:
        """Why a tool that was measured now waits for a person; empty: it need not.

        By now the thermal node has heard of the cycle: what is EXPIRED still has no cold reference.
        """
        expired = AccuracyLevel.EXPIRED if self._hands.ways.count else AccuracyLevel.FAULT
        return self._unsound(expired) or UNSURE * (not self._drift_is_known())

    def _unsound(self, worst: AccuracyLevel) -> str:
        """Why the drift, from a level on, leaves a decision to a person; else empty."""
        drift = self._drift()
        if drift is None:  # a cell without measuring poses need not have a thermal node
            return "the thermal node is silent" if self._hands.ways.count else ""
        return f"the drift is {drift.level.name}: {drift.reason}" if drift.level >= worst else ""

    def _drift_error(self) -> ToolError | None:
        """Of the thermal model in force; without poses nobody asks."""
        drift = self._drift() if self._hands.ways.count else None
        return None if drift is None else drift.error

    def _drift_is_known(self) -> bool:
        """Whether this cycle found the model in force, or none better; else it may be wrong."""
        code, found = self.result.thermal_code, self.result.thermal_id
        if not self._hands.ways.count or code in NONE_BETTER:
            return True
        return code is Code.ACCEPT and found > 0 and self._decider.in_force(THERMAL, found)

    def _accepted(self, calibration_id: int) -> None:
        self.result = replace(self.result, accepted=(*self.result.accepted, calibration_id))

    def _left(self, what: str) -> None:
        self.result = replace(self.result, left=(*self.result.left, what))
        left_s = max(self._hands.gap.left_s(self._hands.now_s), 0.0)
        words = f"{what}: left for the next gap, {left_s:.1f} s before the end of this one"
        self._decided(Outcome(Command(LEAVE, {"what": what, "left_s": left_s}), Code.ACCEPT, words))

    def _tell(self, words: str) -> None:
        self._words.append(words)
