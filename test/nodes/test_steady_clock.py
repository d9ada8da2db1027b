# SPDX-License-Identifier: Apache-2.0
"""The clock of whoever moves the robot, over a host that is suspended."""

import time

from robocal_ros.motion.driver import SteadyClock

PREEMPTED_S = 0.01  # between the reads of its two clocks, at most in one of a thousand


def test_a_suspend_is_told_once_and_counts(monkeypatch):
    told: list[float] = []
    clock = SteadyClock(told.append)
    before_s = [clock.now_s() for _ in range(1000)][-1]
    assert sum(told) < PREEMPTED_S
    told.clear()
    read = time.clock_gettime

    def woken(which: int) -> float:
        return read(which) + 3600.0 * (which == time.CLOCK_BOOTTIME)

    monkeypatch.setattr(time, "clock_gettime", woken)
    assert clock.now_s() - before_s >= 3600.0
    assert len(told) == 1
    assert abs(told[0] - 3600.0) < PREEMPTED_S
    for _ in range(1000):
        clock.now_s()
    assert abs(sum(told) - 3600.0) < PREEMPTED_S
