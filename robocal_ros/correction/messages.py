# SPDX-License-Identifier: Apache-2.0
"""What goes in and out of the joint correction node as messages.

Joint states and trajectories are read and written as they come over the wire, without a message's
objects; irregular joint states go by way of a message, which is also what names their fault.

Layout: OMG CDR, plain, little endian, as ROS 2 writes ``sensor_msgs/JointState`` and
``trajectory_msgs/JointTrajectory``: after four bytes of encapsulation a stamp, ``frame_id`` and
joint names; then positions, velocities and efforts (sequences of double), or points, each of
positions, velocities, accelerations, efforts and ``time_from_start``. Numbers are aligned to their
size, counted from the end of the encapsulation. A stream's messages are laid out alike: where
their numbers are is found once.
"""

import contextlib
import math
import struct
from array import array
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from itertools import compress
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.correction.interface import (
    JointCommand,
    Reason,
    RefusedError,
    TrajectoryCommand,
    finite_command,
    joint_command,
    require_few,
)
from robocal_ros.correction.limiter import FRAME, STAMP
from robocal_ros.correction.serialized_target import STAMPS, SerializedTarget
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import CORRECTED
from robocal_ros.ground.serialized import FIELDS, gather_rows, point_places, scatter_rows
from robocal_ros.ros.conversions import NS, header

HEAD = b"\0\1\0\0"  # plain, little endian
LEAST_POINT = 4 * FIELDS + 8  # bytes of a point without numbers
POINT_FIELDS = ("positions", "velocities", "accelerations", "effort")
EFFORTS = FIELDS - 1  # of a point's fields the last


def _string(data: bytes, at: int) -> tuple[str, slice, int]:
    """Text, where it stands with its length, and where the next number begins.

    What stands between the two may be anything.
    """
    (length,) = struct.unpack_from("<I", data, at)
    end = at + 4 + length
    if not length > 0 or end > len(data) or data[end - 1]:
        raise struct.error("a string does not end within the message")
    return data[at + 4 : end - 1].decode(), slice(at, end), end + -end % 4


def _string_bytes(text: str) -> bytes:
    data = text.encode() + b"\0"
    return (struct.pack("<I", len(data)) + data).ljust(_string_size(text), b"\0")


def _string_size(text: str) -> int:
    return 4 + -(-(len(text.encode()) + 1) // 4) * 4


def _names(data: bytes, at: int) -> tuple[tuple[str, ...], list[slice], int]:
    """Names, where they stand with their lengths and number, and where the next number begins."""
    (count,) = struct.unpack_from("<I", data, at)
    if count > len(data):
        raise struct.error("more names than the message is long")
    names, parts, at = [], [slice(at, at + 4)], at + 4
    for _ in range(count):
        name, part, at = _string(data, at)
        names.append(name)
        parts.append(part)
    return tuple(names), parts, at


def joint_names(data: bytes) -> tuple[str, ...]:
    """The joints that a serialized message names; none where it cannot be read."""
    if data[: len(HEAD)] != HEAD:
        return ()
    try:
        return _names(data, _string(data, FRAME)[2])[0]
    except (struct.error, UnicodeDecodeError):
        return ()


@dataclass(frozen=True, eq=False)
class _Layout:
    """Where things are in a message, in bytes."""

    frame_id: str
    names: tuple[str, ...]
    named: bytes  # the names as they stand there
    counts: tuple[int, ...]  # of positions, velocities, efforts
    places: tuple[int, ...]
    compared: tuple[slice, ...]  # that are the same in all messages laid out so
    compare: Callable[[bytes], tuple[bytes, ...]]
    same: tuple[bytes, ...]
    numbers: struct.Struct  # all of them, after the stamp's two
    doubles: int  # from the first position to the end of the last number, counts among them
    velocity: slice | None  # where the velocities are among these; None where it has none
    size: int


class JointWire:
    """Reads the joint messages of one topic and writes what goes out for them.

    ``readings_of``: the joints of the robot that reads; none of commands. Of readings, velocities
    of which one of the robot's is not finite, and efforts of which any is not, are none: many
    drivers have none, and say NaN. ``is_finite`` says whether every number of the message read
    last is.
    """

    def __init__(self, readings_of: Collection[str] = ()) -> None:
        self.readings_of = readings_of
        self.is_finite = True
        self._layout: _Layout | None = None
        self._efforts = 0  # how many go out
        # of what goes out: what it was made for, and what stands before the numbers of each field
        self._made_for: tuple[_Layout, str, bool, int] | None = None
        self._before: list[bytes] = []
        self._target: tuple[_Layout, SerializedTarget] | None = None

    def read(self, data: bytes) -> JointCommand | None:
        """The command in a message; None for one that is not regular, finite and whole."""
        layout = self._layout
        if layout is None or len(data) != layout.size or layout.compare(data) != layout.same:
            layout = self._layout = _layout(data)
            if layout is None:
                return None
        numbers = np.frombuffer(data, np.float64, layout.doubles, layout.places[0]).copy()
        position = numbers[: layout.counts[0]]
        velocity = None if layout.velocity is None else numbers[layout.velocity]
        self._efforts = layout.counts[2]
        # for so few numbers this takes a tenth of the time of NumPy's isfinite
        given = layout.numbers.unpack_from(data, STAMP)
        self.is_finite = math.isfinite(sum(given))
        if not self.is_finite:
            if not (self.readings_of and np.isfinite(position).all()):
                return None
            if velocity is not None:
                own = [name in self.readings_of for name in layout.names]
                velocity = velocity if np.isfinite(velocity[own]).all() else None
            if not np.isfinite(numbers[len(numbers) - self._efforts :]).all():
                self._efforts = 0
        stamp_ns = given[0] * NS + given[1]
        return JointCommand(layout.names, position, velocity, stamp_ns, layout.frame_id)

    def written(self, data: bytes, command: JointCommand) -> bytes:
        """The message read last, ``data``, with the command's values and mark."""
        layout, velocity, efforts = self._layout, command.velocity, self._efforts
        if layout is None:
            raise ValueError("no message was read")
        wanted = layout, command.mark, velocity is not None, efforts
        if self._made_for != wanted:
            k = len(layout.names)
            counts = k, 0 if velocity is None else k, efforts
            self._before, self._made_for = _before(layout, command.mark, counts), wanted
        to_position, to_velocity, to_effort = self._before
        speeds, place = b"" if velocity is None else velocity.tobytes(), layout.places[2]
        effort = data[place : place + 8 * efforts]
        out = data[:FRAME], to_position, command.position.tobytes(), to_velocity, speeds
        return b"".join((*out, to_effort, effort))

    def target(self, data: bytes, command: JointCommand) -> SerializedTarget | None:
        """What is known of targets laid out as the message read last; None with efforts."""
        layout = self._layout
        if layout is None or layout.counts[2]:
            return None
        if self._target is None or self._target[0] is not layout:
            out = self.written(data, replace(command, mark=CORRECTED))
            written = _layout(out)
            assert written is not None
            at, out_at = (
                (each.places[0], each.places[1] if each.velocity else 0)
                for each in (layout, written)
            )
            like = SerializedTarget(command, data, layout.compared, at, out, out_at)
            self._target = layout, like
        return self._target[1]


def _before(layout: _Layout, mark: str, counts: tuple[int, ...]) -> list[bytes]:
    """What stands before the numbers of each field, so many, after the stamp."""
    parts, part, at = [], _string_bytes(mark) + layout.named, FRAME
    for count in counts:
        part += bytes(-(at + len(part)) % 4) + struct.pack("<I", count)
        if count:
            part += bytes((len(HEAD) - at - len(part)) % 8)
        parts.append(part)
        at, part = at + len(part) + 8 * count, b""
    return parts


def _layout(data: bytes) -> _Layout | None:
    """Find where things are; None for what is not a whole regular message with positions."""
    if data[: len(HEAD)] != HEAD:
        return None
    try:
        frame_id, part, at = _string(data, FRAME)
        names_begin = at
        names, parts, at = _names(data, at)
        counts, places, begins = [], [], []
        for _ in range(3):
            (count,) = struct.unpack_from("<I", data, at)
            begins.append(at)
            counts.append(count)
            at += 4 + ((len(HEAD) - at - 4) % 8 if count else 0)
            places.append(at)
            at += 8 * count
    except (struct.error, UnicodeDecodeError):
        return None
    k = len(names)
    if at > len(data) or not counts[0] == k > 0 or counts[1] not in (0, k):
        return None
    counted = [slice(begin, begin + 4) for begin in begins]
    compared = slice(0, len(HEAD)), part, *parts, *counted
    compare = itemgetter(*compared)
    fields = [f"{c}d" for c in counts if c]  # each begins a number after the end of that before
    numbers, before = "8x".join(fields), places[0] - FRAME
    return _Layout(
        frame_id=frame_id,
        names=names,
        named=data[names_begin : begins[0]],
        counts=tuple(counts),
        places=tuple(places),
        compared=compared,
        compare=compare,
        same=compare(data),
        numbers=struct.Struct(f"<iI{before}x{numbers}"),
        doubles=struct.calcsize(f"<{numbers}") // 8,
        velocity=slice(k + 1, 2 * k + 1) if counts[1] else None,
        size=len(data),
    )


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

    Of a reading velocities that are as many as joints, and efforts, go out empty where one is not
    finite: many drivers have none. Joints beside the robot's of which no position is known are
    left out: joint_state_broadcaster tells so of a spindle that has a velocity alone. Raises
    `InputError` when it cannot be read.
    """

    __slots__ = "_command", "_data", "_message", "_wire"

    def __init__(self, wire: JointWire, data: bytes) -> None:
        self._wire, self._data = wire, data
        self._command = wire.read(data)
        self._message: Any = None
        if self._command is None:
            self._message = read_message(data, JointState)
            if wire.readings_of:
                self._drop_unknown(self._message)

    def _drop_unknown(self, message: Any) -> None:
        """Leave out what a driver does not know: numbers that are not finite, or too few."""
        names, position, own = message.name, message.position, self._wire.readings_of
        if len(position) == len(names) and not all_finite(position):
            known = [math.isfinite(q) or one in own for one, q in zip(names, position, strict=True)]
            for field in ("velocity", "effort", "position", "name"):
                values = getattr(message, field)
                if len(values) == len(known):
                    kept = list(compress(values, known))
                    setattr(message, field, kept if field == "name" else array("d", kept))
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
        if self._command:
            return self._command
        build = joint_command if self._wire.readings_of else finite_command
        return build(self._message)

    def target(self) -> SerializedTarget | None:
        """What is known of targets that are laid out like it; None where it is not regular."""
        return self._wire.target(self._data, self._command) if self._command else None

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
        elif self._wire.readings_of:
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


def _fields_of(command: TrajectoryCommand) -> tuple[Array | None, ...]:
    return command.position, command.velocity, command.acceleration


def changed_path(message: Any, command: TrajectoryCommand) -> Any:
    """A ``JointTrajectory`` with a command's positions, rates and mark: the one that is given."""
    message.header.frame_id = command.mark
    for name, values in zip(POINT_FIELDS, _fields_of(command), strict=False):
        if values is not None:
            for point, row in zip(message.points, values, strict=True):
                setattr(point, name, doubles(row))
    return message


class PathMessage:
    """A serialized trajectory of ``points``, its command, and what goes out for it.

    Raises `InputError` when it cannot be read, `RefusedError` for too many points before they are.
    """

    def __init__(self, came: bytes) -> None:
        self._came, self._size, self.points = came, len(came) - len(HEAD), 0
        self._frame_id, self._stamp_ns = "", 0
        self._names: tuple[str, ...] = ()
        self._times_s = self._doubles = np.empty(0)  # the message after its encapsulation
        # (m, 4, 2) first number and count of each field of each point
        self._places: NDArray[np.int64] = np.empty((0, FIELDS, 2), dtype=np.int64)
        with contextlib.suppress(struct.error, UnicodeDecodeError):
            self._read()
        if not self.points and read_message(came, JointTrajectory).points:
            raise InputError("this JointTrajectory is not laid out as ROS 2 lays it out")

    def _read(self) -> None:
        """Find where its numbers are; no points where it has none, or is no such message."""
        data, size = self._came, self._size
        if size < FRAME - STAMP or data[:2] != HEAD[:2]:
            return
        sec, nanosec = STAMPS.unpack_from(data, STAMP)
        frame_id, _, at = _string(data, FRAME)
        names, _, at = _names(data, at)
        (count,) = struct.unpack_from("<I", data, at)
        if not 0 < count <= size // LEAST_POINT:
            return
        require_few(count)
        doubles = np.zeros(-(-size // 8))
        doubles.view(np.uint8)[:size] = np.frombuffer(data, np.uint8, size, len(HEAD))
        places, times = np.empty((count, FIELDS, 2), dtype=np.int64), np.empty(count)
        if point_places(doubles.view(np.uint32), at + 4 - len(HEAD), size, places, times):
            self.points, self._stamp_ns = count, sec * NS + nanosec
            self._frame_id, self._names, self._times_s = frame_id, names, times
            self._doubles, self._places = doubles, places

    def is_finite(self, first: int = 0) -> bool:
        """Whether every number of its points' fields is finite, from ``first`` on."""
        begins, counts = self._places[:, first:].reshape(-1, 2).T
        ends = np.cumsum(counts)
        index = np.arange(counts.sum()) + np.repeat(begins - ends + counts, counts)
        return bool(np.isfinite(self._doubles[index]).all())

    def _rows(self, field: int) -> Array | None:
        """Numbers (m, k) of a field (0 to 2: positions …); None where it has none."""
        counts, k = self._places[:, field, 1], len(self._names)
        if not counts.any():
            return None
        for point in np.flatnonzero(counts != k)[:1]:
            detail = f"point {point + 1} has {counts[point]} {POINT_FIELDS[field]} for {k} joints"
            raise RefusedError(Reason.WRONG_SIZE, detail)
        out = np.empty((self.points, k))
        gather_rows(self._doubles, self._places[:, field], out)
        return out

    def command(self) -> TrajectoryCommand:
        """Build the session's command.

        Raises `RefusedError` when there are no points, numbers differ, a point has no positions,
        only some points have a rate, or an effort is not finite.
        """
        if not self.points:
            raise RefusedError(Reason.NO_POINTS, "a controller drops it and drives on")
        position, velocity, acceleration = (self._rows(field) for field in range(EFFORTS))
        if position is None:
            raise RefusedError(Reason.NO_POSITION, "a point of the trajectory has none")
        if velocity is None and acceleration is not None:
            raise RefusedError(Reason.WRONG_SIZE, "accelerations without velocities")
        if not self.is_finite(EFFORTS):
            raise RefusedError(Reason.NOT_FINITE, "an effort")
        rates = velocity, acceleration
        return TrajectoryCommand(
            self._names, position, self._times_s, *rates, self._stamp_ns, self._frame_id
        )

    def unchanged(self) -> Any:
        """What came, to publish."""
        return self._came

    def changed(self, command: TrajectoryCommand) -> Any:
        """What to publish: with the command's positions, rates and mark."""
        if (_string_size(command.mark) - _string_size(self._frame_id)) % 8:
            message = read_message(self._came, JointTrajectory)  # its numbers would not be aligned
            return changed_path(message, command)
        written = self._doubles.copy()
        for field, values in enumerate(_fields_of(command)):
            if values is not None:
                scatter_rows(np.ascontiguousarray(values), self._places[:, field], written)
        body, stamp = written.tobytes(), FRAME - STAMP
        rest = body[stamp + _string_size(self._frame_id) : self._size]
        return HEAD + body[:stamp] + _string_bytes(command.mark) + rest
