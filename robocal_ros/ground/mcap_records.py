# SPDX-License-Identifier: Apache-2.0
"""Where the messages lie in a run of MCAP records: found by a compiled scan.

Source: the MCAP specification, https://mcap.dev/spec: a record is an opcode (1 byte) and a length
(8 bytes), then its content; a message's content is channel (2), sequence (4), log time (8) and
publish time (8), then data. Numbers are little endian.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.compiled import kernel, lean

HEAD = 9  # bytes
MESSAGE = 5  # opcode
MESSAGE_HEAD = 22
CHANNEL, LOG_TIME = 0, 6  # places in a message's head

Places = NDArray[np.int64]


@lean
def _number(content: NDArray[np.uint8], at: int, size: int) -> int:
    """A little-endian number of at most 63 bits; negative when it has more."""
    value = np.int64(0)
    for i in range(size):
        value |= np.int64(content[at + i]) << np.int64(8 * i)
    return int(value)


@kernel
def _scan(content: NDArray[np.uint8], columns: Places) -> int:
    """Fill columns (4, k): log time, channel, begin, end. How many, or -1 - place of damage."""
    at = count = 0
    size = content.shape[0]
    while at < size:
        if at + HEAD > size:
            return -1 - at
        length, first = _number(content, at + 1, 8), at + HEAD
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
    columns = np.empty((4, len(content) // (HEAD + MESSAGE_HEAD)), dtype=np.int64)
    count = _scan(np.frombuffer(content, dtype=np.uint8), columns)
    if count < 0:
        raise ValueError(f"no whole record at byte {-1 - count} of the content")
    return columns[:, :count].copy()


def load_kernels() -> None:
    """Have the kernel's machine code before the first bag."""
    find_messages(memoryview(bytes(HEAD)))
