"""Joint trajectories as they come over the wire: read and changed in place, without objects.

Layout: OMG CDR, plain, little endian, as ROS 2 writes ``trajectory_msgs/JointTrajectory``: after
four bytes of encapsulation a stamp, ``frame_id``, joint names, then points, each of positions,
velocities, accelerations, efforts (sequences of double) and ``time_from_start``. Numbers are
aligned to their size, counted from the end of the encapsulation.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import kernel

Array = NDArray[np.float64]

ENCAPSULATION = b"\0\1\0\0"
STAMP = 8  # bytes
FIELDS = 4  # sequences of a point
LEAST_POINT = 4 * FIELDS + 8  # bytes of a point without numbers


@kernel
def _places(
    words: NDArray[np.uint32], begin: int, size: int, places: NDArray[np.int64], times: Array
) -> bool:
    """Where numbers begin (in doubles) and how many they are: ``places`` (m, 4, 2)."""
    at = begin
    for i in range(places.shape[0]):
        for field in range(FIELDS):
            if at + 4 > size:
                return False
            count = int(words[at // 4])
            at += 4
            if count > 0:
                at = (at + 7) // 8 * 8
            places[i, field, 0], places[i, field, 1] = at // 8, count
            at += 8 * count
        if at + 8 > size:
            return False
        times[i] = np.int32(words[at // 4]) + 1e-9 * words[at // 4 + 1]
        at += 8
    return True


@kernel
def _gather(doubles: Array, places: NDArray[np.int64], rows: Array) -> None:
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            rows[i, j] = doubles[places[i, 0] + j]


@kernel
def _scatter(rows: Array, places: NDArray[np.int64], doubles: Array) -> None:
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            doubles[places[i, 0] + j] = rows[i, j]


@dataclass(frozen=True)
class SerializedPath:
    """A trajectory of m points of k joints, each field in all points or in none.

    Attributes
    ----------
    stamp_ns, frame_id, names : of the header and the joints.
    times_s : (m,) from the start.
    doubles : the message after its encapsulation, as numbers.
    size : of the message after its encapsulation, bytes.
    places : (m, 4, 2) first number and count of each field of each point.
    """

    stamp_ns: int
    frame_id: str
    names: tuple[str, ...]
    times_s: Array
    doubles: Array
    size: int
    places: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.times_s)

    def rows(self, field: int) -> Array | None:
        """Numbers (m, k) of a field (0 to 3: positions … efforts); None where it has none."""
        k = int(self.places[0, field, 1])
        if k == 0:
            return None
        out = np.empty((len(self), k))
        _gather(self.doubles, self.places[:, field], out)
        return out

    def changed(self, frame_id: str, rows: dict[int, Array]) -> bytes:
        """The message with another ``frame_id`` and other numbers (m, k) of some fields.

        Raises
        ------
        ValueError
            When `takes` says that the frame does not fit.
        """
        if not self.takes(frame_id):
            raise ValueError(f"frame_id '{frame_id}' moves the numbers off their places")
        doubles = self.doubles.copy()
        for field, values in rows.items():
            _scatter(np.ascontiguousarray(values), self.places[:, field], doubles)
        body = doubles.tobytes()
        rest = body[STAMP + _string_size(self.frame_id) : self.size]
        return ENCAPSULATION + body[:STAMP] + _string(frame_id) + rest

    def takes(self, frame_id: str) -> bool:
        """Whether all numbers stay aligned with this ``frame_id``."""
        return (_string_size(frame_id) - _string_size(self.frame_id)) % 8 == 0


def _string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return (struct.pack("<I", len(data)) + data).ljust(_string_size(text), b"\0")


def _string_size(text: str) -> int:
    return 4 + -(-(len(text.encode()) + 1) // 4) * 4


def read_path(data: bytes, require_few: Callable[[int], None]) -> SerializedPath | None:
    """Read a serialized trajectory; None for one that is not regular, or no such message at all.

    ``require_few`` may refuse the number of points before they are read.
    """
    size = len(data) - len(ENCAPSULATION)
    if size < STAMP or data[:2] != ENCAPSULATION[:2]:
        return None
    try:
        frame_id, names, count, begin = _head(data)
    except (struct.error, UnicodeDecodeError):
        return None
    if not 0 < count <= size // LEAST_POINT:
        return None
    require_few(count)
    doubles = np.zeros(-(-size // 8))
    doubles.view(np.uint8)[:size] = np.frombuffer(data, np.uint8, size, len(ENCAPSULATION))
    places, times = np.empty((count, FIELDS, 2), dtype=np.int64), np.empty(count)
    whole = _places(doubles.view(np.uint32), begin, size, places, times)
    if not whole or np.any(places[:, :, 1] != places[0, :, 1]):
        return None
    sec, nanosec = struct.unpack_from("<iI", data, len(ENCAPSULATION))
    return SerializedPath(
        sec * 1_000_000_000 + nanosec, frame_id, names, times, doubles, size, places
    )


def _head(data: bytes) -> tuple[str, tuple[str, ...], int, int]:
    """``frame_id``, names, number of points, and where the first one begins (after it)."""
    body = memoryview(data)[len(ENCAPSULATION) :]
    at = STAMP

    def number() -> int:
        nonlocal at
        (value,) = struct.unpack_from("<I", body, at)
        at += 4
        return int(value)

    def string() -> str:
        nonlocal at
        length = number()
        if not 0 < length <= len(body) - at:
            raise struct.error("a string is longer than the message")
        text = bytes(body[at : at + length - 1]).decode()
        at += -(-length // 4) * 4
        return text

    frame_id = string()
    count = number()
    if count > len(body):
        raise struct.error("more names than the message is long")
    names = tuple(string() for _ in range(count))
    return frame_id, names, number(), at


def load_kernels() -> None:
    """Call the compiled code once, so that the first trajectory need not wait for it."""
    doubles, places = np.zeros(8), np.zeros((1, FIELDS, 2), dtype=np.int64)
    _places(doubles.view(np.uint32), 0, doubles.nbytes, places, np.zeros(1))
    path = SerializedPath(0, "", (), np.zeros(1), doubles, doubles.nbytes, places + 1)
    rows = path.rows(0)
    path.changed("", {} if rows is None else {0: rows})
