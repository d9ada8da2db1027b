"""One measurement of the tool, and what it tells of it."""

from collections.abc import Callable
from dataclasses import dataclass

from robocal_ros.ground.errors import Code
from robocal_ros.ground.proposals import TOOL
from robocal_ros.maintenance.asking import Script, SilentError
from robocal_ros.maintenance.deciding import Decider
from robocal_ros.maintenance.hands import Hands
from robocal_ros.maintenance.memory import Memory, ToolRecord
from robocal_ros.maintenance.mover import FaultError
from robocal_ros.maintenance.requests import DriverAnswer
from robocal_ros.thermal.accuracy import ToolError
from robocal_ros.tool.driving import STANDS_S
from robocal_ros.tool.results import FULL, QUICK

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
