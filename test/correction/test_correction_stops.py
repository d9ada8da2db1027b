"""A stop of a trajectory slows down on its way: no joint leaves it, or goes on beyond its end."""

import numpy as np
import pytest
from correction_robot import HOME, LIMITS, NAMES, NOMINAL, Robot, large
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from robocal_ros.correction.interface import JointCommand, TrajectoryCommand

AHEAD_S = 0.06
LIMIT = NOMINAL.upper[0] - 0.02  # of the program, which leaves room for the correction
REACH = np.array([0.9, -0.3, 0.4, 0.6, -0.4, 0.8])


def program(strength: float, bend: float, seed: int, spacing_s: float = 0.01) -> TrajectoryCommand:
    """To near joint 1's limit and rest there; the other joints turn back and forth on the way."""
    rng = np.random.default_rng(seed)
    turns, phase = rng.uniform(0.5, 3.0, 6), rng.uniform(0.0, 3.0, 6)
    turns[0], end = 0.0, np.where(np.arange(6) == 0, LIMIT, HOME)
    fastest = np.max(np.abs(REACH) * (1.9 + 8.0 * bend) / LIMITS["velocity_limits"])
    lasts = fastest / strength
    t = np.linspace(0.0, lasts, max(round(lasts / spacing_s), 4) + 1)
    x = t / lasts
    s, rate = x**3 * (10 - 15 * x + 6 * x**2), 30 * x**2 * (1 - x) ** 2 / lasts
    wave = np.sin(turns * s[:, None] + phase) - np.sin(turns + phase)
    q = end + REACH * (s - 1.0)[:, None] + bend * wave * (turns > 0.0)
    slope = REACH + bend * turns * np.cos(turns * s[:, None] + phase)
    return TrajectoryCommand(NAMES, q, t, slope * rate[:, None])


@settings(max_examples=25, deadline=None)
@given(
    st.floats(0.1, 0.95), st.sampled_from([0.0, 0.1, 0.4]), st.integers(0, 50),
    st.floats(0.05, 0.97), st.floats(0.3, 4.0), st.booleans(), st.sampled_from([1.0, 0.5]),
)  # fmt: skip
@example(
    strength=0.84375, bend=0.4, seed=0, when=0.97, brakes=1.0, corrected=False, scaling=1.0
)  # fmt: skip
def test_stops_anywhere(
    strength: float, bend: float, seed: int, when: float, brakes: float, corrected: bool,
    scaling: float,
) -> None:  # fmt: skip
    """Dense samples of what the controller makes of the stop, on the path that it had before."""
    command = program(strength, bend, seed)
    own = np.abs(np.gradient(command.velocity, command.time_from_start_s, axis=0)).max(axis=0)
    limits = np.maximum(brakes * own, 0.1)
    robot = (large if corrected else Robot)(acceleration_limits=limits)
    robot.at = command.position[0]
    robot.rest()
    session, began_s = robot.session, robot.now
    session.controller((), np.empty(0), scaling, robot.now)
    session.trajectory(command, robot.now)
    path = session.output.path
    path.begin(robot.now)
    lasts = command.time_from_start_s[-1]
    robot.now += when * lasts / scaling
    clock = path.time(robot.now) + AHEAD_S
    c = np.append(np.arange(min(clock, lasts), lasts, 1e-3), lasts)
    ahead = np.array([path.place(began_s + at / scaling) for at in c])
    rates = np.gradient(ahead, c, axis=0) if len(c) > 1 else np.zeros_like(ahead)

    stop = session.stop(robot.now, AHEAD_S)
    times = stop.time_from_start_s - AHEAD_S
    assert times[0] == 0.0
    assert np.allclose(stop.position[0], ahead[0], rtol=0.0, atol=1e-6)
    if clock < lasts:
        about = [path.place(began_s + (clock + h) / scaling) for h in (-1e-5, 1e-5)]
        assert np.allclose(stop.velocity[0], np.diff(about, axis=0)[0] / 2e-5, atol=5e-3)
    assert not stop.velocity[-1].any()
    if len(times) < 2:
        assert np.array_equal(stop.position[-1], path.out[-1])
        return
    driven = CubicHermiteSpline(times, stop.position, stop.velocity)
    dense = np.linspace(0.0, times[-1], 2001)
    q = driven(dense)
    on = np.interp(q[:, 0], ahead[:, 0], c)  # joint 1 goes on and on
    way = np.array([np.interp(on, c, column) for column in ahead.T]).T
    assert np.allclose(q, way, rtol=0.0, atol=1e-4)  # of the cubics between the points
    assert np.all(q <= ahead.max(axis=0) + 1e-5)
    assert np.all(q >= ahead.min(axis=0) - 1e-5)
    assert q[:, 0].max() <= NOMINAL.upper[0]
    # 1e-6 rad before its end joint 1 still says within 0.1 ms where it is: it has 2e-4 rad/s there
    steps = np.diff(on[q[:, 0] < ahead[-1, 0] - 1e-6][::50])
    assert np.all(steps >= -1e-4)  # never back
    assert np.all(np.diff(steps) <= 1e-3)  # nor faster on the way than before
    bends = np.abs(np.gradient(rates, c, axis=0)[3:-3]).max(axis=0) if len(c) > 9 else 0.0
    assert np.all(np.abs(driven(dense, 2)) <= 1.4 * np.maximum(limits, bends) + 0.05)


@pytest.mark.parametrize("strength", [1.0, 1.3, 2.0])
def test_a_program_that_brakes_itself_is_not_driven_past(strength: float) -> None:
    """60 ms before it does, at 90 deg/s, by as many times the acceleration that is known."""
    a, speed, steady = strength * LIMITS["acceleration_limits"][0], np.radians(90.0), 0.6
    ramp = speed / a
    t = np.linspace(0.0, steady + 2.0 * ramp, 400)
    rate = np.clip(np.minimum(a * t, a * (t[-1] - t)), 0.0, speed)
    left = np.minimum(t, ramp) ** 2 * a / 2 + speed * np.clip(t - ramp, 0.0, steady)
    left += speed * ramp / 2 - a * np.clip(t[-1] - t, 0.0, ramp) ** 2 / 2
    q, v = np.tile(HOME, (len(t), 1)), np.zeros((len(t), 6))
    q[:, 0], v[:, 0] = HOME[0] + left - left[-1], rate
    robot = Robot()
    robot.at = q[0]
    robot.rest()
    robot.session.trajectory(TrajectoryCommand(NAMES, q, t, v), robot.now)
    robot.session.output.path.begin(robot.now)
    robot.now += steady + ramp - AHEAD_S
    stop = robot.session.stop(robot.now, AHEAD_S)
    assert stop.position[-1, 0] <= q[-1, 0] + 1e-9
    assert stop.time_from_start_s[-1] <= AHEAD_S + 1.2 * ramp


def test_a_controller_that_is_halted_is_held() -> None:
    robot = Robot()
    command = program(0.5, 0.1, 1)
    robot.at = command.position[0]
    robot.rest()
    robot.session.trajectory(command, robot.now)
    robot.session.output.path.begin(robot.now)
    robot.now += 0.4 * command.time_from_start_s[-1]
    robot.session.controller((), np.empty(0), 0.0, robot.now)
    here = robot.session.output.path.place(robot.now)
    robot.now += 0.1
    stop = robot.session.stop(robot.now, AHEAD_S)
    assert np.array_equal(stop.position, here[None])
    assert not stop.velocity.any()


def test_readings_on_a_stop_are_uncorrected_with_what_the_path_had_there() -> None:
    """The offset still comes in as it is stopped, and stands where the robot does."""
    robot = large()
    command = program(0.5, 0.1, 1)
    robot.at = command.position[0]
    robot.rest()
    out = robot.session.trajectory(command, robot.now)
    robot.session.output.path.begin(robot.now)
    robot.now += 0.3 * command.time_from_start_s[-1]
    stop = robot.session.stop(robot.now, AHEAD_S)
    robot.now += stop.time_from_start_s[-1]
    taught = robot.session.reading(JointCommand(NAMES, stop.position[-1]), robot.now).position
    shape = CubicHermiteSpline(out.time_from_start_s, out.position, out.velocity)
    own = CubicHermiteSpline(command.time_from_start_s, command.position, command.velocity)
    t = np.linspace(0.0, out.time_from_start_s[-1], 20_000)
    k = int(np.argmin(np.abs(shape(t)[:, 0] - stop.position[-1, 0])))
    assert np.abs(taught - own(t[k])).max() < 5e-4
