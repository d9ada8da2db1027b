"""Joint states as they come over the wire, for compiled code: lanes of eight bytes.

Layout: OMG CDR, plain, little endian, as ROS 2 writes ``sensor_msgs/JointState``. The message
begins in the middle of the first lane, so that what follows its four bytes of encapsulation, the
stamp, is the second one, and every double is a lane. A layout (9,) holds the first lane of
positions, velocities and efforts in what came, the same in what goes out, and their numbers.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import lean

Array = NDArray[np.float64]
Layout = NDArray[np.int64]

BEGIN = 4  # of the message in the first lane, bytes
FIELDS = 3
CAME, GOES, COUNT = 0, FIELDS, 2 * FIELDS  # parts of a layout
POSITION, VELOCITY = 0, 1  # fields
_STAMP = 1  # lane
_NS = 1_000_000_000


def lanes(size: int) -> int:
    """How many lanes a message of so many bytes takes."""
    return -(-(BEGIN + size) // 8)


@lean
def is_laid_out_as(came: Array, known: Array, mask: Array) -> bool:
    """Whether lanes equal known ones where the bits of ``mask`` are set."""
    a, b, bits, other = came.view(np.uint64), known.view(np.uint64), mask.view(np.uint64), False
    for i in range(a.shape[0]):
        other |= (a[i] ^ b[i]) & bits[i] != 0
    return not other


@lean
def stamp_of(came: Array) -> int:
    """Stamp of the header, ns."""
    sec, nanosec = came.view(np.int32)[2 * _STAMP], came.view(np.uint32)[2 * _STAMP + 1]
    return int(np.int64(sec) * _NS + np.int64(nanosec))


@lean
def are_finite(came: Array, layout: Layout) -> bool:
    """Whether all positions, velocities and efforts are."""
    finite = True
    for field in range(FIELDS):
        first = layout[CAME + field]
        for i in range(first, first + layout[COUNT + field]):
            finite &= abs(came[i]) < np.inf
    return finite


@lean
def pass_through(came: Array, layout: Layout, goes: Array) -> None:
    """Copy stamp and numbers into the message that goes out."""
    goes[_STAMP] = came[_STAMP]
    for field in range(FIELDS):
        come, go = layout[CAME + field], layout[GOES + field]
        for i in range(layout[COUNT + field]):
            goes[go + i] = came[come + i]
