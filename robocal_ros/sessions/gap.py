"""The production gap: whether the robot may be moved, and how long yet."""

import numpy as np

from robocal_ros.core.errors import InputError

LONGEST_GAP_S = 86_400.0


class Gap:
    """Follows the heartbeat ``gap_open`` and the end of the gap that was told; steady clock.

    Parameters
    ----------
    stale_s : a heartbeat counts for so long.
    """

    def __init__(self, stale_s: float) -> None:
        self._stale_s = stale_s
        self._open, self._heard_s = False, -np.inf
        self.ends_s = -np.inf

    def heard(self, is_open: bool, now_s: float) -> None:
        """Take a heartbeat."""
        self._open, self._heard_s = is_open, now_s

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
        if self._heard_s == -np.inf:
            return "gap_open was never heard: let the PLC publish it at 5 Hz"
        silent_s = now_s - self._heard_s
        if not 0.0 <= silent_s <= self._stale_s:
            return f"gap_open is silent for {silent_s:.2f} s (allowed {self._stale_s:g} s)"
        return "" if self._open else "gap_open is false"

    def over(self, now_s: float) -> str:
        """Why the run must end: the gap is closed, or its time has run out; else empty."""
        if (why := self.closed(now_s)) != "":
            return why
        return "the gap's time has run out" if self.left_s(now_s) <= 0.0 else ""
