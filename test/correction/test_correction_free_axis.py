# SPDX-License-Identifier: Apache-2.0
"""A tool that may turn about its z: five equations, and the joints move least.

An arm reaches position and axis; what the freedom is used for is shown against the same correction
with all six equations.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_correction_solution import bent, tool_jacobian

from robocal_ros.correction.damping import LENGTH
from robocal_ros.correction.joint_correction import (
    CorrectionResult,
    JointCorrection,
    StagedCorrection,
    pack_model,
)
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot

NM = 1e-9
TOOL = frames.transform(frames.exp_rotation([0.3, 0.5, 0.1]), [0.05, 0.02, 0.25])
HOME = np.array([0.0, -1.2, 1.2, 0.0, 1.2, 0.0])  # of the KR 150, far from singular
ARM_BOUND, TOOL_BOUND = np.radians([0.24, 5.0])  # those of the node

pytestmark = pytest.mark.filterwarnings("ignore:.*joint limits not given")


def robot(name: str) -> SerialArm:
    return replace(load_robot(name), T_flange_tool=TOOL)


def changed(
    arm: SerialArm, rng: np.random.Generator, shift_m: float = 0.0, turn_deg: float = 0.0
) -> SerialArm:
    """Drift of all parameters, 0.2 mm and 0.1 mrad (1 sigma), and a tool bent by so much."""
    chosen = arm.parameters
    size = np.where(chosen.is_length, 2e-4, 1e-4)
    drift = arm.with_mdh(chosen.add(arm.mdh, size * rng.standard_normal(len(chosen))))
    return bent(drift, rng, shift_m, turn_deg)


def miss(
    reference: SerialArm, actual: SerialArm, q: np.ndarray, corrected: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance (m,) of the tools' origins, m, and angle of their z, rad."""
    goal, T = reference.fk(q) @ reference.T_flange_tool, actual.fk(corrected) @ actual.T_flange_tool
    axis = np.cross(T[:, :3, 2], goal[:, :3, 2])
    assert np.all(np.sum(T[:, :3, 2] * goal[:, :3, 2], axis=1) > 0.0)
    return np.linalg.norm((T - goal)[:, :3, 3], axis=1), np.linalg.norm(axis, axis=1)


def origin_and_axis_rates(
    arm: SerialArm, q: np.ndarray, qd: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (m, 3) of the tool's origin, m/s, and of its z, 1/s."""
    twist = (tool_jacobian(arm, q) @ qd[..., None])[..., 0]
    return twist[:, :3], np.cross(twist[:, 3:], (arm.fk(q) @ arm.T_flange_tool)[:, :3, 2])


def both(
    reference: SerialArm, actual: SerialArm, q: np.ndarray, largest: float
) -> tuple[CorrectionResult, CorrectionResult]:
    """Corrected with the free axis, and with all six equations."""
    free = JointCorrection.between(reference, actual, largest, free_axis=True)
    return free.correct(q), JointCorrection.between(reference, actual, largest).correct(q)


def staged(reference: SerialArm, actual: SerialArm) -> StagedCorrection:
    start, end = pack_model(reference), pack_model(actual)
    bounds = np.full((2, reference.n), [[ARM_BOUND], [TOOL_BOUND]])
    return StagedCorrection(start, end, *bounds, free_axis=True)


@pytest.mark.parametrize("name", ["kr150_r3100", "ur10", "bx200l"])
@pytest.mark.parametrize(("shift_m", "turn_deg"), [(0.0, 0.0), (2e-3, 0.5), (20e-3, 7.0)])
def test_position_and_axis_are_reached(name: str, shift_m: float, turn_deg: float) -> None:
    rng = np.random.default_rng(1)
    reference = robot(name)
    actual = changed(reference, rng, shift_m, turn_deg)
    q = rng.uniform(-2.0, 2.0, (2000, 6))
    free, six = both(reference, actual, q, 1.0)
    whole, all_six = (~r.weak & r.converged for r in (free, six))
    position, axis = miss(reference, actual, q[whole], free.q[whole])
    assert position.max() < NM
    assert axis.max() < NM
    assert free.position_error_m[whole].max() < NM
    assert free.rotation_error_rad[whole].max() < NM
    # Five equations are singular in fewer poses than six.
    assert np.mean(whole) > np.mean(all_six)
    # What is reported without the correction is the axis' angle.
    before, angle = miss(reference, actual, q, q)
    assert np.allclose(free.tcp_shift_m, before, rtol=0.0, atol=1e-14)
    assert np.allclose(np.sin(free.tcp_rotation_rad), angle, rtol=0.0, atol=1e-14)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(["kr150_r3100", "ur10", "bx200l"]))
def test_joints_move_no_further_than_with_six_equations(seed: int, name: str) -> None:
    rng = np.random.default_rng(seed)
    reference = robot(name)
    actual = changed(reference, rng)
    q = rng.uniform(-2.0, 2.0, (300, 6))
    free, six = both(reference, actual, q, 1.0)
    moved, most = (np.linalg.norm(r.joint_shift, axis=1) for r in (free, six))
    J = tool_jacobian(actual, q)
    J[:, :3] /= LENGTH
    s = np.linalg.svd(J, compute_uv=False)
    turn = most * s[:, 0] / s[:, 5]  # of the weakest direction within the shift, at most
    whole = ~free.weak & ~six.weak & free.converged & six.converged & (turn < 0.1)
    moved, most = moved[whole], most[whole]
    assert np.sum(whole) > 100
    # J(q)^T y is not quite J(q')^T y: they differ by the turn, their lengths by its square.
    assert np.all(moved <= most * (1.0 + turn[whole] ** 2))
    assert np.median(moved / most) < 0.99


def test_no_other_turn_about_the_axis_moves_the_joints_less() -> None:
    rng = np.random.default_rng(2)
    reference = robot("kr150_r3100")
    actual = changed(reference, rng, 2e-3, 0.5)
    q = HOME + rng.uniform(-0.5, 0.5, (100, 6))
    free, six = both(reference, actual, q, 1.0)
    least = np.linalg.norm(free.joint_shift, axis=1)
    assert np.all(least <= np.linalg.norm(six.joint_shift, axis=1))
    for turn in np.radians([-1.0, -0.1, -0.01, 0.01, 0.1, 1.0]):
        about_z = frames.transform(frames.exp_rotation([0.0, 0.0, turn]), np.zeros(3))
        turned = replace(actual, T_flange_tool=actual.T_flange_tool @ about_z)
        # from where the tool stands now, turned on about its z
        other = JointCorrection.between(actual, turned).correct(free.q)
        assert np.all(np.linalg.norm(other.q - q, axis=1) > least)


def test_a_turn_about_the_axis_alone_needs_no_correction() -> None:
    rng = np.random.default_rng(3)
    reference = robot("ur10")
    turn = frames.transform(frames.exp_rotation([0.0, 0.0, 0.3]), np.zeros(3))
    actual = replace(reference, T_flange_tool=TOOL @ turn)
    q = rng.uniform(-2.0, 2.0, (50, 6))
    free, _ = both(reference, actual, q, 1.0)
    assert np.abs(free.joint_shift).max() < 1e-12


def test_the_shift_is_continuous_through_singularities() -> None:
    """Steps of 5 urad of a joint; the bound of a joint's shift is 4 mrad, so a jump would show."""
    rng = np.random.default_rng(4)
    reference = robot("kr150_r3100")
    actual = changed(reference, rng)
    for joint, middle in ((4, 0.0), (2, np.arctan2(-41.0, 1400.0)), (1, -1.2)):
        q = np.tile([0.3, -1.2, 1.1, 0.4, 0.8, 0.5], (40_001, 1))
        q[:, joint] = middle + np.linspace(-0.1, 0.1, len(q))
        free, _ = both(reference, actual, q, ARM_BOUND)
        assert np.all(free.converged)
        assert np.abs(free.joint_shift).max() < 1.25 * ARM_BOUND
        assert np.abs(np.diff(free.joint_shift, axis=0)).max() < 0.02 * ARM_BOUND


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([(0.0, 0.0), (2e-3, 0.5), (8e-3, 2.5)]))
def test_there_and_back_is_exact(seed: int, bend: tuple[float, float]) -> None:
    rng = np.random.default_rng(seed)
    reference = robot("kr150_r3100")
    stage = staged(reference, changed(reference, rng, *bend))
    q = HOME + rng.uniform(-0.7, 0.7, (30, 6))
    there = stage.correct(q)
    assert there.arm.converged.all()
    assert there.tool is None or there.tool.converged.all()
    assert np.abs(stage.uncorrect(there.q) - q).max() < 1e-12


def test_rates_keep_the_tool_and_its_axis_moving_as_taught() -> None:
    rng = np.random.default_rng(5)
    reference = robot("kr150_r3100")
    actual = changed(reference, rng, 2e-3, 0.5)
    stage = staged(reference, actual)
    q = HOME + rng.uniform(-0.5, 0.5, (50, 6))
    qd, zero = rng.uniform(-1.0, 1.0, q.shape), np.zeros(q.shape)
    result = stage.correct(q)
    v, a = stage.rates(q, qd, zero, result)
    assert np.abs(v - qd).max() > 1e-3
    assert np.sum(result.whole) > 10
    for wanted, found in zip(
        origin_and_axis_rates(reference, q, qd),
        origin_and_axis_rates(actual, result.q, v),
        strict=True,
    ):
        # central differences over 0.2 ms of a shift of 0.1 rad; what is given up moves otherwise
        assert np.abs(found - wanted)[result.whole].max() < 1e-6
    h = 3e-3
    before, after = (stage.correct(q + t * qd).q for t in (-h, h))
    assert np.allclose(a, (after - 2.0 * result.q + before) / h**2, rtol=0.0, atol=1e-5)


def test_an_arm_of_five_joints_reaches_position_and_axis() -> None:
    full = robot("kr150_r3100")
    reference = SerialArm(
        "five", full.joint_names[:5], full.mdh[:5], full.sign[:5], full.prismatic[:5],
        full.lower[:5], full.upper[:5], T_flange_tool=TOOL,
    )  # fmt: skip
    rng = np.random.default_rng(6)
    actual = changed(reference, rng, 2e-3, 0.5)
    q = HOME[:5] + rng.uniform(-0.5, 0.5, (100, 5))
    free, all_six = both(reference, actual, q, 1.0)
    position, axis = miss(reference, actual, q, free.q)
    assert position.max() < NM
    assert axis.max() < NM
    assert all_six.position_error_m.max() < NM
    assert all_six.rotation_error_rad.max() > 1e-5
