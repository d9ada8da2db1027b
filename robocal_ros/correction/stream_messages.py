"""Joint targets, commands and states that came in, and what goes out for them.

Joint states are read and written as they come over the wire; irregular ones are made messages.
"""

from typing import Any

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from robocal_ros.core.errors import InputError
from robocal_ros.correction import messages
from robocal_ros.correction.inputs import JointCommand, finite_command
from robocal_ros.correction.wire import JointWire


def read_message(data: bytes, kind: type) -> Any:
    """Build a message.

    Raises
    ------
    InputError
        When the bytes are no such message.
    """
    try:
        return deserialize_message(data, kind)
    except Exception as error:  # what the middleware says has no type of its own
        raise InputError(f"this is no {kind.__name__}: {error}") from error


class JointMessage:
    """A serialized ``JointState`` that came in, its command, and what goes out for it.

    Parameters
    ----------
    wire : of its topic.
    is_reading : velocities and efforts that are not finite go out empty: many drivers have none.

    Raises
    ------
    InputError
        When it cannot be read.
    """

    def __init__(self, wire: JointWire, data: bytes, *, is_reading: bool = False) -> None:
        self._wire, self._data = wire, data
        self._command = wire.read(data)
        self._message: Any = None
        if self._command is None:
            self._message = read_message(data, JointState)
            if is_reading:
                messages.drop_unknown_rates(self._message)

    def is_finite(self) -> bool:
        """Whether every number is finite."""
        return self._command is not None or messages.is_finite(self._message)

    def command(self) -> JointCommand:
        """Build the session's command; raises `RefusedError` as `finite_command`."""
        return finite_command(self._message) if self._command is None else self._command

    def unchanged(self) -> Any:
        """What came, to publish."""
        return self._data if self._message is None else self._message

    def changed(self, command: JointCommand) -> Any:
        """What to publish: with the command's positions, velocities and mark."""
        if self._message is None:
            return self._wire.written(self._data, command)
        messages.fill_joints(self._message, command)
        return self._message


class ArrayMessage:
    """A ``Float64MultiArray`` that came in, whose data are the positions of ``names``."""

    def __init__(self, names: tuple[str, ...], message: Any) -> None:
        self._names, self._message = names, message

    def is_finite(self) -> bool:
        """Whether every number is finite."""
        return messages.is_finite(self._message)

    def command(self) -> JointCommand:
        """Build the session's command."""
        return messages.array_command(self._names, self._message)

    def unchanged(self) -> Any:
        """What came, to publish."""
        return self._message

    def changed(self, command: JointCommand) -> Any:
        """What to publish: with the command's positions."""
        messages.fill_array(self._message, command)
        return self._message
