# SPDX-License-Identifier: Apache-2.0
"""What a PLC writes: its heartbeat and its beams, judged before anything is passed on.

Names of refusals are those of OPC UA's status codes (OPC 10000-6, annex A.2). Works without OPC UA,
ROS and clocks: ``now_s`` is monotonic, ``source_ns`` the wall clock's time that the writer gave.
"""

from dataclasses import dataclass
from typing import NamedTuple

from robocal_ros.adapter.inputs import BeamLevel, InputTiming, LevelChange
from robocal_ros.ground.errors import InputError

CONTEST_S = 1.0  # a session that wrote so lately still writes
CLOCK_NS = 1_000_000_000  # a beam's time may be so far from this machine's
GOOD = "Good"
INVALID_TIME = "BadInvalidTimestamp"
CONTESTED = "BadInvalidState"


@dataclass(frozen=True)
class Heartbeat:
    """What the PLC's program says of the gap; ``echo`` 0: it is closed."""

    echo: int
    at_s: float


class HeartbeatWrite(NamedTuple):
    """What comes of a write: its status, what is passed on, and why not."""

    status: str
    passed: Heartbeat | None = None
    words: str = ""


@dataclass(frozen=True)
class _Writer:
    at_s: float
    source_ns: int | None


class HeartbeatInput:
    """Passes each write of the heartbeat on once; never one that is not new.

    The heartbeat is one number, so that no client can write half of it: the beat that the program
    has read while the robot may be moved, 0 while it may not.
    """

    def __init__(self) -> None:
        self._writers: dict[str, _Writer] = {}

    def write(self, session: str, echo: int, source_ns: int | None, now_s: float) -> HeartbeatWrite:
        """Take a write of a session.

        A writer that gives times must give later ones: what repeats an old one is a gateway that
        has latched it. While two sessions write, the gap is closed, whatever they say.
        """
        before = self._writers.get(session)
        if before is not None and before.source_ns is not None:
            if source_ns is None:
                return HeartbeatWrite(INVALID_TIME, None, "without the time that came before")
            if source_ns <= before.source_ns:
                late_s = (before.source_ns - source_ns) * 1e-9
                words = f"{late_s:.3f} s before the last one: repeated, or a clock set back"
                return HeartbeatWrite(INVALID_TIME, None, words)
        self._writers[session] = _Writer(now_s, source_ns)
        others = [
            name
            for name, writer in self._writers.items()
            if name != session and now_s - writer.at_s <= CONTEST_S
        ]
        if others:
            words = f"{session} and {', '.join(others)} both write it: one PLC alone"
            return HeartbeatWrite(CONTESTED, Heartbeat(0, now_s), words)
        return HeartbeatWrite(GOOD, Heartbeat(echo, now_s))

    def end(self, session: str) -> None:
        """A session is gone, and what it wrote counts no more."""
        self._writers.pop(session, None)


class BeamWrite(NamedTuple):
    """What comes of a write: its status, the edge in it, and why not."""

    status: str
    edge: LevelChange | None = None
    words: str = ""


class BeamInput:
    """Finds the edges in the levels of one beam, each written with its time."""

    def __init__(self, timing: InputTiming) -> None:
        self._timing = timing
        self.restart()

    def restart(self) -> None:
        """What the level was before is not known."""
        self._level = BeamLevel(self._timing)

    def write(self, blocked: bool, source_ns: int | None, wall_ns: int) -> BeamWrite:
        """Take a level that was so at ``source_ns``; ``wall_ns``: this machine's time."""
        if source_ns is None:
            words = "without a time: write it with its source time, or Time beside it"
            return BeamWrite(INVALID_TIME, None, words)
        if abs(source_ns - wall_ns) > CLOCK_NS:
            off_s = (source_ns - wall_ns) * 1e-9
            words = f"{off_s:+.3f} s from this machine's time: synchronise the PLC's clock"
            return BeamWrite(INVALID_TIME, None, words)
        try:
            return BeamWrite(GOOD, self._level.hear(blocked, source_ns))
        except InputError as error:
            return BeamWrite(INVALID_TIME, None, str(error))
