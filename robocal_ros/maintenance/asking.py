"""Requests to others, and scripts that wait for their answers from tick to tick.

A script is a generator: it yields whenever it has to wait, and is resumed at the next tick.
"""

from collections.abc import Callable, Generator
from itertools import count
from typing import Any, TypeVar

from robocal_ros.ground.errors import ConflictError
from robocal_ros.maintenance.requests import DriverAnswer, DriverRequest

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
