"""The tool part of a run: quick check, full measurement where it is needed, verification."""

from collections.abc import Callable
from dataclasses import dataclass

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.ground.proposals import TOOL
from robocal_ros.maintenance.deciding import BY, Decider, is_accepted, patiently, settled
from robocal_ros.maintenance.hands import Hands
from robocal_ros.maintenance.memory import Memory, ToolRecord
from robocal_ros.maintenance.mover import FaultError
from robocal_ros.maintenance.requests import DriverAnswer, Script, SilentError
from robocal_ros.maintenance.thermal_part import ThermalCycle
from robocal_ros.session.events import ROLLBACK, Command, Outcome
from robocal_ros.thermal.accuracy import ToolError
from robocal_ros.tool.driving import STANDS_S
from robocal_ros.tool.results import FULL, QUICK

# ---- one measurement of the tool, and what it tells of it ---------------------------------------


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
    """Measures the tool, from home and back.

    Parameters
    ----------
    drift : error of the thermal model in force now; None: not known.

    Attributes
    ----------
    outcome : of the run, as far as it has come.
    revision : of the tool that the last measurement was about.
    wall_ns : of the tick.
    """

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


# ---- tool part ----------------------------------------------------------------------------------


NS = 1_000_000_000
MOVED = "the sensor or the robot has moved, and a robot that has looks like a bent tool"
LATE = "its check does not fit this gap any more, and it is accepted in a gap where that fits"


class ToolPart:
    """Keeps the tool right; what does not fit is done in the next gap.

    Parameters
    ----------
    decided : told of each decision that was made without a person.
    unsure : why a tool that was measured now waits for a person; empty: it need not.
    drift : error of the thermal model in force now; None: not known.

    Attributes
    ----------
    outcome : as far as it has come.
    """

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

    # ---- what was measured ----------------------------------------------------------------------

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
