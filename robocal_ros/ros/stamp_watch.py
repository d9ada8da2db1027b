"""How the stamps of what comes in compare with this host's clock, and how long nothing came."""

import time
from typing import Any

from robocal_ros.ground.samples import stamp_ns
from robocal_ros.ros.diagnostics import ERROR, WARN, Health
from robocal_ros.ros.endpoints import EndpointNode

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
