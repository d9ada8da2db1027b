"""Plays the script of a run from tick to tick, and stops everything where something is odd."""

from collections.abc import Callable
from pathlib import Path
from traceback import extract_tb

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.maintenance.asking import Script
from robocal_ros.maintenance.hands import Hands
from robocal_ros.maintenance.memory import Memory
from robocal_ros.maintenance.mover import FaultError
from robocal_ros.maintenance.run import CycleRun

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
