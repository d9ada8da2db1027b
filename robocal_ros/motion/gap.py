"""The production gap: whether the robot may be moved, and how long yet."""

import numpy as np

from robocal_ros.core.errors import InputError

LONGEST_GAP_S = 86_400.0
STALL_S = 0.1  # between two looks: more is a pause of the own process
DRAIN_S = 0.1  # after one, until all that waited for it has been taken


class Gap:
    """Follows the heartbeat ``gap_open`` and the end of the gap that was told; steady clock.

    A heartbeat bears no time. One that is taken just after a pause of the own process may have
    waited all through it: it counts from before the pause. One that the network delivers late
    counts from its arrival: how late it is nobody here can tell.

    Parameters
    ----------
    stale_s : a heartbeat counts for so long.
    """

    def __init__(self, stale_s: float) -> None:
        self._stale_s = stale_s
        self._open, self._heard_s = False, -np.inf
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

    def heard(self, is_open: bool, now_s: float) -> None:
        """Take a heartbeat."""
        self.look(now_s)
        self._open = is_open
        self._heard_s = now_s if now_s >= self._drained_s else self._paused_s

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
        if self._doubt:
            return self._doubt
        if self._heard_s == -np.inf:
            return "gap_open was never heard: let the PLC publish it at 5 Hz"
        silent_s = now_s - self._heard_s
        if not 0.0 <= silent_s <= self._stale_s:
            return f"gap_open is silent for more than {self._stale_s:g} s"
        return "" if self._open else "gap_open is false"

    def waits(self, now_s: float) -> bool:
        """Whether no heartbeat is fresh for a pause of the own process alone.

        All that is known is from before the pause; a PLC that lives says more within ``stale_s``.
        """
        if not self._heard_s < self._drained_s or now_s > self._drained_s + self._stale_s:
            return False
        return self._open and not self._doubt and self.left_s(now_s) > 0.0

    def over(self, now_s: float) -> str:
        """Why the run must end: the gap is closed, or its time has run out; else empty."""
        if (why := self.closed(now_s)) != "":
            return why
        return "the gap's time has run out" if self.left_s(now_s) <= 0.0 else ""
