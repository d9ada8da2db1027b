"""One maintenance run: thermal measurement, tool, and what became of both."""

from collections.abc import Callable
from dataclasses import replace

from robocal_ros.ground.errors import Code
from robocal_ros.ground.proposals import THERMAL
from robocal_ros.maintenance.accuracy import Drift
from robocal_ros.maintenance.asking import Script, SilentError
from robocal_ros.maintenance.deciding import Decider
from robocal_ros.maintenance.hands import Hands
from robocal_ros.maintenance.memory import CycleResult, Memory
from robocal_ros.maintenance.mover import FaultError
from robocal_ros.maintenance.requests import DriverAnswer
from robocal_ros.maintenance.settling import is_accepted, settled
from robocal_ros.maintenance.thermal_part import MEASUREMENT, NONE_BETTER, ThermalCycle, ThermalPart
from robocal_ros.maintenance.tool_part import ToolPart
from robocal_ros.session.events import LEAVE, Command, Outcome
from robocal_ros.thermal.accuracy import AccuracyLevel, ToolError

UNSURE = "this cycle brought no thermal result into force, and a drift looks like a bent tool"


class CycleRun:
    """The script of a cycle, and its result as it grows.

    Parameters
    ----------
    result : of the cycle that begins.
    drift : what the thermal node says of itself now; None: it is silent.

    Attributes
    ----------
    result : code NONE until it has ended.
    wall_ns : of the tick.
    """

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
