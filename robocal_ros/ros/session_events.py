"""The record of a session on its topic: each command with its outcome, and what it began from."""

from collections.abc import Callable
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from robocal_msgs.msg import SessionEvent

from robocal_ros.ros.conversions import time_message
from robocal_ros.session.events import CONFIGURE, Command, Outcome, arguments_text, outcome_text

# A recorder that comes later still gets the events.
EVENTS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

AddOutput = Callable[[type, str, QoSProfile], Any]


class SessionEvents:
    """Publisher of one session's events."""

    def __init__(self, add: AddOutput) -> None:
        self._events = add(SessionEvent, "~/session_events", EVENTS)
        self._sequence = 0
        self._since = 0  # events after the last configuration

    def tell(self, command: Command, outcome: Outcome | None) -> None:
        """Record a command and what came of it, None for the configuration."""
        self._sequence += 1
        self._since = 0 if command.name == CONFIGURE else self._since + 1
        self._events.publish(event_message(command, outcome, self._sequence))

    @property
    def need_configuration(self) -> bool:
        """Whether to tell the configuration again although nothing has changed.

        A recording that begins later gets the last events alone, and cannot be replayed without a
        configuration among them.
        """
        return self._since >= EVENTS.depth // 2


def event_message(command: Command, outcome: Outcome | None, sequence: int) -> SessionEvent:
    """A command and what came of it, None for the configuration."""
    return SessionEvent(
        stamp=time_message(command.stamp_ns or 0),
        sequence=sequence,
        command=command.name,
        arguments=arguments_text(command),
        outcome="{}" if outcome is None else outcome_text(outcome),
    )
