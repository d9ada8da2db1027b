# SPDX-License-Identifier: Apache-2.0
"""What a joint trajectory controller does: the real one, and the simulated one in its place.

Each test runs against both, judged by the commands that they say they send. The real one, of
ros2_control, is looked for in the environment; without it those tests are skipped.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from control_msgs.msg import JointTolerance
from jumps import no_jump
from long_form import more
from trajectory_controllers import (
    CONTROLLERS,
    HOME,
    NAMES,
    PERIOD_S,
    Controlled,
    seconds,
    trajectory,
)

from robocal_ros.cell_sim.trajectory_controller import SampledPath, Trajectory

pytestmark = pytest.mark.cell  # in real time: what starves the controller is seen in its commands

REST = np.zeros(6)
STEP = np.array([1.0, 0.3, -0.2, 0.5, -0.4, 0.1])
ABORTED, CANCELED, SUCCEEDED = (
    GoalStatus.STATUS_ABORTED,
    GoalStatus.STATUS_CANCELED,
    GoalStatus.STATUS_SUCCEEDED,
)


@pytest.fixture(params=CONTROLLERS)
def start(request: Any, graph: Any, tmp_path: Any) -> Any:
    """Starts a controller of a kind, with ``velocities`` or without, and with its parameters."""

    def started(velocities: bool = True, **parameters: Any) -> Controlled:
        controlled = CONTROLLERS[request.param](graph, tmp_path, velocities, **parameters)
        controlled.wait()
        return controlled

    return started


@pytest.fixture(scope="module", params=CONTROLLERS)
def lasting(request: Any, next_graph: Any, tmp_path_factory: Any) -> Callable[[bool], Controlled]:
    """Gives one whose hardware has velocities, to all who need not begin with it; or a new one."""
    kept: list[Controlled] = []

    def given(anew: bool) -> Controlled:
        if anew or not kept:
            folder = tmp_path_factory.mktemp(request.param)
            kept[:] = [CONTROLLERS[request.param](next_graph(), folder, True)]
            kept[0].wait()
        return kept[0]

    return given


@pytest.fixture
def controller(lasting: Callable[[bool], Controlled]) -> Controlled:
    """The lasting one, at home, with its speed."""
    controlled = lasting(False)
    try:
        if controlled.states[-1].speed_scaling_factor != 1.0:
            controlled.scale(1.0)
        controlled.end(controlled.goal(trajectory([(0.5, HOME, REST)])))
        assert controlled.stands() == pytest.approx(HOME, abs=1e-9)
    except (AssertionError, pytest.fail.Exception):  # it is as a test that failed left it
        controlled = lasting(True)
    del controlled.states[:-3], controlled.readings[:-3]
    return controlled


def on_the_way(controller: Controlled, duration_s: float = 2.0) -> float:
    """A motion has begun; the stamp."""
    controller.send(trajectory([(duration_s, HOME + STEP, REST)]))
    controller.moved(0.3)
    return controller.now_s


# ---- what it says --------------------------------------------------------------------------------


@pytest.mark.parametrize("velocities", [False, True])
def test_states_are_by_alphabet_and_have_what_the_hardware_has(start, velocities):
    controller = start(velocities)
    reading, state = controller.readings[-1], controller.states[-1]
    assert list(reading.name) == sorted(NAMES)
    assert np.all(np.isnan(reading.effort))
    assert len(reading.velocity) == 6
    assert np.all(np.isnan(reading.velocity)) == (not velocities)
    by_name = dict(zip(reading.name, reading.position, strict=True))
    assert [by_name[name] for name in NAMES] == pytest.approx(HOME, abs=1e-9)
    assert list(state.joint_names) == NAMES
    assert len(state.feedback.velocities) == len(state.error.velocities) == 6 * velocities
    assert len(state.feedback.accelerations) == 0
    assert len(state.reference.velocities) == len(state.reference.accelerations) == 6
    assert len(state.output.positions) == 6
    assert len(state.output.velocities) == 0
    assert state.speed_scaling_factor == 1.0


@pytest.mark.parametrize("rows", [3, *more(1, 2)])  # quintics; lines and cubics
def test_it_goes_between_points_as_the_polynomials_do(controller, rows):
    rng = np.random.default_rng(rows)
    time = np.array([0.2, 0.5, 0.6, 1.0])
    q = HOME + 0.2 * rng.standard_normal((4, 6))
    rates = [0.5 * rng.standard_normal((4, 6)), rng.standard_normal((4, 6))][: rows - 1]
    for rate in rates:
        rate[-1] = 0.0
    begin_s = controller.now_s
    controller.send(trajectory(zip(time, q, *rates, strict=True)))
    controller.moved(0.01)
    assert controller.stands() == pytest.approx(q[-1], abs=1e-9)
    path = SampledPath(Trajectory.of(tuple(NAMES), time, q, *rates), 0.0, HOME, REST)
    states = [m for m in controller.states if seconds(m.header.stamp) > begin_s]
    times = [seconds(m.reference.time_from_start) for m in states]
    begins = np.flatnonzero(np.diff(times) < 0.0)  # before it the time is that of standing there
    first = int(begins[-1]) + 1 if len(begins) else 0
    # where two polynomials meet a microsecond tells which of them was gone by
    apart = [np.min(np.abs(np.array([0.0, *time]) - at)) for at in times]
    inside = [i for i in range(first, len(times)) if 0.0 < times[i] < 1.0 and apart[i] > 1e-3]
    wanted, wanted_speed, *_ = path.sample(np.array([times[i] for i in inside]))
    found = np.array([states[i].reference.positions for i in inside])
    speed = np.array([states[i].reference.velocities for i in inside])
    assert len(inside) > 40  # of a hundred; a busy machine leaves some out
    assert np.max(np.abs(found - wanted)) < 1e-6
    assert np.max(np.abs(speed - wanted_speed)) < 1e-4
    ahead, *_ = path.sample(np.array([times[i] + PERIOD_S for i in inside]))
    sent = np.array([states[i].output.positions for i in inside])
    assert np.max(np.abs(sent - ahead)) < 1e-6  # where the robot shall be a cycle later


# ---- stop, replace, jump -------------------------------------------------------------------------


@pytest.mark.parametrize("names", [NAMES, []])
def test_an_empty_trajectory_stops_nothing(controller, names):
    on_the_way(controller)
    controller.topic.publish(trajectory([], names))
    assert not controller.goal(trajectory([], names)).accepted
    assert controller.stands() == pytest.approx(HOME + STEP, abs=1e-9)


def test_a_point_at_time_0_makes_the_command_jump(controller):
    begin_s = on_the_way(controller) - 0.05
    controller.send(trajectory([(0.0, HOME, REST), (1.0, HOME, REST)]))
    assert controller.stands() == pytest.approx(HOME, abs=1e-9)
    _, sent = controller.sent(begin_s)
    steps = np.diff(sent[:, 0])
    assert np.min(steps) < -0.25  # back home within a cycle or two
    assert np.sum(steps < -0.05) <= 2


def test_a_start_in_the_past_leaves_less_time_for_the_way(controller):
    begin_s = controller.now_s
    controller.send(trajectory([(2.0, HOME + STEP)], stamp_s=begin_s - 1.0))
    controller.moved(0.2)
    assert controller.stands() == pytest.approx(HOME + STEP, abs=1e-9)
    # The way to the first point begins where the robot is, and is gone in the time that is left.
    _, speed = controller.speeds(begin_s)
    assert np.max(speed[:, 0]) == pytest.approx(1.0, rel=0.1)


def test_points_in_the_past_are_left_out_with_a_jump(controller):
    begin_s = controller.now_s
    points = [(0.0, HOME, REST), (2.0, HOME + STEP, REST)]
    controller.send(trajectory(points, stamp_s=begin_s - 1.0))
    controller.moved(0.3)
    assert controller.stands() == pytest.approx(HOME + STEP, abs=1e-9)
    assert np.max(np.diff(controller.sent(begin_s)[1][:, 0])) > 0.4  # half of the way at once


@pytest.mark.parametrize("velocities", [False, True])
def test_a_first_point_ahead_of_now_begins_where_the_robot_is(start, velocities):
    """With the speed that the hardware reports; hardware without any is taken to stand."""
    controller = start(velocities)
    begin_s = on_the_way(controller) - 0.05
    controller.send(trajectory([(0.5, HOME + 0.6 * STEP, REST)]))
    assert controller.stands() == pytest.approx(HOME + 0.6 * STEP, abs=1e-9)
    _, speed = controller.speeds(begin_s)
    no_jump(np.abs(speed) < 2.0, "0.05 rad in a cycle would be 12 rad/s")
    times = [seconds(m.reference.time_from_start) for m in controller.states]
    taken = 1 + max(i for i, change in enumerate(np.diff(times)) if change < -0.1)
    first = [m for m, at in zip(controller.states[taken:], times[taken:], strict=True) if at < 0.05]
    slowest = min(m.reference.velocities[0] for m in first)
    assert slowest > 0.4 if velocities else slowest < 0.3  # it went at about 0.7 rad/s


def test_the_last_command_may_be_the_begin(start):
    controller = start(False, interpolate_from_desired_state=True)
    begin_s = on_the_way(controller) - 0.05
    controller.send(trajectory([(0.5, HOME + 0.6 * STEP, REST)]))
    assert controller.stands() == pytest.approx(HOME + 0.6 * STEP, abs=1e-9)
    time, speed = controller.speeds(begin_s)
    first = speed[time < begin_s + 0.1, 0]
    assert np.min(first) > 0.4  # it does not stop
    assert np.max(np.abs(np.diff(first))) < 1.0  # for a cycle it goes twice as fast


def test_accelerations_without_velocities_command_zero(controller):
    begin_s = controller.now_s
    controller.send(trajectory([(0.3, HOME, None, REST), (0.6, HOME, None, REST)]))
    controller.graph.spin_until(lambda: controller.now_s > begin_s + 1.0, "it is over")
    _, sent = controller.sent(begin_s)
    assert np.min(np.max(np.abs(sent), axis=1)) == 0.0
    assert sent[-1] == pytest.approx(HOME, abs=1e-9)


# ---- goals ---------------------------------------------------------------------------------------


def test_what_goals_are_rejected(controller):
    there = HOME + STEP
    moving = np.full(6, 0.1)
    with_efforts = trajectory([(1.0, there, REST)])
    with_efforts.points[0].effort = [0.0] * 6
    for message in (
        trajectory([(1.0, there[:5], REST[:5])], NAMES[:5]),
        trajectory([(1.0, there, REST)], [*NAMES[:5], "no_joint"]),
        trajectory([(1.0, there, moving)]),
        trajectory([(1.0, there, REST), (1.0, there, REST)]),
        trajectory([(1.0, there, REST)], stamp_s=controller.now_s - 5.0),
        trajectory([(1.0, there[:5], REST)]),
        trajectory([(1.0, there, REST[:5])]),
        with_efforts,
    ):
        assert not controller.goal(message).accepted
    controller.graph.spin_for(0.2)
    assert controller.q == pytest.approx(HOME, abs=1e-9)


def test_some_of_the_joints_may_be_allowed(start):
    controller = start(True, allow_partial_joints_goal=True)
    handle = controller.goal(trajectory([(0.5, [HOME[1] + 0.2], [0.0])], NAMES[1:2]))
    assert controller.end(handle) == (SUCCEEDED, 0)
    assert controller.stands() == pytest.approx(HOME + 0.2 * np.eye(6)[1], abs=1e-9)


def test_a_last_velocity_may_be_allowed(start):
    """At the end the command stands, whatever the speed there."""
    controller = start(True, allow_nonzero_velocity_at_trajectory_end=True)
    handle = controller.goal(trajectory([(0.5, HOME + STEP, np.full(6, 0.5))]))
    assert controller.end(handle) == (SUCCEEDED, 0)
    assert controller.stands() == pytest.approx(HOME + STEP, abs=1e-9)


def test_the_joint_that_is_missing_for_one_named_twice_goes_elsewhere(start):
    """To what was sorted last in its place, be it a position, a velocity or an effort."""
    controller = start()
    twice, there = [NAMES[0], NAMES[0], *NAMES[2:]], HOME + 0.2 * STEP
    values = [there[0], HOME[0] + 0.1, *there[2:]]  # the last one counts

    def stands_with(missing: float) -> None:
        wanted = [values[1], missing, *there[2:]]
        assert controller.stands() == pytest.approx(wanted, abs=1e-9)

    for missing in (HOME[1], 0.0):  # positions held since the start; efforts after a success
        handle = controller.goal(trajectory([(0.5, values)], twice))
        assert controller.end(handle) == (SUCCEEDED, 0)
        stands_with(missing)
    controller.send(trajectory([(0.5, there)]))
    controller.moved(0.01, controller.q)
    assert controller.stands() == pytest.approx(there, abs=1e-9)
    controller.send(trajectory([(0.5, values, REST)], twice))
    controller.moved(0.01, there)
    stands_with(there[1])
    last = controller.states[-1].reference.velocities
    assert last == pytest.approx([0.0, there[1], 0.0, 0.0, 0.0, 0.0])  # a position as rad/s
    controller.send(trajectory([(0.5, there, REST)]))
    controller.moved(0.01, controller.q)
    assert controller.stands() == pytest.approx(there, abs=1e-9)
    controller.send(trajectory([(0.5, values)], twice))
    controller.moved(0.01, there)
    stands_with(0.0)  # after velocities


def test_limits_are_not_looked_at(controller):
    handle = controller.goal(trajectory([(0.2, HOME + 9.0, REST)]))
    assert controller.end(handle) == (SUCCEEDED, 0)
    assert controller.stands() == pytest.approx(HOME + 9.0, abs=1e-9)


def test_a_goal_ends_when_its_robot_is_there(controller):
    begin_s = controller.now_s
    handle = controller.goal(trajectory([(1.0, HOME + STEP, REST)]))
    assert controller.end(handle) == (SUCCEEDED, 0)
    ended_s = time.time()
    assert controller.stands() == pytest.approx(HOME + STEP, abs=1e-9)
    at_s, sent = controller.sent(begin_s)
    arrived_s = at_s[np.max(np.abs(sent - HOME - STEP), axis=1) < 1e-9][0]
    assert 1.0 - PERIOD_S < arrived_s - begin_s < 1.5  # commanded a cycle ahead
    assert arrived_s - PERIOD_S < ended_s < arrived_s + 0.5


def test_another_goal_aborts_the_one_before_it(controller):
    first = controller.goal(trajectory([(2.0, HOME + STEP, REST)]))
    controller.moved(0.3)
    second = controller.goal(trajectory([(0.6, HOME, REST)]))
    assert controller.end(first) == (ABORTED, -1)
    assert controller.end(second) == (SUCCEEDED, 0)
    assert controller.stands() == pytest.approx(HOME, abs=1e-9)


def test_a_topic_takes_a_goal_over_and_it_still_succeeds(controller):
    handle = controller.goal(trajectory([(1.5, HOME + STEP, REST)]))
    controller.moved(0.3)
    controller.send(trajectory([(0.6, HOME, REST)]))
    assert controller.end(handle) == (SUCCEEDED, 0)
    assert controller.stands() == pytest.approx(HOME, abs=1e-9)


def test_a_cancel_is_a_hard_stop_where_the_robot_is(controller):
    begin_s = controller.now_s
    handle = controller.goal(trajectory([(2.0, HOME + STEP, REST)]))
    controller.moved(0.3)
    future = handle.cancel_goal_async()
    assert controller.end(handle) == (CANCELED, 0)
    assert future.done()
    assert 0.25 < controller.stands()[0] - HOME[0] < 0.6
    _, speed = controller.speeds(begin_s)
    fastest = int(np.argmax(speed[:, 0]))
    slowing = speed[fastest:, 0]
    assert np.sum((slowing > 0.05) & (slowing < 0.9 * slowing[0])) <= 2  # at once


def test_a_path_tolerance_refuses_a_jump(controller):
    tolerances = [JointTolerance(name=name, position=0.05) for name in NAMES]
    message = trajectory([(0.0, HOME + STEP, REST), (1.0, HOME + STEP, REST)])
    handle = controller.goal(message, path_tolerance=tolerances)
    assert controller.end(handle) == (ABORTED, -4)
    assert controller.stands() == pytest.approx(HOME, abs=1e-9)


# ---- speed scaling -------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [0.5, *more(0.2)])
def test_a_scaled_motion_takes_longer(controller, factor):
    controller.scale(factor)
    begin_s = controller.now_s
    handle = controller.goal(trajectory([(0.5, HOME + STEP, REST)]))
    assert controller.end(handle) == (SUCCEEDED, 0)
    assert controller.stands() == pytest.approx(HOME + STEP, abs=1e-9)
    moving = [
        (seconds(m.header.stamp), seconds(m.reference.time_from_start))
        for m in controller.states
        if seconds(m.header.stamp) > begin_s and 0.0 < seconds(m.reference.time_from_start) < 0.5
    ]
    passed = np.diff(moving, axis=0)  # a busy machine leaves cycles out: the usual one counts
    assert np.median(passed[:, 1] / passed[:, 0]) == pytest.approx(factor, rel=0.02)
    assert moving[-1][0] - moving[0][0] > 0.45 / factor
    middle = [m for m in controller.states if 0.2 < seconds(m.reference.time_from_start) < 0.3]
    assert np.max([m.reference.velocities[0] for m in middle]) == pytest.approx(3.0, rel=0.05)


def test_a_scale_of_0_halts_and_keeps_the_goal(controller):
    handle = controller.goal(trajectory([(1.0, HOME + STEP, REST)]))
    controller.moved(0.3)
    controller.scale(0.0)
    result = handle.get_result_async()
    halted = controller.stands()
    assert halted[0] < HOME[0] + 0.9
    controller.graph.spin_for(1.0)
    assert not result.done()
    assert controller.q == pytest.approx(halted, abs=1e-9)
    controller.scale(1.0)
    controller.graph.spin_until(result.done, "it ends")
    assert result.result().status == SUCCEEDED
    assert controller.stands() == pytest.approx(HOME + STEP, abs=1e-9)
