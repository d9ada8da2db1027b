"""Streams of the joint correction: their period, their pauses; models that grow old."""

from dataclasses import replace

import numpy as np
import pytest
from correction_robot import (
    DT,
    HOME,
    LARGEST_A,
    NAMES,
    REST,
    REST_A,
    ROUNDING,
    Robot,
    bent_tool,
    drifted,
    offer,
    refused,
    swing,
)

from robocal_ros.correction.bounds import Policy, ShiftBounds
from robocal_ros.correction.interface import JointCommand, Reason
from robocal_ros.correction.robot_state import spline

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
    session.offer_model(offer(drifted(3.0), stamp_ns=161 * SECOND))  # the same, seen again
    session.look(aged.now, 162 * SECOND)
    assert not session.status().stale
    assert np.abs(aged.stream() - HOME).max() <= REST * DT + ROUNDING
    assert np.allclose(aged.settle(), at, rtol=0.0, atol=ROUNDING)


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
    for k in range(5000):
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
