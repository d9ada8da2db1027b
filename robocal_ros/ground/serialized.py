# SPDX-License-Identifier: Apache-2.0
"""Serialized data that is read in machine code: joint states, many at a time, points of
trajectories, and where messages lie in a run of MCAP records.

Layout of the first two: OMG CDR, plain, little endian, as ROS 2 writes ``sensor_msgs/JointState``:
after four bytes of encapsulation a stamp, ``frame_id``, joint names, then positions, velocities and
efforts (sequences of double). Numbers are aligned to their size, counted from the end of the
encapsulation. One publisher's messages are nearly always alike but for stamp and numbers.
Of records: the MCAP specification, https://mcap.dev/spec: an opcode (1 byte) and a length (8
bytes), then the content; a message's is channel (2), sequence (4), log time (8) and publish time
(8), then data, numbers little endian.
"""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.compiled import kernel, lean

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Places = NDArray[np.int64]

ENCAPSULATION = 4  # bytes
LITTLE_ENDIAN = b"\0\1"
STAMP = 8  # bytes
SEQUENCES = 3  # positions, velocities, efforts
FIELDS = 4  # sequences of a trajectory's point
SECOND_NS = 1_000_000_000
RECORD_HEAD = 9  # bytes
MESSAGE = 5  # opcode
MESSAGE_HEAD = 22
CHANNEL, LOG_TIME = 0, 6  # places in a message's head


@kernel
def _gather(
    content: Bytes,
    begin: Places,
    end: Places,
    pattern: Bytes,
    fixed: Bytes,
    at: int,
    stamps: Bytes,
    positions: Bytes,
) -> int:
    """Copy stamps (k, 8) and positions (k, 8 n) while messages are as the pattern: how many."""
    size = pattern.shape[0]
    for i in range(begin.shape[0]):
        first = begin[i]
        if end[i] - first != size:
            return i
        message = content[first : first + size]
        other = np.uint8(0)
        for j in range(size):
            other |= np.uint8((message[j] ^ pattern[j]) & fixed[j])
        if other != 0:
            return i
        stamps[i] = message[ENCAPSULATION : ENCAPSULATION + STAMP]
        positions[i] = message[at : at + positions.shape[1]]
    return int(begin.shape[0])


@dataclass(frozen=True, eq=False)
class JointLayout:
    """What messages of one publisher share.

    Attributes
    ----------
    pattern : (size,) bytes of one such message; ``fixed`` (size,): 255 where others must have
        the same byte: text and lengths.
    position_at : place of the first position.
    joints : how many positions there are.
    """

    pattern: Bytes
    fixed: Bytes
    position_at: int
    joints: int

    @classmethod
    def of(cls, message: bytes) -> "JointLayout | None":
        """Layout of a serialized message; None when it is none that can be gathered."""
        if message[:2] != LITTLE_ENDIAN:
            return None
        fixed = np.zeros(len(message), dtype=np.uint8)
        fixed[:2] = 255
        try:
            places = _places(message, fixed)
        except struct.error:
            return None
        return cls(np.frombuffer(message, dtype=np.uint8), fixed, *places)

    def gather(self, content: Bytes, begin: Places, end: Places) -> tuple[Places, Array]:
        """Stamps (k,), ns, and positions (k, n) of the messages up to the first of other layout.

        ``begin``, ``end``: where messages lie in ``content``.
        """
        stamps = np.empty((len(begin), 2), dtype="<u4")
        positions = np.empty((len(begin), self.joints), dtype="<f8")
        rows = stamps.view(np.uint8), positions.view(np.uint8)
        count = _gather(content, begin, end, self.pattern, self.fixed, self.position_at, *rows)
        seconds = stamps[:count, 0].view("<i4").astype(np.int64)
        return SECOND_NS * seconds + stamps[:count, 1], positions[:count]


def _places(message: bytes, fixed: Bytes) -> tuple[int, int]:
    """Where positions begin and how many they are; marks in ``fixed`` what is text or length."""

    def number(at: int) -> tuple[int, int]:
        at = ENCAPSULATION + (at - ENCAPSULATION + 3) // 4 * 4
        (value,) = struct.unpack_from("<I", message, at)
        fixed[at : at + 4] = 255
        return value, at + 4

    def text(at: int) -> int:
        length, at = number(at)
        fixed[at : at + length] = 255
        return at + length

    at = text(ENCAPSULATION + STAMP)
    names, at = number(at)
    for _ in range(min(names, len(message))):
        at = text(at)
    begins = []
    for _ in range(SEQUENCES):
        count, at = number(at)
        if count:
            at = ENCAPSULATION + (at - ENCAPSULATION + 7) // 8 * 8
        begins.append((at, count))
        at += 8 * count
    if at > len(message):
        raise struct.error("the message is shorter than its lengths say")
    return begins[0]


@kernel
def point_places(
    words: NDArray[np.uint32], begin: int, size: int, places: Places, times: Array
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
def gather_rows(doubles: Array, places: Places, rows: Array) -> None:
    """Numbers (m, k) of a field with ``places`` (m, 2) of a message's ``doubles``."""
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            rows[i, j] = doubles[places[i, 0] + j]


@kernel
def scatter_rows(rows: Array, places: Places, doubles: Array) -> None:
    """The other way."""
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            doubles[places[i, 0] + j] = rows[i, j]


@lean
def _number(content: Bytes, at: int, size: int) -> int:
    """A little-endian number of at most 63 bits; negative when it has more."""
    value = np.int64(0)
    for i in range(size):
        value |= np.int64(content[at + i]) << np.int64(8 * i)
    return int(value)


@kernel
def _scan(content: Bytes, columns: Places) -> int:
    """Fill columns (4, k): log time, channel, begin, end. How many, or -1 - place of damage."""
    at = count = 0
    size = content.shape[0]
    while at < size:
        if at + RECORD_HEAD > size:
            return -1 - at
        length, first = _number(content, at + 1, 8), at + RECORD_HEAD
        if length < 0 or length > size - first:
            return -1 - at
        if content[at] == MESSAGE:
            if length < MESSAGE_HEAD:
                return -1 - at
            log_time = _number(content, first + LOG_TIME, 8)
            if log_time < 0:
                return -1 - at
            columns[0, count] = log_time
            columns[1, count] = _number(content, first + CHANNEL, 2)
            columns[2, count] = first + MESSAGE_HEAD
            columns[3, count] = first + length
            count += 1
        at = first + length
    return count


def find_messages(content: memoryview) -> Places:
    """Messages among the records in ``content``, as they are stored.

    Columns (4, k): log time, ns; channel; begin and end of the data in ``content``.

    Raises
    ------
    ValueError
        When the bytes are not whole records; the message names the place.
    """
    columns = np.empty((4, len(content) // (RECORD_HEAD + MESSAGE_HEAD)), dtype=np.int64)
    count = _scan(np.frombuffer(content, dtype=np.uint8), columns)
    if count < 0:
        raise ValueError(f"no whole record at byte {-1 - count} of the content")
    return columns[:, :count].copy()


def load_kernels() -> None:
    """Have the kernel's machine code before the first bag."""
    message = bytes([*LITTLE_ENDIAN, *bytes(ENCAPSULATION - 2 + STAMP + 4 * (2 + SEQUENCES))])
    layout = JointLayout.of(message)
    if layout is not None:
        content = np.frombuffer(message, dtype=np.uint8)
        layout.gather(content, np.zeros(1, dtype=np.int64), np.full(1, len(message)))
    find_messages(memoryview(bytes(RECORD_HEAD)))
