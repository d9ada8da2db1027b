# SPDX-License-Identifier: Apache-2.0
"""The clock by which motions are watched."""

import time
from collections.abc import Callable


class SteadyClock:
    """Seconds that no setting of the clock changes, those of a suspended host included.

    What was heard before it was suspended is old when it wakes. A motion is not: the controller of
    the same host stood still with it.

    ``slept``: takes for how long the host was suspended, before a time of afterwards is given out.
    """

    def __init__(self, slept: Callable[[float], None]) -> None:
        self._slept = slept
        self._asleep_s = _both()[1]

    def now_s(self) -> float:
        """What it shows."""
        now_s, asleep_s = _both()
        if asleep_s > self._asleep_s:
            for_s, self._asleep_s = asleep_s - self._asleep_s, asleep_s
            self._slept(for_s)
        return now_s


def _both() -> tuple[float, float]:
    """The time, and how much of it the host was asleep, at least.

    The second clock is read later: what passes in between makes it less, never more.
    """
    now_s = time.clock_gettime(time.CLOCK_BOOTTIME)
    return now_s, now_s - time.clock_gettime(time.CLOCK_MONOTONIC)
