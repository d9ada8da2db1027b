"""Where the controller is: by its own words, which are old, between points, and in motion."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from correction_robot import (
    DT,
    FASTEST,
    HOME,
    LIMITS,
    NAMES,
    NOMINAL,
    ROUNDING,
    Robot,
    bent_tool,
    refused,
    swing,
)

from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import JointCommand, Reason, RefusedError, TrajectoryCommand
from robocal_ros.correction.session import CorrectionSession

TELLS_S = 0.02  # period of joint_trajectory_controller's state: 50 Hz
# Of a stop from a second or later place, whose first point a controller takes at once.
STOP_S = np.linspace(0.0, 1.0, 101)


def on_its_way(age_s: float, *, velocities: bool) -> tuple[Robot, np.ndarray, np.ndarray, float]:
    """A robot in mid-swing whose controller told its state ``age_s`` ago: place, speed, fastest
    acceleration (rad/s^2) of the way."""
    robot, way = Robot(), swing()
    assert way.velocity is not None
    assert way.acceleration is not None
    robot.session.trajectory(way, robot.now)
    path = robot.session.output.path
    assert path is not None
    begin_s = robot.now
    told_s, end_s = begin_s + 0.7 - age_s - 10.0 * TELLS_S, begin_s + 0.7

    def at(now_s: float) -> tuple[np.ndarray, np.ndarray]:
        u = (now_s - begin_s) / 2.0
        share = 0.5 * (1.0 - np.cos(np.pi * u)), 0.25 * np.pi * np.sin(np.pi * u)
        reach = way.position[-1] - HOME
        return HOME + share[0] * reach, share[1] * reach

    while robot.now < end_s - 1e-9:
        robot.now = min(robot.now + DT, end_s)
        robot.read(at(robot.now)[0])
        while told_s <= min(robot.now, end_s - age_s) + 1e-9:
            q, qd = at(told_s)
            given = {"velocity": qd} if velocities else {}
            robot.session.controller(NAMES, q, 1.0, robot.now, age_s=robot.now - told_s, **given)
            told_s += TELLS_S
    return robot, *at(end_s), float(np.abs(way.acceleration).max())


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("age_s", [0.004, 0.008, 0.02, 0.028, 0.06])
def test_a_reference_of_a_robot_in_motion_is_carried_on(age_s: float, velocities: bool) -> None:
    """A trajectory at once begins where the controller is, not where it was told to have been."""
    for behind_s in (0.0, age_s):
        robot, place, speed, bend = on_its_way(age_s, velocities=velocities)
        begin = place - behind_s * speed
        slow = TrajectoryCommand(
            NAMES,
            begin + np.outer(STOP_S - 0.5 * STOP_S**2, speed),
            STOP_S,
            np.outer(1.0 - STOP_S, speed),
        )
        # one that begins elsewhere may be refused
        with contextlib.suppress(*([RefusedError] if behind_s else [])):
            out = robot.session.trajectory(slow, robot.now)
            # by the mean speed of a period: of its middle
            old_s = age_s if velocities else age_s + TELLS_S
            assert np.abs(out.position[0] - place).max() <= 0.5 * bend * old_s**2 + ROUNDING


def test_a_path_that_has_begun_is_where_its_cubic_is() -> None:
    """Two points in 2 s, begun half a second ago: a controller is not on the line between them."""
    reach = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    way = TrajectoryCommand(
        NAMES, np.array([HOME, HOME + reach]), np.array([0.0, 2.0]), np.zeros((2, 6))
    )
    u = 0.25
    robot = Robot(rested=False)
    robot.at = HOME + (3.0 * u**2 - 2.0 * u**3) * reach
    robot.rest()
    out = robot.session.trajectory(way, robot.now, -u * 2.0)
    assert np.array_equal(out.position, way.position)
    robot = Robot(rested=False)
    robot.at = HOME + u * reach
    robot.rest()
    refused(Reason.START_MISMATCH, robot.session.trajectory, way, robot.now, -u * 2.0)


@pytest.mark.parametrize("lead_s", [0.03, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("speed", [0.1, 0.5])
def test_where_nobody_knows_the_place_the_offset_comes_in_as_ever(
    lead_s: float, speed: float
) -> None:
    """A robot that somebody jogs, a bent tool that waits, and a trajectory that leads in soon."""
    robot = Robot()
    robot.session.enable(True)
    robot.settle()
    moves, begin_s = np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0]), robot.now
    while robot.now < begin_s + 0.5:
        robot.now += DT
        robot.at = HOME + moves * (robot.now - begin_s)
        robot.read(robot.at)
    robot.session.offer_tool(bent_tool(9e-3, 3.5))
    times = lead_s + np.linspace(0.0, 6.0, 121)
    q = np.tile(robot.at + lead_s * moves, (121, 1))
    out = robot.session.trajectory(TrajectoryCommand(NAMES, q, times), robot.now)
    offset = out.position - q
    assert np.abs(offset[0]).max() <= FASTEST * lead_s + ROUNDING
    assert np.abs(np.diff(offset, axis=0)).max() <= FASTEST * np.diff(times).max() + ROUNDING
    assert np.abs(offset[-1]).max() > np.radians(1.0)  # the tool is corrected in the end


@pytest.mark.parametrize("bends", [False, True])
def test_the_speed_between_points_is_that_of_the_spline(bends: bool) -> None:
    """From rest to rest a cubic is 1.5 times, a quintic 1.875 times as fast as its mean."""
    peak = 1.875 if bends else 1.5
    limit = LIMITS["velocity_limits"][0]

    def move(share: float) -> TrajectoryCommand:
        q = np.array([HOME, HOME + np.array([share * limit * 2.0 / peak, 0, 0, 0, 0, 0])])
        rates = np.zeros((2, 6))
        return TrajectoryCommand(NAMES, q, np.array([0.0, 2.0]), rates, rates if bends else None)

    robot = Robot()
    words = refused(Reason.VELOCITY_LIMIT, robot.session.trajectory, move(1.01), robot.now)
    assert "joint_a1 would move at" in words
    robot.session.trajectory(move(0.99), robot.now)


def test_a_joint_without_limits_stands_where_its_turns_meet() -> None:
    """Readings go to and fro between pi and -pi by a microradian."""
    lower, upper = NOMINAL.lower.copy(), NOMINAL.upper.copy()
    lower[5], upper[5] = -np.inf, np.inf
    arm = replace(NOMINAL, lower=lower, upper=upper)
    session = CorrectionSession(arm, arm, "s1", CorrectionConfig(**LIMITS))
    here = np.array([*HOME[:5], np.pi])
    for i in range(60):
        here[5] = np.pi - 1e-6 if i % 2 else -np.pi + 1e-6
        session.reading(JointCommand(NAMES, here.copy()), 100.0 + 0.01 * i)
    begin = np.array([*HOME[:5], np.pi])
    session.target(JointCommand(NAMES, begin), 100.6)


def test_a_scaling_that_is_no_number_is_none() -> None:
    robot = Robot()
    robot.session.controller((), np.empty(0), 0.5, robot.now)
    robot.session.controller((), np.empty(0), np.nan, robot.now)
    robot.session.trajectory(swing(), robot.now)
    path = robot.session.output.path
    assert path is not None
    assert path.time(robot.now + 1.0) == pytest.approx(0.5)
