"""One maintenance run: thermal measurement, tool, and what became of both."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from traceback import extract_tb

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.ground.proposals import THERMAL
from robocal_ros.maintenance.accuracy import Drift
from robocal_ros.maintenance.deciding import Decider, is_accepted, settled
from robocal_ros.maintenance.hands import Hands
from robocal_ros.maintenance.memory import CycleResult, Memory
from robocal_ros.maintenance.mover import FaultError
from robocal_ros.maintenance.requests import DriverAnswer, Script, SilentError
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


# ---- conductor ----------------------------------------------------------------------------------


ENDED, FAULT = "maintenance_ended", "fault"
UNSAVED_S = 2.0  # a fault is written by then, whatever the robot may be doing
Tell = Callable[[str, dict[str, object], Code, str], None]


class Conductor:
    """The run that is open.

    Parameters
    ----------
    tell : takes name, arguments, code and words of what happens.

    Attributes
    ----------
    run : None while nothing runs.
    broken : why the run is broken off; None while it goes on.
    """

    def __init__(self, hands: Hands, memory: Memory, tell: Tell) -> None:
        self._hands, self._memory, self._tell = hands, memory, tell
        self.run: CycleRun | None = None
        self.broken: tuple[Code, str] | None = None
        self._script: Script[None] | None = None
        self._unsaved, self._save_by_s = False, 0.0

    def begin(self, run: CycleRun) -> None:
        """A run begins at the next tick; nothing moves before the tool's driver is disarmed."""
        self._hands.doubt()
        self.run, self._script, self.broken = run, self._whole(run), None
        self._hands.doing = "begins"

    def tick(self, wall_ns: int) -> None:
        """Look after gap and robot, then go on."""
        run, hands = self.run, self._hands
        if self._unsaved and (not hands.stopping or hands.now_s >= self._save_by_s):
            self._save()
        hands.look_after_tool()
        if run is None:
            hands.keep_disarming()
            return
        run.at(wall_ns)
        try:
            if hands.may_wait():
                return
            if why := hands.gap.over(hands.now_s):
                self.give_up(why)
                return
            hands.robot.require_sane(hands.now_s)
            if self._script is not None:
                next(self._script)
        except StopIteration:
            self._script_ended(run)
        except FaultError as error:
            self.fault(error.code, str(error))
        except RobocalError as error:
            self._failed(error)
        except Exception as error:  # a defect: the script is over, and the robot may move
            self.fault(Code.CONFLICT, _defect(error))

    def break_off(self, code: Code, reason: str) -> None:
        """Stop the robot, and bring it home; the run ends with this code."""
        self._close_script()
        self.broken = code, reason
        self._hands.doing = "is broken off"
        self._script = self._hands.after_break()

    def fault(self, code: Code, reason: str, at_once: bool = False) -> None:
        """Stop the robot where it moves, disarm, end the run; nothing more until acknowledged.

        ``at_once``: no tick follows, see `Hands.halt`.
        """
        self._close_script()
        hands, run = self._hands, self.run
        if run is not None and run.owes not in reason:
            reason = f"{reason}; {run.owes}"
        try:
            hands.halt(at_once)
        except Exception as error:  # without a stop of ours it must still be disarmed, and told
            reason = f"{reason}; no stop was sent: {_defect(error)}"
        if hands.tool.engaged:
            hands.disengage()
        self.run, hands.doing = None, "fault"
        self._tell(FAULT, {}, code, reason)
        self._note(run, code, reason, fault=reason)
        # A stop, one that is yet to come too, does not wait for the disk: without this write too
        # the next start finds a fault.
        self._unsaved = bool(hands.out or hands.stopping)
        self._save_by_s = hands.now_s + UNSAVED_S
        if not self._unsaved:
            self._save()

    def give_up(self, why: str, at_once: bool = False) -> None:
        """End the run now: at home and disarmed it just ends, anywhere else it is a `fault`.

        ``at_once``: a stop that is still due after a fault goes out too, see `Hands.halt`.
        """
        hands = self._hands
        if self.run is None:
            if at_once and hands.stopping:
                hands.halt(at_once)
        elif hands.not_handed_over():
            words = f"{why}, and the robot is not handed over at home"
            self.fault(Code.CONFLICT, words, at_once)
        else:
            self._end(Code.CONFLICT, why)

    def _whole(self, run: CycleRun) -> Script[None]:
        if self._hands.tool.engaged:
            yield from self._hands.disarmed()
        yield from run.script()

    def _script_ended(self, run: CycleRun) -> None:
        robot = self._hands.robot
        if away := robot.beside_home():
            code = Code.TOO_FEW_SAMPLES if robot.unheard else Code.LIMIT_EXCEEDED
            self.fault(code, f"robot is not at home: {away}")
        elif self._hands.tool.doubted:
            self.fault(Code.CONFLICT, "the tool node may still be armed")
        elif self.broken is not None:
            self._end(*self.broken)
        else:
            self._end(run.result.code, run.result.message)

    def _failed(self, error: RobocalError) -> None:
        """Something was refused in the middle of it: home, and end with its code."""
        if self.broken is None:
            self.break_off(error.code, str(error))
        else:
            self.fault(error.code, str(error))

    def _end(self, code: Code, message: str) -> None:
        self._close_script()
        run = self.run
        if run is not None and run.owes:
            message = f"{message}; {run.take_back()}"
            if run.owes:
                self.fault(Code.CONFLICT, message)
                return
        self.run = None
        self._hands.doing = ""
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
        self._hands.forget_answers()


def _defect(error: Exception) -> str:
    """Where it is, for whoever mends it."""
    place = extract_tb(error.__traceback__)[-1]
    return f"defect in {Path(place.filename).name}:{place.lineno}: {type(error).__name__}: {error}"
