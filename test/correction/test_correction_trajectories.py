"""Trajectories are corrected as a whole, with a blend along their time."""

from dataclasses import replace

import numpy as np
import pytest
from correction_robot import (
    DT,
    HOME,
    NAMES,
    NOMINAL,
    RATE,
    Robot,
    distance,
    drifted,
    offer,
    pose,
    refused,
    swing,
)

from robocal_ros.core.samples import CORRECTED, TAUGHT
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.inputs import JointCommand, TrajectoryCommand
from robocal_ros.correction.refusals import Reason


def test_a_trajectory_is_corrected_as_a_whole(warm: Robot) -> None:
    command = swing()
    out = warm.session.trajectory(command, warm.now)
    assert distance(pose(drifted(), out.position), pose(NOMINAL, command.position)) < 1e-9
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
    assert slow.max() < RATE


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


def test_a_trajectory_that_is_under_way_already_starts_without_a_jump(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    robot.read(HOME)
    command = swing()
    robot.read(command.position[45])  # it lags
    out = robot.session.trajectory(command, robot.now, starts_in_s=-0.5)
    shift = np.abs(out.position - command.position).max(axis=1)
    assert np.all(shift[:51] == 0.0)
    assert shift[60] > 1e-5


def test_a_trajectory_that_came_much_too_late_is_refused(robot: Robot) -> None:
    """The robot still stands where it began: the controller would jump to where it should be."""
    robot.read(HOME)
    command = swing()
    refused(Reason.START_MISMATCH, robot.session.trajectory, command, robot.now, starts_in_s=-0.5)
    robot.session.enable(False)
    robot.session.trajectory(command, robot.now, starts_in_s=-0.05)


def test_a_later_trajectory_begins_when_it_says(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    robot.read(HOME)
    command = swing()
    out = robot.session.trajectory(command, robot.now, starts_in_s=3.0)
    assert np.array_equal(robot.read(HOME).position, HOME)
    taught = robot.session.reading(JointCommand(NAMES, out.position[-1]), robot.now + 5.0)
    assert np.allclose(taught.position, command.position[-1], rtol=0.0, atol=1e-9)


def test_a_waiting_trajectory_begins_from_what_is_commanded_then(robot: Robot) -> None:
    """The running one goes on until then, and the readings follow it."""
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    robot.read(HOME)
    running = swing()
    first = robot.session.trajectory(running, robot.now)
    robot.session.offer_model(offer(drifted(0.5), revision=2))
    waiting = replace(running, position=np.tile(running.position[50], (201, 1)))
    second = robot.session.trajectory(waiting, robot.now + 0.1, starts_in_s=0.4)
    i = 50  # what the first commands at 0.5 s, where the second begins
    assert running.time_from_start_s[i] == pytest.approx(0.5)
    assert np.allclose(second.position[0], first.position[i], rtol=0.0, atol=1e-9)
    for i in (10, 30, 49):
        state = JointCommand(NAMES, first.position[i])
        taught = robot.session.reading(state, robot.now + running.time_from_start_s[i])
        assert np.allclose(taught.position, running.position[i], rtol=0.0, atol=1e-9)


def test_a_part_of_the_joints_does_not_blend_the_others_unseen(robot: Robot) -> None:
    """Only joint 1 is commanded while a model comes into force; then all of them."""
    before = robot.stream()
    robot.read(before)
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    for _ in range(1000):
        robot.now += DT
        robot.read(before)
        robot.session.target(JointCommand(NAMES[:1], HOME[:1]), robot.now)
    allowed = CorrectionConfig().blend_rates(NOMINAL) * DT
    assert np.all(np.abs(robot.stream() - before) <= allowed * 1.001)


def test_a_stop_passes_at_once_and_as_it_came(warm: Robot) -> None:
    stop = TrajectoryCommand(NAMES, np.empty((0, 6)), np.empty(0))
    before = warm.stream()
    assert warm.session.trajectory(stop, warm.now) is stop
    assert np.array_equal(warm.stream(), before)
    nameless = TrajectoryCommand((), np.empty((0, 0)), np.empty(0), mark=CORRECTED)
    assert warm.session.trajectory(nameless, -1.0) is nameless


def test_ten_thousand_points_at_once(warm: Robot) -> None:
    command = swing(m=10_000)
    out = warm.session.trajectory(command, warm.now)
    assert distance(pose(drifted(), out.position), pose(NOMINAL, command.position)) < 1e-9
