"""What the session asks of whoever drives it, and what is answered."""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from itertools import count
from typing import Any, TypeVar

import numpy as np

from robocal_ros.ground.errors import Code, ConflictError
from robocal_ros.motion.plan import JointPlan


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
class Arm(DriverRequest):
    """Let the tool's driver move the robot (`ToolDriver.arm`, `tcf_node` ``~/arm``)."""


@dataclass(frozen=True)
class Disarm(DriverRequest):
    """Forbid it; a motion of its own is stopped at once."""


@dataclass(frozen=True)
class Measure(DriverRequest):
    """Measure the tool; ``mode`` of `tool.results`. Answered when the run has ended."""

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
    """What came of a request.

    Attributes
    ----------
    code : ACCEPT when done, else why not; a verdict where there is one.
    candidate_id : calibration in the history, else 0.
    missing : numbers, from 1, of the cold poses that were not measured.
    visited : number of those that were; None where that is not told.
    has_result : whether a measurement reached one.
    answer : of a quick check: "pass", "recalibrate", "cannot tell".
    deviation_mm, sigma_mm : of the tip from the tool in force.
    left_plan : the robot was stopped because it left its plan.
    absent : the request reached nobody, as the node is not there.
    """

    code: Code
    message: str = ""
    candidate_id: int = 0
    missing: tuple[int, ...] = ()
    has_result: bool = False
    answer: str = ""
    deviation_mm: float = 0.0
    sigma_mm: float = 0.0
    left_plan: bool = False
    absent: bool = False
    visited: int | None = None

    @property
    def done(self) -> bool:
        """Whether it did what was asked."""
        return self.code is Code.ACCEPT


# ---- requests to others, and scripts that wait for their answers from tick to tick --------------
#
# A script is a generator: it yields whenever it has to wait, and is resumed at the next tick.


R = TypeVar("R")
Script = Generator[None, None, R]


class SilentError(ConflictError):
    """A node did not answer in time."""


class Asking:
    """What was asked and who waits for an answer; times of a steady clock.

    Attributes
    ----------
    now_s : of the tick.
    out : requests that wait to be carried out.
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
        """Wait for an answer.

        Raises
        ------
        SilentError
            When it does not come in time.
        """
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


# ---- disarming ----------------------------------------------------------------------------------
#
# Safety case: nothing moves, and no fault is acknowledged, while another node might move the
# robot. Only its own confirmation ends that doubt; a node that hangs gives none, and may be
# moving. One that is not there at all can give none either, and would block the cell for ever. It
# is let go where it cannot move anything: its service has not existed for `GONE_S`, with each
# disarm that was asked (a node that starts is found sooner, and starts disarmed); this node has
# not armed it since the last confirmed disarm, so that no motion that was asked for here can be
# under way, not the rest of a dead node's trajectory either; and the robot rests at home (`Hands`
# looks).
#
# A node that was started anew confirms too, but knows nothing of that trajectory. So a
# confirmation tells what will be sent; what was sent before it is over where the measurement has
# been answered, or was stopped from here, and the robot rests: until then it is in doubt as well.


AGAIN_S = 0.5
GONE_S = 5.0
SENT = "what the tool node sent may still be driven"


class Disarming:
    """What is known of the tool's driver; times of a steady clock.

    Attributes
    ----------
    engaged : it may be armed.
    armed : this node armed it, and what it was to move may still be under way.
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

    def words(self) -> str:
        """What a person can do."""
        if self.absent:
            return "the tool node is not there: start it, or leave 'laser' empty"
        return "the tool node is silent: wait for it, or start it anew"

    def require_disarmed(self) -> None:
        """Refuse, with a `ConflictError`, what needs a robot that nothing moves from there."""
        if self.engaged:
            words = "the tool node has not confirmed that it is disarmed"
            raise ConflictError(f"{words}; {self.words()}")
        if self.armed:
            raise ConflictError(f"{SENT}: wait until the robot rests")
