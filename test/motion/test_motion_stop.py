"""Stops: at rest in time from any state of a motion, in its direction, within the limits."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_cell import POSTURES, circle_step, make_motion_cell, tip_in_laser

from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics.inverse import inverse
from robocal_ros.motion.plan import SHORTEST_STOP_S, stop, stop_time
from robocal_ros.tool.driving import measuring, start_pose


def running(robot):
    cell = make_motion_cell(robot)
    step = circle_step(cell)
    q = inverse(cell.arm, start_pose(step, cell.limits)[None], POSTURES[robot])[0]
    return cell, measuring(cell, step, q)


@pytest.mark.parametrize("robot", POSTURES)
def test_a_stop_from_any_state_of_a_circle_is_at_rest_in_time(robot):
    cell, plan = running(robot)
    _, _, deceleration = cell.limits.of_joints(cell.arm)
    for t in np.linspace(0.0, plan.duration_s, 101):
        q, qd = plan.at(t)
        stated = float(stop_time(cell.arm, cell.limits, qd))
        halt = stop(cell.arm, cell.limits, q, qd)
        assert halt.duration_s == stated
        np.testing.assert_array_equal(halt.at(0.0)[0], q)
        np.testing.assert_allclose(halt.at(0.0)[1], qd, atol=1e-15)
        end, rest = halt.at(stated)
        np.testing.assert_allclose(rest, 0.0, atol=1e-12)
        np.testing.assert_array_equal(halt.at(stated + 1.0)[1], 0.0)
        time = np.linspace(0.0, stated, 50)
        slowing = np.diff(halt.at(time)[1], axis=0) / time[1]
        assert np.all(np.abs(slowing) <= deceleration * (1.0 + 1e-6))
        # the tip goes no further than half of its speed times the stop's duration
        gone = np.linalg.norm(tip_in_laser(cell, end) - tip_in_laser(cell, q))
        assert gone <= 0.5 * 0.05 * stated * 1.02 + 1e-9


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_a_stop_keeps_its_direction_and_the_limits(seed):
    rng = np.random.default_rng(seed)
    cell = make_motion_cell("kr150_r3100")
    arm = cell.arm
    qd = rng.uniform(-1.0, 1.0, 6)
    # as close to the limits as the shortest stop allows
    room = 0.5 * SHORTEST_STOP_S * np.abs(qd)
    share = rng.choice([0.0, 1.0, 0.5], 6)
    q = arm.lower + room + share * (arm.upper - arm.lower - 2.0 * room)
    halt = stop(arm, cell.limits, q, qd)
    assert halt.duration_s <= stop_time(arm, cell.limits, qd)
    joints, velocity = halt.at(np.linspace(0.0, halt.duration_s, 50))
    assert np.all((joints >= arm.lower - 1e-9) & (joints <= arm.upper + 1e-9))
    np.testing.assert_allclose(velocity, np.linspace(1.0, 0.0, 50)[:, None] * qd, atol=1e-9)


def test_a_joint_beyond_its_limit_is_stopped_as_fast_as_can_be():
    cell = make_motion_cell("ur10")
    q = POSTURES["ur10"]
    arm = replace(cell.arm, upper=np.append(cell.arm.upper[:5], q[5] - 0.01))
    halt = stop(arm, cell.limits, q, 0.5 * np.eye(6)[5])
    assert halt.duration_s == SHORTEST_STOP_S
    assert np.all(np.isfinite(halt.q))


def test_a_robot_at_rest_stays():
    cell = make_motion_cell("ur10")
    halt = stop(cell.arm, cell.limits, POSTURES["ur10"], np.zeros(6))
    np.testing.assert_array_equal(halt.q, np.tile(POSTURES["ur10"], (2, 1)))
    assert halt.duration_s == SHORTEST_STOP_S


def test_a_stop_from_unknown_joints_is_refused():
    cell = make_motion_cell("ur10")
    with pytest.raises(InputError, match="not finite"):
        stop(cell.arm, cell.limits, np.full(6, np.nan), np.zeros(6))
