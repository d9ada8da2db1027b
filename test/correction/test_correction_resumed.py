# SPDX-License-Identifier: Apache-2.0
"""What comes after a pause, another's motion, a wrong clock or a rejected goal: never a jump."""

from dataclasses import replace

import numpy as np
import pytest
from correction_robot import (
    DT,
    HOME,
    LIMITS,
    NAMES,
    NOMINAL,
    REST,
    REST_A,
    ROUNDING,
    Robot,
    endless,
    good_here_only,
    large,
    offer,
    refused,
    still,
    swing,
)

from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import JointCommand, Reason, RefusedError, TrajectoryCommand
from robocal_ros.correction.session import CorrectionSession

PAUSES_S = 0.2, 0.5, 0.8


def left_in_motion() -> tuple[Robot, np.ndarray]:
    """A stream that ended by silence while its offset moved, near a bent wrist."""
    robot = large()
    robot.settle()
    q, speed = HOME.copy(), 0.0
    while q[4] > 0.2:
        speed = min(speed + 1.5 * DT, 1.5)
        q = q + np.array([0.0, 0.0, 0.0, 1.0, -1.0, -0.5]) * speed * DT
        robot.stream(q)
    return robot, q


@pytest.mark.parametrize("pause_s", PAUSES_S)
@pytest.mark.parametrize("told", [False, True])
def test_a_robot_that_was_moved_in_a_pause_is_not_thrown_back(pause_s: float, told: bool) -> None:
    robot = large()
    robot.settle()
    moved, steps = np.radians(5.0), round(pause_s / 2 / 0.01)
    for k in range(2 * steps):
        robot.now += 0.01
        robot.at = robot.at + (moved / steps if k < steps else 0.0)
        robot.read(robot.at)
        if told:
            robot.session.controller(NAMES, robot.at, 1.0, robot.now)
    refused(Reason.START_MISMATCH, robot.stream, HOME)


@pytest.mark.parametrize("pause_s", PAUSES_S)
def test_a_robot_that_stayed_goes_on_after_a_pause(pause_s: float) -> None:
    robot = large()
    robot.settle()
    at = robot.at
    robot.rest(pause_s)
    assert np.array_equal(robot.stream(HOME), at)


@pytest.mark.parametrize("rest_s", [0.3, 30.0])
def test_a_trajectory_after_a_stream_begins_with_an_offset_at_rest(rest_s: float) -> None:
    robot, q = left_in_motion()
    robot.rest(rest_s)
    times = np.linspace(0.0, 3.0, 301)
    out = robot.session.trajectory(
        TrajectoryCommand(NAMES, np.tile(q, (301, 1)), times), robot.now
    ).position
    rates = np.diff(out, axis=0) / times[1]
    assert np.abs(rates).max() <= REST + ROUNDING
    assert np.abs(rates[0]).max() <= REST_A * times[1] + ROUNDING
    assert np.abs(np.diff(rates, axis=0)).max() <= REST_A * times[1] + 2 * ROUNDING / times[1]


def test_a_stream_that_goes_on_begins_with_an_offset_at_rest() -> None:
    robot, q = left_in_motion()
    robot.rest(0.5)
    before = robot.at
    assert np.abs(robot.stream(q) - before).max() <= REST_A * DT * DT + ROUNDING


def test_a_turn_that_the_controller_counts_is_no_start() -> None:
    """What drives a joint without limits does not wrap: a whole turn is a whole turn."""
    arm = endless()
    session = CorrectionSession(arm, arm, "s1", CorrectionConfig(**LIMITS))
    session.reading(JointCommand(NAMES, HOME), 100.0)
    session.controller(NAMES, HOME, 1.0, 100.0)
    turned = HOME + 4.0 * np.pi * np.eye(6)[5]
    refused(Reason.START_MISMATCH, session.target, JointCommand(NAMES, turned), 100.0)
    session.acknowledge(100.0)
    refused(Reason.START_MISMATCH, session.trajectory, still(turned), 100.0)


def test_a_stamp_far_ahead_bars_no_message_after_it() -> None:
    robot, q, stamp = Robot(), HOME.copy(), 10**18
    for k in range(500):
        q[0] += np.radians(60.0) * DT * min(k / 100.0, 1.0)
        stamp += round(DT * 1e9)
        robot.stream(q, stamp_ns=stamp + (900_000_000 if k == 250 else 0))
    assert robot.session.status().refused == {}


def test_the_order_is_that_of_a_source_s_clock_that_was_set_ahead() -> None:
    """From its second message on."""
    robot = Robot()
    for dt, stamp_ms in ((0.05, 1000), (0.001, 1050), (0.01, 1060)):
        robot.stream(dt=dt, stamp_ns=stamp_ms * 10**6)
    refused(Reason.TIME_BACKWARDS, robot.stream, dt=0.001, stamp_ns=1055 * 10**6)


def test_a_clock_that_was_set_back_ends_a_stream_in_order() -> None:
    robot, q, stamp = Robot(), HOME.copy(), 10**18
    for k in range(200):
        q[0] += np.radians(60.0) * DT * min(k / 100.0, 1.0)
        stamp += round(DT * 1e9)
        robot.stream(q, stamp_ns=stamp)
    refused(Reason.TIME_BACKWARDS, robot.stream, q, stamp_ns=stamp - 500_000_000)
    assert robot.session.stream.has_tail
    speeds = [np.radians(60.0)]
    while (command := robot.session.stream.tail(robot.now)) is not None:
        speeds.append((command.position[0] - robot.at[0]) / DT)
        robot.go(command)
        robot.now += DT
    slower = -np.diff(speeds[1:])
    assert np.all(slower <= LIMITS["acceleration_limits"][0] * DT + 2 * ROUNDING / DT)
    assert abs(speeds[-1]) <= LIMITS["acceleration_limits"][0] * DT


def test_a_goal_that_was_rejected_breaks_no_stream() -> None:
    robot = large()
    robot.settle()
    q = HOME.copy()
    for _ in range(100):
        q[0] += np.radians(20.0) * DT
        before = robot.stream(q)
    goal = replace(swing(), position=swing().position + (q - HOME))
    robot.session.trajectory(goal, robot.now, may_be_rejected=True)
    path = robot.session.output.path
    assert path is not None
    robot.session.reject(path)
    q[0] += np.radians(20.0) * DT
    step = robot.stream(q) - before
    assert step[0] == pytest.approx(np.radians(20.0) * DT, rel=0.01)


def test_a_stream_that_is_refused_before_a_goal_was_rejected_does_not_go_on() -> None:
    robot = large()
    robot.settle()
    session, q = robot.session, HOME.copy()

    def send() -> JointCommand:
        q[0] += np.radians(20.0) * DT
        robot.now += DT
        return session.target(JointCommand(NAMES, q.copy()), robot.now)

    for _ in range(48):  # unread, but not for too long
        robot.go(send())
    goal = replace(swing(first_s=0.5), position=swing().position + (q - HOME))
    session.trajectory(goal, robot.now, may_be_rejected=True)
    path = session.output.path
    assert path is not None
    robot.now += 3 * DT
    refused(Reason.STALE_JOINTS, send)
    session.reject(path)
    refused(Reason.STALE_JOINTS, send)
    robot.rest()
    q[:] = session.reading(JointCommand(NAMES, robot.at), robot.now).position
    q[0] -= np.radians(20.0) * DT
    robot.go(send())
    before = robot.at
    for _ in range(50):
        robot.go(send())
    assert robot.at[0] - before[0] == pytest.approx(50 * np.radians(20.0) * DT, rel=0.01)


# ---- what a person acknowledges while something moves --------------------------------------------


def elsewhere() -> TrajectoryCommand:
    return TrajectoryCommand(NAMES, HOME + 0.9 + np.zeros((2, 6)), np.array([0.0, 5.0]))


@pytest.mark.parametrize("pause_s", [0.0, 0.05, 0.3, 0.8])
def test_acknowledged_in_a_stream_the_next_target_does_not_jump(pause_s: float) -> None:
    robot = Robot()
    for _ in range(30):
        robot.stream()
    refused(Reason.START_MISMATCH, robot.session.trajectory, elsewhere(), robot.now)
    robot.session.acknowledge(robot.now)
    if pause_s:
        robot.rest(pause_s)
    before = robot.at.copy()
    far = HOME + np.radians(25.0)
    with pytest.raises(RefusedError):
        robot.stream(far)
    assert np.array_equal(robot.at, before)


def test_acknowledged_on_a_path_the_robot_can_still_be_stopped() -> None:
    robot = large()
    session = robot.session
    session.trajectory(swing(), robot.now)
    path = session.output.path
    for _ in range(280):
        robot.now += DT
        robot.at = path.place(robot.now)
        before = robot.read(robot.at).position
    refused(Reason.START_MISMATCH, session.trajectory, elsewhere(), robot.now)
    session.acknowledge(robot.now)
    robot.now += DT
    robot.at = path.place(robot.now)
    assert np.abs(robot.read(robot.at).position - before).max() < 4e-3  # 1 rad/s
    assert session.stop(robot.now, 0.06) is not None


def test_a_stream_that_catches_up_where_the_model_is_too_large_is_ended() -> None:
    arm, far = good_here_only()
    robot = Robot()
    session = robot.session
    session.offer_model(offer(arm))
    step = (far - HOME) / np.linalg.norm(far - HOME) * np.radians(60.0)
    q = HOME.copy()
    robot.stream(q)
    for _ in range(300):
        q = q + step * DT
        robot.stream(q)
    q = q + step * 0.06
    robot.now += 0.056
    robot.stream(q)
    assert session.stream.lag_s > 0.0
    session.enable(True)
    speeds = []
    for _ in range(400):
        robot.now += DT
        robot.read(robot.at)
        if (command := session.stream.tail(robot.now)) is not None:
            before = robot.at.copy()
            robot.go(command)
            speeds.append(np.abs(robot.at - before).max() / DT)
    assert not session.stream.runs(robot.now)
    assert speeds
    assert speeds[-1] < 0.1 * max(speeds)


def test_velocities_of_another_number_are_refused() -> None:
    robot = Robot()
    robot.stream()
    refused(Reason.WRONG_SIZE, robot.stream, HOME, velocity=np.zeros(5))


@pytest.mark.parametrize("share", [1.0, 0.02], ids=["come in", "on its way in"])
@pytest.mark.parametrize("goes_on", ["stream", "trajectory"])
def test_acknowledged_at_rest_readings_are_told_as_before(share: float, goes_on: str) -> None:
    """And what begins where they say that the robot is begins there, without a step."""
    robot = large()
    session = robot.session
    session.trajectory(swing(), robot.now)
    path = session.output.path
    assert path is not None
    robot.now += 2.0 * share
    robot.at = path.place(robot.now)
    path.end(robot.now)  # somebody else stopped it there
    robot.rest()
    refused(Reason.START_MISMATCH, session.trajectory, elsewhere(), robot.now)
    before = robot.read(robot.at).position
    assert np.abs(before - robot.at).max() > np.radians(0.02)
    session.acknowledge(robot.now)
    taught = robot.read(robot.at).position
    assert np.allclose(taught, before, rtol=0.0, atol=1e-12)
    assert session.status(robot.now).settled == (share == 1.0)
    at = robot.at.copy()
    if goes_on == "stream":
        robot.stream(taught)
        assert np.abs(robot.at - at).max() <= REST * DT + ROUNDING
    else:
        out = session.trajectory(still(taught), robot.now)
        assert np.abs(out.position[0] - at).max() <= ROUNDING


@pytest.mark.parametrize("scaling", [0.0, 0.3])
def test_a_path_that_ended_while_the_controller_paused_stays_ended_as_it_goes_on(
    scaling: float,
) -> None:
    """Cancelled in a pause; how fast the controller's clock runs later moves nothing of it."""
    robot = large()
    session = robot.session
    session.trajectory(swing(), robot.now)
    path = session.output.path
    assert path is not None
    robot.now += 1.0
    session.controller((), np.empty(0), scaling, robot.now)
    robot.now += 0.3
    path.end(robot.now)
    robot.at = path.place(robot.now)
    robot.rest()
    before, withheld = robot.read(robot.at).position, session.offset(robot.now).withheld
    for factor in (1.0, 0.5):
        session.controller((), np.empty(0), factor, robot.now)
        robot.rest()
        assert np.array_equal(path.place(robot.now), robot.at)
        assert np.array_equal(session.offset(robot.now).withheld, withheld)
        assert np.array_equal(robot.read(robot.at).position, before)


@pytest.mark.parametrize("rates", [None, np.zeros((1, 6))], ids=["lines", "cubics"])
def test_a_stream_of_single_points_has_its_offset_when_it_has_come_in(
    rates: np.ndarray | None,
) -> None:
    """Each takes the last one's place on its way. Finding: it was on its way in for ever.

    What is on its way in becomes less by a part of 0.04 / 0.5 with each; 0.0091 rad to 1e-5.
    """
    robot = large()
    within = int(np.ceil(np.log(1e-5 / 0.0091) / np.log(1.0 - 0.04 / 0.5)))
    for k in range(within + 30):
        q = HOME + 0.01 * k * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
        robot.session.trajectory(
            TrajectoryCommand(NAMES, q[None].copy(), np.array([0.5]), rates), robot.now
        )
        path = robot.session.output.path
        assert path is not None
        for _ in range(4):
            robot.now += 0.01
            robot.at = path.place(robot.now)
            robot.read(robot.at)
            if abs(k - within) > 5:
                assert robot.session.status(robot.now).settled == (k > within)


def test_a_pause_holds_the_path_that_goes_on_when_another_is_rejected() -> None:
    robot = Robot()
    session = robot.session
    session.trajectory(swing(), robot.now)
    first = session.output.path
    assert first is not None
    for _ in range(100):
        robot.now += DT
        robot.at = first.place(robot.now)
        robot.read(robot.at)
    again = replace(swing(), position=swing().position + (robot.at - HOME))
    session.trajectory(again, robot.now, may_be_rejected=True)
    second, paused_s = session.output.path, robot.now
    session.controller(NAMES, robot.at, 0.0, paused_s)
    session.controller(NAMES, robot.at, 1.0, paused_s + 10.0)
    assert second is not None
    session.reject(second)
    assert session.output.path is first
    assert np.allclose(first.place(paused_s + 10.0), robot.at, rtol=0.0, atol=1e-9)
    assert first.live(paused_s + 10.0)


# ---- A command begins where the robot stands, or not at all --------------------------------------


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
