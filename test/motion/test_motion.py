# SPDX-License-Identifier: Apache-2.0
"""Circles, plunges, approaches: where they begin, how they run, what they are refused for."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_cell import (
    OPENING,
    POSTURES,
    TOOL,
    circle_step,
    instants,
    make_motion_cell,
    plunge_step,
    shifted,
    tip_in_laser,
    upright,
)

from robocal_ros.cell_sim.beams import beams_of
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, LimitError
from robocal_ros.kinematics.arm import inverse
from robocal_ros.motion.plan import MotionLimits, Ride, ramp_of
from robocal_ros.tool.driving import approach, measuring, start_pose
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.run import MeasuringPlan, PlannedStep

ROBOTS = pytest.mark.parametrize("robot", POSTURES)
MICROMETRE = 1e-6


def turn_s(step: PlannedStep, limits: MotionLimits) -> tuple[float, float]:
    """Begin and end of a circle's turn at constant speed, s from the start of its plan."""
    begin = ramp_of(step.speed_m_s, limits.tcp_acceleration_m_s2)
    return begin, begin + 2.0 * np.pi * step.radius_m / step.speed_m_s


def started(cell, step, robot):
    """Joints exactly where a step begins."""
    return inverse(cell.arm, start_pose(step, cell.limits)[None], POSTURES[robot])[0]


def above(cell, robot, by_laser):
    """Joints with the tool upright, its tip off the crossing."""
    way = np.linspace(0.0, 1.0, 50)[:, None] * by_laser
    T = np.stack([shifted(cell, upright(cell, 0.0), shift) for shift in way])
    return inverse(cell.arm, T, POSTURES[robot])[-1]


def require_kept(cell, plan, speed_m_s):
    """No limit is exceeded by finite differences over a fine grid, nor is the plan at rest late."""
    velocity, acceleration, _ = cell.limits.of_joints(cell.arm)
    time = instants(plan, 5e-4)
    q, qd = plan.at(time)
    dt = time[1]
    assert np.all(np.abs(np.diff(q, axis=0)) / dt <= velocity * (1.0 + 1e-6))
    assert np.all(np.abs(np.diff(qd, axis=0)) / dt <= acceleration * (1.0 + 1e-6))
    tip = tip_in_laser(cell, q)
    assert np.max(np.linalg.norm(np.diff(tip, axis=0), axis=1)) / dt <= speed_m_s * (1.0 + 1e-5)
    assert np.all((q >= cell.arm.lower) & (q <= cell.arm.upper))
    assert np.all(plan.at(plan.duration_s + 1.0)[1] == 0.0)
    for end in (0, -1):
        np.testing.assert_allclose(plan.qd[end], 0.0, atol=1e-12)
        np.testing.assert_allclose(plan.at(plan.time_s[end])[0], plan.q[end], atol=1e-12)


@ROBOTS
@pytest.mark.parametrize("direction", [1, -1])
def test_the_circle_is_round_and_even_between_points_too(robot, direction):
    cell = make_motion_cell(robot)
    step = circle_step(cell, direction=direction)
    plan = measuring(cell, step, started(cell, step, robot))
    require_kept(cell, plan, step.speed_m_s)
    tip = tip_in_laser(cell, plan.at(instants(plan))[0])
    np.testing.assert_allclose(np.hypot(tip[:, 0], tip[:, 1]), step.radius_m, atol=MICROMETRE)
    np.testing.assert_allclose(tip[:, 2], -5e-3, atol=MICROMETRE)
    begin, end = turn_s(step, cell.limits)
    time = np.linspace(begin, end, 2000)
    tip = tip_in_laser(cell, plan.at(time)[0])
    angle = np.unwrap(np.arctan2(tip[:, 1], tip[:, 0]))
    expected = direction * (time - begin) * step.speed_m_s / step.radius_m
    np.testing.assert_allclose(
        step.radius_m * (angle - step.start_rad - expected), 0.0, atol=MICROMETRE
    )
    assert abs(expected[-1]) == pytest.approx(2.0 * np.pi)
    speed = np.linalg.norm(np.diff(tip, axis=0), axis=1) / np.diff(time)
    np.testing.assert_allclose(speed, step.speed_m_s, rtol=1e-4)


@ROBOTS
def test_the_flange_does_not_turn_on_a_circle(robot):
    cell = make_motion_cell(robot)
    step = circle_step(cell)
    plan = measuring(cell, step, started(cell, step, robot))
    R = cell.arm.fk(plan.at(instants(plan))[0])[:, :3, :3]
    np.testing.assert_allclose(R, np.broadcast_to(step.T_base_flange[:3, :3], R.shape), atol=1e-7)


@ROBOTS
def test_the_plunge_is_vertical_and_keeps_its_depth(robot):
    cell = make_motion_cell(robot)
    step = plunge_step(cell)
    plan = measuring(cell, step, started(cell, step, robot))
    require_kept(cell, plan, step.speed_m_s)
    tip = tip_in_laser(cell, plan.at(instants(plan, 1e-4))[0])
    np.testing.assert_allclose(tip[:, :2], 0.0, atol=MICROMETRE)
    assert np.min(tip[:, 2]) == pytest.approx(3.5e-3 - step.depth_m, abs=MICROMETRE)
    assert tip[-1, 2] == pytest.approx(3.5e-3, abs=MICROMETRE)
    speed = np.abs(np.diff(tip[:, 2])) / np.diff(instants(plan, 1e-4))
    assert np.median(speed) == pytest.approx(step.speed_m_s, rel=1e-4)


@ROBOTS
@pytest.mark.parametrize("kind", [circle_step, plunge_step])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=8, deadline=None)
def test_a_segment_begins_where_the_robot_was_measured(robot, kind, seed):
    cell, rng = make_motion_cell(robot), np.random.default_rng(seed)
    step = kind(cell)
    q = started(cell, step, robot) + np.radians(0.019) * rng.uniform(-1.0, 1.0, 6)
    plan = measuring(cell, step, q)
    np.testing.assert_array_equal(plan.q[0], q)
    require_kept(cell, plan, step.speed_m_s)
    # a circle as round, a plunge as upright, only beside the step's own
    tip = tip_in_laser(cell, plan.at(instants(plan))[0])
    np.testing.assert_allclose(tip[-1], _end(cell, step, tip[0]), atol=MICROMETRE)


def _end(cell, step, start):
    """Where a step ends that begins at a tip's place (3,)."""
    if step.kind == "plunge":
        return start
    run = step.speed_m_s * turn_s(step, cell.limits)[0] / step.radius_m  # run-up and run-out
    first, last = step.start_rad - 0.5 * run, step.start_rad + 0.5 * run
    moved = [np.cos(last) - np.cos(first), np.sin(last) - np.sin(first), 0.0]
    return start + step.radius_m * np.array(moved)


@ROBOTS
@given(
    across=st.floats(-0.1, 0.1),
    side=st.floats(-0.1, 0.1),
    height=st.floats(0.0, 0.04),
    turn=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
)
@settings(max_examples=20, deadline=None)
def test_an_approach_goes_over_the_housing(robot, across, side, height, turn):
    cell = make_motion_cell(robot)
    step = circle_step(cell)
    from_pose = shifted(cell, upright(cell, 0.1 + height), [across, side, 0.0])
    from_pose[:3, :3] = from_pose[:3, :3] @ frames.exp_rotation(turn)
    q = _joints_at(cell, from_pose, POSTURES[robot])
    plan = approach(cell, step, q)
    np.testing.assert_array_equal(plan.q[0], q)
    np.testing.assert_allclose(cell.arm.fk(plan.q[-1]), start_pose(step, cell.limits), atol=1e-9)
    require_kept(cell, plan, cell.limits.tcp_speed_m_s)
    joints = plan.at(instants(plan, 5e-3))[0]
    for share in np.linspace(0.0, 1.0, 13):
        z = cell.tool.T_flange_tool[:3, 2]
        point = cell.tool.p_tip - share * cell.tool.length_m * z
        p = tip_in_laser(cell, joints, point)
        beside = np.hypot(p[:, 0], p[:, 1]) > OPENING.clear_radius_m - cell.tool.radius_m
        assert not np.any(beside & (p[:, 2] < OPENING.top_m + cell.tool.radius_m))
        assert np.all(p[:, 2] > OPENING.floor_m + cell.tool.radius_m)
    assert measuring(cell, step, plan.q[-1]).duration_s > 0.0


def _joints_at(cell, T_base_flange, posture):
    start = cell.arm.fk(posture)
    screw = frames.log_rotation(T_base_flange[:3, :3] @ start[:3, :3].T)
    share = np.linspace(0.0, 1.0, 60)[:, None]
    R = frames.exp_rotation(share * screw) @ start[:3, :3]
    p = start[:3, 3] + share * (T_base_flange[:3, 3] - start[:3, 3])
    return inverse(cell.arm, frames.transform(R, p), posture)[-1]


@ROBOTS
def test_to_a_plunge_the_tip_rises_before_it_goes_over_the_beams(robot):
    cell = make_motion_cell(robot)
    q = started(cell, circle_step(cell), robot)
    plan = approach(cell, plunge_step(cell), q)
    require_kept(cell, plan, cell.limits.tcp_speed_m_s)
    tip = tip_in_laser(cell, plan.at(instants(plan))[0])
    beside = np.hypot(*(tip - tip[0])[:, :2].T) > MICROMETRE
    assert np.all(tip[beside, 2] > tip[-1, 2] - MICROMETRE)
    assert np.count_nonzero(beside) > 10


@ROBOTS
def test_from_circle_to_circle_the_tip_goes_straight_within_the_opening(robot):
    cell = make_motion_cell(robot)
    step = plunge_step(cell)
    q = started(cell, step, robot)
    plan = approach(cell, circle_step(cell), q, after_circle=True)
    require_kept(cell, plan, cell.limits.tcp_speed_m_s)
    tip = tip_in_laser(cell, plan.at(instants(plan))[0])
    along = tip[-1] - tip[0]
    off = np.cross(tip - tip[0], along / np.linalg.norm(along))
    assert np.max(np.linalg.norm(off, axis=1)) < MICROMETRE


@ROBOTS
def test_an_approach_from_its_goal_stays_there(robot):
    cell = make_motion_cell(robot)
    step = plunge_step(cell)
    q = started(cell, step, robot)
    plan = approach(cell, step, q)
    assert np.max(np.abs(plan.at(instants(plan))[0] - q)) < 1e-9
    assert plan.duration_s < 0.3


@ROBOTS
@given(
    seed=st.integers(0, 2**32 - 1),
    radius=st.floats(4e-3, 0.04),
    speed=st.floats(5e-3, 0.1),
    start=st.floats(-np.pi, np.pi),
)
@settings(max_examples=25, deadline=None)
def test_any_circle_is_round_to_a_micrometre(robot, seed, radius, speed, start):
    rng = np.random.default_rng(seed)
    posture = POSTURES[robot] + rng.uniform(-0.2, 0.2, 6)
    limits = MotionLimits(joint_velocity=10.0, joint_acceleration=100.0, tcp_speed_m_s=speed)
    roomy = replace(OPENING, clear_radius_m=0.3, floor_m=-0.3)
    cell = make_motion_cell(robot, posture, housing=roomy, limits=limits)
    step = circle_step(cell, radius_m=radius, speed_m_s=speed, start_rad=start)
    plan = measuring(cell, step, _joints_at(cell, start_pose(step, limits), posture))
    assert len(plan.time_s) < 400
    tip = tip_in_laser(cell, plan.at(instants(plan, 2e-3))[0])
    np.testing.assert_allclose(np.hypot(tip[:, 0], tip[:, 1]), radius, atol=MICROMETRE)
    np.testing.assert_allclose(tip[:, 2], -5e-3, atol=MICROMETRE)


def test_a_full_run_is_a_way_of_twelve_seconds_and_a_quick_one_of_four():
    cell = make_motion_cell("ur10")
    x, y = beams_of(cell.T_base_laser, np.pi / 2.0, 0.0)
    laser = LaserFrame(np.array([x.start, x.end, y.start, y.end]))
    np.testing.assert_allclose(laser.T_base_laser, cell.T_base_laser, atol=1e-12)
    bent = TOOL.T_flange_tool.copy()  # what the steps before will have shown
    bent[:3, :3] = bent[:3, :3] @ frames.exp_rotation([0.03, -0.02, 0.0])
    bent[:3, 3] += [2e-3, -3e-3, 1e-3]
    along, across, _ = laser.T_base_laser[:3, :3].T @ cell.arm.fk(_POSTURE)[:3, 0]
    spin = float(np.arctan2(across, along))
    for mode, longest in (("full", 12.0), ("quick", 4.0)):
        run = MeasuringPlan(mode, laser, TOOL.T_flange_tool, spin_rad=spin)
        q, gone = _POSTURE, -approach(cell, run.step(1, bent), _POSTURE).duration_s
        for number in range(1, len(run.names) + 1):
            step = run.step(number, bent)
            after = number > 1 and run.step(number - 1, bent).kind == "circle"
            for plan in (partial(approach, after_circle=after), measuring):
                moved = plan(cell, step, q)
                q, gone = moved.q[-1], gone + moved.duration_s
        assert gone <= longest


_POSTURE = POSTURES["ur10"]


@ROBOTS
def test_points_stay_few(robot):
    cell = make_motion_cell(robot)
    step = circle_step(cell)
    assert len(measuring(cell, step, started(cell, step, robot)).time_s) < 400
    assert len(approach(cell, step, above(cell, robot, [0.1, -0.1, 0.1])).time_s) < 1200


@ROBOTS
def test_slow_joints_make_an_approach_slow_but_not_a_circle(robot):
    slow = MotionLimits(joint_velocity=0.01, joint_acceleration=0.2)
    cell = make_motion_cell(robot, limits=slow)
    step = circle_step(cell)
    q = above(cell, robot, [0.03, 0.03, 0.1])
    plan = approach(cell, step, q)
    require_kept(cell, plan, cell.limits.tcp_speed_m_s)
    assert plan.duration_s > approach(make_motion_cell(robot), step, q).duration_s
    with pytest.raises(LimitError, match=r"would need a (velocity|acceleration) of"):
        measuring(cell, step, started(cell, step, robot))


@ROBOTS
def test_an_approach_takes_all_that_the_limits_give(robot):
    for limits, share in (
        (MotionLimits(joint_velocity=0.01, joint_acceleration=50.0), 0),
        (MotionLimits(joint_velocity=5.0, joint_acceleration=0.1), 1),
    ):
        cell = make_motion_cell(robot, limits=limits)
        q = started(cell, circle_step(cell), robot)
        peaks = approach(cell, plunge_step(cell), q).peaks()
        limit = limits.of_joints(cell.arm)[share]
        assert np.max(peaks[share] / limit) == pytest.approx(1.0, rel=1e-6)


@ROBOTS
@pytest.mark.parametrize("joint", range(6))
def test_a_robot_elsewhere_is_refused_and_the_joint_named(robot, joint):
    cell = make_motion_cell(robot)
    step = circle_step(cell)
    q = started(cell, step, robot) + np.radians(0.021) * np.eye(6)[joint]
    with pytest.raises(LimitError, match=rf"{cell.arm.joint_names[joint]} is off by 0.021 deg"):
        measuring(cell, step, q)


@ROBOTS
def test_steps_beyond_their_speed_or_depth_are_refused(robot):
    cell = make_motion_cell(robot)
    for step, words in (
        (circle_step(cell, speed_m_s=0.0501), "50.1 mm/s, allowed are 50.0"),
        (plunge_step(cell, speed_m_s=0.011), "11.0 mm/s, allowed are 10.0"),
        (plunge_step(cell, depth_m=0.021), "21.0 mm, allowed are 20.0"),
    ):
        with pytest.raises(LimitError, match=words):
            measuring(cell, step, started(cell, step, robot))


@ROBOTS
def test_a_circle_too_wide_for_the_opening_is_refused(robot):
    narrow = make_motion_cell(robot, housing=replace(OPENING, clear_radius_m=0.016))
    step = circle_step(narrow)  # 12 mm and a tool of 4 mm: nothing is left
    with pytest.raises(LimitError, match=r"the tool, with .* mm into the station's housing"):
        measuring(narrow, step, started(narrow, step, robot))
    # 4 mm are left: a stop of 0.12 s from 50 mm/s needs 3 mm, the checked instants 0.5 mm
    limits = MotionLimits(stop_deceleration=20.0)
    wide = make_motion_cell(robot, housing=replace(OPENING, clear_radius_m=0.02), limits=limits)
    assert measuring(wide, step, started(wide, step, robot)).duration_s > 0.0


@ROBOTS
def test_room_for_a_stop_is_kept_to_the_housing(robot):
    limits = MotionLimits(stop_deceleration=0.1)  # 0.02 rad/s: 0.2 s, 5 mm at 50 mm/s
    cell = make_motion_cell(robot, housing=replace(OPENING, clear_radius_m=0.02), limits=limits)
    step = circle_step(cell)
    with pytest.raises(LimitError, match=r"mm to be kept free"):
        measuring(cell, step, started(cell, step, robot))


@ROBOTS
def test_a_plunge_onto_the_floor_is_refused(robot):
    cell = make_motion_cell(robot, housing=replace(OPENING, floor_m=-7e-3))
    step = plunge_step(cell)  # 3.5 mm deep with a tip rounded by 4 mm
    with pytest.raises(LimitError, match=r"the tool, with .* mm into the station's housing"):
        measuring(cell, step, started(cell, step, robot))


@ROBOTS
def test_a_short_tool_would_bring_the_flange_onto_the_housing(robot):
    tool = replace(TOOL, T_flange_tool=frames.transform(np.eye(3), [0, 0, 0.05]), length_m=0.04)
    cell = make_motion_cell(robot, tool=tool)
    step = circle_step(cell)
    with pytest.raises(LimitError, match="the flange, with"):
        measuring(cell, step, started(cell, step, robot))


@ROBOTS
def test_a_robot_beside_the_opening_does_not_move(robot):
    cell = make_motion_cell(robot)
    q = above(cell, robot, [0.08, 0.0, 0.01])  # the tip inside the housing
    with pytest.raises(LimitError, match=r"part 1: the tool, .* by hand"):
        approach(cell, circle_step(cell), q)


def test_a_joint_limit_on_the_way_is_named():
    cell = make_motion_cell("ur10")
    step = circle_step(cell)
    q = started(cell, step, "ur10")
    free = measuring(cell, step, q)
    joint = int(np.argmax(np.ptp(free.q, axis=0)))
    upper = cell.arm.upper.copy()
    upper[joint] = 0.5 * (q[joint] + np.max(free.q[:, joint]))
    near = replace(cell, arm=replace(cell.arm, upper=upper))
    with pytest.raises(LimitError, match=f"{cell.arm.joint_names[joint]} would be at"):
        measuring(near, step, q)


def test_joints_keep_their_limits_between_points_too():
    cell = make_motion_cell("ur10")
    step = circle_step(cell)
    q = started(cell, step, "ur10")
    free = measuring(cell, step, q)
    between = np.max(free.at(instants(free, 1e-4))[0], axis=0)
    at_points = np.max(free.q, axis=0)
    joint = int(np.argmax(between - at_points))
    assert between[joint] - at_points[joint] > 1e-9
    upper = cell.arm.upper.copy()
    upper[joint] = at_points[joint] + 0.1 * (between[joint] - at_points[joint])
    near = replace(cell, arm=replace(cell.arm, upper=upper))
    with pytest.raises(LimitError, match=f"{cell.arm.joint_names[joint]} would be at"):
        measuring(near, step, q)


@ROBOTS
def test_accelerations_of_a_turn_are_those_of_its_velocities(robot):
    cell = make_motion_cell(robot)
    step = circle_step(cell)
    plan = measuring(cell, step, started(cell, step, robot))
    begin, end = turn_s(step, cell.limits)
    turn = (plan.time_s > begin + 1e-9) & (plan.time_s < end - 1e-9)
    slope = np.gradient(plan.qd, plan.time_s, axis=0)[turn]
    # of a sine: omega^2 h^2 / 6 of its size
    size = np.max(np.abs(slope))
    allowed = size * (step.speed_m_s / step.radius_m * 0.01) ** 2
    np.testing.assert_allclose(plan.qdd[turn], slope, atol=allowed)


def test_a_station_near_a_singularity_or_out_of_reach_is_refused():
    folded = POSTURES["ur10"].copy()
    folded[4] = -0.05  # the wrist's axes nearly in line
    cell = make_motion_cell("ur10", folded)
    step = plunge_step(cell)
    with pytest.raises(LimitError, match="singularity"):
        approach(cell, step, folded)
    cell = make_motion_cell("ur10")
    far = cell.T_base_laser.copy()
    far[:3, 3] *= 3.0
    away = replace(cell, T_base_laser=far)
    with pytest.raises(LimitError, match=r"reach|singular"):
        approach(away, circle_step(away), above(cell, "ur10", [0.0, 0.0, 0.1]))


def test_joints_that_are_not_finite_are_refused():
    cell = make_motion_cell("ur10")
    for plan in (approach, measuring):
        with pytest.raises(LimitError, match="not finite"):
            plan(cell, circle_step(cell), np.full(6, np.nan))


@pytest.mark.parametrize(
    "bad", [{"tcp_speed_m_s": 0.0}, {"plunge_depth_m": np.nan}, {"joint_velocity": [1.0, -1.0]}]
)
def test_limits_must_be_positive(bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        MotionLimits(**bad)


def test_limits_are_given_for_all_joints_or_each():
    arm = make_motion_cell("ur10").arm
    velocity, _, _ = MotionLimits(joint_velocity=[1, 2, 3, 4, 5, 6]).of_joints(arm)
    np.testing.assert_array_equal(velocity, [1, 2, 3, 4, 5, 6])
    with pytest.raises(InputError, match="joint_acceleration has 3 values"):
        MotionLimits(joint_acceleration=[1, 2, 3]).of_joints(arm)


@given(st.floats(0.0, 2.0), st.floats(1e-3, 0.3), st.floats(0.05, 5.0))
@settings(max_examples=80, deadline=None)
def test_a_ride_keeps_its_bounds_and_arrives(length, speed, acceleration):
    ride = Ride.within(length, speed, acceleration)
    time = np.linspace(0.0, ride.duration_s, 4001)
    way, v, a = ride(time)
    assert way[0] == 0.0
    assert way[-1] == pytest.approx(length, abs=1e-12)
    assert np.all((v >= 0.0) & (v <= speed * (1.0 + 1e-12)))
    assert np.all(np.abs(a) <= acceleration * (1.0 + 1e-9))
    dt = time[1]
    jerk = 6.0 * ride.speed_m_s / ride.ramp_s**2  # the largest, and the largest jump of it
    mean_v, mean_a = 0.5 * (v[1:] + v[:-1]), 0.5 * (a[1:] + a[:-1])
    np.testing.assert_allclose(np.diff(way) / dt, mean_v, atol=jerk * dt**2 / 4.0 + 1e-10)
    np.testing.assert_allclose(np.diff(v) / dt, mean_a, atol=jerk * dt + 1e-10)
    points = ride.times()
    assert np.all(np.diff(points) > 0.0)
    assert points[-1] == pytest.approx(ride.duration_s)
