"""A command begins where the robot stands, or not at all."""

import numpy as np
import pytest
from correction_robot import (
    DT,
    HOME,
    LIMITS,
    NAMES,
    NOMINAL,
    REST,
    ROUNDING,
    Robot,
    large,
    refused,
    still,
)

from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import JointCommand, Reason, TrajectoryCommand
from robocal_ros.correction.session import CorrectionSession

FAR = np.radians(0.021)  # beyond the tolerance of 0.02 deg
NEAR = np.radians(0.019)


def moved(by: float, joint: int = 1) -> np.ndarray:
    q = HOME.copy()
    q[joint] += by
    return q


def test_nothing_goes_out_before_joint_states_have_arrived() -> None:
    robot = Robot()
    robot.session = CorrectionSession(NOMINAL, NOMINAL, "s1", CorrectionConfig(**LIMITS))
    said = refused(Reason.STALE_JOINTS, robot.session.target, JointCommand(NAMES, HOME), 1.0)
    assert "joint_a1" in said
    refused(Reason.STALE_JOINTS, robot.session.trajectory, still(first_s=60.0), 1.0)
    assert not robot.session.status().mismatch  # nothing is wrong: they will come
    robot.rest()
    assert np.array_equal(robot.stream(), HOME)


def test_readings_that_have_just_begun_are_waited_for() -> None:
    """Nobody has to acknowledge that a program began to stream as fast as the robot was read."""
    robot = Robot()
    robot.session = CorrectionSession(NOMINAL, NOMINAL, "s1", CorrectionConfig(**LIMITS))
    for _ in range(3):
        robot.read(HOME)
        robot.now += DT
    assert "tell whether the robot stands" in refused(Reason.STALE_JOINTS, robot.stream)
    assert not robot.session.status().mismatch
    robot.rest()
    assert np.array_equal(robot.stream(), HOME)


@pytest.mark.parametrize("on", [False, True])
@pytest.mark.parametrize("joint", range(6))
def test_the_first_target_is_where_the_robot_stands(on: bool, joint: int) -> None:
    robot = Robot()
    robot.session.enable(on)
    robot.at = moved(NEAR, joint)
    robot.rest()
    robot.stream()
    robot = Robot()
    robot.session.enable(on)
    robot.at = moved(-FAR, joint)
    robot.rest()
    assert NAMES[joint] in refused(Reason.START_MISMATCH, robot.stream)


def test_after_a_mismatch_nothing_goes_out_until_it_is_acknowledged() -> None:
    robot = large()
    robot.at = moved(0.5)
    robot.rest()
    refused(Reason.START_MISMATCH, robot.stream)
    robot.at = HOME  # also where it would fit now
    robot.rest()
    refused(Reason.START_MISMATCH, robot.stream)
    refused(Reason.START_MISMATCH, robot.session.trajectory, still(), robot.now)
    assert "joint_a2" in robot.session.status().mismatch
    assert "acknowledge" in robot.session.status().mismatch
    assert np.array_equal(robot.read(HOME).position, HOME)
    robot.session.enable(True)  # is no look at the robot
    assert robot.session.status().mismatch
    robot.session.acknowledge(robot.now)
    assert not robot.session.status().mismatch
    assert np.array_equal(robot.stream(), HOME)
    assert robot.session.status().refused[Reason.START_MISMATCH] == 3


def test_a_trajectory_that_the_controller_rejected_is_not_believed() -> None:
    """The robot stands at home all the time: what comes next begins there, uncorrected."""
    robot = large()
    first = robot.session.trajectory(still(), robot.now)
    assert np.abs(first.position[-1] - HOME).max() > 10 * FAR
    for _ in range(25):
        robot.now += 1.0
        robot.read(HOME)
    for command in (still(first_s=0.01), still()):
        out = robot.session.trajectory(command, robot.now)
        first_s = command.time_from_start_s[0]
        assert np.abs(out.position[0] - HOME).max() <= REST * first_s + ROUNDING
    assert np.allclose(robot.read(HOME).position, HOME, rtol=0.0, atol=1e-12)


def test_a_trajectory_goes_on_from_the_correction_of_the_one_before() -> None:
    robot = large()
    first = robot.session.trajectory(still(), robot.now)
    robot.now += 25.0
    robot.read(first.position[-1])
    for first_s in (0.0, 0.01):
        out = robot.session.trajectory(still(first_s=first_s), robot.now)
        assert np.allclose(out.position, first.position[-1], rtol=0.0, atol=1e-12)


def test_a_trajectory_from_nowhere_is_refused_unless_it_takes_its_time() -> None:
    """The robot was moved by hand: nobody knows what correction it shows."""
    for first_s, fine in ((0.0, False), (0.05, False), (20.0, True)):
        robot = large()
        first = robot.session.trajectory(still(), robot.now)
        robot.now += 25.0
        robot.read(first.position[-1] + 0.3)
        command = still(first_s=first_s)
        if fine:
            robot.session.trajectory(command, robot.now)
        else:
            reason = Reason.VELOCITY_LIMIT if first_s else Reason.START_MISMATCH
            refused(reason, robot.session.trajectory, command, robot.now)


def test_a_restart_while_corrected_goes_on_where_the_robot_stands() -> None:
    robot = large()
    at = robot.settle()
    assert np.abs(at - HOME).max() > 10 * FAR
    for on in (False, True):
        new = large()
        new.session.enable(on)
        new.at = at
        new.rest()
        assert np.abs(new.stream() - at).max() <= ROUNDING
        last = at
        for _ in range(2000):
            assert np.abs(new.stream() - last).max() <= REST * DT + ROUNDING
            last = new.at
        assert np.allclose(new.settle(), at if on else HOME, rtol=0.0, atol=ROUNDING)


def test_a_restart_that_does_not_know_the_model_yet_waits() -> None:
    at = large().settle()
    new = Robot()
    new.at = at
    new.rest()
    refused(Reason.START_MISMATCH, new.stream)


def test_after_a_pause_at_the_uncorrected_target_the_correction_blends_in_again() -> None:
    robot = large()
    at = robot.settle()
    robot.at = HOME
    robot.rest()
    assert np.array_equal(robot.stream(dt=1.0), HOME)
    assert np.abs(robot.stream() - HOME).max() <= REST * DT + ROUNDING
    assert np.allclose(robot.settle(), at, rtol=0.0, atol=ROUNDING)


def test_a_part_of_the_joints_does_not_tell_that_the_others_are_uncorrected() -> None:
    """One joint is hardly shifted: where it stands says nothing about the rest."""
    robot = large()
    at = robot.settle()
    joint = int(np.argmin(np.abs(at - HOME)))
    assert abs(at[joint] - HOME[joint]) < NEAR < np.abs(at - HOME).max()
    name, taught = (NAMES[joint],), HOME[[joint]]
    robot.at = at.copy()
    robot.rest()
    robot.at[joint] = HOME[joint]  # as if it were uncorrected: within the tolerance of both
    part = TrajectoryCommand(name, np.tile(taught, (3, 1)), np.array([0.0, 0.5, 1.0]))
    robot.now += 1.0
    robot.read(robot.at)
    robot.session.target(JointCommand(name, taught), robot.now)
    assert np.abs(robot.stream() - at).max() <= ROUNDING
    robot.session.trajectory(part, robot.now)
    robot.now += 2.0
    robot.at[joint] = HOME[joint]
    robot.read(robot.at)
    out = robot.session.trajectory(still(first_s=0.01), robot.now)
    assert np.allclose(out.position, at, rtol=0.0, atol=1e-12)


def test_old_readings_do_not_tell_where_the_robot_is(warm: Robot) -> None:
    at = warm.stream()
    command = JointCommand(NAMES, HOME)
    warm.now += 0.3
    said = refused(Reason.STALE_JOINTS, warm.session.target, command, warm.now)
    assert "0.300 s" in said
    warm.session.reading(JointCommand(NAMES, at), warm.now, 0.25)  # late on the way
    refused(Reason.STALE_JOINTS, warm.session.target, command, warm.now)
    warm.read(at)
    assert np.array_equal(warm.session.target(command, warm.now).position, at)


@pytest.mark.parametrize(("ahead_s", "known"), [(0.09, True), (0.11, False), (0.45, False)])
def test_readings_stamped_far_ahead_do_not_tell_where_the_robot_is(
    warm: Robot, ahead_s: float, known: bool
) -> None:
    at = warm.stream()
    command = JointCommand(NAMES, HOME)
    warm.now += 0.3
    warm.session.reading(JointCommand(NAMES, at), warm.now, -ahead_s)
    if known:
        warm.session.target(command, warm.now)
        return
    said = refused(Reason.STALE_JOINTS, warm.session.target, command, warm.now)
    assert "over 0.1 s ahead of the clock" in said


def test_a_part_of_the_joints_is_not_completed_from_old_readings(warm: Robot) -> None:
    warm.stream()
    part = JointCommand(NAMES[:2], HOME[:2])
    warm.session.target(part, warm.now)
    warm.now += 0.25
    said = refused(Reason.STALE_JOINTS, warm.session.target, part, warm.now)
    assert "joint_a3" in said
    assert "0.2 s" in said
