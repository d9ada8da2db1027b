"""Settled streams of joint messages: what need not be looked at goes out before it is a command."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from robocal_ros.correction.command_sources import CommandSources
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.correction.stream_messages import JointMessage
from robocal_ros.correction.wire import JointWire
from robocal_ros.nodes.source_guard import SourceGuard


class JointStream(ABC):
    """The serialized ``JointState`` of a topic, for a session.

    Parameters
    ----------
    publisher : of what goes out.
    """

    is_reading: bool

    def __init__(self, publisher: Any) -> None:
        self._wire, self._publisher = JointWire(), publisher

    def read(self, data: bytes) -> JointMessage:
        """What came, for the session; raises `InputError` where it cannot be read."""
        return JointMessage(self._wire, data, is_reading=self.is_reading)

    def before(self, guard: SourceGuard, receive: Callable[[Any], None]) -> Callable[[Any], None]:
        """Take what came; ``receive`` is given what the session must look at."""

        def take(data: bytes) -> None:
            if guard.fault or not self._passes(data):
                receive(data)

        return take

    @abstractmethod
    def _passes(self, data: bytes) -> bool:
        """Correct and publish a plain message; False, and nothing done, for any other."""


class ReadingStream(JointStream):
    """Readings; ``now_ns`` gives the time of the clock that stamps them."""

    is_reading = True

    def __init__(
        self, session: CorrectionSession, publisher: Any, now_ns: Callable[[], int]
    ) -> None:
        super().__init__(publisher)
        self._plain, self._now_ns = session.plain_readings(self._wire), now_ns

    def _passes(self, data: bytes) -> bool:
        out = self._plain.take(data, time.monotonic(), self._now_ns())
        if out is not None:
            self._publisher.publish(out)
        return out is not None


class TargetStream(JointStream):
    """Targets on ``topic``; ``tell`` is called at the time when one went out."""

    is_reading = False

    def __init__(
        self,
        session: CorrectionSession,
        publisher: Any,
        topic: str,
        sources: CommandSources,
        tell: Callable[[float], None],
    ) -> None:
        super().__init__(publisher)
        self._plain, self._tell = session.plain_targets(self._wire), tell
        self._topic, self._sources = topic, sources

    def _passes(self, data: bytes) -> bool:
        now = time.monotonic()
        if not self._sources.go_on(self._topic, now):
            return False
        out = self._plain.take(data, now)
        if out is not None:
            self._sources.hear(self._topic, now)
            self._publisher.publish(out)
            self._tell(now)
        return out is not None
