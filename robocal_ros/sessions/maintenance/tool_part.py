"""The tool part of a run: quick check, full measurement where it is needed, verification."""

from collections.abc import Callable
from dataclasses import dataclass

from robocal_ros.core.codes import Code
from robocal_ros.core.errors import RobocalError
from robocal_ros.core.proposals import TOOL
from robocal_ros.core.thermal.accuracy import ToolError
from robocal_ros.sessions.events import ROLLBACK, Command, Outcome
from robocal_ros.sessions.maintenance.asking import Script, SilentError
from robocal_ros.sessions.maintenance.config import Times
from robocal_ros.sessions.maintenance.deciding import BY, Decider
from robocal_ros.sessions.maintenance.hands import Hands
from robocal_ros.sessions.maintenance.memory import Memory
from robocal_ros.sessions.maintenance.requests import Answer
from robocal_ros.sessions.maintenance.settling import is_accepted, patiently, settled
from robocal_ros.sessions.maintenance.thermal_part import CycleBook
from robocal_ros.sessions.tool_driving import STANDS_S
from robocal_ros.sessions.tool_results import FULL, QUICK

NS = 1_000_000_000
FAILED = (Code.WRONG_TOOL, Code.CLOCK_WRONG, Code.BEAM_EDGES_WRONG, Code.RESIDUAL_TOO_LARGE)
MOVED = "the sensor or the robot has moved, and a robot that has looks like a bent tool"


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
    fault : why an accepted tool that failed its check is still in force; empty: it is not.
    told : why not, or what a person must know.
    left : what did not fit.
    """

    first: Answer | None = None
    last: Answer | None = None
    checked: str = ""
    bent: bool = False
    candidate_id: int = 0
    accepted: bool = False
    fault: str = ""
    told: str = ""
    left: str = ""

    def came(self, answer: Answer) -> None:
        """Of a measurement."""
        self.first, self.last = self.first or answer, answer

    @property
    def found_code(self) -> Code:
        """What was found of the tool as the gap began, also where that is mended since."""
        if self.bent:
            return Code.LIMIT_EXCEEDED
        return self.first.code if self.first else Code.NONE

    def words(self) -> list[str]:
        """What was found first, what came last, and what else there is to say; each once."""
        said = [each.message for each in (self.first, self.last) if each] + [self.told]
        said = list(dict.fromkeys(filter(None, said)))
        return [words for words in said if not any(words in o for o in said if o is not words)]


def worst_s(times: Times, mode: str) -> float:
    """From home and back, with everything that may go wrong."""
    limit_s = times.check_s if mode == QUICK else times.full_s
    # Stand, arm, run, its end after a cancel, disarm, stand twice, way home, rest.
    return limit_s + 3.0 * times.answer_s + 4.0 * times.rest_s + times.tool_home_s


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
        book: CycleBook,
        decider: Decider,
        memory: Memory,
        decided: Callable[[Outcome], None],
        unsure: Callable[[], str],
        drift: Callable[[], ToolError | None],
    ) -> None:
        self._hands, self._book, self._decider, self._memory = hands, book, decider, memory
        self._decided, self._unsure, self._drift = decided, unsure, drift
        self._times = hands.config.times
        self._checked = 0  # revision of the tool that the last measurement was about
        self._through = 0  # thermal model that gave its flange poses
        self.wall_ns = 0
        self.outcome = ToolOutcome()

    def wants(self) -> str:
        """The measurement that is due: FULL or QUICK; empty: none."""
        record, config = self._memory.tool, self._hands.config
        if config.T_base_laser is None or self._decider.newest(TOOL):
            return ""
        known = 0 < record.wall_ns <= self.wall_ns
        known = known and record.revision == self._decider.revision(TOOL)
        known = known and record.thermal_id == self._decider.thermal_id()
        if known and record.answer in ("recalibrate", "cannot tell"):
            return FULL
        known = known and record.answer != "failed"
        due = not known or self._age_s(record.wall_ns) >= config.check_every_s
        return QUICK if due else ""

    def script(self, cycle_id: str) -> Script[None]:
        """Everything that is due and fits."""
        outcome = self.outcome
        wanted = self.wants()
        if not wanted:
            if waiting := self._decider.newest(TOOL):
                outcome.told = f"tool candidate {waiting.id} waits for a decision"
            return
        if wanted == QUICK:
            if not (yield from self._check(cycle_id, "check", outcome)):
                return
            passed = self._memory.tool.answer == "pass"
            if passed and not self._full_is_due():
                return
            optional = passed
        else:
            optional = False
        if optional and not self._hands.fits(worst_s(self._times, FULL)):
            return  # only when time allows
        yield from self._full(cycle_id, outcome)
        return

    def _full_is_due(self) -> bool:
        every_s = self._hands.config.full_every_s
        return every_s > 0.0 and not 0.0 <= self._age_s(self._memory.tool.full_ns) < every_s

    def _check(self, cycle_id: str, name: str, outcome: ToolOutcome) -> Script[bool]:
        """A quick check; whether it gave an answer."""
        answer = yield from self._measured(QUICK, f"{cycle_id}/{name}", outcome)
        if answer is None:
            return False
        outcome.checked = answer.answer
        self._note(answer, answer.answer)
        return True

    def _full(self, cycle_id: str, outcome: ToolOutcome) -> Script[None]:
        answer = yield from self._measured(FULL, f"{cycle_id}/full", outcome)
        if answer is None:
            return
        self._memory.note_tool(full_ns=self.wall_ns)
        outcome.candidate_id = answer.candidate_id
        if answer.code is Code.NO_SIGNIFICANT_GAIN:
            self._note(answer, "pass")
            return
        self._note(answer, "recalibrate", answer.candidate_id if answer.done else 0)
        outcome.bent = answer.done and outcome.checked != "pass"
        if answer.done and (drift := self._drift()) is not None:
            self._memory.note_tool(drift_rms_m=drift.rms_m, drift_bound_m=drift.bound_m)
        if not answer.done:
            outcome.told = f"tool measurement {answer.candidate_id}: {answer.message}"
            return
        found = yield from settled(
            self._hands, self._decider, TOOL, answer.candidate_id, self._doubt, self.wall_ns
        )
        self._decided(found)
        if not is_accepted(found):
            outcome.told = found.message
            return
        outcome.accepted = True
        yield from self._verify(cycle_id, outcome)

    def _doubt(self) -> str:
        """Why a candidate inside the bounds waits for a person all the same; empty: it need not."""
        return MOVED if self._book.moved else self._unsure()

    def _verify(self, cycle_id: str, outcome: ToolOutcome) -> Script[None]:
        """Check the tool that was just accepted; one that is not right is taken back."""
        verified = yield from self._check(cycle_id, "verify", outcome)
        if not self._decider.in_force(TOOL, outcome.candidate_id):
            outcome.accepted = False  # somebody chose another one
        elif not verified:
            outcome.left = "verification of the accepted tool"
        elif outcome.checked == "recalibrate":
            yield from self._take_back(outcome)

    def _take_back(self, outcome: ToolOutcome) -> Script[None]:
        number = outcome.candidate_id

        def act() -> Outcome:
            if not self._decider.in_force(TOOL, number):  # a try before did it, or somebody else
                words = "the accepted tool failed its check and is no longer in force"
                return Outcome(Command(ROLLBACK, {}), Code.ACCEPT, words, repeated=True)
            why = "its check failed"
            return self._decider.roll_back(TOOL, self._checked, BY, why, self.wall_ns)

        try:
            back = yield from patiently(self._hands, act)
            self._decided(back)
            why = "" if back.done else back.message
        except RobocalError as error:
            why = str(error)
        if why:
            outcome.fault = f"tool {number} failed its check and could not be taken back: {why}"
            return
        outcome.accepted = False
        if back.repeated:
            outcome.told = back.message
            return
        outcome.told = "the accepted tool failed its check and was taken back: look at it"
        self._memory.note_tool(revision=self._decider.revision(TOOL), words=outcome.told)

    def _measured(self, mode: str, cycle_id: str, outcome: ToolOutcome) -> Script[Answer | None]:
        """From home and back home; None where it did not fit, or gave no result for this tool."""
        hands = self._hands
        yield  # what was kept just before may have taken its time: the gap is looked at again
        if hands.tool.absent:
            outcome.left = f"tool measurement ({mode})"
            outcome.came(Answer(Code.CONFLICT, hands.tool.words(), absent=True))
            return None
        if not hands.fits(worst_s(self._times, mode)):
            outcome.left = f"tool measurement ({mode})"
            return None
        hands.doing = f"tool measurement ({mode})"
        yield from hands.stand(STANDS_S)
        self._checked, self._through = self._decider.revision(TOOL), self._decider.thermal_id()
        try:
            answer = yield from hands.arm()
            if answer.done:
                limit_s = self._times.check_s if mode == QUICK else self._times.full_s
                answer = yield from hands.measure(mode, cycle_id, limit_s)
        except SilentError as error:
            answer = Answer(Code.CONFLICT, str(error))
        outcome.came(answer)
        yield from hands.disarmed()
        yield from hands.stand(STANDS_S)
        yield from hands.go_home()
        if answer.has_result and self._checked == self._decider.revision(TOOL):
            return answer
        outcome.left = f"tool measurement ({mode})"
        if answer.has_result:
            outcome.told = f"{outcome.left} is discarded: another tool came into force"
            return None
        outcome.told = f"{outcome.left}: {answer.message}"
        if answer.code in FAILED:  # what an older check found of the tool holds no more
            self._memory.note_tool(
                answer="failed",
                words=answer.message,
                revision=self._checked,
                thermal_id=self._through,
                candidate=0,
            )
        return None

    def _note(self, answer: Answer, verdict: str, candidate: int = 0) -> None:
        self._memory.note_tool(
            answer=verdict,
            words=answer.message,
            deviation_mm=answer.deviation_mm,
            sigma_mm=answer.sigma_mm,
            revision=self._checked,
            thermal_id=self._through,
            candidate=candidate,
            wall_ns=self.wall_ns,
        )

    def _age_s(self, wall_ns: int) -> float:
        return (self.wall_ns - wall_ns) / NS
