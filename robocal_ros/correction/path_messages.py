"""Joint trajectories: serialized ones without an object per point, irregular ones as messages."""

from typing import Any

import numpy as np
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.correction.incoming import require_finite
from robocal_ros.correction.inputs import TrajectoryCommand, trajectory_command
from robocal_ros.correction.messages import fill_path, is_finite
from robocal_ros.correction.serialized_path import SerializedPath, read_path
from robocal_ros.correction.stream_messages import read_message

POSITIONS, VELOCITIES, ACCELERATIONS, EFFORTS = FIELDS = range(4)


class PathMessage:
    """A trajectory that came in, its command, and what goes out for it.

    Parameters
    ----------
    came : serialized, or as a message.

    Raises
    ------
    InputError
        When it cannot be read.

    Attributes
    ----------
    points : how many; 0 is a stop.
    """

    def __init__(self, came: bytes | JointTrajectory) -> None:
        self._came = came
        self._path: SerializedPath | None = read_path(came) if isinstance(came, bytes) else None
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
            return is_finite(self._message())
        rows = [self._path.rows(field) for field in FIELDS]
        return all(bool(np.isfinite(values).all()) for values in rows if values is not None)

    def command(self) -> TrajectoryCommand:
        """Build the session's command.

        Raises
        ------
        RefusedError
            As `trajectory_command`.
        """
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
        fill_path(message, command)
        return message
