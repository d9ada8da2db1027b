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
from robocal_ros.correction.limiter import OUT, ROUNDING, VELOCITY, step_out
from robocal_ros.ground.compiled import bare

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

NS = 1_000_000_000
HEAD = 4  # bytes of a message before those by which its numbers are aligned
STAMP, FRAME = HEAD, HEAD + 8  # where these begin
STAMPS = struct.Struct("<iI")
UNLIKE = -3.0  # a target that is laid out otherwise, or has numbers that none has


@bare
def follow_serialized(
    elapsed: float, came: Bytes, like: Bytes, compared: Bytes, given: Array, at: int, rates_at: int,
    out: Bytes, written: Array, out_at: int, out_rates_at: int, q: Array, velocity: Array,
    before: Array, most: Array, memory: Array, limits: Array, active: Array, speeds: Array,
    span: Array, bounds: Array, tcp: Array, largest: Array, free: bool, works: Array,
    reports: Array, figures: Array,
) -> float:  # fmt: skip
    """Correct a serialized target of all n joints and put it out: see `limiter.step_out`.

    Parameters
    ----------
    came, like, compared : (b,) the message, one that is laid out as it must be, and 255 for each
        byte that must be the same in both.
    given, written : numbers of ``came`` and of ``out``; positions begin at ``at`` and ``out_at``,
        velocities at ``rates_at`` and ``out_rates_at``, 0 where there are none.
    out : (c,) what goes out, with all that is not the stamp or a number.
    q, velocity, before : (n,) for what is read, and for what was put out before.
    most : (n,) largest positions that are believed.

    Returns
    -------
    float
        As `limiter.step_out`, or `UNLIKE`: then nothing has gone out.
    """
    n, unlike = q.shape[0], np.uint8(0)
    for i in range(came.shape[0]):
        unlike |= (came[i] ^ like[i]) & compared[i]
    fine = unlike == 0
    for j in range(n):
        q[j], velocity[j], before[j] = given[at + j], 0.0, memory[OUT, j]
        if rates_at > 0:
            velocity[j] = given[rates_at + j]
        fine = fine and abs(q[j]) <= most[j] and np.isfinite(velocity[j])
    if not fine:
        return UNLIKE
    share = step_out(
        q, velocity, elapsed, elapsed, memory, limits, active, speeds, span, bounds, tcp, largest,
        free, works, reports, figures,
    )  # fmt: skip
    if 0.0 <= share <= 1.0 + ROUNDING:
        for i in range(STAMP, FRAME):
            out[i] = came[i]
        for j in range(n):
            written[out_at + j] = memory[OUT, j]
            if out_rates_at > 0:
                written[out_rates_at + j] = memory[VELOCITY, j]
    return share


class SerializedTarget:
    """What is known of targets that are laid out as one that came, and room for the next one.

    ``command``: of the one that came. ``same``: where its bytes ``like`` are those of all. ``out``:
    what goes out for it. Positions and velocities begin ``at`` these bytes, and ``out_at`` those;
    0 where there are none.
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
        self.q, self.velocity, self.before = np.zeros((3, len(command.names)))
        compared = np.zeros(len(like), dtype=np.uint8)
        for part in same:
            compared[part] = 255
        came, given = _room(like)
        written, numbers = _room(out)
        self._came, self._out = came.data, written.data
        places, out_places = (
            [(HEAD + place) // 8 if place else 0 for place in each] for each in (at, out_at)
        )
        self._given: tuple[Any, ...] = (
            came, np.frombuffer(like, np.uint8).copy(), compared, given, *places, written, numbers,
            *out_places, self.q, self.velocity, self.before,
        )  # fmt: skip

    def follow(self, came: bytes, elapsed_s: float, *step: Any) -> float:
        """Put out the target in a message of this ``size``: see `follow_serialized`.

        ``step``: the last arguments of that.
        """
        self._came[:] = came
        return follow_serialized(elapsed_s, *self._given, *step)

    def stamp_ns(self, came: bytes) -> int:
        """The stamp of a message of this ``size``; 0 when it is not set."""
        sec, nanosec = STAMPS.unpack_from(came, STAMP)
        return int(sec * NS + nanosec)

    def written(self) -> bytes:
        """What goes out for the last one that was put out."""
        return self._out.tobytes()


def _room(message: bytes) -> tuple[Bytes, Array]:
    """A copy of a message whose numbers are aligned, and these."""
    numbers = np.zeros(-(-(HEAD + len(message)) // 8))
    data = numbers.view(np.uint8)[HEAD : HEAD + len(message)]
    data[:] = np.frombuffer(message, np.uint8)
    return data, numbers
