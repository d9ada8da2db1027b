# SPDX-License-Identifier: Apache-2.0
"""Who may work in a place that several robots share: a sensor, a station. No clock, no ROS.

Each robot's PLC wants a gap; one at a time gets it. What a robot holds it holds by its PLC's
heartbeat, and beyond that until its own status says that it is out; who falls silent loses it when
the lease ends. Nobody's clock is compared with another's: times are those of this host, at which
messages came.
"""

from collections.abc import Iterable
from dataclasses import dataclass

HEARTBEAT_S = 0.5  # a gap that nobody renews for so long is closed (GapOpen.msg)


@dataclass
class _Claimant:
    since_s: float = 0.0  # when it began to want
    wanted_s: float = float("-inf")  # when it last said so
    open_s: float = float("-inf")  # when its gap was last told to be open
    told_s: float = float("-inf")  # when its status last came
    out: bool = False  # as that says

    def wants(self, now_s: float) -> bool:
        return now_s - self.wanted_s <= HEARTBEAT_S


class SharedPlace:
    """One place, and the robots that want it.

    A robot gets it when every other one is known to be out, or was silent for ``lease_s``; the one
    that has wanted it longest, of two at one instant the first by name. It keeps it while it wants
    it, and until it is out. Of whose status nothing came for half the lease the gap is closed, so
    that it has the other half to leave, if it still can.

    ``start_s``: nothing was heard before: a robot may be in already.
    """

    def __init__(self, robots: Iterable[str], lease_s: float, start_s: float) -> None:
        self._robots = {name: _Claimant(open_s=start_s, told_s=start_s) for name in sorted(robots)}
        self._lease_s = lease_s
        self._holder = ""

    def want(self, robot: str, wanted: bool, now_s: float) -> bool:
        """A robot's PLC wants the gap, or not any more; whether to tell the robot that it is open.

        Each time: what is not renewed for `HEARTBEAT_S` is closed.
        """
        one = self._robots[robot]
        if wanted and not one.wants(now_s):
            one.since_s = now_s
        one.wanted_s = now_s if wanted else float("-inf")
        heard = now_s - one.told_s <= 0.5 * self._lease_s
        opened = wanted and heard and self.holder(now_s) == robot
        if opened:
            one.open_s = now_s
        return opened

    def tell(self, robot: str, out: bool, now_s: float) -> None:
        """A robot's status: whether it is out of the place, and does nothing there."""
        one = self._robots[robot]
        one.told_s, one.out = now_s, out

    def holder(self, now_s: float) -> str:
        """Who has the place now; empty: nobody."""
        held = self._robots.get(self._holder)
        if held is not None and self._is_out(self._holder, now_s):
            silent = now_s - held.told_s > self._lease_s
            self._holder = self._holder if held.wants(now_s) and not silent else ""
        if not self._holder:
            waiting = [
                (one.since_s, name)
                for name, one in self._robots.items()
                if one.wants(now_s)
                and now_s - one.told_s <= self._lease_s
                and all(self._is_out(other, now_s) for other in self._robots if other != name)
            ]
            self._holder = min(waiting, default=(0.0, ""))[1]
        return self._holder

    def why(self, now_s: float) -> str:
        """Who waits, and for whom; empty where nobody does."""
        found = self._robots.items()
        waiting = [n for n, one in found if one.wants(now_s) and n != self._holder]
        if not waiting:
            return ""
        inside = [n for n in self._robots if n not in waiting and not self._is_out(n, now_s)]
        reason = f"{', '.join(inside)} is not known to be out" if inside else "nobody else is in"
        return f"{', '.join(waiting)} waits: {reason}"

    def _is_out(self, robot: str, now_s: float) -> bool:
        """Known to be out by what it told after its gap had closed, or silent for the lease."""
        one = self._robots[robot]
        if now_s - one.told_s > self._lease_s:
            return True
        return one.out and one.told_s > one.open_s + HEARTBEAT_S
