"""Commands of callers, carried out by a session in their turn; each caller gets the outcome."""

import time
import traceback
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from rclpy.task import Future

from robocal_ros.ros.endpoints import EndpointNode, NotActiveError
from robocal_ros.session.events import Command, Outcome


class Session(Protocol):
    """What a session does with commands."""

    @property
    def waiting(self) -> int:
        """Number of commands not yet carried out."""

    def submit(self, command: Command, clock_ns: int | None = None) -> None:
        """Queue a command."""

    def step(self, *, wall_ns: int, force: bool = False) -> list[Outcome]:
        """Carry out one command: what was decided outside before it, and it."""


class CommandDesk:
    """Between the callers of a node and its session.

    Parameters
    ----------
    timeout_s : a command waits at most so long for its samples.
    show : takes each outcome, also of what was decided outside.

    Attributes
    ----------
    session : None while the node is inactive.
    """

    def __init__(
        self, node: EndpointNode, timeout_s: float, show: Callable[[Outcome], None]
    ) -> None:
        self._node, self._show = node, show
        self._asked: deque[Future] = deque()
        self.session: Session | None = None
        self._deadline = node.add_timer(timeout_s, self._force, steady=True)
        self._deadline.cancel()

    def ask(self, command: Command) -> Future:
        """Give a command to the session; the future becomes its outcome."""
        if self.session is None:
            raise NotActiveError("no session: activate the node")
        future: Future = Future()
        if not self._asked:
            self._deadline.reset()
        self._asked.append(future)
        self.session.submit(command, self._node.now_ns())
        self.step()
        return future

    def step(self, *, force: bool = False) -> None:
        """Carry out the commands whose samples are complete."""
        while self.session is not None and self._asked:
            try:
                outcomes: list[Any] = self.session.step(wall_ns=time.time_ns(), force=force)
            except Exception as error:  # a defect must not end the node: the caller is told
                self._asked.popleft().set_exception(error)
                continue
            if not outcomes:
                return
            asked = self._asked.popleft()  # before it is shown: that may give a command too
            for outcome in outcomes:
                self._show_safely(outcome)
            asked.set_result(outcomes[-1])
        self._deadline.cancel()

    def _show_safely(self, outcome: Outcome) -> None:
        """A defect in showing what was done must not take the answer from its caller."""
        try:
            self._show(outcome)
        except Exception:
            self._node.get_logger().error(f"not shown:\n{traceback.format_exc()}")

    def close(self) -> None:
        """End the session; calls that wait are answered."""
        self.session = None
        self._deadline.cancel()
        while self._asked:
            error = NotActiveError("deactivated while the command waited: nothing was done")
            self._asked.popleft().set_exception(error)

    def _force(self) -> None:
        self.step(force=True)
