"""What time it is on the clock of the samples."""

import time
from collections.abc import Callable
from typing import Any

from robocal_ros.ground.samples import stamp_ns
from robocal_ros.ros.endpoints import ERROR, WARN, EndpointNode, Health


class DataClock:
    """The samples' clock, read between them too: ROS time runs on where they pause."""

    def __init__(self) -> None:
        self._newest_ns: int | None = None
        self._read_ns = 0

    def at(self, newest_ns: int | None, now_ns: int) -> int:
        """Time of the samples' clock at ROS time ``now_ns``; that itself before the first."""
        if newest_ns is None:
            return now_ns
        if newest_ns != self._newest_ns:
            self._newest_ns, self._read_ns = newest_ns, now_ns
        return newest_ns + max(now_ns - self._read_ns, 0)


# ---- the clock of whoever moves the robot -------------------------------------------------------


class SteadyClock:
    """Seconds that no setting of the clock changes, those of a suspended host included.

    What was heard before it was suspended is old when it wakes. A motion is not: the controller of
    the same host stood still with it.

    Parameters
    ----------
    slept : takes for how long the host was suspended, before a time of afterwards is given out.
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


# ---- stamps that do not fit the clock -----------------------------------------------------------


AHEAD_S = 0.1  # hosts that NTP keeps are some ms apart; a busy host makes messages old, not early
SILENT_S = 5.0


class StampWatch:
    """Judges inputs by receive time, beside the sessions, which go by the stamps alone.

    An input is ahead where every message since the last look was: one wrong stamp is the sessions'
    to leave out. With simulated time the stamps are the clock, and only silence is judged.

    Parameters
    ----------
    node : its clock is what stamps are compared with.
    needed : the topic whose silence is worth a warning once it has been heard.
    """

    def __init__(self, node: EndpointNode, needed: str) -> None:
        self._node, self._needed = node, needed
        self._simulated = bool(node.get_parameter("use_sim_time").value)
        self._least_ns: dict[str, int] = {}  # smallest lead of the stamps since the last look
        self._ahead_ns: dict[str, int] = {}  # as the last look found it
        self._heard_s: dict[str, float] = {}  # steady clock

    def note(self, topic: str, message: Any) -> None:
        """Take notice of a message that has come in."""
        self._heard_s[topic] = time.monotonic()
        if not self._simulated:
            lead = stamp_ns(message.header.stamp) - self._node.now_ns()
            self._least_ns[topic] = min(lead, self._least_ns.get(topic, lead))

    def judge(self, health: Health) -> dict[str, object]:
        """Add what is wrong to a node's health; returns figures of each input."""
        self._ahead_ns |= self._least_ns
        self._least_ns.clear()
        for topic, lead in self._ahead_ns.items():
            if lead > AHEAD_S * 1e9:
                health.worsen(
                    ERROR,
                    f"{topic} is stamped {lead * 1e-9:.2f} s ahead of this host's clock: set the "
                    "clocks of both (NTP or PTP)",
                )
        now = time.monotonic()
        silent = {topic: now - heard for topic, heard in self._heard_s.items()}
        if silent.get(self._needed, 0.0) > SILENT_S:
            health.worsen(
                WARN, f"{self._needed} is silent for {silent[self._needed]:.0f} s: check its driver"
            )
        return {f"{topic} last received s ago": f"{s:.1f}" for topic, s in silent.items()}
