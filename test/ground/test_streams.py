# SPDX-License-Identifier: Apache-2.0
"""Joint readings by stamp: interpolation, standstill, gaps, order and memory."""

from dataclasses import replace

import numpy as np
import pytest

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import JointSample, JointStream, NotStillError, StandstillRule

MS = 1_000_000
RULE = StandstillRule(before_s=0.2, after_s=0.1, tolerance_rad=0.01, gap_s=0.15)


def fill(stream: JointStream, stamps_ms, position=lambda ms: (0.5, -0.5)) -> None:
    for ms in stamps_ms:
        stream.add(JointSample(ms * MS, ("a", "b"), np.array(position(ms))), 150 * MS)


def test_readings_are_interpolated_linearly():
    stream = JointStream(("a", "b"))
    fill(stream, range(1000, 2001, 50), lambda ms: (1e-6 * ms, -2e-6 * ms))
    reading = stream.standstill(1512 * MS, RULE)
    assert reading is not None
    assert reading.q == pytest.approx([1512e-6, -3024e-6], abs=1e-15)
    assert reading.ready_ns == 1650 * MS


def test_at_a_reading_that_reading_counts():
    stream = JointStream(("a", "b"))
    fill(stream, range(1000, 2001, 50), lambda ms: (1e-6 * ms, 0.0))
    reading = stream.standstill(1500 * MS, RULE)
    assert reading is not None
    assert reading.q[0] == 1500e-6


def test_a_window_without_length_may_hold_one_reading():
    stream = JointStream(("a", "b"))
    fill(stream, range(1000, 2001, 50))
    reading = stream.standstill(1500 * MS, replace(RULE, before_s=0.0, after_s=0.0))
    assert reading is not None
    assert (reading.q.tolist(), reading.ready_ns) == ([0.5, -0.5], 1500 * MS)


def test_the_answer_waits_for_the_window_and_not_longer():
    stream = JointStream(("a", "b"))
    fill(stream, range(1000, 1550, 50))
    assert stream.standstill(1450 * MS, RULE) is None
    fill(stream, [1550])
    assert stream.standstill(1450 * MS, RULE) is not None
    assert JointStream(("a", "b")).standstill(0, RULE) is None


@pytest.mark.parametrize(("moves_at", "still"), [(1200, True), (1350, False), (1575, True)])
def test_moving_inside_the_window_is_refused(moves_at, still):
    """Window of 1450: from the reading before 1250 to the one at 1550 or after it."""
    stream = JointStream(("a", "b"))
    fill(stream, range(1000, 2001, 50), lambda ms: (0.5, -0.5 + (0.02 if ms > moves_at else 0)))
    if still:
        assert stream.standstill(1450 * MS, RULE) is not None
    else:
        with pytest.raises(NotStillError, match=r"b moved by 1\.146 deg \(allowed 0\.573 deg\)"):
            stream.standstill(1450 * MS, RULE)


def test_a_gap_in_the_window_is_refused_and_one_outside_is_not():
    stream = JointStream(("a", "b"))
    fill(stream, [*range(1000, 1401, 50), *range(1700, 2301, 50)])
    with pytest.raises(NotStillError, match=r"pause for 0\.300 s"):
        stream.standstill(1600 * MS, RULE)
    assert stream.standstill(2100 * MS, RULE) is not None
    assert (stream.gap_count, stream.longest_gap_ns) == (1, 300 * MS)


def test_before_the_first_reading_there_is_no_answer():
    stream = JointStream(("a", "b"))
    fill(stream, range(1000, 2001, 50))
    with pytest.raises(NotStillError, match="from before"):
        stream.standstill(1100 * MS, RULE)


def test_stamps_must_grow():
    stream = JointStream(("a", "b"))
    fill(stream, [1000, 1050])
    for ms in (1050, 1049, 100):
        with pytest.raises(InputError, match="is not after"):
            fill(stream, [ms])
    assert stream.newest_ns == 1050 * MS


def test_a_clock_jump_starts_anew():
    stream = JointStream(("a", "b"))
    fill(stream, range(10_000, 11_001, 50))
    fill(stream, range(1000, 2001, 50))
    assert stream.newest_ns == 2000 * MS
    assert stream.standstill(1500 * MS, RULE) is not None
    with pytest.raises(NotStillError, match="from before"):
        stream.standstill(1100 * MS, RULE)


def test_a_missing_joint_is_named():
    stream = JointStream(("a", "b"))
    with pytest.raises(InputError, match="no position of b; it has a, c"):
        stream.add(JointSample(1, ("a", "c"), np.zeros(2)), MS)


def test_only_the_latest_readings_are_kept():
    stream = JointStream(("a", "b"), capacity=64)
    fill(stream, range(1000, 1000 + 50 * 1000, 50), lambda ms: (1e-7 * ms, 0.0))
    newest = 1000 + 50 * 999
    reading = stream.standstill((newest - 500) * MS, RULE)
    assert reading is not None
    assert reading.q[0] == pytest.approx(1e-7 * (newest - 500), abs=1e-15)
    with pytest.raises(NotStillError, match="from before"):
        stream.standstill(1500 * MS, RULE)


def test_a_leap_is_believed_when_a_second_reading_follows_it():
    stream = JointStream(("a", "b"))
    fill(stream, [*range(1000, 2001, 50), 9000, 9050])
    assert stream.newest_ns == 9050 * MS
    assert (stream.gap_count, stream.longest_gap_ns) == (1, 7000 * MS)
    assert stream.standstill(1500 * MS, RULE) is not None  # a leap ahead forgets nothing
    fill(stream, [500])
    assert stream.newest_ns == 9050 * MS
    fill(stream, [550])
    assert stream.newest_ns == 550 * MS
    with pytest.raises(NotStillError, match="before the measurement"):
        stream.standstill(400 * MS, RULE)


def test_two_clocks_in_turn_leave_the_first_in_charge():
    stream = JointStream(("a", "b"))
    fill(stream, [1000, 1050])
    fill(stream, [ms + away for ms in range(1100, 2001, 50) for away in (0, 3_600_000)])
    assert stream.newest_ns == 2000 * MS
    assert stream.gap_count == 0
    assert stream.standstill(1500 * MS, RULE) is not None


def test_a_short_jump_back_at_a_low_rate_is_believed():
    """The second reading is less than a second behind the clock that was left."""
    stream = JointStream(("a", "b"))
    fill(stream, [*range(1000, 3001, 100), 1950, 2050])
    assert stream.newest_ns == 2050 * MS


def test_readings_minutes_apart_are_all_taken():
    """A recorder may keep readings only about the measurements, and few between them."""
    stream = JointStream(("a", "b"))
    fill(stream, [*range(0, 600_000, 60_000), *range(600_000, 601_001, 50)])
    assert stream.newest_ns == 601_000 * MS
    assert stream.gap_count == 10
    assert stream.standstill(600_500 * MS, RULE) is not None
    fill(stream, [*range(60_000, 300_000, 60_000)])  # and the same again
    assert stream.newest_ns == 180_000 * MS  # the last is believed by the next


def test_a_wrong_stamp_among_readings_minutes_apart_is_told():
    stream = JointStream(("a", "b"))
    told = [
        stream.add(JointSample(ms * MS, ("a", "b"), np.zeros(2)), 150 * MS).lone_ns
        for ms in (60_000, 120_000, 9_000_000, 180_000, 240_000)
    ]
    assert told == [None, None, None, 9_000_000 * MS, None]
    assert stream.newest_ns == 180_000 * MS
