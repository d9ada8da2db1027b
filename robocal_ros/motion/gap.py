"""The production gap: whether the robot may be moved, and how long yet."""

import secrets

import numpy as np

from robocal_ros.ground.errors import InputError

LONGEST_GAP_S = 86_400.0
STALL_S = 0.1  # between two looks: more is a pause of the own process
DRAIN_S = 0.1  # after one, until all that waited for it has been taken
BEAT_S = 0.2  # between two beats
MOST_BEAT = 2**32 - 1  # 1 follows; 0, which a message has by itself, is never a beat
KNOWN_BEATS = 16


class Gap:
    """Follows the PLC's heartbeat ``gap_open`` and the end of the gap that was told; steady clock.

    The PLC echoes the newest beat that it has read. An echo is fresh while its beat was counted up
    no longer than ``stale_s`` ago, so that the way to the PLC and back is in it. The gap is open
    while the last message says so, a fresh echo came no longer than ``stale_s`` ago, and its beat
    is no older than ``stale_s + BEAT_S``: a value that is repeated closes the gap by then.

    A message that is taken just after a pause of the own process may have waited all through it: it
    counts from before the pause, or from when its beat was counted up.

    Parameters
    ----------
    stale_s : a heartbeat counts for so long, and so old may the beat be that it echoes.
    """

    def __init__(self, stale_s: float) -> None:
        self._stale_s = stale_s
        self._open, self._came_s = False, -np.inf  # what the newest message said, and when
        self._echo: int | None = None
        self._fresh_s = self._beat_s = -np.inf  # the newest fresh echo: when it came, its beat
        self.beat = secrets.randbelow(MOST_BEAT) + 1  # an echo of before a restart is none of ours
        self._counted_s: dict[int, float] = {}
        self._looked_s: float | None = None
        self._paused_s = self._drained_s = -np.inf  # the last pause's begin, and the end of doubt
        self._doubt = ""
        self.ends_s = -np.inf

    def look(self, now_s: float) -> None:
        """The own process goes on; call it every 20 ms."""
        if self._looked_s is not None and now_s - self._looked_s > STALL_S:
            if self._looked_s >= self._drained_s:
                self._paused_s = self._looked_s
            self._drained_s = now_s + DRAIN_S
        self._looked_s = now_s

    def count(self, now_s: float) -> int:
        """The next beat, which is to be published now."""
        self.beat = self.beat % MOST_BEAT + 1
        self._know(self.beat, now_s)
        return self.beat

    def saw(self, beat: int, now_s: float) -> None:
        """Take a beat that another process counts; one that comes again is no newer."""
        self.look(now_s)
        if beat and beat not in self._counted_s:
            self._know(beat, self._since_s(now_s))

    def heard(self, is_open: bool, echo: int | None, now_s: float) -> None:
        """Take a heartbeat; ``echo`` None: of a PLC that does not echo, and counts as fresh."""
        self.look(now_s)
        self._open, self._echo, self._came_s = is_open, echo, self._since_s(now_s)
        beat_s = self._came_s if echo is None else self._counted_s.get(echo, -np.inf)
        if not is_open:
            self._fresh_s = self._beat_s = -np.inf
        elif self._came_s - beat_s <= self._stale_s:
            self._fresh_s, self._beat_s = max(self._came_s, beat_s), beat_s

    def doubt(self, why: str) -> None:
        """Nobody knows whose heartbeats these are: closed; empty ends that."""
        self._doubt = why

    def begin(self, gap_s: float, now_s: float) -> None:
        """A gap of a length at the most begins.

        Raises
        ------
        InputError
            When the length makes no sense.
        """
        if not 0.0 < gap_s <= LONGEST_GAP_S:
            raise InputError(
                f"a gap of {gap_s:g} s: tell its length, up to {LONGEST_GAP_S:g} s, in seconds"
            )
        self.ends_s = now_s + gap_s

    def left_s(self, now_s: float) -> float:
        """Until the end that was told; negative afterwards."""
        return self.ends_s - now_s

    def closed(self, now_s: float) -> str:
        """Why the robot may not be moved by the heartbeat; empty when it may."""
        stale_s = self._stale_s
        if self._doubt:
            return self._doubt
        if self._came_s == -np.inf:
            return "gap_open was never heard: let the PLC publish it at 5 Hz"
        if not 0.0 <= now_s - max(self._came_s, self._fresh_s) <= stale_s:
            return f"gap_open is silent for more than {stale_s:g} s"
        if not self._open:
            return "gap_open is false"
        if now_s - self._fresh_s > stale_s or now_s - self._beat_s > stale_s + BEAT_S:
            return (
                f"gap_open echoes {self._echo}, which is no beat of the last {stale_s:g} s: let "
                "the PLC's program echo the newest beat of maintenance_node/status"
            )
        return ""

    def waits(self, now_s: float) -> bool:
        """Whether no heartbeat is fresh for a pause of the own process alone.

        All that is known is from before the pause; a PLC that lives says more within ``stale_s``.
        """
        if not self._fresh_s < self._drained_s or now_s > self._drained_s + self._stale_s:
            return False
        return self._open and not self._doubt and self.left_s(now_s) > 0.0

    def over(self, now_s: float) -> str:
        """Why the run must end: the gap is closed, or its time has run out; else empty."""
        if (why := self.closed(now_s)) != "":
            return why
        return "the gap's time has run out" if self.left_s(now_s) <= 0.0 else ""

    def _since_s(self, now_s: float) -> float:
        """From when on counts what is taken now."""
        return now_s if now_s >= self._drained_s else self._paused_s

    def _know(self, beat: int, counted_s: float) -> None:
        self._counted_s[beat] = counted_s
        if len(self._counted_s) > KNOWN_BEATS:
            del self._counted_s[next(iter(self._counted_s))]
