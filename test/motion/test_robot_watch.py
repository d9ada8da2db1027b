# SPDX-License-Identifier: Apache-2.0
"""Where the robot is against its plan, and how fast its controller drives."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from long_form import more

from robocal_ros.kinematics.robots import load_robot
from robocal_ros.motion.cell import DrivingConfig, Housing, MotionCell, ToolBody, joint_way
from robocal_ros.motion.plan import LEAD_S, SHORTEST_STOP_S, MotionLimits, stop
from robocal_ros.motion.robot_watch import (
    BEHIND_S,
    LATE_S,
    LATELY_S,
    LEAST,
    PACE_S,
    REST_RAD,
    STANDS_S,
    STEADY_S,
    TOLD_S,
    USUAL_S,
    Lateness,
    RobotWatch,
    SpeedScaling,
)
from robocal_ros.motion.stopping import WatchedStop

ARM = load_robot("kr150_r3100")
LIMITS = MotionLimits()
DRIVING = DrivingConfig(Housing(0.06, 0.03, -0.12, 0.05), 0.1, 0.008, 0.05, limits=LIMITS)
HOME = np.array([0.3, -1.2, 1.2, 0.4, 0.9, -0.3])
FASTEST = LIMITS.of_joints(ARM)[0]
CELL = MotionCell(ARM, ToolBody(np.eye(4), 0.1, 0.008, 0.05), np.eye(4), DRIVING.housing, LIMITS)
WAY = np.array([1.0, -0.3, 0.2, 0.5, -0.4, 0.1])
FAST_CELL = replace(CELL, limits=MotionLimits(tcp_speed_m_s=0.25))
FAST_PLAN = joint_way(FAST_CELL, HOME, HOME + 0.1 * WAY)
# of a robot's joint states: 1 kHz to 25 Hz
PERIODS_S = (0.001, 0.002, 0.004, 0.008, 0.02, 0.04)


def seen(times_s: np.ndarray, q: np.ndarray) -> RobotWatch:
    watch = RobotWatch(ARM, DRIVING)
    for at_s, joints in zip(times_s, q, strict=True):
        watch.reading(at_s, joints, at_s)
    return watch


def steady(period_s: float, velocity: np.ndarray, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    times = 10.0 + period_s * np.arange(count)
    return times, HOME + np.outer(times - times[-1], velocity)


@given(
    period_s=st.sampled_from(PERIODS_S),
    share=st.floats(-1.0, 1.0),
    ago=st.integers(0, 59),
    joint=st.integers(0, 5),
    wild=st.floats(allow_nan=False, allow_infinity=False),
)
def test_one_wild_reading_changes_nothing(
    period_s: float, share: float, ago: int, joint: int, wild: float
) -> None:
    times, q = steady(period_s, share * FASTEST)
    q[-1 - ago, joint] = wild
    found, velocity = seen(times, q).state(times[-1], keeps=False)
    assert np.allclose(found, HOME, rtol=0.0, atol=1e-9)
    assert np.allclose(velocity, share * FASTEST, rtol=0.0, atol=1e-9)


@given(
    wild=st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=6, max_size=6),
    count=st.integers(1, 60),
)
def test_however_many_are_wild_the_stop_is_as_short_as_one_of_its_own(
    wild: list[float], count: int
) -> None:
    times, q = steady(0.008, 0.3 * FASTEST)
    q[-count:] = wild
    found, velocity = seen(times, q).state(times[-1], keeps=False)
    assert np.all(np.isfinite(found))
    assert np.all(np.abs(velocity) <= FASTEST)
    plan = stop(ARM, LIMITS, found, velocity)
    longest_s = max(SHORTEST_STOP_S, float(np.max(FASTEST / LIMITS.of_joints(ARM)[2])))
    reach = np.abs(plan.q[-1] - plan.q[0])
    assert np.all(reach <= 0.5 * longest_s * FASTEST + 1e-6 * np.abs(found))


@pytest.mark.parametrize("count", [1, 2, LEAST - 1])
def test_too_few_readings_tell_no_speed(count: int) -> None:
    times, q = steady(0.004, FASTEST, count)
    found, velocity = seen(times, q).state(times[-1], keeps=False)
    assert np.array_equal(found, np.median(q, axis=0))
    assert not velocity.any()


def test_a_span_that_rounding_ends_before_the_first_reading_is_not_there_yet():
    first_s, last_s, span_s = 0.014, 0.044, 0.03
    assert last_s - first_s >= span_s
    assert last_s - span_s < first_s
    watch = seen(np.array([first_s, last_s]), np.tile(HOME, (2, 1)))
    assert watch.resting(span_s) is None
    assert not watch.tells_speed(1.0)
    watch.reading(0.05, HOME, 0.05)
    assert watch.resting(span_s) == pytest.approx(HOME, abs=0.0)


@given(share=st.floats(-1.0, 1.0), late_s=st.floats(0.0, 0.2))
def test_a_stop_from_readings_that_came_late_begins_where_the_robot_is_now(
    share: float, late_s: float
) -> None:
    """Finding: it began where the robot had been, and threw it back."""
    times, q = steady(0.004, share * FASTEST)
    found, velocity = seen(times, q).state(times[-1] + late_s, keeps=False)
    assert np.allclose(found, HOME + late_s * share * FASTEST, rtol=0.0, atol=1e-9)
    assert np.allclose(velocity, share * FASTEST, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("late_s", [0.0, 0.15, 0.25])
def test_a_robot_stands_by_readings_from_after_its_stop_alone(late_s: float) -> None:
    """Finding: readings of before a motion, which came late, ended the stop of that motion."""
    watch, stopping = RobotWatch(ARM, DRIVING), WatchedStop(ARM, LIMITS)
    times = 0.004 * np.arange(500)
    for count, now_s in enumerate(times.tolist()):
        watch.reading(now_s - late_s, HOME, now_s - late_s)
        watch.silence.look(now_s)
        if count == 250:
            stopping.begin((HOME, 0.0 * HOME), now_s)
        stopping.look(watch, now_s)
        if stopping.under_way:
            last_s = now_s
    assert stopping.sent == 1
    assert last_s == pytest.approx(times[250] + late_s + STANDS_S, abs=0.005)


@given(
    late_s=st.floats(0.0, 0.15),
    behind_s=st.floats(0.0, 0.09),
    period_s=st.sampled_from([0.004, 0.02]),
    slow=st.floats(1.0, 10.0),
)
def test_a_stop_that_is_obeyed_is_sent_once_however_late_that_is_heard(
    late_s: float, behind_s: float, period_s: float, slow: float
) -> None:
    """Finding: by a reference of before the stop it seemed to drive on: it was sent four times."""
    began_s, reacts_s, lags_s = 1.0, 0.01, 0.014
    limits = replace(LIMITS, stop_deceleration=np.full(6, slow))
    watch, stopping = RobotWatch(ARM, DRIVING), WatchedStop(ARM, limits)
    speed = 0.5 * FASTEST
    begin = HOME + speed * (began_s + reacts_s)
    plan = stop(ARM, limits, begin, speed)

    def sent(at_s: float) -> tuple[np.ndarray, np.ndarray]:
        since_s = at_s - began_s - reacts_s
        if since_s < 0.0:
            return begin + speed * since_s, speed
        place, velocity = plan.at(since_s)
        return place, velocity

    told_s = 0.0
    for now_s in np.arange(0.1, began_s + plan.duration_s + 0.8, 0.004).tolist():
        read_s = now_s - late_s
        watch.reading(read_s, sent(read_s - lags_s)[0], read_s)
        watch.silence.look(now_s)
        if now_s - told_s >= period_s:
            watch.controller(*sent(now_s - behind_s), now_s - behind_s)
            told_s = now_s
        if now_s >= began_s and not stopping.sent:
            stopping.begin(sent(now_s), now_s)
        stopping.look(watch, now_s)
    assert stopping.sent == 1
    assert stopping.failed == ""
    assert not stopping.under_way


# ---- how late messages come ---------------------------------------------------------------------


def latest(stamps: np.ndarray, came: np.ndarray, ages: np.ndarray | None = None) -> np.ndarray:
    lateness, ages = Lateness("states"), came - stamps if ages is None else ages
    rows = zip(stamps.tolist(), came.tolist(), ages.tolist(), strict=True)
    return np.array([lateness.take(*row) for row in rows])


@given(
    offset_s=st.floats(-1e9, 1e9),
    drift=st.floats(-6e-4, 6e-4),
    jitter_s=st.floats(0.0, USUAL_S),
)
def test_clocks_that_differ_and_drift_make_nothing_late(
    offset_s: float, drift: float, jitter_s: float
) -> None:
    came = 10.0 + np.arange(0.0, 3600.0, 1.0)
    scatter = np.random.default_rng(0).uniform(0.0, jitter_s, len(came))
    late = latest((1.0 + drift) * came + offset_s - scatter, came)
    assert late.max() < 1e-6  # stamps of 1e9 s are kept to 0.1 us


@pytest.mark.parametrize("lag_s", [0.05, 0.4, 3.0])
def test_what_waits_for_a_busy_node_is_late_as_long_as_it_lasts(lag_s: float) -> None:
    stamps = 1e9 + np.arange(0.0, 70.0, 0.004)
    came = stamps - 1e9 + np.clip(stamps - 1e9 - 5.0, 0.0, lag_s)  # falls behind, and stays so
    late = latest(stamps, came)
    assert late[:1000].max() < 1e-6
    assert late[-1] == pytest.approx(lag_s, abs=6e-4 * 70.0)


@pytest.mark.parametrize("by_s", [-5.0, -0.5, -0.05, 0.05, 0.5, 5.0])
@pytest.mark.parametrize("whose", ["sender", "receiver", "both"])
def test_a_clock_that_is_set_makes_nothing_late(whose: str, by_s: float) -> None:
    came = np.arange(0.0, 4.0, 0.004)
    is_set = by_s * (came >= 2.0)
    stamps = 1e9 + came + is_set * (whose != "receiver")
    ages = 1e9 + came + is_set * (whose != "sender") - stamps
    assert latest(stamps, came, ages).max() < 1e-6


def taken_back(now_s: float, slew: float = 1.0 / 12.0) -> float:
    """Stamps of a clock that chronyd takes back by 0.5 s from 20 s on, as fast as it may."""
    return 1e9 + now_s + 0.5 - min(max(now_s - 20.0, 0.0) * slew, 0.5)


@pytest.mark.parametrize("period_s", [0.004, 0.02, 0.1])
@pytest.mark.parametrize("scatter", [0.0, 0.4])
def test_a_clock_that_chronyd_takes_back_makes_late_until_it_has_been_steady(
    period_s: float, scatter: float
) -> None:
    """Finding: 0.5 s at 83 333 ppm, on the robot's computer alone, refused commands for 498 s."""
    times, rng, lateness, late = (
        np.arange(0.0, 60.0, period_s),
        np.random.default_rng(0),
        Lateness("states"),
        [],
    )
    jitter_s = scatter * min(period_s, USUAL_S)
    for now_s in (times + rng.uniform(0.0, jitter_s, len(times))).tolist():
        stamp_s = taken_back(now_s - rng.uniform(0.0, jitter_s))
        late.append(lateness.take(stamp_s, now_s, 1e9 + now_s - stamp_s))
        if 26.0 <= now_s <= 30.0:
            assert "chronyd" in lateness.words(now_s)
    ends_s = 20.0 + 0.5 * 12.0
    assert 0.48 < max(late) <= 0.5 + 2.0 * USUAL_S
    assert max(late[: round(20.0 / period_s)]) == 0.0
    # what scatters may begin the steady time anew, as may the last of the way
    assert max(late[round((ends_s + 1.5 * STEADY_S) / period_s) :]) == 0.0
    assert lateness.words(now_s) == ""


@pytest.mark.parametrize("ppm", [1000.0, 5000.0, 20_000.0])
def test_a_clock_that_is_taken_back_slowly_makes_late_until_it_has_been_steady(ppm: float) -> None:
    lateness, times = Lateness("states"), np.arange(0.0, 540.0, 0.02).tolist()
    stamps = [taken_back(t, ppm * 1e-6) for t in times]
    late = [lateness.take(at, t, 1e9 + t - at) for at, t in zip(stamps, times, strict=True)]
    over = round((20.0 + 0.5 / (ppm * 1e-6) + 1.5 * STEADY_S) / 0.02)
    assert max(late[over:]) == 0.0
    if ppm < USUAL_S / STEADY_S * 1e6:  # as good as steady
        assert max(late) <= 3.0 * USUAL_S
    else:
        assert max(late) > 0.4


@pytest.mark.parametrize("stall_s", [0.01, 0.02, 0.03])
@pytest.mark.parametrize("away_s", [0.0, -0.3, 0.02])
def test_a_backlog_of_small_stalls_stays_late_by_clocks_that_agree(
    stall_s: float, away_s: float
) -> None:
    """Finding: a relay with one message a cycle, 0.45 to 1 s behind, was believed after 5 s."""
    stamps = 0.01 * np.arange(4000)
    backlog = sum(stall_s * (stamps >= at) for at in np.arange(5.0, 20.0, 30.0 * stall_s))
    came = stamps + backlog
    late = latest(1e9 + stamps, came, backlog + away_s)
    assert np.all(late >= backlog - 6e-4 * came - BEHIND_S + min(away_s, 0.0) - USUAL_S)


@pytest.mark.parametrize("slower", [0.001, 0.002, 0.004])
def test_a_queue_that_is_hardly_too_slow_stays_late_by_clocks_that_agree(slower: float) -> None:
    """Finding: it leaves out too few messages to tell it, and was believed 0.4 s late."""
    stamps = 0.004 * np.arange(100_000)
    backlog = np.minimum(slower * np.maximum(stamps - 5.0, 0.0), 0.4)
    came = stamps + backlog
    late = latest(1e9 + stamps, came, backlog)
    assert late[-1] > max(0.4 - 6e-4 * came[-1], 0.0) - BEHIND_S


@given(stalls_s=st.lists(st.floats(0.04, 0.4), min_size=1, max_size=3), seed=st.integers(0, 99))
def test_a_relay_that_hands_on_one_message_in_each_of_its_cycles_stays_late(
    stalls_s: list[float], seed: int
) -> None:
    """Its queue never drains, nor does it lose any: the stalls alone tell it from a clock."""
    period_s, first = 0.01, 500
    stamps = period_s * np.arange(6000)
    begins = np.sort(np.random.default_rng(seed).integers(first, 3000, len(stalls_s)))
    backlog = sum(
        stall_s * (np.arange(6000) >= at) for stall_s, at in zip(stalls_s, begins, strict=True)
    )
    late, least = latest(1e9 + stamps, stamps + backlog), backlog - 6e-4 * stamps - 1e-6
    assert np.all(late[least > USUAL_S] >= least[least > USUAL_S])


@pytest.mark.parametrize("slower", [0.02, 0.05, 0.08])
def test_a_full_queue_that_leaves_messages_out_stays_late(slower: float) -> None:
    """A node or relay that is a little too slow falls behind as a slewed clock, to its depth."""
    period_s, depth, queue, stamps, came, now_s = 0.004, 100, [], [], [], 0.0
    made = iter(np.arange(0.0, 90.0, period_s).tolist())
    coming = next(made)
    while now_s < 80.0:
        while coming <= now_s:
            queue = [*queue, coming][-depth:]
            coming = next(made)
        if queue:
            stamps.append(queue.pop(0))
            came.append(now_s)
        now_s += period_s * (1.0 + slower * (now_s > 5.0))
    late = latest(1e9 + np.array(stamps), np.array(came))
    assert late[-1] > depth * period_s - 6e-4 * 80.0 - period_s


def test_late_messages_are_told_of_with_how_late_they_were():
    lateness = Lateness("joint states")
    assert lateness.take(0.0, 5.0) == 0.0  # no stamp
    for at_s in (10.0, 10.1, 10.2):
        lateness.take(at_s, at_s)
    lateness.take(10.3, 10.3 + LATE_S)
    assert lateness.words(10.5) == ""
    lateness.take(10.4, 10.4 + 0.5)
    lateness.take(11.0, 11.0)
    assert "joint states come up to 500 ms late" in lateness.words(11.0)
    assert lateness.words(11.0 + LATELY_S) == ""


@given(late_s=st.floats(0.0, 0.12), lag_s=st.floats(0.0, 0.03), drives_s=st.floats(0.5, 0.9))
def test_a_stop_of_a_motion_that_began_late_hurries_no_joint(
    late_s: float, lag_s: float, drives_s: float
) -> None:
    """Nothing but readings; drives that lag by no more than usual are not thrown back either."""
    plan = FAST_PLAN
    now_s = drives_s * plan.duration_s + late_s
    watch = RobotWatch(ARM, DRIVING)
    watch.follow(plan, FAST_CELL, 0.0)
    times = np.arange(-0.2, now_s, 0.008)
    for at_s, q in zip(times, plan.places(np.maximum(times - late_s - lag_s, 0.0)), strict=True):
        watch.reading(at_s, q, at_s)
        watch.away()
    found, velocity = watch.state(now_s, keeps=True)
    command, _ = plan.at(now_s - late_s)
    ahead_s = (found - command)[0] / velocity[0]
    # of the first line of the stop, which goes on so much faster
    assert -lag_s - 0.01 < ahead_s < 0.8 * LEAD_S


@pytest.mark.parametrize("stall_s", [0.4, *more(0.05, 0.2)])
def test_readings_that_waited_for_a_busy_node_are_no_robot_beside_its_path(stall_s: float) -> None:
    """They come at once; the first is looked at, and then the last: the robot went on meanwhile."""
    plan = joint_way(CELL, HOME, HOME + WAY)
    stalls_s = 0.5 * plan.duration_s
    watch = RobotWatch(ARM, DRIVING)
    watch.reading(-0.008, HOME, -0.008)
    watch.follow(plan, CELL, 0.0)
    for at_s in np.arange(0.0, plan.duration_s, 0.008):
        heard_s = at_s
        if stalls_s <= at_s < stalls_s + stall_s:
            heard_s = stalls_s + stall_s + 1e-4 * (at_s - stalls_s)
        watch.reading(at_s, plan.at(at_s)[0], heard_s)
        waited = stalls_s + 0.008 < at_s < stalls_s + stall_s - 0.008
        assert waited or watch.keeps(*watch.away()), at_s


@pytest.mark.parametrize("by_s", [0.15, 0.5, 0.9])
@pytest.mark.parametrize("period_s", [0.004, 0.008])
def test_of_a_robot_that_came_to_rest_while_its_clock_was_set_back_no_stop_is_made_a_motion(
    period_s: float, by_s: float
) -> None:
    """Finding: its way over all of the silence was taken for that of a cycle, at 0.4 rad/s."""
    halt = stop(ARM, LIMITS, HOME, 0.3 * WAY)
    watch, stopping = RobotWatch(ARM, DRIVING), WatchedStop(ARM, LIMITS)
    for at_s in np.arange(-0.5, by_s + 1.0, period_s):
        q = halt.at(at_s)[0] if at_s > 0.0 else HOME + at_s * 0.3 * WAY
        if not stopping.under_way and 0.0 <= at_s < period_s:
            stopping.begin((HOME, 0.3 * WAY), at_s)
        watch.reading(10.0 + at_s - by_s * (at_s > 0.0), q, at_s)
        watch.silence.look(at_s)
        plan = stopping.look(watch, at_s)
        assert plan is None or np.max(np.abs(plan.qd)) == 0.0
        if at_s > by_s + period_s:
            assert not watch.speed(at_s) > REST_RAD
    assert not stopping.under_way


def test_a_scaling_that_is_not_told_again_is_as_planned():
    """Finding: one that had died at 0 was believed for ever."""
    watch = seen(*steady(0.008, 0.0 * FASTEST))
    begin_s = watch.newest[0]
    watch.scaled(0.0, begin_s)
    for count in range(1, 400):
        watch.reading(begin_s + 0.008 * count, HOME, begin_s + 0.008 * count)
        assert watch.scaling == float(0.008 * count > 1.0)
    assert watch.driven_s(begin_s + 3.2) - watch.driven_s(begin_s + 2.2) == pytest.approx(1.0)


def test_the_ways_into_a_pause_and_out_of_it_are_no_speed() -> None:
    """Finding: a cycle ended by the first 0.01 after a pause, for "slower than planned"."""
    watch, paced = RobotWatch(ARM, DRIVING), []
    times = 0.002 * np.arange(5000)
    knots = [0.0, 1.0, 1.3, 5.0, 5.2, 6.0, 6.0, 10.0], [1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.3, 0.3]
    for at_s, factor in zip(times, np.interp(times, *knots), strict=True):
        watch.scaled(float(factor), float(at_s))
        paced.append(watch.unpaused)
    assert np.all(np.array(paced)[times < 6.0] == 1.0)
    assert np.all(np.array(paced)[times > 6.0 + PACE_S + 0.003] == 0.3)


def test_what_is_not_told_again_is_forgotten() -> None:
    """Finding: a broadcaster that died at 0 % was believed for ever."""
    scaling = SpeedScaling()
    assert scaling.at(0.0) is None
    scaling.slider(100.0, 10.0)
    scaling.slider(0.0, 10.1)
    assert scaling.at(10.1 + TOLD_S) == 0.0
    assert scaling.at(10.11 + TOLD_S) is None
    scaling.slider(0.0, 20.0)  # it has told another number before
    assert scaling.at(20.0) == 0.0


def test_the_controller_knows_better_than_the_slider_while_it_tells() -> None:
    """Finding: the one that said less won, though the controller ran at full speed."""
    scaling = SpeedScaling()
    scaling.slider(30.0, 10.0)
    assert scaling.at(10.0) == pytest.approx(0.3)
    scaling.controller(1.0, 10.1)
    assert scaling.at(10.2) == 1.0
    scaling.slider(30.0, 11.5)
    assert scaling.at(11.5) == pytest.approx(0.3)  # the controller is silent


def test_a_scaling_that_is_never_filled_tells_nothing() -> None:
    """Finding: a controller without it, which leaves it at 0, was paused for ever."""
    scaling = SpeedScaling()
    scaling.controller(0.0, 10.0)
    assert scaling.at(10.0) is None
    scaling.slider(50.0, 10.1)
    scaling.controller(0.0, 10.2)
    assert scaling.at(10.2) == 0.5
    scaling.controller(0.2, 10.3)
    scaling.controller(0.0, 10.4)
    assert scaling.at(10.4) == 0.0


@pytest.mark.parametrize("strange", [math.nan, math.inf, -math.inf, -0.1])
def test_what_is_no_scaling_tells_nothing(strange: float) -> None:
    scaling = SpeedScaling()
    scaling.controller(0.7, 10.0)
    scaling.controller(strange, 10.1)
    assert scaling.at(10.1) == 0.7
    scaling.controller(5.0, 10.2)
    assert scaling.at(10.2) == 1.0
