# SPDX-License-Identifier: Apache-2.0
"""Stops of what was put out, on controllers as they are: judged by each cycle of their command."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from correction_robot import HOME, NAMES, NOMINAL, Robot

from robocal_ros.cell_sim.trajectory_controller import (
    CYCLE_S,
    LAG_S,
    ControllerOptions,
    JointMotion,
    Trajectory,
)
from robocal_ros.correction.interface import TrajectoryCommand
from robocal_ros.correction.node import FIRST_S
from robocal_ros.correction.robot_state import RobotState
from robocal_ros.correction.trajectories import AHEAD_S, on_its_path
from robocal_ros.kinematics.robots import load_description
from robocal_ros.motion.cell import DrivingConfig, Housing
from robocal_ros.motion.driver import COPIES, COPY_S, StatedController
from robocal_ros.motion.plan import LEAD_S, MotionLimits, stop
from robocal_ros.motion.robot_watch import STANDS_S, Lateness, RobotWatch
from robocal_ros.motion.stopping import WatchedStop

SPEED = 1.0  # rad/s of the first joint
BRAKES = load_description("kr150_r3100").max_acceleration[0]
REACTION_S = 0.01
STATES_S = 0.008
T = np.linspace(0.0, 5.0, 501)
RATE = SPEED * np.clip(np.minimum(T, 5.0 - T) / 0.5, 0.0, 1.0)
WAY = np.concatenate([[0.0], np.cumsum(0.5 * (RATE[1:] + RATE[:-1]) * np.diff(T))])
Q, QD = np.tile(HOME, (len(T), 1)), np.zeros((len(T), 6))
Q[:, 0], QD[:, 0] = HOME[0] - 2.0 + WAY, RATE


class Driven:
    """The session of a robot that drives, 2 s on its way, on a simulated controller.

    What it tells since ``waits_s`` waits for a busy node, which now takes the first of it.
    """

    def __init__(
        self,
        velocities: bool,
        lag_s: float,
        told: bool,
        waits_s: float = 0.0,
        *,
        stamps: bool = True,
    ) -> None:
        self.robot, self.velocities, self.stamps = Robot(), velocities, stamps
        robot = self.robot
        robot.at = Q[0]
        robot.rest()
        self.begin_s = robot.now
        robot.session.trajectory(TrajectoryCommand(NAMES, Q, T, QD), robot.now)
        robot.session.output.path.begin(robot.now)
        options = ControllerOptions(velocity_states=velocities)
        self.motion = JointMotion(Q[0], names=NAMES, options=options, lag_s=lag_s)
        self.motion.take(REACTION_S, Trajectory.of(NAMES, T[1:], Q[1:], QD[1:]))
        self.stated, self.lateness = StatedController(), Lateness("joint states")
        self.state = RobotState(NOMINAL, 0.2, np.full(6, 3.5e-4))
        self.state.told = lambda now: self.stated.reference(NAMES, now)
        for at_s in np.arange(1.6, 2.0 - waits_s, STATES_S):
            self.pass_to(float(at_s), told)
        if waits_s:
            self.pass_to(2.0 - waits_s, told, waits_s)
        robot.now = self.begin_s + 2.0

    def pass_to(self, at_s: float, told: bool, waits_s: float = 0.0) -> None:
        """Until then; the controller tells its state, and the joints theirs."""
        self.motion.pass_to(at_s)
        q, qd, _, _, desired, rate, _ = self.motion.last()[1]
        now_s, state = self.begin_s + at_s + waits_s, np.floor(at_s / CYCLE_S + 1e-9) * CYCLE_S
        late_s = self.lateness.take(at_s, now_s)
        speeds = qd if self.velocities else np.full(6, np.nan)
        self.state.read(np.arange(6), q, now_s, velocity=speeds, late_s=late_s)
        if told:
            stamp = SimpleNamespace(sec=int(state), nanosec=round(state % 1 * 1e9))
            stamp = stamp if self.stamps else Time()
            self.stated.take(
                SimpleNamespace(
                    header=SimpleNamespace(stamp=stamp),
                    joint_names=list(NAMES),
                    feedback=SimpleNamespace(velocities=qd if self.velocities else []),
                    reference=SimpleNamespace(positions=desired, velocities=rate),
                ),
                now_s,
            )
        else:
            self.stated.hear(speeds, 6, now_s)

    def takes(self, message: Any, late_s: float) -> None:
        """Take a stop so late."""
        stamp_s = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        points = message.points
        times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in points]
        speeds = [p.velocities for p in points] if points[0].velocities else None
        places = [p.positions for p in points]
        given = Trajectory.of(message.joint_names, times, places, speeds, start_s=stamp_s or None)
        self.motion.take(2.0 + late_s, given)
        self.motion.pass_to(2.0 + late_s)

    def obeys(self, message: Any, late_s: float) -> np.ndarray:
        """The same; the speed of the command in each cycle, from just before."""
        self.takes(message, late_s)
        self.motion.pass_to(3.5)
        rows = self.motion._rows[: self.motion._count - self.motion._begin]
        return np.diff(rows[round(1.9 / CYCLE_S) :, 2, 0]) / CYCLE_S


def by_its_path(driven: Driven, late_s: float) -> tuple[np.ndarray, bool]:
    """For a trajectory without points, a lease, a deactivation."""
    session, now_s = driven.robot.session, driven.robot.now
    path = session.output.path
    planned = session.stop(now_s, AHEAD_S)
    plan = on_its_path(path, planned, now_s)
    message = driven.stated.stop_message(plan, planned.names, now_s, at_s=AHEAD_S, first_s=FIRST_S)
    return driven.obeys(message, late_s), bool(message.header.stamp.sec)


def by_readings(driven: Driven, late_s: float) -> tuple[np.ndarray, bool]:
    """Of a robot that is elsewhere than its path, or drives on."""
    now_s, brakes = driven.robot.now, load_description("kr150_r3100").max_acceleration
    stopping = WatchedStop(NOMINAL, MotionLimits(stop_deceleration=brakes))
    plan = stopping.begin(driven.state.to_stop(now_s), now_s).going_on(REACTION_S)
    message = driven.stated.stop_message(plan, NAMES, now_s, first_s=FIRST_S)
    return driven.obeys(message, late_s), bool(message.header.stamp.sec)


STOPS = [by_its_path, by_readings]


def even_change(velocities: bool) -> float:
    """Of the command's speed in a cycle, by a stop that is not stamped.

    A cubic makes up for a cycle. The first line, `FIRST_S` long, has the mean speed of its way,
    less where it is a cycle late, the next one that of 10 ms further on.
    """
    lines = 0.5 * BRAKES * (FIRST_S + 0.01) + SPEED * CYCLE_S / FIRST_S
    return 3.0 * BRAKES * CYCLE_S if velocities else lines


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("lag_s", [0.0, LAG_S])
def test_a_stop_on_a_controller_that_tells_its_reference_never_steps(stop, velocities, lag_s):
    """Finding: the command went back at 2.5 and 3.4 rad/s for a cycle, and stood for one."""
    for late_s in (0.008, 0.02, 0.05) if stop is by_its_path else (0.008,):
        speed, stamped = stop(Driven(velocities, lag_s, told=True), late_s)
        assert stamped
        assert np.min(speed) > -1e-3
        assert np.max(speed) < SPEED + 1e-3
        # The robot brakes as it may. From readings it begins to 10 ms after they came, and what is
        # taken up to a cycle later has a second cycle's braking to do in the first one.
        cycles = 1.05 if stop is by_its_path else 2.0
        assert np.max(np.abs(np.diff(speed))) < cycles * BRAKES * CYCLE_S
        assert speed[-1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("velocities", [True, False])
def test_by_states_without_a_stamp_no_stop_is_stamped(velocities, stop):
    """Finding: it began by a clock at 0, at -1 s even, and the controller rejected it."""
    speed, stamped = stop(Driven(velocities, 0.0, told=True, stamps=False), 0.008)
    assert not stamped
    assert np.min(speed) > -1e-3
    assert np.max(np.abs(np.diff(speed))) < even_change(velocities)
    assert speed[-1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("waits_s", [0.04, 0.1, 0.2])
def test_a_stop_by_what_a_busy_node_took_late_never_goes_back(waits_s, told, velocities, stop):
    """Finding: states and readings that had waited looked new; the command stepped by 34 rad/s."""
    speed, stamped = stop(Driven(velocities, 0.0, told, waits_s), 0.008)
    assert stamped is (told and waits_s < 0.05)
    assert np.min(speed) > -1e-3
    assert np.max(np.abs(np.diff(speed))) < even_change(velocities)
    assert speed[-1] == pytest.approx(0.0, abs=1e-9)


def test_from_readings_that_are_too_late_no_stop_is_planned():
    """It is stopped by its path, which it counts as following."""
    driven = Driven(True, 0.0, True, waits_s=0.3)
    session, now_s = driven.robot.session, driven.robot.now
    assert driven.state.to_stop(now_s) is None
    assert driven.state.follows(session.output.path, now_s)
    assert driven.stated.reference(NAMES, now_s) is None


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("velocities", [True, False])
def test_without_its_reference_a_stop_steps_by_no_more_than_the_drives_lag(stop, velocities):
    """Any trajectory that is not stamped begins where the drives are: that is the controller's."""
    speed, stamped = stop(Driven(velocities, 0.0, told=False), 0.008)
    assert not stamped
    assert np.min(speed) > -1e-3
    even = even_change(velocities)
    assert np.max(np.abs(np.diff(speed))) < even
    speed, _ = stop(Driven(velocities, LAG_S, told=False), 0.008)
    back = SPEED * LAG_S / CYCLE_S  # in one cycle
    even += 6.0 * SPEED * LAG_S / FIRST_S**2 * CYCLE_S  # a cubic that makes up for the lag
    assert np.min(speed) > SPEED - back - even
    assert np.max(np.abs(np.diff(speed))) < back + even
    assert np.max(np.abs(np.diff(speed))) > 0.9 * back  # no sender can help it


def own_stop(driven: Driven, deceleration: float, taken: Any) -> tuple[float, np.ndarray]:
    """Length of an own stop, and the command's speed, where these of its copies arrive."""
    q, qd = driven.motion.last()[1][4:6]
    planned = stop(NOMINAL, MotionLimits(stop_deceleration=deceleration), q, qd)
    plan, messages = planned.going_on(REACTION_S), []
    for number in range(COPIES):
        at_s = number * COPY_S
        if not number or not messages[0].header.stamp.nanosec:
            messages.append(driven.stated.stop_message(plan, NAMES, driven.robot.now, at_s=at_s))
    for number in taken[:-1]:
        driven.takes(messages[min(number, len(messages) - 1)], 0.008 + number * COPY_S)
    last = messages[min(taken[-1], len(messages) - 1)]
    return planned.duration_s, driven.obeys(last, 0.008 + taken[-1] * COPY_S)


@pytest.mark.parametrize("over_s", [-0.11, -0.1, -0.09, -0.075, -0.06])
def test_a_stop_in_lines_slows_down_where_its_plan_was_ready_late(over_s):
    """Finding: on a busy computer it was one line to where the robot is to stand."""
    driven = Driven(False, 0.0, told=False)
    q, qd = driven.motion.last()[1][4:6]
    plan = stop(NOMINAL, MotionLimits(stop_deceleration=5.0), q, qd).going_on(REACTION_S)
    at_s = plan.duration_s - REACTION_S + over_s
    message = driven.stated.stop_message(plan, NAMES, 0.0, at_s=at_s, first_s=FIRST_S)
    times = np.array([p.time_from_start.nanosec * 1e-9 for p in message.points])
    places = np.array([p.positions for p in message.points])[:, 0]
    speeds = np.diff(places) / np.diff(times)
    assert times[0] >= LEAD_S - 1e-9
    assert times[-1] == pytest.approx(-over_s, abs=1e-8)
    assert len(speeds) >= 2
    assert np.all(np.diff(np.abs(speeds)) < 0.0)


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("over_s", [-0.02, 0.0, 0.3])
def test_a_stop_that_is_sent_when_it_should_be_over_is_no_step(over_s, velocities):
    """Finding: what is at time 0 or before, a controller takes in one cycle."""
    driven = Driven(velocities, 0.0, told=False)
    q, qd = driven.motion.last()[1][4:6]
    plan = stop(NOMINAL, MotionLimits(stop_deceleration=5.0), q, qd).going_on(REACTION_S)
    at_s = plan.duration_s + over_s
    message = driven.stated.stop_message(plan, NAMES, driven.robot.now, at_s=at_s)
    points = message.points
    assert points[0].time_from_start.nanosec * 1e-9 == pytest.approx(LEAD_S)
    assert points[-1].positions == pytest.approx(plan.q[-1])
    # a cubic that begins at the robot's speed and ends at rest
    most = max(SPEED, 1.5 * np.max(np.abs(plan.q[-1] - q)) / LEAD_S)
    assert np.max(np.abs(driven.obeys(message, 0.0))) <= most * 1.01


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("deceleration", [20.0, 5.0, 2.0])
def test_a_stop_that_is_lost_twice_ends_as_it_was_planned(deceleration, told, velocities):
    """Whatever its length: each copy is of the same plan at its own time."""
    for lost in range(COPIES):
        lag_s = LAG_S if told else 0.0
        duration_s, speed = own_stop(Driven(velocities, lag_s, told), deceleration, [lost])
        moves_s = CYCLE_S * (1 + np.flatnonzero(np.abs(speed) > 1e-6)[-1]) - 0.1
        assert moves_s <= 1.5 * duration_s
        # Where it begins before it arrives, and from a drive's place, up to two cycles in one.
        assert moves_s <= REACTION_S + duration_s + 0.008 + 2.0 * CYCLE_S
        assert np.min(speed) > -1e-3
        assert np.max(speed) < SPEED * (1.0 if told else 1.2) + 1e-3


@pytest.mark.parametrize("velocities", [True, False])
def test_a_stamped_stop_that_comes_three_times_is_one(velocities):
    once = own_stop(Driven(velocities, LAG_S, told=True), 5.0, [0])
    thrice = own_stop(Driven(velocities, LAG_S, told=True), 5.0, [0, 1, 2])
    assert thrice[1] == pytest.approx(once[1], abs=1e-9)


def test_a_stop_that_a_pausing_controller_is_seen_to_take_is_over():
    """Of own motions: the watch takes the controller's word for it."""
    robot = RobotWatch(NOMINAL, DrivingConfig(Housing(0.06, 0.03, -0.12, 0.05), 0.1, 0.008, 0.05))
    stopping, controller = WatchedStop(NOMINAL, MotionLimits()), StatedController()
    state = SimpleNamespace(joint_names=NAMES, header=SimpleNamespace(stamp=Time()))
    state.feedback = SimpleNamespace(velocities=np.zeros(6))
    for number in range(200):
        now_s = number * CYCLE_S
        robot.scaled(float(number == 0), now_s)
        robot.reading(now_s, HOME, now_s)
        robot.silence.look(now_s)
        qd = 0.3 * np.eye(6)[0] * (number < 100)  # unscaled
        robot.controller(HOME, qd, now_s)
        state.reference = SimpleNamespace(positions=HOME, velocities=qd)
        state.speed_scaling_factor = robot.scaling
        controller.take(state, now_s)
        robot.held_s = controller.held_s
        if number == 60:
            stopping.begin((HOME, np.zeros(6)), now_s)
        stopping.look(robot, now_s)
        if not 100 <= number <= 100 + np.ceil(STANDS_S / CYCLE_S):
            assert stopping.under_way is (60 <= number < 100)
