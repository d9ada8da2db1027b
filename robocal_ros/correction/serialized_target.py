# SPDX-License-Identifier: Apache-2.0
"""A target of a stream from the bytes that came to those that go out, in one compiled piece.

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
from robocal_ros.correction.limiter import ADDS, OUT, ROUNDING, TOO_FAST, VELOCITY, step_out
from robocal_ros.ground.compiled import bare

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

ENCAPSULATION = 4  # bytes of a message before those by which its numbers are aligned
STAMP, FRAME = ENCAPSULATION, ENCAPSULATION + 8  # where these begin
STAMPS = struct.Struct("<iI")
# what becomes of a target: nothing went out, as it is laid out otherwise or is for the long way; it
# went out, corrected or as it came; and it did, but its velocities are too high
UNUSUAL, CORRECTED_ONE, UNCHANGED_ONE, FAST_ONE = range(4)
GIVEN, RATE, BEFORE = range(3)  # rows of a target's room: what is read, and what was out before
ACTIVE, PACE, FASTEST, MOST_BELIEVED = range(4)  # rows of a stream's joints


@bare
def follow_serialized(
    elapsed: float, came: Array, like: Bytes, at: int, rates_at: int, out: Array, out_at: int,
    out_rates_at: int, room: Array, joints: Array, memory: Array, limits: Array, span: Array,
    bounds: Array, tcp: Array, largest: Array, free: bool, works: Array, reports: Array,
    figures: Array,
) -> int:  # fmt: skip
    """Correct a serialized target of all n joints and put it out: see `limiter.step_out`.

    Each array costs a call some 0.1 us where it left the processor's caches: so these are few.

    Parameters
    ----------
    came, out : the message and what goes out, with all that is not the stamp or a number, behind
        `ENCAPSULATION` bytes. Positions begin at ``at`` and ``out_at``, velocities at ``rates_at``
        and ``out_rates_at``, in numbers; 0 where there are none.
    like : (2, b) a message that is laid out as this must be, and 255 for each byte that must be
        the same.
    room : (3, n) for what is read, and what was put out before.
    joints : (4, n) 1 where active, speeds in this step and ever, largest position believed.

    Returns
    -------
    int
        What became of it.
    """
    n, unlike = room.shape[1], np.uint8(0)
    data, written, q, velocity = came.view(np.uint8), out.view(np.uint8), room[GIVEN], room[RATE]
    for i in range(like.shape[1]):
        unlike |= (data[ENCAPSULATION + i] ^ like[0, i]) & like[1, i]
    fine = unlike == 0
    for j in range(n):
        q[j], velocity[j], room[BEFORE, j] = came[at + j], 0.0, memory[OUT, j]
        if rates_at > 0:
            velocity[j] = came[rates_at + j]
        fine = fine and abs(q[j]) <= joints[MOST_BELIEVED, j] and np.isfinite(velocity[j])
    if not fine:
        return UNUSUAL
    share = step_out(
        q, velocity, elapsed, elapsed, memory, limits, joints[ACTIVE], joints[PACE : FASTEST + 1],
        span, bounds, tcp, largest, free, works, reports, figures,
    )  # fmt: skip
    if not 0.0 <= share <= 1.0 + ROUNDING:
        return UNUSUAL
    for i in range(ENCAPSULATION + STAMP, ENCAPSULATION + FRAME):
        written[i] = data[i]
    for j in range(n):
        out[out_at + j] = memory[OUT, j]
        if out_rates_at > 0:
            out[out_rates_at + j] = memory[VELOCITY, j]
    if rates_at > 0 and figures[TOO_FAST] != 0.0:
        return FAST_ONE
    return CORRECTED_ONE if figures[ADDS] != 0.0 else UNCHANGED_ONE


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
