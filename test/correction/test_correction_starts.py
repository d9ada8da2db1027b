"""What a robot shows may not be what it was sent: rejected commands, stalls, other hands."""

import numpy as np
import pytest
from correction_robot import (
    DT,
    HOME,
    NAMES,
    REST,
    ROUNDING,
    Robot,
    bent_tool,
    drifted,
    offer,
    refused,
    still,
)

from robocal_ros.correction.interface import JointCommand, Reason, TrajectoryCommand

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
def test_off_a_way_out_that_was_rejected_is_gone_again(corrected: Robot, again: str) -> None:
    """The correction should have gone with that trajectory; the robot still shows it."""
    corrected.session.enable(False)
    corrected.session.trajectory(still(seconds=20.0), corrected.now)
    waits(corrected, 21.0)
    at = corrected.at
    if again == "target":
        out = np.array([corrected.stream() for _ in range(500)])
        dt = DT
    else:
        out = corrected.session.trajectory(still(seconds=5.0), corrected.now).position
        dt = 5.0 / 40
    assert np.abs(out[0] - at).max() <= ROUNDING  # from where it stands
    assert np.abs(np.diff(out, axis=0)).max() <= REST * dt + ROUNDING
    assert np.array_equal(out[-1], HOME)


def test_a_refused_trajectory_is_no_beginning(corrected: Robot) -> None:
    fresh = Robot()
    fresh.at = corrected.at
    fresh.rest()
    fresh.session.offer_model(offer(drifted()))
    fresh.session.offer_tool(bent_tool())
    fresh.rest()
    beyond = np.tile(HOME, (41, 1))
    beyond[-1, 0] = 4.0
    path = TrajectoryCommand(NAMES, beyond, np.linspace(8.0, 28.0, 41))
    refused(Reason.JOINT_LIMIT, fresh.session.trajectory, path, fresh.now)
    assert np.abs(fresh.stream() - corrected.at).max() < np.radians(0.02)  # goes on from there


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


def test_a_controllers_reference_is_as_old_as_what_it_said_of_the_joint() -> None:
    """A scaling alone, and the states of other joints, say nothing of where it is."""
    robot = Robot()
    session, nothing = robot.session, np.empty(0)
    ahead = HOME + 0.01  # of the robot, which lags
    session.controller(NAMES, ahead, 1.0, robot.now)
    assert np.array_equal(robot.stream(ahead), ahead)
    for names, position in (
        ((), nothing),
        (("gripper",), np.zeros(1)),
        (NAMES[:5], ahead[:5]),
        (NAMES, np.array([*ahead[:5], np.nan])),
    ):
        robot = Robot()
        robot.session.controller(NAMES, ahead, 1.0, robot.now)
        robot.rest(0.2)
        robot.session.controller(names, position, 1.0, robot.now)
        refused(Reason.START_MISMATCH, robot.stream, ahead)
