# SPDX-License-Identifier: Apache-2.0
"""What a session was told and what came of it, written into a bag as its node does."""

from collections.abc import Mapping
from typing import Any

from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagWriter
from robocal_ros.session.events import Command, Outcome, arguments_text, outcome_text


class EventLog:
    """Writes commands onto a topic of ``robocal_msgs/SessionEvent``."""

    def __init__(self, bag: BagWriter, topic: str) -> None:
        self._bag, self._topic, self._sequence = bag, topic, 0

    def write(self, command: Command, outcome: Outcome | None, now_ns: int) -> None:
        """Write a command and what came of it; None for a configuration."""
        self._sequence += 1
        message: Mapping[str, Any] = {
            "stamp": ros_time(command.stamp_ns or 0),
            "sequence": self._sequence,
            "command": command.name,
            "arguments": arguments_text(command),
            "outcome": "{}" if outcome is None else outcome_text(outcome),
        }
        self._bag.write(self._topic, "robocal_msgs/msg/SessionEvent", message, now_ns)
