# SPDX-License-Identifier: Apache-2.0
"""A maintenance cycle: its parts in their order, the tool's, and what became of each."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.history.history_records import LASER_FRAME, THERMAL, TOOL, Head
from robocal_ros.maintenance.accuracy import UNKNOWN, CycleResult, Memory, ToolRecord, utc_of
from robocal_ros.maintenance.deciding import BY, Decider, is_accepted, patiently, settled
from robocal_ros.maintenance.fixture_part import JUDGED, FixturePart, FixtureVisits
from robocal_ros.maintenance.fixture_part import MEASUREMENT as FIXTURE_MEASUREMENT
from robocal_ros.maintenance.mover import STATION, FaultError
from robocal_ros.maintenance.robot_interface import CellInterface, DriverAnswer, Script, SilentError
from robocal_ros.maintenance.thermal_part import MEASUREMENT, NONE_BETTER, ThermalCycle, ThermalPart
from robocal_ros.session.events import LEAVE, REJECT, ROLLBACK, Command, Outcome
from robocal_ros.thermal.accuracy import Accuracy, AccuracyLevel, ToolError
from robocal_ros.tool.driving import STANDS_S
from robocal_ros.tool.session import FULL, LASER, QUICK, WITNESS

NS = 1_000_000_000
FAILED = (  # without a result they say that something is wrong with the tool, or its measurement
    Code.WRONG_TOOL, Code.CLOCK_WRONG, Code.BEAM_EDGES_WRONG, Code.RESIDUAL_TOO_LARGE,
    Code.LIMIT_EXCEEDED,
)  # fmt: skip
MEASURED_ANEW = ("recalibrate", "cannot tell")  # answers of a check
OF_STATION = (WITNESS, LASER)  # tell nothing of the tool
MOVED = "the sensor or the robot has moved, and a robot that has looks like a bent tool"
LATE = "its check does not fit this gap any more, and it is accepted in a gap where that fits"
UNSURE = "this cycle brought no thermal result into force, and a drift looks like a bent tool"


@dataclass
class ToolOutcome:
    """What came of the tool in a cycle."""

    first: DriverAnswer | None = None  # of the first measurement; None before any
    last: DriverAnswer | None = None
    checked: str = ""  # the last quick check's answer
    bent: bool = False  # another tool than the one in force, and not just as due by the calendar
    candidate_id: int = 0  # of the full measurement; 0 without
    accepted: bool = False  # without a person, and it stayed
    fault: str = ""  # why an accepted tool that failed its check is still in force; empty: none is
    mandrel: str = ""  # what it said, but for a station that has moved
    station: str = ""  # where the beams were found, the same
    # of that measurement, where it was judged, and what it is kept as
    station_code: Code = Code.NONE
    station_id: int = 0
    note: str = ""  # why not, or what a person must know
    left: str = ""  # what did not fit

    def take(self, answer: DriverAnswer) -> None:
        """Note what came of a measurement."""
        self.first, self.last = self.first or answer, answer

    @property
    def found_code(self) -> Code:
        """What was found of the tool as the gap began, also where that is mended since."""
        if self.last and self.last.code is Code.STATION_MOVED:
            return self.last.code
        if self.bent:
            return Code.LIMIT_EXCEEDED
        return self.first.code if self.first else Code.NONE

    def messages(self) -> list[str]:
        """What was found first, what came last, and what else there is to say; each once."""
        found = [each.message for each in (self.first, self.last) if each]
        found += [self.mandrel, self.station, self.note]
        found = list(dict.fromkeys(filter(None, found)))
        return [text for text in found if not any(text in o for o in found if o is not text)]


class ToolPart:
    """Keeps the tool right; what does not fit is done in the next gap.

    ``decided`` takes each decision that was made without a person, ``unsure`` says why a tool that
    was measured now waits for a person (empty: it need not), ``drift`` the error of the thermal
    model in force (None: not known).
    """

    def __init__(
        self,
        cell: CellInterface,
        thermal: ThermalCycle,
        decider: Decider,
        memory: Memory,
        decided: Callable[[Outcome], None],
        unsure: Callable[[], str],
        drift: Callable[[], ToolError | None],
    ) -> None:
        self._cell, self._thermal, self._decider, self._memory = cell, thermal, decider, memory
        self._decided, self._unsure, self._drift = decided, unsure, drift
        self._late = False  # nothing but the time for its check was against the last candidate
        self._tool, self._through = (Head(kind, 0, None, None) for kind in (TOOL, THERMAL))
        self.outcome = ToolOutcome()
        self.wall_ns = 0  # of the tick

    def script(self, cycle_id: str) -> Script[None]:
        """Everything that is due and fits."""
        wanted, outcome = self._due(), self.outcome
        if not wanted:
            if waiting := self._decider.newest(TOOL):
                record = self._memory.tool
                if record.postponed and record.candidate == waiting.id:  # for a longer gap
                    outcome.candidate_id = waiting.id
                    yield from self._settle(cycle_id)
                    return
                outcome.note = f"tool candidate {waiting.id} waits for a decision"
                yield from self._ask_mandrel(cycle_id, waiting.id)
            return
        if wanted == QUICK:
            if not (yield from self._check(f"{cycle_id}/check", goes_on=True)):
                return
            if self._memory.tool.answer == "pass" and not self._full_is_due():
                return
        candidate = yield from self._measured_anew(f"{cycle_id}/full")
        if candidate and not (yield from self._ask_mandrel(cycle_id, candidate)):
            yield from self._settle(cycle_id)

    def _measured_anew(self, name: str) -> Script[int]:
        """A full measurement; the candidate that is to be settled, 0: none."""
        outcome = self.outcome
        answer = yield from self._measured(FULL, name)
        if answer is None:
            return 0
        outcome.candidate_id = answer.candidate_id
        if answer.code is Code.NO_SIGNIFICANT_GAIN:
            return 0
        outcome.bent = answer.done and outcome.checked != "pass"
        if not answer.done:
            outcome.note = f"tool measurement {answer.candidate_id}: {answer.message}"
        return answer.candidate_id if answer.done else 0

    def _ask_mandrel(self, cycle_id: str, candidate: int) -> Script[bool]:
        """Whose is a change in doubt, the tool's or the station's? Whether that is settled.

        A station that stands: the tool is measured again; unless a person has decided meanwhile.
        """
        cell, outcome = self._cell, self.outcome
        if cell.config.driving.mandrel is None or not self._decider.is_for_mandrel(candidate):
            return False
        told = yield from self._measured(WITNESS, f"{cycle_id}/witness")
        if told is None or not (told.done or told.code is Code.STATION_MOVED):
            return False

        def reject() -> Outcome:
            return self._decider.decide(REJECT, candidate, BY, told.message, self.wall_ns)

        yield  # what was kept just before may have taken its time
        if words := self._decider.decided(candidate):
            outcome.candidate_id, outcome.note = candidate, words
            return True
        self._decided((yield from patiently(cell, reject)))
        if not told.done:
            outcome.candidate_id = candidate
            return True
        self._memory.note_tool(answer="recalibrate", candidate=0)
        if (yield from self._measured_anew(f"{cycle_id}/again")):
            yield from self._settle(cycle_id)
        return True

    def _due(self) -> str:
        """The measurement that is due: FULL or QUICK; empty: none."""
        record, config = self._memory.tool, self._cell.config
        if config.T_base_laser is None or self._decider.newest(TOOL):
            return ""
        head, known = self._decider.head, 0 < record.wall_ns <= self.wall_ns
        known = known and record.is_of(head(TOOL)) and record.is_through(head(THERMAL))
        if known and record.answer in MEASURED_ANEW:
            return FULL
        if not known or record.answer == "failed":
            return QUICK
        both_s = self._cell.tool_worst_s(QUICK) + self._cell.tool_worst_s(FULL)
        due = self._age_s(record.wall_ns) >= config.check_every_s
        due = due or (self._full_is_due() and self._cell.fits(both_s))
        return QUICK if due else ""

    def _full_is_due(self) -> bool:
        """By ``full_every_s``; a check comes before it."""
        every_s = self._cell.config.full_every_s
        return every_s > 0.0 and not 0.0 <= self._age_s(self._memory.tool.full_ns) < every_s

    def _age_s(self, wall_ns: int) -> float:
        return (self.wall_ns - wall_ns) / NS

    def find_beams(self, cycle_id: str) -> Script[None]:
        """Find the beams again where that is due: how their station drifts.

        The first time is a person's, while the station stands right.
        """
        cell, outcome, every_s = self._cell, self.outcome, self._cell.config.laser_frame_every_s
        if every_s <= 0.0 or cell.config.driving.mandrel is None or outcome.left or outcome.fault:
            return
        recent = 0.0 <= self._age_s(self._memory.tool.laser_ns) < every_s
        if not recent and self._decider.revision(LASER_FRAME):
            yield from self._measured(LASER, f"{cycle_id}/laser frame")

    def _leave_out(self, mode: str, words: str) -> None:
        """A measurement that is due does not fit: which gap would do stands in ``words``."""
        outcome = self.outcome
        outcome.left = f"tool measurement ({mode})"
        if mode == LASER:
            outcome.station, outcome.station_code = f"beam station: {words}", Code.LIMIT_EXCEEDED
        else:
            note = f"{outcome.left}: {words}"
            outcome.note = "; ".join(filter(None, (outcome.note, note)))

    def _check(self, name: str, *, goes_on: bool = False) -> Script[bool]:
        """A quick check; whether it gave an answer."""
        answer = yield from self._measured(QUICK, name, goes_on=goes_on)
        if answer is None:
            return False
        self.outcome.checked = answer.answer
        return True

    def _measured(
        self, mode: str, cycle_id: str, *, goes_on: bool = False
    ) -> Script[DriverAnswer | None]:
        """Measure from where the robot stands, and go home; None where no result counts.

        With ``goes_on`` a check after which a full measurement is due and fits leaves it there.

        Raises `FaultError` when the robot was stopped because it left its plan, or as
        `CellInterface` does.
        """
        cell, outcome = self._cell, self.outcome
        yield  # what was kept just before may have taken its time: the gap is looked at again
        if cell.tool.absent:
            outcome.left = f"tool measurement ({mode})"
            outcome.take(DriverAnswer(Code.CONFLICT, cell.tool.advice(), absent=True))
            return None
        if words := cell.too_short(cell.tool_worst_s(mode)):
            self._leave_out(mode, words)
            return None
        cell.doing = f"tool measurement ({mode})"
        yield from cell.stand(STANDS_S)
        self._tool, self._through = self._decider.head(TOOL), self._decider.head(THERMAL)
        try:
            answer = yield from cell.arm()
            if answer.done:
                # of this run alone: an id of long ago is answered with what was found then
                name = f"{cycle_id} of {utc_of(self._memory.began_ns)}"
                answer = yield from cell.measure(mode, name, cell.run_s(mode))
        except SilentError as error:
            answer = DriverAnswer(Code.CONFLICT, str(error))
        before = self._memory.tool
        self._learn(mode, answer)
        yield from cell.disarmed()
        yield from cell.stand(STANDS_S)
        if answer.left_plan:  # held, or it hit something: nobody drives it on unseen
            raise FaultError(answer.code, answer.message)
        full = answer.has_result and answer.answer in MEASURED_ANEW
        if not (goes_on and full and cell.fits(cell.tool_worst_s(FULL))):
            yield from cell.go_home()
        return self._credited(mode, answer, before)

    def _learn(self, mode: str, answer: DriverAnswer) -> None:
        """Remember it at once: the run may be broken off on the way home."""
        outcome, memory = self.outcome, self._memory
        if mode == LASER and (answer.has_result or answer.code in FAILED):
            if answer.code is not Code.TOO_FEW_SAMPLES:  # what came of it; all else is tried again
                memory.note_tool(laser_ns=self.wall_ns)
            outcome.station_code, outcome.station_id = answer.code, answer.candidate_id
        if mode in OF_STATION and answer.code is not Code.STATION_MOVED:
            if mode == WITNESS:
                outcome.mandrel = f"mandrel: {answer.message}"
            else:
                outcome.station = f"beam station: {answer.message}"
            return
        outcome.take(answer)
        about = ToolRecord.measured_with(self._tool, self._through) | {"words": answer.message}
        moved = answer.code is Code.STATION_MOVED
        if moved or not answer.has_result:
            if moved or answer.code in FAILED:  # what an older check found holds no more
                memory.note_tool(**about, answer="failed", candidate=0)
            return
        full, verdict, candidate = mode == FULL, answer.answer, 0
        if full:
            same = answer.code is Code.NO_SIGNIFICANT_GAIN
            verdict = "pass" if same else "recalibrate"
            candidate = answer.candidate_id if answer.done else 0
        memory.note_tool(
            **about,
            answer=verdict,
            deviation_mm=answer.deviation_mm,
            sigma_mm=answer.sigma_mm,
            candidate=candidate,
            postponed=False,
            wall_ns=self.wall_ns,
        )
        if full:
            memory.note_tool(full_ns=self.wall_ns)
            told = ToolError(memory.tool.drift_rms_m, memory.tool.drift_bound_m)
            if answer.done or told == UNKNOWN:  # one that finds the same tool tells it too
                drift = self._drift() or UNKNOWN
                memory.note_tool(drift_rms_m=drift.rms_m, drift_bound_m=drift.bound_m)
        elif outcome.accepted and verdict == "recalibrate":
            failed = f"tool {outcome.candidate_id} failed its check and is still in force"
            outcome.fault = f"{failed}: take it back"

    def _credited(self, mode: str, answer: DriverAnswer, before: ToolRecord) -> DriverAnswer | None:
        """The answer, where it is of the tool in force; kept while nothing moves."""
        outcome = self.outcome
        current = self._tool == self._decider.head(TOOL)
        if answer.has_result and not current and mode not in OF_STATION:
            self._memory.tool, outcome.fault = before, ""
        self._memory.save()
        if mode in OF_STATION or (answer.has_result and current):
            return answer
        outcome.left = f"tool measurement ({mode})"
        outcome.note = f"{outcome.left}: {answer.message}"
        if answer.has_result:
            outcome.note = f"{outcome.left} is discarded: another tool came into force"
        return None

    def _settle(self, cycle_id: str) -> Script[None]:
        """Accept the candidate and check it, or leave it to a person or to a gap with more time."""
        outcome, self._late = self.outcome, False
        number = outcome.candidate_id
        found = yield from settled(
            self._cell, self._decider, TOOL, number, self._doubt, self.wall_ns
        )
        self._decided(found)
        if is_accepted(found):
            outcome.accepted = True
            yield from self._verify(cycle_id)
            return
        outcome.note = found.message
        if self._late:
            outcome.left = f"acceptance of tool candidate {number}"
            self._memory.note_tool(postponed=True)

    def _doubt(self) -> str:
        """Why a candidate inside the bounds is not accepted now; empty: nothing is against it."""
        why = MOVED if self._thermal.moved else self._unsure()
        self._late = not why and not self._cell.fits(self._cell.tool_worst_s(QUICK))
        return LATE if self._late else why

    def _verify(self, cycle_id: str) -> Script[None]:
        """Check the tool that was just accepted; one that is not right is taken back."""
        outcome = self.outcome
        verified = yield from self._check(f"{cycle_id}/verify")
        if verified and outcome.checked == "cannot tell":
            verified = yield from self._check(f"{cycle_id}/verify again")
        if outcome.fault:
            try:
                back = yield from patiently(self._cell, self._roll_back)
            except RobocalError as error:
                self._stays(str(error))
            else:
                self._took_back(back)
        elif not self._decider.in_force(TOOL, outcome.candidate_id):
            outcome.accepted = False  # somebody chose another one
        elif not verified or outcome.checked != "pass":
            outcome.left = "verification of the accepted tool"

    def take_back(self) -> None:
        """Take a tool back that failed its check, where the run was broken off before."""
        try:
            self._took_back(self._roll_back())
        except RobocalError as error:
            self._stays(str(error))

    def _roll_back(self) -> Outcome:
        """The tool from before the accepted one is in force again."""
        if not self._decider.in_force(TOOL, self.outcome.candidate_id):
            # a try before did it, or somebody else
            message = "the accepted tool failed its check and is no longer in force"
            return Outcome(Command(ROLLBACK, {}), Code.ACCEPT, message, repeated=True)
        revision = self._tool.revision
        return self._decider.roll_back(TOOL, revision, BY, "its check failed", self.wall_ns)

    def _took_back(self, back: Outcome) -> None:
        """Of the tool that is back nothing is known: two measurements contradict each other."""
        outcome = self.outcome
        self._decided(back)
        if not back.done:
            self._stays(back.message)
            return
        outcome.accepted, outcome.fault, outcome.note = False, "", back.message
        if not back.repeated:
            outcome.note = "the accepted tool failed its check and was taken back: look at it"
            about = ToolRecord.measured_with(self._decider.head(TOOL), self._through)
            self._memory.note_tool(**about, answer="failed", words=outcome.note)

    def _stays(self, why: str) -> None:
        number = self.outcome.candidate_id
        self.outcome.fault = f"tool {number} failed its check and could not be taken back: {why}"


class CycleRun:
    """The script of a cycle, and its result as it grows: its code is NONE until it has ended.

    ``drift`` gives what the thermal node reports of itself now; None: it is silent.
    """

    def __init__(
        self,
        result: CycleResult,
        cell: CellInterface,
        thermal: ThermalCycle,
        visits: FixtureVisits,
        decider: Decider,
        memory: Memory,
        decided: Callable[[Outcome], None],
        drift: Callable[[], Accuracy | None],
    ) -> None:
        self.result = result
        self._cell, self._decider, self._decided, self._drift = cell, decider, decided, drift
        self._thermal, self._fixture = ThermalPart(cell, thermal), FixturePart(cell, visits)
        self._tool = ToolPart(
            cell, thermal, decider, memory, decided, self._unsure, self._drift_error
        )
        self._messages: list[str] = []

    def at(self, wall_ns: int) -> None:
        """Set the time of the tick, for what is kept."""
        self._tool.wall_ns = wall_ns

    @property
    def owes(self) -> str:
        """That an accepted tool that failed its check is still in force; empty: none is."""
        return self._tool.outcome.fault

    def take_back(self) -> str:
        """Do it where the script did not come to it, at home; what came of it."""
        self._tool.take_back()
        return self.owes or self._tool.outcome.note

    def ended(self, code: Code, message: str) -> CycleResult:
        """The result, at its end; with the tool part also where it was broken off."""
        tool = self._tool.outcome
        accepted = (tool.candidate_id,) if tool.accepted else ()
        self.result = replace(
            self.result,
            code=code,
            message=message,
            stamp_ns=self._tool.wall_ns,
            tool_found_code=tool.found_code,
            tool_code=tool.last.code if tool.last else Code.NONE,
            tool_id=tool.candidate_id,
            tool_answer=tool.checked,
            accepted=self.result.accepted + accepted,
            station_code=tool.station_code,
            station_id=tool.station_id,
        )
        return self.result

    def script(self) -> Script[None]:
        """Everything that fits, in its order; ends at home."""
        if self._cell.ways.count:
            yield from self._measure_thermal()
        yield from self._measure_tool()
        if self._cell.fixture_ways is not None:
            yield from self._measure_fixture()
        message, left = "; ".join(self._messages) or "nothing was due", self.result.left
        if left:
            message = f"{message}; left for the next gap: {', '.join(left)}"
        self.result = replace(self.result, code=Code.ACCEPT, complete=not left, message=message)

    def _measure_thermal(self) -> Script[None]:
        if dropped := self._thermal.drop_old():
            self._messages.append(f"thermal: {dropped}")
        try:
            answer, left = yield from self._thermal.script(self.result.cycle_id)
        except SilentError as error:
            answer, left = DriverAnswer(Code.CONFLICT, str(error)), MEASUREMENT
            yield from self._cell.go_home()
        if left:
            self._leave(left)
        if answer is None:
            return
        candidate = answer.candidate_id
        self._messages.append(f"thermal: {answer.message}")
        if answer.missing:
            poses = ", ".join(map(str, answer.missing))
            self._messages.append(f"without pose {poses} of the cold reference")
        self.result = replace(self.result, thermal_code=answer.code, thermal_id=candidate)
        if not (answer.done and candidate):
            return
        # EXPIRED was said before this measurement, and must not keep its result waiting.
        found = yield from settled(
            self._cell,
            self._decider,
            THERMAL,
            candidate,
            lambda: self._unsound(AccuracyLevel.FAULT),
            self._tool.wall_ns,
        )
        self._decided(found)
        self._messages.append(found.message)
        if is_accepted(found):
            self.result = replace(self.result, accepted=(*self.result.accepted, candidate))

    def _measure_tool(self) -> Script[None]:
        yield from self._tool.script(self.result.cycle_id)
        if self._cell.robot.place == STATION:  # a measurement did not fit any more after a check
            yield
            yield from self._cell.go_home()
        yield from self._tool.find_beams(self.result.cycle_id)
        found = self._tool.outcome
        if found.left:
            self._leave(found.left)
        self._messages += [f"tool: {message}" for message in found.messages()]
        if longer := self._cell.longer_way_home():
            self._messages.append(longer)
        if found.fault:
            raise FaultError(Code.CONFLICT, found.fault)

    def _measure_fixture(self) -> Script[None]:
        try:
            answer, left = yield from self._fixture.script()
        except SilentError as error:
            answer, left = DriverAnswer(Code.CONFLICT, str(error)), FIXTURE_MEASUREMENT
        yield from self._cell.go_home()
        if left:
            self._leave(left)
        if answer is None:
            return
        if answer.code in JUDGED:
            found, code = answer.candidate_id, answer.code
            self.result = replace(self.result, fixture_code=code, fixture_id=found)
        waits = f"; candidate {answer.candidate_id} waits for a decision"
        self._messages.append(f"fixture: {answer.message}{waits if answer.done else ''}")

    def _leave(self, what: str) -> None:
        self.result = replace(self.result, left=(*self.result.left, what))
        left_s = max(self._cell.gap.left_s(self._cell.now_s), 0.0)
        message = f"{what}: left for the next gap, {left_s:.1f} s before the end of this one"
        command = Command(LEAVE, {"what": what, "left_s": left_s})
        self._decided(Outcome(command, Code.ACCEPT, message))

    def _unsure(self) -> str:
        """Why a tool that was measured now waits for a person; empty: it need not.

        By now the thermal node has heard of the cycle: what is EXPIRED still has no cold reference.
        """
        expired = AccuracyLevel.EXPIRED if self._cell.ways.count else AccuracyLevel.FAULT
        if why := self._unsound(expired):
            return why
        code, found = self.result.thermal_code, self.result.thermal_id
        if not self._cell.ways.count or code in NONE_BETTER:
            return ""
        # only a model that this cycle brought into force is known to be right
        known = code is Code.ACCEPT and found > 0 and self._decider.in_force(THERMAL, found)
        return "" if known else UNSURE

    def _unsound(self, worst: AccuracyLevel) -> str:
        """Why the drift, from a level on, leaves a decision to a person; else empty."""
        drift = self._drift()
        if drift is None:  # a cell without measuring poses need not have a thermal node
            return "the thermal node is silent" if self._cell.ways.count else ""
        return f"the drift is {drift.level.name}: {drift.reason}" if drift.level >= worst else ""

    def _drift_error(self) -> ToolError | None:
        """Of the thermal model in force, None where it is not known; without poses nobody asks."""
        if not self._cell.ways.count:
            return ToolError(0.0, 0.0)
        drift = self._drift()
        return None if drift is None else drift.error
