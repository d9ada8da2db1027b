"""The tool part of a run: quick check, full measurement where it is needed, verification."""

from collections.abc import Callable

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.ground.proposals import TOOL
from robocal_ros.maintenance.asking import Script
from robocal_ros.maintenance.deciding import BY, Decider
from robocal_ros.maintenance.hands import Hands
from robocal_ros.maintenance.memory import Memory
from robocal_ros.maintenance.settling import is_accepted, patiently, settled
from robocal_ros.maintenance.thermal_part import ThermalCycle
from robocal_ros.maintenance.tool_measuring import ToolMeasuring, ToolOutcome
from robocal_ros.session.events import ROLLBACK, Command, Outcome
from robocal_ros.thermal.accuracy import ToolError
from robocal_ros.tool.results import FULL, QUICK

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
