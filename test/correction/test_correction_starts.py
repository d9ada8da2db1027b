"""What a robot shows may not be what it was sent: rejected commands, stalls, other hands."""

import numpy as np
import pytest
from correction_robot import DT, HOME, NAMES, Robot, bent_tool, drifted, offer, refused, still

from robocal_ros.correction.inputs import JointCommand, TrajectoryCommand
from robocal_ros.correction.refusals import Reason

SECOND = 1_000_000_000


@pytest.fixture
def corrected() -> Robot:
    """At rest, corrected by some tenths of a degree."""
    robot = Robot()
    robot.session.offer_model(offer(drifted()))
    robot.session.offer_tool(bent_tool())
    robot.session.enable(True)
    robot.settle()
    robot.rest(1.0)
    return robot


def waits(robot: Robot, seconds: float) -> None:
    for _ in range(round(seconds / 0.05)):
        robot.now += 0.05
        robot.read(robot.at)


@pytest.mark.parametrize("again", ["target", "trajectory"])
def test_off_does_not_trust_a_way_out_that_was_rejected(corrected: Robot, again: str) -> None:
    """The correction should have gone with that trajectory; the robot still shows it."""
    corrected.session.enable(False)
    corrected.session.trajectory(still(seconds=20.0), corrected.now)
    waits(corrected, 21.0)
    if again == "target":
        refused(Reason.START_MISMATCH, corrected.stream)
    else:
        act = corrected.session.trajectory
        refused(Reason.START_MISMATCH, act, still(seconds=5.0), corrected.now)


def test_off_trusts_a_robot_that_was_seen_without_correction(corrected: Robot) -> None:
    corrected.session.enable(False)
    corrected.settle()
    corrected.rest(1.0)
    assert np.array_equal(corrected.stream(), HOME)  # compared, and right
    corrected.rest(1.0)
    corrected.at = HOME + 0.01  # as an off node always did: it adds nothing
    assert np.array_equal(corrected.stream(), HOME)


def test_a_refused_trajectory_is_no_beginning(corrected: Robot) -> None:
    fresh = Robot()
    fresh.at = corrected.at
    fresh.session.offer_model(offer(drifted()))
    fresh.session.offer_tool(bent_tool())
    fresh.rest()
    beyond = np.tile(HOME, (41, 1))
    beyond[-1, 0] = 4.0
    path = TrajectoryCommand(NAMES, beyond, np.linspace(8.0, 28.0, 41))
    refused(Reason.JOINT_LIMIT, fresh.session.trajectory, path, fresh.now)
    assert np.abs(fresh.stream() - corrected.at).max() < np.radians(0.02)  # goes on from there


@pytest.mark.parametrize("speed", [0.5, 0.8])
def test_a_stall_and_its_burst_are_no_speed(speed: float) -> None:
    """25 messages wait 50 ms and come at once: none is refused, none steps further."""
    robot = Robot(velocity_limits=np.full(6, 1.0))
    q, step = HOME.copy(), np.array([speed * DT, 0.0, 0.0, 0.0, 0.0, 0.0])
    last, largest = robot.stream(), 0.0
    for i in range(400):
        q = q + step
        if i == 50:
            robot.now += 0.05
        out = robot.stream(q, dt=2e-4 if 50 <= i < 75 else DT)
        last, largest = out, max(largest, float(np.abs(out - last).max()))
    assert largest == pytest.approx(step[0], rel=1e-9)


def test_a_pause_does_not_allow_a_long_step() -> None:
    robot = Robot(velocity_limits=np.full(6, 1.0))
    for _ in range(20):
        robot.stream()
    far = HOME + np.array([0.08, 0.0, 0.0, 0.0, 0.0, 0.0])  # 1 rad/s for 80 ms
    refused(Reason.VELOCITY_LIMIT, robot.stream, far, dt=0.09)


def test_a_robot_that_somebody_else_moves_is_not_lagging(corrected: Robot) -> None:
    corrected.now += 60.0
    q = corrected.at.copy()
    for _ in range(60):
        corrected.now += 0.01
        q[0] += 0.008
        corrected.read(q)
    beside = q.copy()
    beside[0] -= 0.14
    command = JointCommand(NAMES, beside)
    refused(Reason.START_MISMATCH, corrected.session.target, command, corrected.now)


def test_a_model_from_the_future_is_as_stale_as_an_old_one() -> None:
    robot = Robot(model_age_s=60.0)
    robot.session.offer_model(offer(drifted(), stamp_ns=200 * SECOND))
    robot.session.look(robot.now, 100 * SECOND)
    assert "100.0 s in the future" in robot.session.status().stale
