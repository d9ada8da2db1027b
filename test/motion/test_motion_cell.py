# SPDX-License-Identifier: Apache-2.0
"""Ways clear of the housing, between taught poses, and stops."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_cell import POSTURES, circle_step, make_motion_cell, shifted, tip_in_laser, upright

from robocal_ros.ground.errors import InputError, LimitError
from robocal_ros.kinematics.arm import inverse
from robocal_ros.motion.cell import Housing, MotionCell, ToolBody, departure, joint_way
from robocal_ros.motion.plan import SHORTEST_STOP_S, MotionLimits, stop, stop_time
from robocal_ros.tool.driving import measuring, start_pose

HOUSING = Housing(clear_radius_m=0.04, top_m=0.02, floor_m=-0.08, retract_m=0.04)


def solid(points):
    """Whether points (..., 3) of the laser frame are in the housing."""
    across = np.hypot(points[..., 0], points[..., 1])
    beside = (across > HOUSING.clear_radius_m) & (points[..., 2] < HOUSING.top_m)
    return beside | (points[..., 2] < HOUSING.floor_m)


def within(start, end, radius, rng, count=20000):
    """Points on the surface of a capsule."""
    on_axis = start + rng.random((count, 1)) * (end - start)
    out = rng.normal(size=(count, 3))
    return on_axis + radius * out / np.linalg.norm(out, axis=1)[:, None]


places = st.tuples(st.floats(-0.08, 0.08), st.floats(-0.08, 0.08), st.floats(-0.1, 0.1))


@given(start=places, end=places, radius=st.floats(1e-3, 0.02), seed=st.integers(0, 9))
@settings(max_examples=60, deadline=None)
def test_what_counts_as_clear_has_no_point_in_the_housing(start, end, radius, seed):
    start, end = np.array(start), np.array(end)
    cut = float(HOUSING.cut_by(start[None], end[None], radius)[0])
    # never refused for more than the corner of the square around the round at the rim
    allowed = (np.sqrt(2.0) - 1.0) * radius + 2e-3  # and the draw's coarseness
    grown = radius + (allowed if cut > 0.0 else -1e-12)
    points = within(start, end, grown, np.random.default_rng(seed))
    assert np.any(solid(points)) == (cut > 0.0)


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [
        ([0.035, 0.0, 0.0], [0.035, 0.0, 0.1], 0.0),  # upright in the opening
        ([0.038, 0.0, 0.0], [0.038, 0.0, 0.1], 0.002),  # on its wall
        ([0.0, 0.0, -0.077], [0.0, 0.0, 0.1], 0.001),  # on the floor
        ([0.1, 0.0, 0.025], [0.1, 0.0, 0.2], 0.0),  # over the top
        ([0.1, 0.0, 0.021], [0.1, 0.0, 0.2], 0.003),  # on the top
        ([0.05, 0.0, 0.0], [0.05, 0.0, 0.1], 0.014),  # in the wall
        ([0.0, 0.0, 0.025], [0.2, 0.0, 0.025], 0.0),  # level, over the top
        ([0.0, 0.0, 0.0], [0.3, 0.0, 0.2], 0.0),  # slanted, out of the opening
        ([0.01, 0.0, 0.0], [0.31, 0.0, 0.2], 0.01),  # slanted, at 24 mm height 46 mm off the middle
    ],
)
def test_known_cuts(start, end, expected):
    for ends in ((start, end), (end, start)):
        found = HOUSING.cut_by(*(np.array([p]) for p in ends), 0.004)
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_tool_is_seen_along_its_axis_and_on_to_the_flange():
    T = np.eye(4)
    T[:3, 3] = [0.05, 0.0, 0.3]  # a torch that sits beside the flange's axis
    tool = ToolBody(T, 0.1, 0.004, 0.06)
    np.testing.assert_allclose(tool.corners, [[0.05, 0, 0.3], [0.05, 0, 0.2], [0, 0, 0]])
    places = tool.corners[None] * [1.0, -1.0, -1.0] + [-0.05, 0.0, 0.3]
    parts = {
        # above the crossing: only if too thick for the opening
        (0.0, 1e-3): (0.0, 0.0, 0.0),
        (0.0, 37e-3): (1e-3, 0.0, 0.0),
        # beside the opening the tip is in the wall, its upper part 80 mm above the top
        (0.1, 1e-3): (20e-3 + 5e-3, 0.0, 0.0),
        (0.1, 81e-3): (105e-3, 5e-3, 0.0),
        # the flange, a ball of 60 mm at 300 mm, comes 20 mm off the top last
        (0.1, 221e-3): (245e-3, 145e-3, 1e-3),
    }
    for (beside, margin), expected in parts.items():
        found = tool.cuts(HOUSING, places + np.array([beside, 0.0, 0.0]), margin)
        np.testing.assert_allclose([float(x[0]) for x in found.values()], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"clear_radius_m": 0.0}, "opening radius 0 mm: must be positive"),
        ({"floor_m": 0.01}, "housing depth -10 mm: must be positive"),
        ({"floor_m": -np.inf}, "housing depth inf mm"),
        ({"retract_m": 0.02}, "retract height 20 mm: .* above the housing top, 20 mm"),
        ({"top_m": np.nan}, "housing top nan mm"),
        ({"reach_m": 0.03}, "housing reach 30 mm: must be more than the opening radius, 40 mm"),
    ],
)
def test_sizes_that_make_no_sense_are_refused_as_the_parameters_are_called(bad, words):
    """In mm and in the words of `opening_radius_mm`, `housing_top_mm`, `retract_mm` and so on."""
    with pytest.raises(InputError, match=words):
        Housing(**(vars(HOUSING) | bad))
    with pytest.raises(InputError, match="tool radius 0 mm"):
        ToolBody(np.eye(4), 0.1, 0.0, 0.05)


def test_beyond_the_reach_of_the_housing_nothing_is_solid():
    """A capsule of 5 mm, level and 50 mm under the brim, passes z at several distances."""
    housing = Housing(**(vars(HOUSING) | {"reach_m": 0.3}))
    passes = np.array([0.1, 0.29, 0.304, 0.306, 1.0])
    start = np.column_stack([passes, np.full(5, -0.5), np.full(5, -0.03)])
    end = start * [1.0, -1.0, 1.0]
    cut = housing.cut_by(start, end, 0.005)
    assert (cut > 0.0).tolist() == [True, True, True, False, False]
    assert cut[2] == pytest.approx(0.001, abs=1e-12)
    np.testing.assert_allclose(cut[:1], HOUSING.cut_by(start, end, 0.005)[:1])
    aside = start + np.array([0.0, 0.9, 0.0])  # the line would pass at 0.1 m, but it ends before
    assert housing.cut_by(aside[:1], aside[:1] + np.array([0.0, 0.5, 0.0]), 0.005)[0] == 0.0


SAMPLES = np.linspace(0.0, 1.0, 2001)


@pytest.fixture(params=list(POSTURES))
def cell(request) -> MotionCell:
    return make_motion_cell(request.param)


def posture(cell: MotionCell) -> np.ndarray:
    return next(q for name, q in POSTURES.items() if name[:2] == cell.arm.name[:2].lower())


def joints(cell: MotionCell, T_base_flange: np.ndarray) -> np.ndarray:
    """Joints at a flange pose, followed from the posture over the crossing."""
    way = np.tile(upright(cell, 0.0), (21, 1, 1))
    way[:, :3, 3] += np.linspace(0.0, 1.0, 21)[:, None] * (T_base_flange - way[0])[:3, 3]
    return inverse(cell.arm, way, posture(cell))[-1]


def sampled(plan):
    return plan.at(SAMPLES * plan.duration_s)


@pytest.mark.parametrize("tcp_speed_m_s", [0.1, 10.0])
def test_a_joint_way_is_straight_and_within_its_limits(cell, tcp_speed_m_s):
    limits = MotionLimits(joint_velocity=0.8, joint_acceleration=2.0, tcp_speed_m_s=tcp_speed_m_s)
    cell = replace(cell, limits=limits)
    start = posture(cell)
    end = start + np.array([0.4, -0.2, 0.1, 0.3, -0.1, 0.0])
    plan = joint_way(cell, start, end)
    q, qd = sampled(plan)
    np.testing.assert_allclose(q[[0, -1]], [start, end], atol=1e-12)
    share = (q - start) @ (end - start) / np.sum((end - start) ** 2)
    np.testing.assert_allclose(q, start + share[:, None] * (end - start), atol=1e-9)
    assert np.all(np.diff(share) >= 0.0)
    assert np.all(plan.qd[[0, -1]] == 0.0)
    assert np.max(np.abs(qd)) <= 0.8 * (1.0 + 1e-6)
    assert np.max(plan.peaks()[1]) <= 2.0 * (1.0 + 1e-6)
    tips = (cell.arm.fk(q) @ np.append(cell.tool.p_tip, 1.0))[:, :3]
    speed = np.linalg.norm(np.diff(tips, axis=0), axis=1) / (plan.duration_s / 2000)
    assert speed.max() <= tcp_speed_m_s * (1.0 + 1e-3)
    # One of the limits is what makes it last.
    reached = [np.max(np.abs(qd)) / 0.8, np.max(plan.peaks()[1]) / 2.0, speed.max() / tcp_speed_m_s]
    assert max(reached) > 0.99


def test_no_way_is_a_way(cell):
    q = posture(cell)
    plan = joint_way(cell, q, q)
    assert 0.0 < plan.duration_s < 1.0
    np.testing.assert_array_equal(plan.q, np.tile(q, (len(plan.q), 1)))


def test_an_end_beyond_the_limits_is_refused(cell):
    q = posture(cell)
    beyond = q.copy()
    beyond[1] = cell.arm.upper[1] + 0.01
    with pytest.raises(LimitError, match=cell.arm.joint_names[1]):
        joint_way(cell, q, beyond)


@pytest.mark.parametrize("depth_m", [-0.02, 0.0, 0.01])
@pytest.mark.parametrize("height_m", [0.05, 0.15])
def test_a_departure_leaves_the_opening_upwards_and_ends_at_home(cell, depth_m, height_m):
    beams = joints(cell, shifted(cell, upright(cell, depth_m), [0.004, -0.003, 0.0]))
    home = joints(cell, shifted(cell, upright(cell, height_m), [0.1, -0.05, 0.0]))
    plan = departure(cell, beams, home)
    q, _ = sampled(plan)
    np.testing.assert_allclose(q[[0, -1]], [beams, home], atol=1e-9)
    tip = cell.in_laser((cell.arm.fk(q) @ np.append(cell.tool.p_tip, 1.0))[:, :3])
    low = tip[:, 2] < cell.housing.top_m
    assert low[0]
    assert not np.any(np.diff(low.astype(int)) > 0)  # out, never in again
    aside = np.linalg.norm(tip[low, :2] - tip[0, :2], axis=1)
    assert aside.max() < 1e-5  # 10 um: the inverse is exact, the cubics nearly


def test_a_home_pose_in_another_posture_is_refused(cell):
    beams = joints(cell, upright(cell, 0.0))
    home = joints(cell, upright(cell, 0.1))
    turned = home.copy()
    turned[5] += 2.0 * np.pi if home[5] < 0.0 else -2.0 * np.pi
    wide = replace(cell, arm=replace(cell.arm, lower=cell.arm.lower - 7, upper=cell.arm.upper + 7))
    with pytest.raises(
        LimitError, match=f"beside the taught home pose in {cell.arm.joint_names[5]}"
    ):
        departure(wide, beams, turned)


def test_a_way_through_the_housing_is_refused(cell):
    """From the side of the opening, tilted, the flange would pass the wall."""
    beams = joints(cell, shifted(cell, upright(cell, -0.02), [0.039, 0.0, 0.0]))
    home = joints(cell, upright(cell, 0.1))
    with pytest.raises(LimitError, match="housing"):
        departure(cell, beams, home)


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
