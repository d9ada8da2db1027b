"""Trajectories are corrected as a whole, with a blend along their time."""

import numpy as np
import pytest
from correction_robot import (
    HOME,
    NAMES,
    NOMINAL,
    REST,
    Robot,
    distance,
    drifted,
    offer,
    pose,
    refused,
    swing,
)

from robocal_ros.correction.interface import JointCommand, Reason
from robocal_ros.ground.samples import CORRECTED, TAUGHT


def test_a_trajectory_is_corrected_as_a_whole(warm: Robot) -> None:
    command = swing()
    out = warm.session.trajectory(command, warm.now)
    corrected = distance(pose(drifted(), out.position[5:]), pose(NOMINAL, command.position[5:]))
    assert corrected < 1e-9  # after the step of its acceleration
    assert np.array_equal(out.time_from_start_s, command.time_from_start_s)
    assert out.mark == CORRECTED
    h = 0.01
    v = (out.position[2:] - out.position[:-2]) / (2 * h)
    assert out.velocity is not None
    assert out.acceleration is not None
    assert np.allclose(out.velocity[1:-1], v, rtol=0.0, atol=1e-4)
    a = (out.position[2:] - 2 * out.position[1:-1] + out.position[:-2]) / h**2
    assert np.allclose(out.acceleration[1:-1], a, rtol=0.0, atol=1e-3)
    assert np.all(out.velocity[[0, -1]] == pytest.approx(0.0, abs=1e-12))


def test_velocities_follow_the_positions_while_a_blend_is_under_way(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    robot.read(HOME)
    command = swing()
    out = robot.session.trajectory(command, robot.now)
    assert out.velocity is not None
    v = (out.position[2:] - out.position[:-2]) / 0.02
    slow = np.abs(out.velocity[1:-1] - v).max(axis=1)
    # where the blend starts and ends its rate has a corner
    assert np.median(slow) < 1e-4
    assert slow.max() < REST


def test_readings_follow_a_blend_along_the_trajectory(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    robot.read(HOME)
    command = swing()
    out = robot.session.trajectory(command, robot.now)
    for i in (0, 20, 60, 200):
        state = JointCommand(NAMES, out.position[i])
        taught = robot.session.reading(state, robot.now + command.time_from_start_s[i])
        assert np.allclose(taught.position, command.position[i], rtol=0.0, atol=1e-9)
        assert taught.mark == TAUGHT


def test_a_trajectory_that_came_much_too_late_is_refused(robot: Robot) -> None:
    """The robot still stands where it began: the controller would jump to where it should be."""
    robot.read(HOME)
    command = swing()
    refused(Reason.START_MISMATCH, robot.session.trajectory, command, robot.now, starts_in_s=-0.5)
    assert robot.session.status().mismatch


def test_a_later_trajectory_begins_when_it_says(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    robot.read(HOME)
    command = swing()
    out = robot.session.trajectory(command, robot.now, starts_in_s=3.0)
    assert np.allclose(robot.read(HOME).position, HOME, rtol=0.0, atol=1e-12)
    taught = robot.session.reading(JointCommand(NAMES, out.position[-1]), robot.now + 5.0)
    assert np.allclose(taught.position, command.position[-1], rtol=0.0, atol=1e-9)


def test_ten_thousand_points_at_once(warm: Robot) -> None:
    command = swing(m=10_000)
    out = warm.session.trajectory(command, warm.now)
    left = distance(pose(drifted(), out.position[100:]), pose(NOMINAL, command.position[100:]))
    assert left < 1e-9  # after the step of its acceleration
