# SPDX-License-Identifier: Apache-2.0
"""Streams of the joint correction: their period, their pauses; models that grow old."""

import copy
import itertools
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from correction_robot import (
    DT,
    HOME,
    LARGEST_A,
    LIMITS,
    NAMES,
    NOMINAL,
    REST,
    REST_A,
    ROUNDING,
    Robot,
    bent_tool,
    drifted,
    offer,
    refused,
    still,
    swing,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_correction_over_time import Watch

from robocal_ros.correction.bounds import CorrectionConfig, Policy, ShiftBounds
from robocal_ros.correction.interface import (
    CorrectionState,
    JointCommand,
    Reason,
    RefusedError,
    TrajectoryCommand,
)
from robocal_ros.correction.sent_path import spline

SECOND = 1_000_000_000


FAR = HOME + 0.1  # from where the robot stands
TIGHT = ShiftBounds(0.2e-3, np.radians(0.1), np.radians(0.3))


# ---- models that grow old ------------------------------------------------------------------------


@pytest.fixture
def aged() -> Robot:
    """Settled with a model of second 100, which may be 60 s old."""
    robot = Robot(model_age_s=60.0)
    robot.session.offer_model(offer(drifted(3.0), stamp_ns=100 * SECOND))
    robot.session.enable(True)
    robot.session.look(robot.now, 101 * SECOND)
    robot.settle()
    return robot


def test_an_old_model_is_blended_out_and_a_fresh_one_in(aged: Robot) -> None:
    session, at = aged.session, aged.at
    session.look(aged.now, 160 * SECOND)
    assert not session.status().stale
    assert np.array_equal(aged.stream(), at)
    session.look(aged.now, 161 * SECOND)
    assert "61.0 s old" in session.status().stale
    last = at
    for _ in range(10):
        assert 0.0 < np.abs(aged.stream() - last).max() <= REST * DT + ROUNDING
        last = aged.at
    assert np.array_equal(aged.settle(), HOME)
    assert session.offset(aged.now).revision is None
    status = session.status(aged.now)
    assert status.state is CorrectionState.WITHOUT_MODEL
    assert "nothing is corrected: " in status.in_words()
    assert "61.0 s old" in status.in_words()
    session.offer_model(offer(drifted(3.0), stamp_ns=161 * SECOND))  # the same, seen again
    session.look(aged.now, 162 * SECOND)
    assert not session.status().stale
    assert np.abs(aged.stream() - HOME).max() <= REST * DT + ROUNDING
    assert np.allclose(aged.settle(), at, rtol=0.0, atol=ROUNDING)


@pytest.mark.parametrize("looked_at_again", [False, True])
def test_a_model_that_is_too_old_when_it_comes_corrects_nothing(looked_at_again: bool) -> None:
    robot, path = Robot(model_age_s=60.0), still(first_s=1.0)
    session, old = robot.session, offer(drifted(3.0), stamp_ns=100 * SECOND)
    session.look(robot.now, 1000 * SECOND)
    session.enable(True)
    if looked_at_again:
        session.offer_model(offer(drifted(), 2, stamp_ns=1000 * SECOND))
        refused(Reason.OLD_REVISION, session.offer_model, old)
        session.take_over()
    else:
        session.offer_model(old)
    assert "900.0 s old" in session.status().stale
    assert session.trajectory(path, robot.now) is path


def test_a_clock_that_jumps_only_starts_blends(aged: Robot) -> None:
    """A model is stale and fresh by turns: every step is a blend's."""
    last = aged.at
    for k in range(40):
        aged.session.look(aged.now, (10**6 if k % 3 else 0) * SECOND)
        for _ in range(5):
            assert np.abs(aged.stream() - last).max() <= REST * DT + ROUNDING
            last = aged.at


def test_without_a_limit_no_model_is_stale() -> None:
    robot = Robot()
    robot.session.offer_model(offer(drifted(), stamp_ns=1))
    robot.session.look(robot.now, 10**18)
    assert not robot.session.status().stale


def test_that_no_drift_is_known_does_not_grow_old() -> None:
    """The nominal model is of no measurement: thermal_node gives it the stamp 0."""
    robot = Robot(model_age_s=60.0)
    robot.session.offer_model(offer(NOMINAL, 0))
    robot.session.look(robot.now, 10**18)
    assert not robot.session.status().stale


def test_a_driver_whose_clock_is_ahead_starves_no_other() -> None:
    """A gripper's clock is half a second ahead of the arm's; each is held to its own order."""
    robot, finger = Robot(), JointCommand(("finger",), np.zeros(1))
    session, at = robot.session, SECOND
    for _ in range(20):
        robot.now, at = robot.now + DT, at + 2_000_000
        session.reading(replace(finger, stamp_ns=at + SECOND // 2), robot.now)
        robot.read(HOME, stamp_ns=at)
    assert session.status().refused == {}
    refused(Reason.TIME_BACKWARDS, robot.read, HOME, stamp_ns=at - 1)
    early = replace(finger, stamp_ns=at)
    refused(Reason.TIME_BACKWARDS, session.reading, early, robot.now)


def test_a_reading_that_was_overtaken_tells_nothing_of_how_late_others_are() -> None:
    """Finding: those after it, of a robot that was heard 0.15 s late, counted as of now."""
    session, stall_s, began_s = Robot().session, 0.15, 10.0

    def read(at_s: float, now_s: float) -> float:
        session.reading(JointCommand(NAMES, HOME, None, round(at_s * SECOND)), now_s, now_s - at_s)
        return session.late_s

    for count in range(200):
        at_s = began_s + count * DT
        late_s = read(at_s, at_s + stall_s * (count > 100))
    assert late_s == pytest.approx(stall_s, abs=1e-3)
    refused(Reason.TIME_BACKWARDS, read, at_s - 0.05, at_s + stall_s + DT)
    assert read(at_s + 2.0 * DT, at_s + 2.0 * DT + stall_s) == pytest.approx(stall_s, abs=1e-3)


def test_any_number_of_drivers_takes_no_more_room() -> None:
    robot = Robot()
    for i in range(5000):
        robot.now += DT
        robot.session.reading(
            JointCommand((f"finger_{i}",), np.zeros(1), stamp_ns=SECOND), robot.now
        )
        robot.read(HOME, stamp_ns=SECOND + i)
    assert len(robot.session._stamps) <= 100
    refused(Reason.TIME_BACKWARDS, robot.read, HOME, stamp_ns=SECOND)


# ---- the velocities that go out ------------------------------------------------------------------


@pytest.mark.parametrize("at", ["regular", "weak", "clamped"])
def test_the_velocities_that_go_out_are_the_derivative_of_the_positions(at: str) -> None:
    """Of a stream in motion whose offset is the wanted one: central differences over 2 ms."""
    config = {"policy": Policy.CLAMP, "thermal": TIGHT} if at == "clamped" else {}
    robot = Robot(rested=False, **config)
    robot.session.offer_model(offer(drifted(3.0 if at == "clamped" else 1.0)))
    home = HOME.copy()
    if at == "weak":
        home[4] = 0.01
    robot.at = home
    robot.rest()
    robot.session.enable(True)
    out, given, taught = [], [], []
    reach = np.array([0.2, -0.1, 0.2, -0.3, 0.02, 0.3])
    for k in range(3600):
        t = max(k - 2000, 0) * 1e-3
        q = home + reach * (1.0 - np.cos(t))
        velocity = reach * np.sin(t)
        robot.now += 1e-3
        robot.read(robot.at)
        message = robot.session.target(JointCommand(NAMES, q, velocity), robot.now)
        robot.go(message)
        if k > 2002 and not robot.session.output.limiter.withheld.any():
            out.append((k, robot.at))
            given.append(message.velocity)
            taught.append(velocity)
    k, out = np.array([k for k, _ in out]), np.array([q for _, q in out])
    inner = np.flatnonzero((k[2:] - k[:-2]) == 2) + 1
    assert len(inner) > 1000
    status = robot.session.status()
    assert (status.reduced > 0, bool(status.clamped)) == (at == "weak", at == "clamped")
    numeric = (out[inner + 1] - out[inner - 1]) / 2e-3
    made = np.array(given)[inner]
    own = np.array(taught)[inner]
    # central differences are off by a sixth of the third derivative, (1 ms)**2 * 0.3 rad/s**3
    slack = 1e-6
    assert np.abs(made - own).max() > 20.0 * slack
    assert np.allclose(made, numeric, rtol=0.0, atol=slack), np.abs(made - numeric).max()


# ---- what takes a path's place -------------------------------------------------------------------


@pytest.mark.parametrize("scaling", [1.0, 0.5])
@pytest.mark.parametrize("after_s", [0.3, 0.4, 0.5])
@pytest.mark.parametrize("moves", [True, False])
def test_a_stream_in_the_place_of_a_path_lets_its_offset_go_on(
    moves: bool, after_s: float, scaling: float
) -> None:
    """Its rate changes no faster than the limiter allows, from what it was on the path."""
    robot = Robot()
    session = robot.session
    session.offer_tool(bent_tool(4e-3, 1.5))
    robot.rest()
    session.enable(True)
    taught = swing(duration=4.0)
    if not moves:
        taught = replace(taught, position=0.0 * taught.position + HOME, acceleration=None)
        taught = replace(taught, velocity=0.0 * taught.position)
    session.trajectory(taught, robot.now)
    path, begin_s = session.output.path, robot.now
    assert path is not None

    def goal(t_s: float) -> np.ndarray:
        k = int(np.searchsorted(taught.time_from_start_s, t_s, side="right")) - 1
        ends = slice(k, k + 2)
        rates, bends = taught.velocity[ends], taught.acceleration
        bends = None if bends is None else bends[ends]
        return spline(taught.time_from_start_s, taught.position[ends], rates, bends, k, t_s)[0]

    while robot.now < begin_s + after_s:
        robot.now += DT
        robot.at = path.place(robot.now)
        session.controller(NAMES, robot.at, scaling, robot.now)
        robot.read(robot.at)
    at_s = path.time(robot.now)
    offset = robot.at - goal(at_s)
    rate, most = scaling * path.offset(robot.now)[1], LARGEST_A if moves else REST_A
    assert np.abs(rate).max() > most * DT  # to begin at rest would be a jump of it
    q = goal(at_s)
    robot.now += 1e-9
    robot.read(robot.at)
    robot.stream(q, dt=0.0)
    assert np.allclose(robot.at - q, offset, rtol=0.0, atol=1e-6)
    for k in range(1, 30):
        q, before, offset = goal(at_s + k * scaling * DT), rate, robot.at - q
        rate = (robot.stream(q) - q - offset) / DT
        # how fast the path's own changed is known from the next millisecond of it
        slack = most * 1e-3 if k == 1 else 0.0
        assert np.all(np.abs(rate - before) <= most * DT + slack + ROUNDING / DT)


# ---- Streams whose messages come in bursts, unevenly, at another rate, or not all: they go on ----


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
@example(  # two messages at one instant
    [
        (("lost", 0.008, 2.225073858507e-311), 29),
        (("bursts", 6, 2e-05), 49),
        (("lost", 0.008, 0.037751995091581815), 43),
        (("bursts", 6, 2e-05), 35),
    ],
    0.7992498799344213,
    835,
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


def test_a_refused_target_of_one_joint_slows_all_of_its_stream_down() -> None:
    robot, q = Robot(), HOME.copy()
    for k in range(250):
        q = q + 0.5 * min(k * DT / 0.3, 1.0) * DT
        robot.stream(q)
    far = {"names": NAMES[:1], "q": q[:1] + 1.0}
    refused(Reason.VELOCITY_LIMIT, robot.stream, **far)
    speeds = [np.full(6, 0.5)]
    while (command := robot.session.stream.tail(robot.now)) is not None:
        assert command.names == NAMES
        speeds.append((command.position - robot.at) / DT)
        robot.go(command)
        robot.now += DT
    slower = -np.diff(speeds, axis=0)
    assert np.all(slower[1:] <= LIMITS["acceleration_limits"] * DT + 2 * ROUNDING / DT)
    assert np.all(speeds[1] > 0.4)
    assert np.all(np.abs(speeds[-1]) <= LIMITS["acceleration_limits"] * DT)


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


# ---- The way from where the robot is to the first point of a trajectory --------------------------


LIMIT = 1.0
NEAR = CorrectionConfig().start_rad
ADDED = np.radians(1.0)  # more than a correction changes the way
ONE = np.array([0.0, -1.0, 0.0, 0.0, 0.0, 0.0])


def standing(on: bool, **config: object) -> Robot:
    robot = Robot(velocity_limits=np.full(6, LIMIT), **config)
    if on:
        robot.session.offer_model(offer(drifted()))
        robot.session.offer_tool(bent_tool())
        robot.session.enable(True)
        robot.settle()
    robot.rest()
    return robot


def to(q: np.ndarray, lead_s: float, rates: bool = False) -> TrajectoryCommand:
    """Rests at ``q`` from then on."""
    path = still(q, first_s=lead_s)
    return replace(path, velocity=np.zeros(path.position.shape)) if rates else path


@pytest.mark.parametrize("on", [False, True])
@pytest.mark.parametrize("rates", [False, True])
def test_a_lead_in_obeys_the_velocity_limits(on: bool, rates: bool) -> None:
    """Held against what a controller does: it draws a line, or a curve from rest to rest."""
    at_rest, rng = standing(on), np.random.default_rng(5)
    peak = 1.875 if rates else 1.0  # of a quintic
    seen = Counter[bool]()
    for _ in range(60):
        robot = copy.deepcopy(at_rest)
        command = to(HOME + rng.uniform(-0.4, 0.4, 6), rng.uniform(0.1, 1.0), rates)
        lead_s = command.time_from_start_s[0]
        way = np.abs(command.position[0] - HOME).max()
        slow, fast = peak * (way + ADDED) / lead_s < LIMIT, peak * (way - ADDED) / lead_s > LIMIT
        seen[slow] += slow or fast
        if fast:
            refused(Reason.VELOCITY_LIMIT, robot.session.trajectory, command, robot.now)
        elif slow:
            robot.session.trajectory(command, robot.now)
    assert min(seen[True], seen[False]) > 5


def test_a_lead_in_is_refused_with_its_joint_and_speed() -> None:
    robot = standing(True)
    words = refused(
        Reason.VELOCITY_LIMIT, robot.session.trajectory, to(HOME + 0.5 * ONE, 0.25), robot.now
    )
    assert NAMES[1] in words
    assert "(point 1)" in words
    robot.session.trajectory(to(HOME + 0.5 * ONE, 0.25), robot.now, 0.5)  # half a second more


def test_clamped_or_passed_it_is_refused_all_the_same() -> None:
    for policy in ("clamp", "pass"):
        robot = standing(False, policy=policy)
        act = robot.session.trajectory
        refused(Reason.VELOCITY_LIMIT, act, to(HOME + 0.5 * ONE, 0.25), robot.now)


def test_a_robot_that_stands_at_the_first_point_need_not_move() -> None:
    """A clock that is ahead by microseconds makes every trajectory lead in."""
    robot = standing(False)
    robot.at = HOME + 0.9 * NEAR
    robot.rest()
    assert np.array_equal(robot.session.trajectory(to(HOME, 1e-5), robot.now).position[0], HOME)


def test_single_points_to_a_robot_that_lags() -> None:
    """A planner that sends the next point 20 ms ahead, again and again; the robot is 0.1 s late."""
    robot, dt, speed = standing(False), 0.02, 0.8
    sent = [HOME] * 6
    for i in range(80):
        robot.now += dt
        robot.read(sent[-6])
        q = sent[-1] + min(1.0, i / 25) * speed * dt * ONE
        command = TrajectoryCommand(NAMES, q[None], np.array([dt]))
        sent.append(robot.session.trajectory(command, robot.now).position[0])
    robot.now += dt
    robot.read(sent[-6])
    far = TrajectoryCommand(NAMES, (sent[-1] + 1.5 * LIMIT * dt * ONE)[None], np.array([dt]))
    refused(Reason.VELOCITY_LIMIT, robot.session.trajectory, far, robot.now)


def test_what_was_rejected_is_no_place_to_lead_from() -> None:
    """The robot stands at home, and not where a trajectory should have brought it."""
    robot = standing(False)
    robot.session.trajectory(to(HOME + 0.3 * ONE, 0.5), robot.now)
    robot.rest(0.6)
    refused(Reason.VELOCITY_LIMIT, robot.session.trajectory, to(HOME + 0.3 * ONE, 0.05), robot.now)


def test_a_part_of_the_joints_leads_in_alone() -> None:
    robot = standing(False)
    path = still(HOME + 0.5 * ONE, first_s=0.25)
    part = replace(path, names=NAMES[:1], position=path.position[:, :1])
    robot.session.trajectory(part, robot.now)
    part = replace(path, names=NAMES[1:2], position=path.position[:, 1:2])
    refused(Reason.VELOCITY_LIMIT, robot.session.trajectory, part, robot.now)


@pytest.mark.parametrize("on", [False, True])
def test_a_lead_in_needs_readings_that_are_fresh(on: bool) -> None:
    robot = standing(on)
    robot.now += 0.3
    refused(Reason.STALE_JOINTS, robot.session.trajectory, still(first_s=5.0), robot.now)
    robot.read(robot.at)
    out = robot.session.trajectory(still(first_s=5.0), robot.now)
    assert np.abs(out.position[0] - robot.at).max() <= REST * 5.0
