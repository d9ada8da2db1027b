"""Joint trajectories: serialized ones without an object per point, irregular ones as messages."""

from typing import Any

from rclpy.serialization import deserialize_message
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.core.errors import InputError
from robocal_ros.core.serialized_path import SerializedPath, read_path
from robocal_ros.sessions.correction import (
    TrajectoryCommand,
    require_finite,
    trajectory_command,
)

POSITIONS, VELOCITIES, ACCELERATIONS, EFFORTS = range(4)


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


class PathMessage:
    """A trajectory that came in, its command, and what goes out for it.

    Raises
    ------
    InputError
        When it cannot be read.

    Attributes
    ----------
    points : how many; 0 is a stop.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._path: SerializedPath | None = read_path(data)
        self._message: Any = None
        if self._path is None:
            self._message = read_message(data, JointTrajectory)
        self.points = len(self._message.points) if self._path is None else len(self._path)

    def command(self) -> TrajectoryCommand:
        """Build the session's command.

        Raises
        ------
        RefusedError
            As `trajectory_command`.
        """
        path = self._path
        if path is None:
            return trajectory_command(self._message)
        position, counts = path.rows(POSITIONS), path.places[0, :, 1]
        odd = any(count not in (0, len(path.names)) for count in counts[:EFFORTS])
        if position is None or odd or counts[ACCELERATIONS] > counts[VELOCITIES]:
            return trajectory_command(deserialize_message(self._data, JointTrajectory))  # says why
        efforts = path.rows(EFFORTS)
        if efforts is not None:
            require_finite(tuple(f"effort {i + 1}" for i in range(efforts.shape[1])), efforts)
        rates = path.rows(VELOCITIES), path.rows(ACCELERATIONS)
        return TrajectoryCommand(
            path.names, position, path.times_s, *rates, path.stamp_ns, path.frame_id
        )

    def unchanged(self) -> bytes:
        """The message as it came."""
        return self._data

    def corrected(self, command: TrajectoryCommand) -> Any:
        """Message to publish, with the command's positions, rates and mark."""
        changed = {
            POSITIONS: command.position,
            VELOCITIES: command.velocity,
            ACCELERATIONS: command.acceleration,
        }
        rows = {field: values for field, values in changed.items() if values is not None}
        if self._path is not None and self._path.takes(command.mark):
            return self._path.changed(command.mark, rows)
        message = self._message or deserialize_message(self._data, JointTrajectory)
        message.header.frame_id = command.mark
        names = ("positions", "velocities", "accelerations")
        for field, values in rows.items():
            for point, row in zip(message.points, values, strict=True):
                setattr(point, names[field], row.tolist())
        return message
