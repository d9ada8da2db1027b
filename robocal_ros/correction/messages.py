"""What goes in and out of the joint correction node as messages.

Joint states and trajectories are read and written as they come over the wire; irregular ones go by
way of a message, which is also what names their fault.
"""

import math
from array import array
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.correction.interface import (
    Array,
    JointCommand,
    TrajectoryCommand,
    finite_command,
    joint_command,
    require_finite,
    trajectory_command,
)
from robocal_ros.correction.wire import JointWire, SerializedPath, read_path
from robocal_ros.ground.errors import InputError
from robocal_ros.ros.conversions import header

POINT_FIELDS = ("positions", "velocities", "accelerations", "effort")
POSITIONS, VELOCITIES, ACCELERATIONS, EFFORTS = FIELDS = range(4)


def doubles(values: Array) -> "array[float]":
    """The type that a message takes without looking at each number."""
    return array("d", values.tobytes())


def read_message(data: bytes, kind: type) -> Any:
    """Build a message; `InputError` when the bytes are none."""
    try:
        return deserialize_message(data, kind)
    except Exception as error:  # what the middleware says has no type of its own
        raise InputError(f"this is no {kind.__name__}: {error}") from error


def all_finite(*rows: Any) -> bool:
    """Whether every number of these is finite."""
    return all(all(map(math.isfinite, row)) for row in rows)


class JointMessage:
    """A serialized ``JointState`` that came in, its command, and what goes out for it.

    With ``is_reading`` velocities that are as many as joints, and efforts, go out empty where one
    is not finite: many drivers have none. Raises `InputError` when it cannot be read.
    """

    def __init__(self, wire: JointWire, data: bytes, *, is_reading: bool = False) -> None:
        self._wire, self._data, self._is_reading = wire, data, is_reading
        self._command = wire.read(data)
        self._message: Any = None
        if self._command is None:
            self._message = read_message(data, JointState)
            if is_reading:
                self._drop_unknown(self._message)

    @staticmethod
    def _drop_unknown(message: Any) -> None:
        """Empty what a driver does not know: numbers that are not finite, or too few."""
        for name in ("velocity", "effort"):
            values = getattr(message, name)
            if not (all_finite(values) and len(values) in (0, len(message.name))):
                setattr(message, name, array("d"))

    def is_finite(self) -> bool:
        """Whether every number is finite."""
        message = self._message
        return message is None or all_finite(message.position, message.velocity, message.effort)

    def command(self) -> JointCommand:
        """Build the session's command; raises `RefusedError` as `finite_command`."""
        if self._command is not None:
            return self._command
        return joint_command(self._message) if self._is_reading else finite_command(self._message)

    def unchanged(self) -> Any:
        """What came, to publish; of a reading without what its driver does not know."""
        if self._message is None and not self._wire.is_finite:
            self._message = read_message(self._data, JointState)
            self._drop_unknown(self._message)
        return self._data if self._message is None else self._message

    def changed(self, command: JointCommand) -> Any:
        """What to publish: with the command's positions, velocities and mark."""
        message = self._message
        if message is None:
            return self._wire.written(self._data, command)
        message.header.frame_id = command.mark
        message.position = doubles(command.position)
        if command.velocity is not None:
            message.velocity = doubles(command.velocity)
        elif self._is_reading:
            message.velocity = array("d")
        return message


class ArrayMessage:
    """A ``Float64MultiArray`` that came in, whose data are the positions of ``names``."""

    def __init__(self, names: tuple[str, ...], message: Any) -> None:
        self._names, self._message = names, message

    def is_finite(self) -> bool:
        """Whether every number is finite."""
        return all_finite(self._message.data)

    def command(self) -> JointCommand:
        """Build the session's command."""
        return JointCommand(self._names, np.array(self._message.data, dtype=np.float64))

    def unchanged(self) -> Any:
        """What came, to publish."""
        return self._message

    def changed(self, command: JointCommand) -> Any:
        """What to publish: with the command's positions; the layout stays."""
        self._message.data = doubles(command.position)
        return self._message


def tail_message(command: JointCommand, kind: type, stamp_ns: int) -> Any:
    """What goes out without a message that came: ``JointState`` or ``Float64MultiArray``."""
    if kind is Float64MultiArray:
        return Float64MultiArray(data=doubles(command.position))
    message = JointState(name=list(command.names), position=doubles(command.position))
    message.header = header(stamp_ns, command.mark)
    if command.velocity is not None:
        message.velocity = doubles(command.velocity)
    return message


class PathMessage:
    """A trajectory that ``came`` in, its command, and what goes out for it.

    Raises `InputError` when it cannot be read.
    """

    def __init__(self, came: bytes | JointTrajectory) -> None:
        self._came = came
        self._path: SerializedPath | None = None
        if isinstance(came, bytes):
            self._path = read_path(came)
        self._read: Any = None
        self.points = len(self._message().points) if self._path is None else len(self._path)

    def _message(self) -> Any:
        if self._read is None:
            came = self._came
            self._read = read_message(came, JointTrajectory) if isinstance(came, bytes) else came
        return self._read

    def is_finite(self) -> bool:
        """Whether every number is finite."""
        if self._path is None:
            points = self._message().points
            return all_finite(*(getattr(point, name) for point in points for name in POINT_FIELDS))
        rows = [self._path.rows(field) for field in FIELDS]
        return all(bool(np.isfinite(values).all()) for values in rows if values is not None)

    def command(self) -> TrajectoryCommand:
        """Build the session's command; raises `RefusedError` as `trajectory_command`."""
        path = self._path
        if path is None:
            return trajectory_command(self._message())
        position, counts = path.rows(POSITIONS), path.places[0, :, 1]
        odd = any(count not in (0, len(path.names)) for count in counts[:EFFORTS])
        if position is None or odd or counts[ACCELERATIONS] > counts[VELOCITIES]:
            return trajectory_command(self._message())  # says why
        efforts = path.rows(EFFORTS)
        if efforts is not None:
            require_finite(tuple(f"effort {i + 1}" for i in range(efforts.shape[1])), efforts)
        rates = path.rows(VELOCITIES), path.rows(ACCELERATIONS)
        return TrajectoryCommand(
            path.names, position, path.times_s, *rates, path.stamp_ns, path.frame_id
        )

    def unchanged(self) -> Any:
        """What came, to publish."""
        return self._came

    def changed(self, command: TrajectoryCommand) -> Any:
        """What to publish: with the command's positions, rates and mark."""
        if self._path is not None and self._path.takes(command.mark):
            changed = {
                POSITIONS: command.position,
                VELOCITIES: command.velocity,
                ACCELERATIONS: command.acceleration,
            }
            rows = {field: values for field, values in changed.items() if values is not None}
            return self._path.changed(command.mark, rows)
        message = self._message()
        message.header.frame_id = command.mark
        rates = (command.position, command.velocity, command.acceleration)
        for name, values in zip(POINT_FIELDS, rates, strict=False):
            if values is not None:
                for point, row in zip(message.points, values, strict=True):
                    setattr(point, name, doubles(row))
        return message
