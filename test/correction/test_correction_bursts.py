"""Streams whose messages come in bursts, unevenly, at another rate, or not all: they go on."""

import itertools

import numpy as np
import pytest
from correction_robot import DT, HOME, LIMITS, NAMES, Robot, drifted, offer
from hypothesis import given, settings
from hypothesis import strategies as st
from test_correction_over_time import Watch

from robocal_ros.correction.interface import JointCommand, Reason, RefusedError

PERIODS = 0.002, DT, 0.008, 0.01, 0.02, 0.04
TIMER_S = 1e-3  # the node looks for a tail no faster
RELAY_S = 20e-6  # messages do not follow one another faster
SPEED = np.radians(60.0)


def even(period_s: float, count: int, spread: float, rng: np.random.Generator) -> np.ndarray:
    """Times (m, 2) at which targets are made, and come in: so much of a period late at most."""
    made = period_s * np.arange(1, count + 1)
    return np.column_stack([made, made + spread * period_s * rng.uniform(size=count)])


def lost(period_s: float, count: int, share: float, rng: np.random.Generator) -> np.ndarray:
    """The same, with so many lost, but no two in a row."""
    times = even(period_s, count, 0.0, rng)
    gone = rng.uniform(size=count) < share
    gone[1:] &= ~gone[:-1]
    return np.asarray(times[~gone])


def bursts(sizes: np.ndarray, apart_s: float) -> np.ndarray:
    """The same: a program wakes now and then, and sends what it should have sent since."""
    made = DT * np.arange(1, sizes.sum() + 1)
    woken = np.repeat(DT * np.cumsum(sizes), sizes)
    place = np.concatenate([np.arange(size) for size in sizes])
    return np.column_stack([made, woken + apart_s * place])


class Program:
    """A program that knows what it wants, its messages as they come in, and the node's tail."""

    def __init__(self, share: float) -> None:
        """A swing at so much of the joints' speeds."""
        self.robot = Robot()
        self.watch = Watch(self.robot, min(PERIODS))
        self.robot.session.offer_model(offer(drifted(3.0)))
        self.robot.session.enable(True)
        self.reach = 0.2 * np.array([1.0, 0.3, 0.3, 1.0, 0.3, 1.0])
        self.turns = share * LIMITS["velocity_limits"] / self.reach
        for _ in range(20):
            self.robot.stream(HOME)
        self.begin_s, self.made_s = self.robot.now, 0.0

    def target(self, t: float) -> np.ndarray:
        ramp = 0.5 * t * t / 0.3 if t < 0.3 else t - 0.15
        return HOME + self.reach * np.sin(self.turns * ramp)

    def send(self, times: np.ndarray) -> None:
        """Send targets that are made and come in at ``times`` (m, 2) from now on."""
        before_s = self.made_s
        for made_s, comes_s in times + before_s:
            self.made_s = made_s
            self.take(self.target(made_s), comes_s)

    def take(self, q: np.ndarray, comes_s: float) -> None:
        robot, stream = self.robot, self.robot.session.stream
        at_s = max(self.begin_s + comes_s, robot.now + RELAY_S)
        tail_s = max(stream.period_s, TIMER_S)
        while stream.has_tail and robot.now + tail_s < at_s:
            robot.now += tail_s
            robot.read(robot.at)
            if (tail := stream.tail(robot.now)) is not None:
                self.look(tail, q)
        robot.now = at_s
        robot.read(robot.at)
        self.look(robot.session.target(JointCommand(NAMES, q), robot.now), q)

    def look(self, out: JointCommand, q: np.ndarray) -> None:
        robot, taught = self.robot, self.robot.session.output.taught
        robot.go(out)
        self.watch.out(NAMES, robot.at)
        self.watch.offset(NAMES, taught, robot.at)

    def stop(self) -> None:
        """It stands: the robot comes there."""
        q = self.target(self.made_s)
        for k in range(1, 401):
            self.take(q, self.made_s + k * DT)
        assert self.robot.session.status().lag_s == 0.0
        assert np.array_equal(self.robot.session.output.taught, q)
        assert self.robot.session.status().refused == {}


PART = st.one_of(
    st.tuples(st.just("even"), st.sampled_from(PERIODS), st.floats(0.0, 0.9)),
    st.tuples(st.just("lost"), st.sampled_from(PERIODS[:-1]), st.floats(0.0, 0.2)),
    st.tuples(st.just("bursts"), st.integers(2, 6), st.floats(RELAY_S, 1e-3)),
    st.tuples(st.just("any bursts"), st.just(0), st.floats(RELAY_S, 5e-4)),
)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.tuples(PART, st.integers(5, 60)), min_size=1, max_size=6),
    st.floats(0.05, 0.8),
    st.integers(0, 1000),
)
def test_an_honest_program_is_followed(
    parts: list[tuple[tuple[str, float, float], int]], share: float, seed: int
) -> None:
    program, rng = Program(share), np.random.default_rng(seed)
    for (kind, value, other), count in parts:
        if kind == "even":
            program.send(even(value, count, other, rng))
        elif kind == "lost":
            program.send(lost(value, count, other, rng))
        else:
            sizes = rng.integers(2, 7, count) if kind == "any bursts" else np.full(count, value)
            program.send(bursts(sizes.astype(int), other))
    program.stop()


def under_way(speed: float) -> tuple[Robot, np.ndarray]:
    robot, q = Robot(), HOME.copy()
    for k in range(100):
        q[0] += min(k * DT / 0.3, 1.0) * speed * DT
        robot.stream(q)
    return robot, q


@pytest.mark.parametrize("speed_deg_s", [20.0, 60.0])
@pytest.mark.parametrize("size", [2, 3, 4, 5, 20])
def test_a_program_that_wakes_seldom_is_followed_from_the_first_burst_on(
    size: int, speed_deg_s: float
) -> None:
    """Without the tail's help: the way of two bursts is missing at most, then less than one's."""
    robot, q = under_way(np.radians(speed_deg_s))
    step, lags = np.radians(speed_deg_s) * DT, []
    for _ in range(240 // size):
        for k in range(size):
            q[0] += step
            robot.stream(q, dt=size * DT - (size - 1) * 60e-6 if k == 0 else 60e-6)
        lags.append(robot.session.status().lag_s)
    share = np.radians(speed_deg_s) / LIMITS["velocity_limits"][0]
    assert max(lags) <= 3.0 * size * DT * share
    assert lags[-1] <= max(lags)
    assert robot.session.stream.period_s == pytest.approx(size * DT, rel=0.02)


@pytest.mark.parametrize("speed_deg_s", [60.0, 100.0])
@pytest.mark.parametrize("period_s", [0.012, 0.02, 0.04, 0.05])
def test_a_stream_may_slow_its_rate_down_and_speed_it_up(
    period_s: float, speed_deg_s: float
) -> None:
    speed = np.radians(speed_deg_s)
    robot, q = under_way(speed)
    for _ in range(15):
        q[0] += speed * period_s
        robot.stream(q, dt=period_s)
    assert robot.session.stream.period_s == pytest.approx(period_s)
    for _ in range(60):
        q[0] += speed * DT
        robot.stream(q)
    assert robot.session.stream.period_s == pytest.approx(DT)


@pytest.mark.parametrize("stall_s", [0.03, 0.05, 0.09])
@pytest.mark.parametrize("between", [3, 20])
def test_two_stalls_are_no_rate(stall_s: float, between: int) -> None:
    """No step after either is longer than the stream's own, but for what is caught up with."""
    robot, q = under_way(np.radians(30.0))
    for _ in range(2):
        for dt in [stall_s, *[DT] * between]:
            q[0] += np.radians(30.0) * dt
            before = robot.at[0]
            robot.stream(q, dt=dt)
            assert robot.at[0] - before <= 1.06 * np.radians(30.0) * DT


def test_pauses_are_no_period() -> None:
    """A program that moves a little now and then: after each pause it is looked at as before."""
    robot, q = under_way(np.radians(30.0))
    for _ in range(6):
        for _ in range(3):
            robot.stream(q)
        robot.rest(0.4)
        robot.stream(q, dt=DT)
        assert robot.session.stream.period_s == pytest.approx(DT)
        assert not robot.session.stream.runs(robot.now + 0.11)


def controlled(speed: float, seed: int) -> np.ndarray:
    """Speeds of joint 1 by a controller's cycle: an uneven stream, which is ended."""
    rng, robot, q = np.random.default_rng(seed), Robot(), HOME.copy()
    sent, made_s = [], robot.now
    for k in range(200):
        q[0] += min(k * DT / 0.3, 1.0) * speed * DT
        made_s += DT
        robot.stream(q, dt=made_s + rng.uniform(0.0, 0.0035) - robot.now)
        sent.append((robot.now, robot.at[0]))
    begins_s = robot.now
    with pytest.raises(RefusedError, match=Reason.NOT_FINITE.value):
        robot.stream(np.full(6, np.nan), dt=1e-3)
    while (command := robot.session.stream.tail(robot.now)) is not None:
        robot.go(command)
        sent.append((robot.now, robot.at[0]))
        robot.now += DT
    times, places = np.array(sent).T
    cycles = np.arange(begins_s, times[-1], DT)
    held = places[np.searchsorted(times, cycles, side="right") - 1]
    return np.diff(held) / DT


def test_the_slow_down_of_an_uneven_stream_begins_as_fast_as_it_was() -> None:
    """A parabola through 0.1 s of it is uncertain by sqrt(192 / 25) / 0.1 s of a place's noise.

    That of a place is its speed's way in 3.5 ms / sqrt(12): 1.7 deg/s here, of which five.
    """
    slack = 5.0 * np.sqrt(192.0 / 25.0) / 0.1 * SPEED * 0.0035 / np.sqrt(12.0)
    for seed in range(40):
        speeds = controlled(SPEED, seed)
        slows = LIMITS["acceleration_limits"][0] * DT
        assert speeds.max() <= SPEED + slack
        # the first cycle has what is left of the last message's
        assert abs(speeds[1] - SPEED) <= slack + 2.0 * slows
        assert np.all(np.abs(np.diff(speeds[1:])) <= slows + 1e-9)


@pytest.mark.parametrize("left_deg_s", [0.0, 4.0, 20.0])
def test_a_stream_that_slows_down_is_ended_as_fast_as_it_is_by_then(left_deg_s: float) -> None:
    """Its last 0.1 s are a parabola, whose slope at the end is known."""
    robot, q = under_way(SPEED)
    slows, left = np.radians(200.0), np.radians(left_deg_s)
    speeds = np.append(np.arange(SPEED, left, -slows * DT), left)
    assert len(speeds) * DT > 0.15
    for speed, after in itertools.pairwise(speeds):
        q[0] += 0.5 * (speed + after) * DT
        robot.stream(q)
    with pytest.raises(RefusedError):
        robot.stream(np.full(6, np.nan))
    before = robot.at[0]
    command = robot.session.stream.tail(robot.now)
    moved = 0.0 if command is None else command.position[0] - before
    assert -1e-9 <= left * DT - moved <= 0.5 * LIMITS["acceleration_limits"][0] * DT**2 + 1e-9
