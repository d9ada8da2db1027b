"""Ways between taught poses, and home from a station."""

from dataclasses import replace

import numpy as np
import pytest
from motion_cell import POSTURES, make_motion_cell, shifted, upright

from robocal_ros.ground.errors import LimitError
from robocal_ros.kinematics.inverse import inverse
from robocal_ros.motion.cell import MotionCell, departure, joint_way
from robocal_ros.motion.plan import MotionLimits

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
