"""The heartbeat of the gap, heard by a process that pauses now and then."""

import numpy as np
import pytest

from robocal_ros.motion.gap import STALL_S, Gap

TICK_S, BEAT_S, STALE_S = 0.02, 0.2, 0.5
LATE_S = 0.05  # after a pause, until the last beat that waited is delivered


def heartbeats(gap: Gap, from_s: float, to_s: float) -> float:
    """Ticks and beats without a pause; the time then."""
    now_s, beat_s = from_s, from_s
    while now_s < to_s:
        now_s += TICK_S
        gap.look(now_s)
        if now_s >= beat_s + BEAT_S:
            beat_s = now_s
            gap.heard(True, now_s)
    return now_s


def test_a_beat_that_waited_through_a_pause_counts_from_before_it():
    gap = Gap(STALE_S)
    before_s = heartbeats(gap, 0.0, 2.0)
    assert not gap.closed(before_s)
    after_s = before_s + 1.0
    gap.heard(True, after_s)  # taken before the first look
    assert gap.closed(after_s) == "gap_open is silent for more than 0.5 s"
    gap.look(after_s + TICK_S)
    gap.heard(True, after_s + TICK_S)  # the next one that waited
    assert gap.closed(after_s + TICK_S)
    now_s = heartbeats(gap, after_s + TICK_S, after_s + 0.5)
    assert not gap.closed(now_s)


def test_a_false_that_waited_closes_at_once():
    gap = Gap(STALE_S)
    before_s = heartbeats(gap, 0.0, 2.0)
    gap.heard(False, before_s + 0.2)
    assert gap.closed(before_s + 0.2) == "gap_open is false"


def test_a_doubt_closes_until_it_ends():
    gap = Gap(STALE_S)
    now_s = heartbeats(gap, 0.0, 1.0)
    gap.doubt("two publish it")
    assert gap.closed(now_s) == "two publish it"
    gap.doubt("")
    assert not gap.closed(now_s)


@pytest.mark.parametrize("seed", range(20))
def test_no_old_beat_keeps_the_gap_open_whatever_pauses(seed):
    """The PLC dies; what it sent before waits for as long as this process pauses."""
    rng = np.random.default_rng(seed)
    for _ in range(20):
        gap, now_s = Gap(STALE_S), 0.0
        dies_s = rng.uniform(1.0, 3.0)
        beats_s = list(np.arange(0.0, dies_s, BEAT_S))
        while now_s < 6.0:
            pauses = rng.random() < 0.02
            now_s += rng.uniform(0.05, 1.5) if pauses else TICK_S
            gap.look(now_s)
            deliver_s = now_s + rng.uniform(0.0, LATE_S) if pauses else now_s
            while beats_s and beats_s[0] <= now_s and deliver_s <= now_s + TICK_S:
                gap.heard(True, max(now_s, deliver_s))
                del beats_s[0]
            if now_s > dies_s + STALE_S:
                assert gap.closed(now_s), (seed, now_s, dies_s)


def test_one_late_beat_holds_the_gap_open_no_longer_than_the_plc_is_told():
    """As docs/plc.md: lost and sent again, the last one before the PLC dies; no pause."""
    gap = Gap(STALE_S)
    sent_s = heartbeats(gap, 0.0, 2.0) + BEAT_S
    gap.heard(True, sent_s - BEAT_S)
    arrives_s = sent_s - BEAT_S + STALE_S  # later, and the gap would have closed before
    for now_s in np.arange(sent_s, arrives_s - TICK_S, TICK_S):
        gap.look(now_s)
        assert not gap.closed(now_s)
    gap.heard(True, arrives_s)
    bound_s = 2.0 * STALE_S - BEAT_S
    assert not gap.closed(sent_s + bound_s - TICK_S)
    assert gap.closed(sent_s + bound_s + TICK_S)
    assert bound_s + STALL_S == pytest.approx(0.9)
