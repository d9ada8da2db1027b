# SPDX-License-Identifier: Apache-2.0
"""What is known of the targets of a stream as they are serialized: see `limiter.follow_serialized`.

The messages of a stream are laid out alike. Of one that was corrected the long way it is known
which bytes are the same in all of them, and where the numbers are; the next one is compared,
corrected and written without an object of Python for it. Objects take twice as long as all the
rest does, and the robot waits for it.
"""

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.interface import JointCommand
from robocal_ros.correction.limiter import ENCAPSULATION

Array = NDArray[np.float64]

STAMPS = struct.Struct("<iI")


class SerializedTarget:
    """What is known of targets that are laid out as one that came, and room for the next one.

    ``command``: of the one that came. ``same``: where its bytes ``like`` are those of all. ``out``:
    what goes out for it. Positions and velocities begin ``at`` these bytes, and ``out_at`` those;
    0 where there are none.

    Attributes
    ----------
    came, out : the bytes of the next message, and of what goes out for it.
    room : (3, n) numbers of it.
    given : the arguments of `follow_serialized` from ``came`` to ``room``.
    """

    def __init__(
        self,
        command: JointCommand,
        like: bytes,
        same: Sequence[slice],
        at: Sequence[int],
        out: bytes,
        out_at: Sequence[int],
    ) -> None:
        self.command, self.size = command, len(like)
        self.room = np.zeros((3, len(command.names)))
        compared = np.zeros((2, len(like)), dtype=np.uint8)
        compared[0] = np.frombuffer(like, np.uint8)
        for part in same:
            compared[1, part] = 255
        self.came, came = _aligned(like)
        self.out, written = _aligned(out)
        places, out_places = (
            [(ENCAPSULATION + place) // 8 if place else 0 for place in each]
            for each in (at, out_at)
        )
        self.given: tuple[Any, ...] = (
            came, compared, *places, written, *out_places, self.room
        )  # fmt: skip


def _aligned(message: bytes) -> tuple[memoryview, Array]:
    """Bytes of a message so that its numbers are aligned, and these with what stands before."""
    numbers = np.zeros(-(-(ENCAPSULATION + len(message)) // 8))
    data = numbers.view(np.uint8)[ENCAPSULATION : ENCAPSULATION + len(message)].data
    data[:] = message
    return data, numbers
