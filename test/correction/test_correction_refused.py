"""What the session does not take: bad values, clocks, its own output."""

from dataclasses import replace

import numpy as np
import pytest
from correction_robot import HOME, NAMES, NOMINAL, Robot, offer, refused, still, swing

from robocal_ros.correction.interface import JointCommand, Reason, TrajectoryCommand
from robocal_ros.ground.samples import CORRECTED, TAUGHT


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite(warm: Robot, bad: float) -> None:
    q = HOME.copy()
    q[3] = bad
    session, now = warm.session, warm.now
    assert "joint_a4" in refused(Reason.NOT_FINITE, session.target, JointCommand(NAMES, q), now)
    fast = JointCommand(NAMES, HOME, velocity=q)
    refused(Reason.NOT_FINITE, session.target, fast, now)
    refused(Reason.NOT_FINITE, session.reading, JointCommand(NAMES, q), now)
    assert session.reading(fast, now).velocity is None  # a driver that has none says NaN
    points, times = np.stack([HOME, q]), np.array([0.0, 1.0])
    trajectory = TrajectoryCommand(NAMES, points, times)
    assert "point 2" in refused(Reason.NOT_FINITE, session.trajectory, trajectory, now)
    still = np.stack([HOME, HOME])
    for rates in ({"velocity": points}, {"velocity": still, "acceleration": points}):
        trajectory = TrajectoryCommand(NAMES, still, times, **rates)
        refused(Reason.NOT_FINITE, session.trajectory, trajectory, now)
    assert session.status().refused[Reason.NOT_FINITE] == 6
    assert np.all(np.isfinite(warm.read(HOME).position))


def test_doubled_and_misfitting_joints(warm: Robot) -> None:
    session, now = warm.session, warm.now
    doubled = (NAMES[0], *NAMES[:5])
    refused(Reason.DOUBLED_JOINT, session.target, JointCommand(doubled, HOME), now)
    refused(Reason.DOUBLED_JOINT, session.reading, JointCommand(doubled, HOME), now)
    refused(Reason.WRONG_SIZE, session.target, JointCommand(NAMES, HOME[:5]), now)
    refused(Reason.WRONG_SIZE, session.reading, JointCommand(NAMES, HOME[:5]), now)
    refused(Reason.UNKNOWN_JOINT, session.target, JointCommand((), np.empty(0)), now)


def test_time_that_goes_backwards(warm: Robot) -> None:
    session = warm.session
    warm.stream(stamp_ns=2_000_000_000)
    refused(Reason.TIME_BACKWARDS, warm.stream, stamp_ns=1_999_000_000)
    command = replace(swing(m=3), time_from_start_s=np.array([0.0, 1.0, 1.0]))
    refused(Reason.TIME_BACKWARDS, session.trajectory, command, warm.now)
    command = replace(command, time_from_start_s=np.array([-0.1, 1.0, 2.0]))
    refused(Reason.TIME_BACKWARDS, session.trajectory, command, warm.now)
    # after a look by the operator any source time will do
    session.acknowledge(warm.now)
    warm.stream(stamp_ns=5)


def test_readings_of_a_clock_that_was_set_back_are_taken(warm: Robot) -> None:
    q = warm.stream()
    warm.read(q, stamp_ns=10_000_000_000)
    refused(Reason.TIME_BACKWARDS, warm.read, q, stamp_ns=9_900_000_000)
    warm.read(q, stamp_ns=1_000_000_000)


def test_a_source_whose_clock_was_set_back_goes_on(warm: Robot) -> None:
    """A simulator that was started again, or one stamp from the future."""
    warm.stream(stamp_ns=10**15)
    warm.stream(stamp_ns=10**9)
    refused(Reason.TIME_BACKWARDS, warm.stream, stamp_ns=9 * 10**8)


def test_a_trajectory_for_later_does_not_bar_those_that_come_before(warm: Robot) -> None:
    later = replace(still(), stamp_ns=1_000_000_000_000)
    warm.session.trajectory(later, warm.now, 600.0)
    sooner = replace(still(first_s=0.5), stamp_ns=400_000_000_000)
    warm.session.trajectory(sooner, warm.now, 10.0)


def test_a_model_that_is_the_reference_to_rounding_corrects_nothing() -> None:
    """A file's decimals and a quaternion on the way leave 1e-13 of it."""
    robot = Robot()
    robot.read(HOME)
    robot.session.offer_model(offer(NOMINAL.with_mdh(NOMINAL.mdh + 1e-13)))
    robot.session.enable(True)
    assert np.array_equal(robot.stream(), HOME)
    status = robot.session.status()
    assert status.settled
    assert not status.active


def test_own_output_that_comes_back(warm: Robot) -> None:
    session, now = warm.session, warm.now
    out = warm.stream()
    marked = JointCommand(NAMES, HOME, mark=CORRECTED)
    refused(Reason.OWN_OUTPUT, session.target, marked, warm.now)
    refused(Reason.OWN_OUTPUT, session.trajectory, replace(swing(), mark=CORRECTED), warm.now)
    for mark in (CORRECTED, TAUGHT):
        refused(Reason.OWN_OUTPUT, session.reading, replace(marked, mark=mark), warm.now)
    # the same target again is no loop
    assert np.array_equal(warm.stream(), out)
    assert now < warm.now
