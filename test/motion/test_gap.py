# SPDX-License-Identifier: Apache-2.0
"""The heartbeat of the gap and its echo, heard by a process that pauses now and then."""

from collections.abc import Callable

import numpy as np
import pytest

from robocal_ros.motion.robot_watch import BEAT_S, DRAIN_S, MOST_BEAT, Gap

TICK_S, STALE_S = 0.02, 0.5
LATE_S = 0.05  # after a pause, until the last beat that waited is delivered
OLDEST_S = STALE_S + BEAT_S  # as docs/plc.md: no beat that is older keeps the gap open


class Line:
    """A node that counts beats, and a PLC that echoes the newest it has read; no pauses.

    Attributes
    ----------
    plc : what the PLC writes, of the newest beat that it has read.
    to_plc_s, from_plc_s : the ways of the network.
    """

    def __init__(self) -> None:
        self.gap, self.now_s = Gap(STALE_S), 100.0
        self.plc: Callable[[int], tuple[bool, int] | None] = lambda newest: (True, newest)
        self.to_plc_s = self.from_plc_s = 0.0
        self.newest = 0
        self._counted_s = self._written_s = -np.inf
        self._to_plc: list[tuple[float, int]] = []
        self._from_plc: list[tuple[float, bool, int]] = []

    def tick(self) -> None:
        self.now_s += TICK_S
        now_s, gap = self.now_s, self.gap
        gap.look(now_s)
        if now_s >= self._counted_s + BEAT_S - 1e-9:
            self._counted_s = now_s
            self._to_plc.append((now_s + self.to_plc_s, gap.count(now_s)))
        while self._to_plc and self._to_plc[0][0] <= now_s + 1e-9:
            self.newest = self._to_plc.pop(0)[1]
        if now_s >= self._written_s + BEAT_S - 1e-9 and (said := self.plc(self.newest)):
            self._written_s = now_s
            self._from_plc.append((now_s + self.from_plc_s, *said))
        while self._from_plc and self._from_plc[0][0] <= now_s + 1e-9:
            gap.heard(*self._from_plc.pop(0)[1:], now_s)

    def run(self, seconds: float) -> list[bool]:
        """Whether the gap was open, tick by tick."""
        found = []
        for _ in range(round(seconds / TICK_S)):
            self.tick()
            found.append(not self.gap.closed(self.now_s))
        return found

    def closes_within(self, seconds: float) -> None:
        was_open = self.run(seconds + 3.0)
        last = max((i for i, is_open in enumerate(was_open) if is_open), default=-1)
        assert (last + 1) * TICK_S <= seconds + TICK_S + 1e-9


@pytest.fixture
def line() -> Line:
    line = Line()
    line.run(1.0)
    assert all(line.run(5.0))
    return line


def heartbeats(gap: Gap, from_s: float, to_s: float) -> float:
    """Ticks and heartbeats without a pause, each echoed at once; the time then."""
    now_s, beat_s = from_s, from_s
    while now_s < to_s:
        now_s += TICK_S
        gap.look(now_s)
        if now_s >= beat_s + BEAT_S:
            beat_s = now_s
            gap.heard(True, gap.count(now_s), now_s)
    return now_s


def test_a_bridge_that_repeats_the_last_value_of_a_dead_plc_opens_nothing(line):
    last = line.newest
    line.plc = lambda newest: (True, last)
    line.closes_within(OLDEST_S)
    assert f"gap_open echoes {last}, which is no beat of the last 0.5 s" in line.gap.closed(
        line.now_s
    )
    line.plc = lambda newest: (True, newest)
    line.run(BEAT_S)
    assert all(line.run(2.0))


@pytest.mark.parametrize("delay_s", [0.0, 0.1, 0.2, 0.3])
@pytest.mark.parametrize("way", ["to_plc_s", "from_plc_s"])
def test_a_plc_that_dies_or_says_no_closes_whatever_the_way_takes(delay_s, way):
    for says in (None, (False, 0)):
        line = Line()
        setattr(line, way, delay_s)
        line.run(1.0 + delay_s)
        assert all(line.run(3.0))
        died_s, line.plc = line.now_s, lambda newest, says=says: says
        while not line.gap.closed(line.now_s):
            line.tick()
        assert line.now_s - died_s <= OLDEST_S + TICK_S


@pytest.mark.parametrize(("old_s", "opens"), [(0.4, True), (0.6, False)])
@pytest.mark.parametrize("way", ["to_plc_s", "from_plc_s"])
def test_an_echo_counts_by_the_way_there_and_back(old_s, opens, way):
    line = Line()
    setattr(line, way, old_s)
    was_open = line.run(5.0)
    assert all(was_open[50:]) if opens else not any(was_open)


def test_a_network_that_grows_slow_closes_the_gap(line):
    per_s = 0.05
    for _ in range(200):
        line.from_plc_s += 0.1 * per_s
        if line.run(0.1)[-1]:
            assert line.from_plc_s <= STALE_S + per_s * OLDEST_S
    assert line.gap.closed(line.now_s)


def test_an_echo_of_before_a_restart_opens_nothing(line):
    echo = line.newest
    for _ in range(20):
        line.gap = Gap(STALE_S)
        line.plc = lambda newest: (True, echo)
        assert not any(line.run(5.0))
    line.plc = lambda newest: (True, newest)
    assert any(line.run(1.0))


def test_a_plc_that_starts_anew_opens_once_it_has_read_a_beat(line):
    line.plc = lambda newest: (True, 0)  # a message that was never filled in
    line.closes_within(OLDEST_S)
    line.plc = lambda newest: (True, newest)
    assert any(line.run(1.0))


def test_the_count_wraps_around_and_is_never_0():
    line = Line()
    line.gap.beat = MOST_BEAT - 10
    line.run(1.0)
    seen = set()
    for _ in range(50):
        assert all(line.run(0.1))
        seen.add(line.newest)
    assert {MOST_BEAT, 1} <= seen
    assert 0 not in seen
    line.gap.saw(0, line.now_s)
    line.plc = lambda newest: (True, 0)
    line.closes_within(OLDEST_S)


def test_a_true_with_an_old_echo_does_not_take_a_false_back(line):
    gap, echo = line.gap, line.newest
    line.plc = lambda newest: None
    line.run(0.2)
    assert not gap.closed(line.now_s)
    gap.heard(False, echo, line.now_s)
    assert gap.closed(line.now_s) == "gap_open is false"
    line.run(0.4)
    gap.heard(True, echo, line.now_s)
    assert "which is no beat of the last" in gap.closed(line.now_s)


def test_who_only_sees_the_beats_judges_by_when_it_saw_each_first():
    """As tcf_node: the status that bears the beat comes again, or waited through a pause."""
    gap = Gap(STALE_S)
    gap.look(0.0)
    gap.saw(7, 0.0)
    for now_s in np.arange(TICK_S, 3.0, TICK_S):
        gap.saw(7, now_s)
        gap.heard(True, 7, now_s)
        if abs(now_s - OLDEST_S) > 0.5 * TICK_S:
            assert bool(gap.closed(now_s)) == (now_s > OLDEST_S), now_s
    gap.saw(8, 5.0)  # after a pause
    gap.heard(True, 8, 5.0)
    assert gap.closed(5.0)
    for now_s in np.arange(5.0, 5.0 + 2.0 * DRAIN_S, TICK_S):
        gap.look(now_s)
    gap.saw(9, now_s)
    gap.heard(True, 9, now_s)
    assert not gap.closed(now_s)


def test_a_beat_that_waited_through_a_pause_counts_from_before_it():
    for echoes in (True, False):  # without: std_msgs/Bool
        gap = Gap(STALE_S)
        before_s = heartbeats(gap, 0.0, 2.0)
        echo = gap.beat if echoes else None
        assert not gap.closed(before_s)
        after_s = before_s + 1.0
        gap.heard(True, echo, after_s)  # taken before the first look
        assert gap.closed(after_s) == "gap_open is silent for more than 0.5 s"
        gap.look(after_s + TICK_S)
        gap.heard(True, echo, after_s + TICK_S)  # the next one that waited
        assert gap.closed(after_s + TICK_S)
        now_s = heartbeats(gap, after_s + TICK_S, after_s + 0.5)
        assert not gap.closed(now_s)


def test_a_false_that_waited_closes_at_once():
    gap = Gap(STALE_S)
    before_s = heartbeats(gap, 0.0, 2.0)
    gap.heard(False, gap.beat, before_s + 0.2)
    assert gap.closed(before_s + 0.2) == "gap_open is false"


def test_a_doubt_closes_until_it_ends():
    gap = Gap(STALE_S)
    now_s = heartbeats(gap, 0.0, 1.0)
    gap.doubt("two publish it")
    assert gap.closed(now_s) == "two publish it"
    gap.doubt("")
    assert not gap.closed(now_s)


@pytest.mark.parametrize("echoes", [True, False])
@pytest.mark.parametrize("seed", range(20))
def test_no_old_beat_keeps_the_gap_open_whatever_pauses(seed, echoes):
    """The PLC dies; what it sent before waits for as long as this process pauses."""
    rng = np.random.default_rng(seed)
    for _ in range(20):
        gap, now_s, counted_s = Gap(STALE_S), 0.0, -np.inf
        dies_s, written_s = rng.uniform(1.0, 3.0), 0.0
        waiting: list[tuple[bool, int | None]] = []
        while now_s < 6.0:
            pauses = rng.random() < 0.02
            end_s = now_s + (rng.uniform(0.05, 1.5) if pauses else TICK_S)
            while written_s <= min(end_s, dies_s):
                waiting.append((True, gap.beat if echoes else None))
                written_s += BEAT_S
            now_s = end_s
            gap.look(now_s)
            deliver_s = now_s + rng.uniform(0.0, LATE_S) if pauses else now_s
            while waiting and deliver_s <= now_s + TICK_S:
                gap.heard(*waiting.pop(0), max(now_s, deliver_s))
            if now_s >= counted_s + BEAT_S:
                counted_s = now_s
                gap.count(now_s)
            if now_s > dies_s + STALE_S:
                assert gap.closed(now_s), (seed, now_s, dies_s)


@pytest.mark.parametrize("seed", range(20))
def test_nothing_holds_the_gap_open_longer_than_the_plc_is_told(seed):
    """Random delays, losses, pauses, a bridge that repeats: `OLDEST_S` from what the PLC read."""
    rng = np.random.default_rng(seed)
    opened = 0
    for _ in range(10):
        line = Line()
        dies_s = line.now_s + rng.uniform(1.0, 3.0)
        last = [0]
        counted_at: dict[int, float] = {}

        def plc(newest: int, dies_s=dies_s, last=last, line=line) -> tuple[bool, int] | None:
            if line.now_s < dies_s:
                last[0] = newest
            return None if rng.random() < 0.2 else (True, last[0])

        line.plc = plc
        while line.now_s < dies_s + 3.0:
            line.to_plc_s, line.from_plc_s = rng.exponential(0.1, 2)
            if rng.random() < 0.02:
                line.now_s += rng.uniform(0.05, 1.5)
            line.tick()
            counted_at.setdefault(line.gap.beat, line.now_s)
            if not line.gap.closed(line.now_s):
                opened += 1
                assert line.now_s <= dies_s + OLDEST_S
                assert line.now_s - counted_at.get(last[0], line.now_s) <= OLDEST_S + TICK_S
    assert opened > 100
