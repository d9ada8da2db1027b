"""Joint readings by time stamp: interpolation and the standstill check."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import JointBlock, JointSample

Array = NDArray[np.float64]

CLOCK_JUMP_NS = 1_000_000_000


@dataclass(frozen=True)
class StandstillRule:
    """When a robot counts as standing still around an instant.

    Attributes
    ----------
    before_s, after_s : the window about the instant.
    tolerance_rad : largest range of any joint in the window (prismatic: m).
    gap_s : longest pause between two joint readings in the window.
    """

    before_s: float = 0.3
    after_s: float = 0.1
    tolerance_rad: float = float(np.radians(0.02))
    gap_s: float = 0.25


@dataclass(frozen=True)
class Reading:
    """Joints (n,) interpolated at an instant, and the stamp of the reading that completed it."""

    q: Array
    ready_ns: int


class Added(NamedTuple):
    """What a reading did to a stream.

    ``began_ns``: stamp at which the stream begins, or begins anew; ``lone_ns``: stamp of an
    earlier reading that no other followed and that is not used. None: it did no such thing.
    """

    began_ns: int | None = None
    lone_ns: int | None = None


class NotStillError(InputError):
    """The joints cannot be given at that instant; the message says why."""


def _goes_on(stamp_ns: int, held_ns: int, newest_ns: int | None, near_ns: int) -> bool:
    """Whether a stamp goes on from one that leapt, and not from the newest before the leap."""
    if stamp_ns <= held_ns:
        return False
    if newest_ns is None or held_ns > newest_ns:
        return True
    if stamp_ns > newest_ns:
        return False
    return stamp_ns - held_ns <= near_ns or newest_ns - stamp_ns >= CLOCK_JUMP_NS


class JointStream:
    """The latest joint readings of one arm, in its joint order, oldest first.

    Content depends on the readings alone, not on when they arrive between other topics.
    """

    def __init__(self, joint_names: tuple[str, ...], capacity: int = 16384) -> None:
        self._names = joint_names
        self._stamp = np.zeros(2 * capacity, dtype=np.int64)
        self._q = np.zeros((2 * capacity, len(joint_names)))
        self._capacity = capacity
        self._size = 0
        self._order: dict[tuple[str, ...], NDArray[np.int64]] = {}
        self._held: tuple[int, Array] | None = None  # a reading that leapt, not yet believed
        self.gap_count = 0
        self.longest_gap_ns = 0

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest reading."""
        return int(self._stamp[self._size - 1]) if self._size else None

    def add(self, sample: JointSample, gap_ns: int) -> Added:
        """Append a reading; joints may come in any order and beside others.

        A leap of the stamps, back by a second or more or ahead by more than that and ``gap_ns``,
        is believed when the next reading goes on from there: one wrong stamp must not move the
        clock. So is the beginning. A leap ahead is a pause; a leap back starts the stream anew.
        Pauses longer than ``gap_ns`` are counted.

        Raises
        ------
        InputError
            When a joint is missing, or the stamp is not after the newest one.
        """
        order = self._order.get(sample.names)
        if order is None:
            order = self._order[sample.names] = sample.order(self._names)
        stamp_ns, near_ns = sample.stamp_ns, max(CLOCK_JUMP_NS, gap_ns)
        held, newest = self._held, self.newest_ns
        began_ns = lone_ns = None
        if held is not None and _goes_on(stamp_ns, held[0], newest, near_ns):
            if newest is None or held[0] < newest:
                self._size, began_ns = 0, held[0]
            self._append(held, gap_ns)
            newest = held[0]
        elif newest is not None and -CLOCK_JUMP_NS < stamp_ns - newest <= 0:
            raise InputError(f"joint state at {stamp_ns} ns is not after {newest} ns")
        elif held is not None:
            lone_ns = held[0]
        reading = stamp_ns, sample.position[order]
        leaps = newest is None or not 0 < stamp_ns - newest <= near_ns
        self._held = reading if leaps else None
        if not leaps:
            self._append(reading, gap_ns)
        return Added(began_ns, lone_ns)

    def extend(self, block: JointBlock, start: int, before_ns: int | None, gap_ns: int) -> int:
        """Append the readings from ``start`` on that just follow each other: how many these are.

        Each is what `add` would have done. The first one that leaps, is not after the one before
        it, or is stamped ``before_ns`` or later is left to the caller.
        """
        order, newest = self._order.get(block.names), self.newest_ns
        if order is None or newest is None or self._held is not None:
            return 0
        stamps = block.stamp_ns[start:]
        steps = stamps - np.concatenate(([newest], stamps[:-1]))
        plain = (steps > 0) & (steps <= max(CLOCK_JUMP_NS, gap_ns))
        if before_ns is not None:
            plain &= stamps < before_ns
        count = len(plain) if plain.all() else int(np.argmin(plain))
        pauses = steps[:count][steps[:count] > gap_ns]
        if len(pauses):
            self.gap_count += len(pauses)
            self.longest_gap_ns = max(self.longest_gap_ns, int(pauses.max()))
        rows = slice(start, start + count)
        stamps, q = block.stamp_ns[rows], block.position[rows][:, order]
        while len(stamps):
            self._make_room()
            room = len(self._stamp) - self._size
            end = self._size + min(room, len(stamps))
            self._stamp[self._size : end], self._q[self._size : end] = stamps[:room], q[:room]
            self._size, stamps, q = end, stamps[room:], q[room:]
        return count

    def _make_room(self) -> None:
        """Forget the older half of the readings where there is no room for more."""
        if self._size == len(self._stamp):
            self._stamp[: self._capacity] = self._stamp[self._capacity :]
            self._q[: self._capacity] = self._q[self._capacity :]
            self._size = self._capacity

    def _append(self, reading: tuple[int, Array], gap_ns: int) -> None:
        """Append a reading, and count the pause before it."""
        stamp_ns, q = reading
        newest = self.newest_ns
        if newest is not None and stamp_ns - newest > gap_ns:
            self.gap_count += 1
            self.longest_gap_ns = max(self.longest_gap_ns, stamp_ns - newest)
        self._make_room()
        self._stamp[self._size], self._q[self._size] = stamp_ns, q
        self._size += 1

    def window(self, from_ns: int, to_ns: int) -> tuple[NDArray[np.int64], Array]:
        """Stamps (k,) and joints (k, n) of the readings from ``from_ns`` up to ``to_ns``."""
        stamps = self._stamp[: self._size]
        low, high = np.searchsorted(stamps, from_ns), np.searchsorted(stamps, to_ns, side="right")
        return stamps[low:high].copy(), self._q[low:high].copy()

    def standstill(self, stamp_ns: int, rule: StandstillRule) -> Reading | None:
        """Joints at an instant at which the robot stands still; None while readings are to come.

        Raises
        ------
        NotStillError
            When the robot moved, or readings are missing around the instant.
        """
        first_ns = stamp_ns - int(rule.before_s * 1e9)
        last_ns = stamp_ns + int(rule.after_s * 1e9)
        stamps = self._stamp[: self._size]
        if not self._size or stamps[-1] < last_ns:
            return None
        low = int(np.searchsorted(stamps, first_ns, side="right")) - 1
        high = int(np.searchsorted(stamps, last_ns, side="left"))
        if low < 0:
            raise NotStillError("no joint readings from before the measurement")
        gap = float(np.max(np.diff(stamps[low : high + 1]))) * 1e-9
        if gap > rule.gap_s:
            raise NotStillError(
                f"joint readings pause for {gap:.3f} s (allowed {rule.gap_s:.3f} s)"
            )
        window = self._q[low : high + 1]
        spread = np.ptp(window, axis=0)
        worst = int(np.argmax(spread))
        if spread[worst] > rule.tolerance_rad:
            raise NotStillError(
                f"{self._names[worst]} moved by {np.degrees(spread[worst]):.3f} deg "
                f"(allowed {np.degrees(rule.tolerance_rad):.3f} deg)"
            )
        at = int(np.searchsorted(stamps, stamp_ns, side="right"))
        before, after = int(stamps[at - 1]), int(stamps[min(at, high)])
        share = 0.0 if after == before else (stamp_ns - before) / (after - before)
        q = (1.0 - share) * self._q[at - 1] + share * self._q[min(at, high)]
        return Reading(q, int(stamps[high]))

    def resting(self, stamp_ns: int, rule: StandstillRule) -> Array | None:
        """Mean joints (n,) of the standstill about an instant. Else as `standstill`."""
        reading = self.standstill(stamp_ns, rule)
        if reading is None:
            return None
        _, q = self.window(stamp_ns - int(rule.before_s * 1e9), reading.ready_ns)
        return np.asarray(q.mean(axis=0))


# ---- how long something was not heard -----------------------------------------------------------


MOST_S = 0.05  # counted from one look to the next: more is a pause of the own process
CREDIT_S = 0.2  # at most so much is believed to be one


class Silence:
    """Counts what passes between looks; pauses of the own process are nobody's silence."""

    def __init__(self) -> None:
        self._looked_s: float | None = None
        self._heard_s = 0.0
        self._newest_ns = 0
        self.lasts_s = 0.0

    def heard_if_new(self, stamp_ns: int, now_s: float) -> None:
        """The newest reading has this stamp; one whose clock stands is no new reading."""
        if stamp_ns != self._newest_ns:
            self._newest_ns = stamp_ns
            self.heard(now_s)

    def heard(self, now_s: float) -> None:
        """It was heard now (steady clock)."""
        self._looked_s = self._heard_s = now_s
        self.lasts_s = 0.0

    def look(self, now_s: float) -> float:
        """How long it has not been heard."""
        if self._looked_s is not None:
            self.lasts_s += min(max(now_s - self._looked_s, 0.0), MOST_S)
            self.lasts_s = max(self.lasts_s, now_s - self._heard_s - CREDIT_S)
        self._looked_s = now_s
        return self.lasts_s
