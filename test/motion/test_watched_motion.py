# SPDX-License-Identifier: Apache-2.0
"""Own motions on a controller as it is: scaled, paused, deaf to a stop, or unwilling."""

import numpy as np
import pytest
from driven_robot import HOUSING, LAG_S, PERIOD_S, AheadMotion, Robot
from hypothesis import given
from hypothesis import strategies as st
from long_form import more

from robocal_ros.cell_sim.trajectory_controller import JointMotion
from robocal_ros.ground.errors import Code
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.motion.cell import DrivingConfig
from robocal_ros.motion.plan import LEAD_S, SHORTEST_STOP_S, JointPlan, MotionLimits, stop
from robocal_ros.motion.robot_watch import REST_RAD, SEEN_S, STANDS_S, MotionReport, RobotWatch
from robocal_ros.motion.stopping import REPEAT_S, WatchedStop
from robocal_ros.session.events import TOOL_STEP
from robocal_ros.tool.driving import DrivePhase

ARM = load_robot("kr150_r3100")
HOME = np.array([0.3, -1.2, 1.2, 0.4, 0.9, -0.3])


@pytest.fixture
def robot(history) -> Robot:
    made = Robot(history)
    made.run(0.5)
    return made


def driven(robot: Robot, phase: DrivePhase, for_s: float) -> None:
    robot.driver.arm(robot.now_s)
    robot.measure("quick")
    robot.run(20.0, until=lambda: robot.driver.phase is phase)
    robot.run(for_s)
    assert robot.driver.phase is phase


def stood_after_s(robot: Robot, since_s: float) -> float:
    """How long the robot went on moving."""
    path = np.array(robot.path[round(since_s / PERIOD_S) - 1 :])
    moved = np.flatnonzero(np.max(np.abs(np.diff(path, axis=0)), axis=1) > 1e-6)
    return float((moved[-1] + 1) * PERIOD_S)


# ---- what goes out ------------------------------------------------------------------------------


@given(
    speed=st.lists(st.floats(-1.0, 1.0, allow_subnormal=False), min_size=6, max_size=6),
    lag_cycles=st.integers(0, 5),
    late_s=st.floats(0.0, 0.01),
)
def test_a_stop_throws_no_joint_back_and_none_ahead(speed, lag_cycles, late_s):
    """On a controller with its own spline, whose drives lag, from what it says of itself."""
    qd = np.array(speed)
    motion = JointMotion(HOME, lag_s=4e-3 * lag_cycles)
    motion.follow(0.0, [2.0], (HOME + 2.0 * qd)[None])  # a line, without velocities
    motion.joints(np.array([1.0]))
    halt = stop(ARM, MotionLimits(), HOME + 1.0 * qd, qd)
    time_s, q, velocity = halt.points()
    assert time_s[0] >= LEAD_S - 1e-12
    assert np.all(np.diff(time_s) > 0.0)
    motion.follow(1.0 + late_s, time_s + 1.0 + late_s, q, velocity)
    path = motion.joints(1.0 + np.arange(0.0, halt.duration_s + 0.1, 4e-3))
    rate = np.diff(path, axis=0) / 4e-3 * np.sign(qd)
    assert np.all(rate >= -0.05 * np.abs(qd) - 1e-9)
    assert np.all(rate <= 1.3 * np.abs(qd) + 1e-9)
    assert np.max(np.abs(path[-1] - halt.q[-1])) < 1e-6


@pytest.mark.parametrize("phase", [DrivePhase.APPROACH, DrivePhase.MEASURE])
def test_every_motion_begins_ahead_of_now_with_velocities(robot, phase):
    driven(robot, phase, 0.1)
    for _, plan in robot.sent:
        time_s, q, qd = plan.points()
        assert time_s[0] == pytest.approx(LEAD_S)
        assert np.all(qd[-1] == 0.0)
        # what a controller makes of it from rest is the plan
        begin = JointPlan(
            np.array([0.0, LEAD_S]),
            np.array([plan.q[0], q[0]]),
            np.array([0.0 * qd[0], qd[0]]),
            np.zeros((2, 6)),
        )
        between = np.linspace(0.0, LEAD_S, 20)
        assert np.max(np.abs(begin.at(between)[0] - plan.at(between)[0])) < REST_RAD


def test_a_stop_of_a_robot_that_rests_is_not_sent_again():
    """Readings that tremble are no motion: a second stop would replace what is driven next."""
    rng = np.random.default_rng(5)
    robot = RobotWatch(ARM, DrivingConfig(HOUSING, 0.1, 0.008, 0.05))
    stopping = WatchedStop(ARM, MotionLimits())
    for number in range(125):
        now_s = number * PERIOD_S
        robot.reading(now_s, HOME + 3e-5 * rng.uniform(-1.0, 1.0, 6), now_s)
        robot.silence.look(now_s)
        if number == 60:
            stopping.begin((HOME, np.zeros(6)), now_s)
        assert stopping.look(robot, now_s) is None
    assert stopping.sent == 1
    assert not stopping.under_way


# ---- speed scaling and pauses -------------------------------------------------------------------


@pytest.mark.parametrize("tells", [True, False])
@pytest.mark.parametrize("speed", [0.5, *more(0.1, 0.95)])
def test_a_scaled_robot_measures_as_ever(robot, speed, tells):
    robot.speed, robot.tells = speed, tells
    robot.driver.arm(robot.now_s)
    robot.measure("quick")
    robot.run(400.0, until=robot.at_rest)
    last = robot.outcomes[-1]
    assert last.command.name == TOOL_STEP
    assert last.document is not None
    assert "recalibrate" in str(last.document)  # the taught tool is not the true one


@pytest.mark.parametrize("tells", [True, False])
@pytest.mark.parametrize("phase", [DrivePhase.APPROACH, DrivePhase.MEASURE])
def test_a_pause_of_ten_seconds_is_waited_for(robot, phase, tells):
    robot.tells = tells
    driven(robot, phase, 0.4)
    robot.speed = 0.0
    robot.run(10.0)
    assert robot.driver.armed
    assert bool(robot.driver.trouble(robot.now_s)) is not tells
    robot.speed = 1.0
    robot.run(100.0, until=robot.at_rest)
    assert robot.outcomes[-1].document is not None


def test_a_paused_robot_is_stopped_where_it_is(robot):
    robot.tells = True
    driven(robot, DrivePhase.MEASURE, 0.4)
    robot.speed = 0.0
    robot.run(1.0)
    here = robot.q
    robot.driver.disarm("enough", robot.now_s)
    robot.run(0.5)
    robot.speed = 1.0
    robot.run(1.0)
    assert np.max(np.abs(robot.q - here)) < 1e-4


@pytest.mark.parametrize("lost", [2, 1000, *more(1)])
def test_a_stop_that_is_lost_in_a_pause_does_not_let_the_motion_go_on(lost):
    """Finding: after 0.1 s it was over; with the pause the motion went on, 17 deg in 1 s."""
    robot = RobotWatch(ARM, DrivingConfig(HOUSING, 0.1, 0.008, 0.05))
    q, speed, held, now_s = HOME, 0.3 * np.eye(6)[0], False, 0.0
    stopping = WatchedStop(ARM, MotionLimits())

    def read(scaling: float) -> None:
        nonlocal q, now_s
        now_s += PERIOD_S
        q = q if held else q + speed * PERIOD_S * scaling
        robot.scaled(scaling, now_s)
        robot.reading(now_s, q, now_s)
        robot.silence.look(now_s)

    for scaling in [1.0] * 60 + [0.0] * 60:
        read(scaling)
    paused = q
    stopping.begin(robot.state(now_s, keeps=True), now_s)
    for _ in range(round(30.0 / PERIOD_S)):
        read(0.0)
        plan = stopping.look(robot, now_s)
        if plan is not None:
            assert np.max(np.abs(plan.q - paused)) < REST_RAD
            held = held or stopping.sent > lost
    assert stopping.under_way
    assert not stopping.failed
    assert 30.0 / REPEAT_S - 2.0 <= stopping.sent <= 30.0 / REPEAT_S + 2.0
    went_on_s = now_s
    while stopping.under_way:
        read(1.0)
        held = stopping.look(robot, now_s) is not None or held
    assert not stopping.failed
    assert now_s - went_on_s > STANDS_S
    # of one that never came in: until the shortest stop is to be over, and the next one is sent
    longest_s = SHORTEST_STOP_S + SEEN_S[False] + 2.0 * PERIOD_S
    assert abs(q - paused)[0] <= (speed[0] * longest_s if lost == 1000 else 0.0)


# ---- stops --------------------------------------------------------------------------------------


@pytest.mark.parametrize("lost", [0, 2, *more(1)])
@pytest.mark.parametrize("phase", [DrivePhase.APPROACH, DrivePhase.MEASURE])
def test_a_lost_stop_is_sent_again_until_the_robot_stands(robot, phase, lost):
    driven(robot, phase, 0.6)
    robot.lost = lost
    at_s = robot.now_s
    robot.driver.disarm("enough", at_s)
    planned_s = robot.sent[-1][1].duration_s
    robot.run(2.0)
    assert robot.stops == 1 + lost
    took_s = stood_after_s(robot, at_s)
    assert took_s <= 1.5 * (planned_s + LAG_S + PERIOD_S)  # with the controller's own lag
    assert not robot.driver.moves


def test_a_robot_that_never_stops_is_stopped_by_other_means(robot):
    hard = []
    robot.driver._hard_stop = hard.append
    driven(robot, DrivePhase.APPROACH, 0.4)
    robot.lost = 1000
    robot.driver.disarm("enough", robot.now_s)
    robot.run(1.0)
    assert len(hard) == 1
    assert "does not stop" in hard[0]
    assert robot.driver.trouble(robot.now_s) == hard[0]


# ---- what the controller says -------------------------------------------------------------------


def test_a_rejected_motion_ends_the_run_with_the_controllers_words(robot):
    driven(robot, DrivePhase.APPROACH, 0.0)
    robot.coming.clear()
    robot.driver.reported(MotionReport(failed=True, words="rejected: no"), robot.now_s)
    robot.run(0.5)
    assert "rejected: no" in robot.outcomes[-1].message
    assert robot.outcomes[-1].status is Code.CONFLICT
    assert not robot.driver.armed


def test_a_preempted_motion_is_stopped_from_where_the_robot_is(robot):
    """Another trajectory took the controller over, and drives elsewhere."""
    driven(robot, DrivePhase.APPROACH, 0.6)
    away = robot.q + 0.5
    robot.coming.clear()
    robot.motion.follow(robot.now_s, [robot.now_s + 2.0], away[None], np.zeros((1, 6)))
    robot.run(0.016)
    at_s = robot.now_s
    words = "the controller ended the motion (-1): preempted"
    robot.driver.reported(MotionReport(ended=True, failed=True, words=words), at_s)
    robot.run(1.0)
    assert "preempted" in robot.driver.told
    assert stood_after_s(robot, at_s) <= SHORTEST_STOP_S + LAG_S + 0.1


def test_an_end_that_is_no_arrival_is_seen(robot):
    """A topic trajectory takes a goal over, and the goal still succeeds."""
    driven(robot, DrivePhase.APPROACH, 0.6)
    robot.motion = AheadMotion(robot.q)
    robot.driver.reported(MotionReport(ended=True), robot.now_s)
    robot.run(3.0, until=lambda: not robot.driver.armed)
    assert robot.outcomes[-1].left_plan


def test_cycles_that_are_computed_ahead_change_nothing():
    """A motion, a stop on its way, and one just after it: to the last bit."""
    plain, ahead = JointMotion(HOME), AheadMotion(HOME)
    sent = {0.304: HOME + 0.3, 1.008: HOME + 0.1, 1.016: HOME, 40.0: HOME + 0.2}
    for now_s in PERIOD_S * np.arange(1, 5300):
        for at_s in [one for one in sent if now_s - PERIOD_S < one <= now_s]:
            for motion in (plain, ahead):
                motion.follow(at_s, [at_s + 1.0], sent[at_s][None], np.zeros((1, 6)))
        assert np.array_equal(ahead.now(now_s), plain.joints(np.array([now_s]))[0]), now_s
