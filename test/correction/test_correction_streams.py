"""Streams of the joint correction: their period, their pauses; models that grow old."""

from dataclasses import replace

import numpy as np
import pytest
from correction_robot import DT, HOME, REST, ROUNDING, Robot, drifted, offer, refused

from robocal_ros.correction.inputs import JointCommand
from robocal_ros.correction.refusals import Reason

SECOND = 1_000_000_000


FAR = HOME + 0.1  # from where the robot stands


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
