# SPDX-License-Identifier: Apache-2.0
"""The correction reaches the taught pose, can be undone, and never leaves its bounds."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from long_form import amount

from robocal_ros.correction import solution
from robocal_ros.correction.bounds import FADES_FROM, CorrectionConfig
from robocal_ros.correction.damping import LENGTH
from robocal_ros.correction.joint_correction import (
    EXACT,
    JointCorrection,
    StagedCorrection,
    pack_model,
)
from robocal_ros.correction.solution import MOST_OVER, RATE_STEP_S, rates_batch
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot

TOOL = frames.transform(frames.exp_rotation([0.3, 0.2, 0.1]), [0.05, 0.02, 0.25])
NM = 1e-9
BOUNDS = np.radians([[0.24] * 6, [5.0] * 6])
HOME = np.array([0.0, -1.2, 1.2, 0.0, 1.2, 0.0])  # of the KR 150, far from singular


pytestmark = pytest.mark.filterwarnings("ignore:.*joint limits not given")


def robot(name: str) -> SerialArm:
    return replace(load_robot(name), T_flange_tool=TOOL)


def drifted(arm: SerialArm, rng: np.random.Generator, size_m: float) -> SerialArm:
    """Random drift of all parameters that moves the flange by at most ``size_m``."""
    chosen = arm.parameters
    change = rng.standard_normal(len(chosen)) * np.where(chosen.is_length, 3e-4, 2e-4)
    q = rng.uniform(-1.5, 1.5, (100, arm.n))

    def scaled(scale: float) -> SerialArm:
        mdh = arm.mdh.copy()
        for (joint, column), x in zip(chosen.index, change, strict=True):
            mdh[joint, column] += scale * x
        return arm.with_mdh(mdh)

    moved = np.linalg.norm((scaled(1.0).fk(q) - arm.fk(q))[:, :3, 3], axis=1).max()
    return scaled(size_m / moved)


def bent(arm: SerialArm, rng: np.random.Generator, shift_m: float, turn_deg: float) -> SerialArm:
    """Another tool, shifted and turned by so much in a random direction."""
    direction, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    change = frames.transform(frames.exp_rotation(axis * np.radians(turn_deg)), direction * shift_m)
    return replace(arm, T_flange_tool=arm.T_flange_tool @ change)


def staged(reference: SerialArm, actual: SerialArm) -> StagedCorrection:
    return StagedCorrection(pack_model(reference), pack_model(actual), *BOUNDS)


def tool_jacobian(arm: SerialArm, q: np.ndarray) -> np.ndarray:
    J = arm.jacobian(q)
    lever = (arm.fk(q)[..., :3, :3] @ arm.T_flange_tool[:3, 3])[..., None]
    J[..., :3, :] += np.cross(J[..., 3:, :], lever, axis=-2)
    return J


def scaled_jacobian(arm: SerialArm, q: np.ndarray) -> np.ndarray:
    """At the tool, with the units of the damping."""
    J = tool_jacobian(arm, q)
    J[..., :3, :] /= LENGTH
    return J


def pose_error(arm: SerialArm, q: np.ndarray, goal: np.ndarray) -> tuple[float, float]:
    T = arm.fk(q) @ arm.T_flange_tool
    turn = frames.log_rotation(goal[..., :3, :3] @ np.swapaxes(T[..., :3, :3], -1, -2))
    return (
        float(np.linalg.norm((T - goal)[..., :3, 3], axis=-1).max()),
        float(np.linalg.norm(turn, axis=-1).max()),
    )


def well_conditioned(arm: SerialArm, rng: np.random.Generator, m: int) -> np.ndarray:
    q = rng.uniform(-2.0, 2.0, (m, arm.n))
    return q[np.linalg.cond(tool_jacobian(arm, q)) < 1e3]


def at_most_iterations(arm: SerialArm, q: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Newton's iterations (m,) by Kantorovich's bound, 0 where it bounds nothing.

    ``error`` (m,) is the norm of the scaled twist at the tool. A Jacobian changes per radian by no
    more than its own norm. The last iteration is one of which the step is below 0.1 urad.
    """
    s = np.linalg.svd(scaled_jacobian(arm, q), compute_uv=False)
    step, bend = error / s[:, -1], s[:, 0] / (2.0 * s[:, -1])
    bounded, count = 2.0 * bend * step < 0.5, np.ones(len(q), np.int64)
    for _ in range(10):
        count += step > solution.SMALL_STEP
        step = np.where(bounded & (step > solution.SMALL_STEP), bend * step**2, step)
    return np.where(bounded, count, 0)


@pytest.mark.parametrize("name", ["kr150_r3100", "ur10", "bx200l"])
@pytest.mark.parametrize(
    ("drift_m", "shift_m", "turn_deg"),
    [(1e-3, 0.0, 0.0), (1e-3, 2e-3, 0.5), (1e-3, 9e-3, 3.5), (1e-3, 20e-3, 7.0)],
)
def test_reaches_the_taught_pose(
    name: str, drift_m: float, shift_m: float, turn_deg: float
) -> None:
    rng = np.random.default_rng(1)
    reference = robot(name)
    actual = bent(drifted(reference, rng, drift_m), rng, shift_m, turn_deg)
    q = well_conditioned(actual, rng, 2000)
    result = JointCorrection.between(reference, actual).correct(q)
    whole = ~result.weak & result.converged
    goal = reference.fk(q) @ TOOL
    position, rotation = pose_error(actual, result.q[whole], goal[whole])
    assert position < NM
    assert rotation < NM
    assert result.position_error_m[whole].max() < NM
    assert result.rotation_error_rad[whole].max() < NM
    # A pose from which the goal lies beyond the reach, or too many radians away, has no solution.
    assert np.mean(whole) > (0.92 if turn_deg < 1.0 else 0.6)
    error = np.hypot(result.tcp_shift_m / LENGTH, result.tcp_rotation_rad)
    most = at_most_iterations(actual, q, error)
    assert np.all(whole[most > 0])
    sixteen_at_a_time = 3 + (shift_m > 5e-3)  # matrices of `six_axis`
    assert np.all(result.iterations[most > 0] <= np.maximum(most, sixteen_at_a_time)[most > 0])
    assert np.mean(most > 0) > 0.3 or turn_deg > 1.0
    assert np.allclose(result.joint_shift, result.q - q)
    apart = (actual.fk(q) @ actual.T_flange_tool - goal)[:, :3, 3]
    assert np.allclose(result.tcp_shift_m, np.linalg.norm(apart, axis=1), rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("name", ["kr150_r3100", "ur10", "bx200l"])
@pytest.mark.parametrize("turn_deg", [0.5, 1.2, 2.0, 3.5, 5.0])
def test_a_bent_tool_is_solved_sixteen_points_at_a_time(name: str, turn_deg: float) -> None:
    """Finding: from 1.8 deg on each point was tried so, and then solved once more by itself."""
    rng = np.random.default_rng(2)
    arm = robot(name)
    actual = bent(arm, rng, 2e-3 * turn_deg, turn_deg)
    q = rng.uniform(-2.0, 2.0, (480, 6))
    stage = staged(arm, actual)
    result = stage.correct(q).tool
    assert result is not None
    assert result.converged.all()
    assert np.mean(np.isin(result.iterations, [3, 4])) > 0.95
    back = stage.uncorrect(stage.correct(q).q)
    assert np.allclose(back, q, rtol=0.0, atol=1e-9)


def test_nothing_to_correct_gives_the_same_joints() -> None:
    arm = robot("ur10")
    q = np.random.default_rng(3).uniform(-2.0, 2.0, (100, 6))
    result = JointCorrection.between(arm, arm).correct(q)
    assert np.array_equal(result.q, q)
    assert result.iterations.max() == 0
    assert result.tcp_shift_m.max() < 1e-14


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
@example(3753)  # goes 36 deg there and back, with 51 of these roundings
@example(16948)  # the stretched elbow lies within the shift: its mirror image is found
def test_there_and_back_is_exact(seed: int) -> None:
    rng = np.random.default_rng(seed)
    reference = robot("kr150_r3100")
    actual = bent(drifted(reference, rng, 1e-3), rng, 2e-3, 0.5)
    correction = JointCorrection.between(reference, actual)
    there = correction.correct(well_conditioned(reference, rng, 20))
    back = correction.inverse().correct(there.q)
    whole = ~there.weak & ~back.weak & there.converged & back.converged
    assert np.sum(whole) > 10
    taught = there.q - there.joint_shift
    sides = [np.sign(np.linalg.det(tool_jacobian(reference, q))) for q in (taught, back.q)]
    mirrored = whole & (sides[0] != sides[1])
    assert np.sum(mirrored) <= 1
    # some thirty roundings of each of four poses (the goal and the one reached, there and back),
    # as the Jacobian turns them into joints
    rounding = 4.0 * 32.0 * np.finfo(float).eps * np.linalg.cond(tool_jacobian(reference, taught))
    assert np.all(
        np.abs(back.q - taught).max(axis=1)[whole & ~mirrored] < rounding[whole & ~mirrored]
    )


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.floats(1e-5, 0.02), st.floats(1e-4, 0.5))
@example(851968, 0.01953125, 0.5)  # bends by 0.61 of the bound beyond it
@example(153163, 1e-5, 1e-4)  # arm and wrist stretched: 0.2 % more of the position is left
def test_bounds_hold_at_and_around_singularities(seed: int, size: float, largest: float) -> None:
    rng = np.random.default_rng(seed)
    reference = robot("kr150_r3100")
    actual = drifted(reference, rng, size)
    q = rng.uniform(-2.0, 2.0, (200, 6))
    q[:100, 4] = rng.choice([0.0, 1e-9, 1e-5, 1e-3, 1e-2], 100)  # wrist stretched
    q[50:150, 2] = np.arctan2(-41.0, 1400.0) + rng.choice([0.0, 1e-8, 1e-3], 100)  # arm stretched
    result = JointCorrection.between(reference, actual, largest).correct(q)
    assert np.all(np.isfinite(result.q))
    # The bound steers the first step; the solution bends beyond it, and what bends far is dropped.
    assert np.abs(result.joint_shift).max() <= MOST_OVER * largest
    # No more of the position is left than of the whole error, but for what the arm bends within the
    # shift, and what the tool's turn adds along a direction of the position that is weak itself.
    before = np.hypot(result.tcp_shift_m / LENGTH, result.tcp_rotation_rad)
    after = result.position_error_m / LENGTH
    bend = np.linalg.norm(scaled_jacobian(actual, q), ord=2, axis=(-2, -1)) / 2.0
    square = np.sum(result.joint_shift**2, axis=1)
    assert np.all(after <= 1.05 * before + bend * square + 1e-12)


def test_the_shift_is_continuous_through_a_wrist_singularity() -> None:
    rng = np.random.default_rng(4)
    reference = robot("kr150_r3100")
    actual = drifted(reference, rng, 0.3e-3)
    bound = np.radians(0.3)
    q = np.tile([0.3, -1.2, 1.1, 0.4, 0.0, 0.5], (40_001, 1))
    q[:, 4] = np.linspace(-0.1, 0.1, len(q))
    result = JointCorrection.between(reference, actual, bound).correct(q)
    assert np.all(result.converged)
    assert result.weak.any()
    shift = result.joint_shift
    assert np.abs(shift).max() < 1.25 * bound
    # The steps are 5 µrad of joint 5; a jump would be of the order of the bound.
    assert np.abs(np.diff(shift, axis=0)).max() < 0.02 * bound


def settled(reference: SerialArm, actual: SerialArm) -> StagedCorrection:
    start, end = pack_model(reference), pack_model(actual)
    return StagedCorrection(start, end, *np.ones((2, reference.n)))


def shift(stage: StagedCorrection, q: np.ndarray) -> np.ndarray:
    return stage.correct(q).q - q


def rates(stage: StagedCorrection, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> Any:
    return stage.rates(q, qd, qdd, stage.correct(q))


def test_rates_follow_the_path() -> None:
    rng = np.random.default_rng(5)
    reference = robot("kr150_r3100")
    actual = bent(drifted(reference, rng, 1e-3), rng, 2e-3, 0.5)
    stage = settled(reference, actual)
    q = HOME + rng.uniform(-0.5, 0.5, (300, 6))
    qd, qdd = rng.uniform(-2.0, 2.0, (2, 300, 6))
    v, a = rates(stage, q, qd, qdd)
    h = 1e-4
    before, after = (shift(stage, q + qd * t + 0.5 * qdd * t * t) for t in (-h, h))
    assert np.abs(v - qd).max() > 1e-4
    assert np.allclose(v, qd + (after - before) / (2 * h), rtol=0.0, atol=2e-7)
    h = 1e-3
    before, here, after = (shift(stage, q + qd * t + 0.5 * qdd * t * t) for t in (-h, 0.0, h))
    shift_a = (after - 2 * here + before) / h**2
    assert np.allclose(a, qdd + shift_a, rtol=0.0, atol=1e-3 * np.abs(shift_a).max())


def test_rates_are_those_of_the_tool() -> None:
    """The twist of the tool at the corrected joints is that of the reference tool, to 1e-9."""
    rng = np.random.default_rng(6)
    reference = robot("ur10")
    actual = drifted(reference, rng, 1e-3)
    stage = settled(reference, actual)
    q = well_conditioned(reference, rng, 200)
    qd = rng.uniform(-1.0, 1.0, q.shape)
    result = stage.correct(q)
    v, _ = rates(stage, q, qd, np.zeros_like(q))
    wanted = (tool_jacobian(reference, q) @ qd[..., None])[..., 0]
    found = (tool_jacobian(actual, result.q) @ v[..., None])[..., 0]
    whole = result.whole
    assert np.abs(found - wanted)[whole].max() < 1e-9


def test_an_arm_at_rest_stays_at_rest() -> None:
    reference = robot("kr150_r3100")
    actual = drifted(reference, np.random.default_rng(7), 1e-3)
    zero = np.zeros((1, 6))
    q = np.array([[0.1, -1.5, 1.4, 0.2, 0.9, 0.3]])
    v, a = rates(settled(reference, actual), q, zero, zero)
    assert np.all(v == 0.0)
    assert np.all(a == 0.0)


def test_rates_with_a_sliding_joint_match_differences() -> None:
    rng = np.random.default_rng(8)
    reference = load_robot("p1r2p3")
    actual = drifted(reference, rng, 1e-3)
    stage = settled(reference, actual)
    q = rng.uniform(0.1, 0.4, (20, 3))
    qd = rng.uniform(-0.5, 0.5, (20, 3))
    v, _ = rates(stage, q, qd, np.zeros_like(q))
    h = 1e-4
    numeric = (shift(stage, q + h * qd) - shift(stage, q - h * qd)) / (2 * h)
    assert np.allclose(v, qd + numeric, rtol=0.0, atol=1e-6)


def test_an_arm_of_three_joints_gets_as_near_as_it_can() -> None:
    rng = np.random.default_rng(9)
    reference = load_robot("p1r2p3")
    actual = drifted(reference, rng, 1e-3)
    q = rng.uniform(0.1, 0.4, (20, 3))
    result = JointCorrection.between(reference, actual).correct(q)
    assert np.all(result.converged)
    assert result.tcp_shift_m.min() > 1e-4
    assert pose_error(actual, result.q, reference.fk(q))[0] < NM  # their position; no turn


def seven_joints() -> SerialArm:
    alpha = np.radians([-90, 90, 90, -90, -90, 90, 0])
    mdh = np.zeros((7, 5))
    mdh[:, 0] = [0.34, 0.0, 0.4, 0.0, 0.4, 0.0, 0.126]
    mdh[:, 3] = alpha
    names = tuple(f"joint_{i}" for i in range(7))
    limit = np.full(7, np.inf)
    return SerialArm("seven", names, mdh, np.ones(7), np.zeros(7, dtype=np.bool_), -limit, limit)


def test_a_redundant_arm_reaches_the_pose_with_a_small_shift() -> None:
    rng = np.random.default_rng(10)
    reference = seven_joints()
    mdh = reference.mdh + rng.standard_normal((7, 5)) * 2e-4
    actual = reference.with_mdh(mdh)
    q = rng.uniform(0.3, 1.2, (50, 7))
    result = JointCorrection.between(reference, actual).correct(q)
    assert np.all(result.converged)
    position, rotation = pose_error(actual, result.q, reference.fk(q))
    assert position < NM
    assert rotation < NM
    assert np.abs(result.joint_shift).max() < 0.02


@dataclass(frozen=True)
class Crossing:
    """A wrist singularity that is crossed along ``q`` (m, 6), at ``speed`` rad/s of the joints."""

    reference: SerialArm
    actual: SerialArm
    q: np.ndarray
    qd: np.ndarray
    dt: float
    speed: float

    @property
    def stage(self) -> StagedCorrection:
        return staged(self.reference, self.actual)


def crossings(name: str, count: int, seed: int = 0) -> Iterator[Crossing]:
    """Random ones of the wrist alone, at up to 60 deg/s and beyond, at 250 or 500 Hz.

    Any tool; drifts of 0.004 to 0.12 mm. The five other singular values are above 0.25 all the
    way, and with joint 5 at a right angle all six above 0.1: neither shoulder nor elbow is near.
    """
    described, rng = load_robot(name), np.random.default_rng(seed)
    while count:
        turn, place = frames.exp_rotation(rng.uniform(-1.0, 1.0, 3)), rng.uniform(-0.15, 0.15, 3)
        tool = frames.transform(turn, place + 0.2 * np.eye(3)[2])
        reference = replace(described, T_flange_tool=tool)
        actual = drifted(reference, rng, 10.0 ** rng.uniform(np.log10(4e-6), np.log10(1.2e-4)))
        way, middle = rng.uniform(-1.0, 1.0, 6), rng.uniform(-2.0, 2.0, 6)
        way[4], middle[4] = rng.choice([-1.0, 1.0]), 0.0
        rate, speed = rng.choice([250.0, 500.0]), np.radians(rng.uniform(10.0, 90.0))
        t = np.arange(-round(0.3 * rate), round(0.3 * rate) + 1)[:, None] / rate
        q = middle + speed * t * way
        away = q[::10].copy()
        away[:, 4] = np.pi / 2.0
        near, far = (
            np.linalg.svd(scaled_jacobian(reference, at), compute_uv=False) for at in (q, away)
        )
        if near[:, 4].min() > 0.25 and far[:, 5].min() > 0.1:
            yield Crossing(reference, actual, q, np.tile(speed * way, (len(q), 1)), 1 / rate, speed)
            count -= 1


@pytest.mark.parametrize("name", ["kr150_r3100", "ur10", "bx200l"])
def test_crossing_a_wrist_singularity_gives_up_one_direction_alone(name: str) -> None:
    for crossing in crossings(name, amount(60, 200)):
        reference, actual, q = crossing.reference, crossing.actual, crossing.q
        result = crossing.stage.correct(q)
        assert result.arm.converged.all()
        assert result.weak.any()
        rate = np.abs(np.diff(result.q - q, axis=0)).max() / crossing.dt
        assert np.degrees(rate) <= 2.0 * max(1.0, crossing.speed / np.radians(60.0))
        goal, T = reference.fk(q) @ reference.T_flange_tool, actual.fk(result.q)
        T = T @ actual.T_flange_tool
        left = (goal - T)[:, :3, 3]
        turn = frames.log_rotation(goal[:, :3, :3] @ np.swapaxes(T[:, :3, :3], -1, -2))
        assert np.linalg.norm(left, axis=1).max() <= 0.04e-3
        # without the one direction of turn that the posture gives up: no twist of the joints has a
        # part along u, so that u is to be met by a turn alone (equation 2)
        J = scaled_jacobian(reference, q)
        u = np.linalg.svd(J)[0][:, :, 5, None]
        M = J @ np.swapaxes(J, 1, 2)
        given_up = u[:, 3:] - M[:, 3:, :3] @ np.linalg.solve(M[:, :3, :3], u[:, :3])
        given_up = (given_up / np.linalg.norm(given_up, axis=1, keepdims=True))[..., 0]
        turn -= np.sum(given_up * turn, axis=1, keepdims=True) * given_up
        assert np.degrees(np.linalg.norm(turn, axis=1).max()) <= 0.005


def test_rates_are_the_derivative_all_through_a_crossing() -> None:
    """Against differences of the fourth order, with another step."""
    some = 0
    for crossing in crossings("kr150_r3100", 20, seed=1):
        stage, q, qd, h = crossing.stage, crossing.q, crossing.qd, 5e-4
        result = stage.correct(q)
        v, a = stage.rates(q, qd, np.zeros_like(q), result)
        ahead, on, behind, off = (shift(stage, q + k * h * qd) for k in (1, 2, -1, -2))
        rate = (8.0 * (ahead - behind) - (on - off)) / (12.0 * h)
        bend = (16.0 * (ahead + behind) - (on + off) - 30.0 * (result.q - q)) / (12.0 * h**2)
        some += result.weak.any() and not result.weak.all()
        # the least drift's zone is crossed in some 15 ms: (0.2 ms / 15 ms)^2 in a rate's third
        # derivative, and its square root where the damping ends, in an acceleration's
        assert np.abs(v - qd - rate).max() <= 1e-3 * np.abs(rate).max()
        rounding = 4.0 * EXACT / RATE_STEP_S**2
        assert np.abs(a - bend).max() <= 2e-2 * np.abs(bend).max() + rounding
    assert some > 5


def test_one_point_of_a_stream_has_the_bits_of_a_batch() -> None:
    for crossing in crossings("kr150_r3100", 3):
        stage, q = crossing.stage, crossing.q
        batch, out = stage.correct(q).q, np.empty_like(stage.reports[0])
        for row, expected in zip(q, batch, strict=True):
            solution.correct_staged(row, stage.largest, False, stage.works, out)
            assert np.array_equal(out[-1, :6], expected)


def test_stages_together_are_the_whole_correction_and_undo_it() -> None:
    rng = np.random.default_rng(12)
    reference = robot("kr150_r3100")
    actual = bent(drifted(reference, rng, 0.1e-3), rng, 1e-3, 0.2)
    start, end = pack_model(reference), pack_model(actual)
    stage = StagedCorrection(start, end, np.full(6, 0.1), np.full(6, 0.5))
    q = HOME + rng.uniform(-0.5, 0.5, (100, 6))
    q[:, 4] += 0.5  # no direction is weak
    result = stage.correct(q)
    assert np.all(result.whole)
    direct = JointCorrection.between(reference, actual).correct(q)
    assert np.abs(result.q - direct.q).max() < 1e-12
    assert np.abs(stage.uncorrect(result.q) - q).max() < 1e-12
    assert result.tool is not None
    assert result.tool.tcp_shift_m == pytest.approx(np.full(100, 1e-3), rel=1e-6)


def test_undoing_is_exact_where_only_a_share_was_corrected() -> None:
    rng = np.random.default_rng(13)
    reference = robot("kr150_r3100")
    actual = drifted(reference, rng, 0.1e-3)
    start, end = pack_model(reference), pack_model(actual)
    bound = np.full(6, np.radians(0.3))
    stage = StagedCorrection(start, end, bound, bound)
    q = np.tile([0.3, -1.2, 1.1, 0.4, 0.0, 0.5], (201, 1))
    q[:, 4] = np.linspace(-0.05, 0.05, 201)
    result = stage.correct(q)
    assert not np.all(result.whole)
    assert np.abs(stage.uncorrect(result.q) - q).max() < 1e-9


def test_kernels_are_compiled_for_one_type_of_array_only() -> None:
    """Another type would be compiled while the robot moves, and hold it up for seconds."""
    reference = robot("kr150_r3100")
    models = np.stack([pack_model(reference)] * 2)
    q = np.tile(HOME, (6, 2))[::2, ::2]
    for array in (models, q):
        array.flags.writeable = False
    correction = JointCorrection(models, np.broadcast_to(0.1, (6,)))
    correction.correct(q)
    correction.correct(q[0].tolist())
    stage = settled(reference, reference)
    stage.rates(q, q, q, stage.correct(q))
    correction.inverse().correct(q[:1])
    assert len(solution.correct_batch.signatures) == 1
    assert len(rates_batch.signatures) == 1


def test_wrong_shapes_are_a_callers_mistake() -> None:
    arm = robot("ur10")
    with pytest.raises(ValueError, match="different joints"):
        JointCorrection.between(arm, load_robot("p1r2p3"))
    with pytest.raises(ValueError, match="positive"):
        JointCorrection.between(arm, arm, 0.0)
    with pytest.raises(ValueError, match="models have shape"):
        JointCorrection(np.zeros((4, 8, 9)))


# ---- From corrected joints back to taught ones, with a bent tool and near singularities ----------


ARM = load_robot("kr150_r3100")
CONFIG = CorrectionConfig()
DRIFT, TOOL_BOUNDS = (bounds.of_joints(ARM) for bounds in (CONFIG.thermal, CONFIG.tool))
STEP = 1e-6


def bent_stage(shift_m: float, turn_deg: float, free_axis: bool) -> StagedCorrection:
    """A drift of some tenths of a millimetre, and a tool that is shifted and turned."""
    rng, chosen = np.random.default_rng(3), ARM.parameters
    size = rng.standard_normal(len(chosen)) * np.where(chosen.is_length, 2e-4, 1e-4)
    turn = frames.exp_rotation([0.0, np.radians(turn_deg), 0.0])
    tool = ARM.T_flange_tool @ frames.transform(turn, [shift_m, 0.0, 0.0])
    actual = replace(ARM.with_mdh(chosen.add(ARM.mdh, size)), T_flange_tool=tool)
    end = pack_model(actual)
    return StagedCorrection(pack_model(ARM), end, FADES_FROM * DRIFT, TOOL_BOUNDS, free_axis)


def acceptable(stage: StagedCorrection, q: np.ndarray) -> np.ndarray:
    """Those of the postures in which a command is corrected, and not refused."""
    found = stage.correct(q)
    tool = found.tool
    assert tool is not None
    fine = found.arm.converged & tool.converged
    fine &= np.all(np.abs(found.arm.joint_shift) <= DRIFT, axis=1)
    return q[fine & np.all(np.abs(tool.joint_shift) <= TOOL_BOUNDS, axis=1)]


def turning(stage: StagedCorrection, q: np.ndarray) -> np.ndarray:
    """How fast the shift of a joint changes, per motion of the joints (m,)."""
    fast = np.zeros((len(q), 6))
    for nudge in STEP * np.eye(6):
        there, back = (stage.correct(q + way * nudge).q for way in (1.0, -1.0))
        fast += np.abs((there - back - 2.0 * nudge) / (2.0 * STEP))
    return np.asarray(fast.max(axis=1))


def postures(count: int) -> np.ndarray:
    return np.random.default_rng(8).uniform(ARM.lower, ARM.upper, (count, 6))


@pytest.mark.parametrize(("shift_m", "turn_deg"), [(2e-3, 0.5), (9e-3, 2.9)])
@pytest.mark.parametrize(("free_axis", "share"), [(False, 0.0), (True, 1e-3)])
def test_taught_joints_come_back_where_the_shift_turns_slower_than_the_joints(
    shift_m: float, turn_deg: float, free_axis: bool, share: float
) -> None:
    """There each corrected posture has one taught one: the shift is a contraction."""
    stage = bent_stage(shift_m, turn_deg, free_axis)
    q = acceptable(stage, postures(6000))
    q = q[turning(stage, q) < 1.0]
    assert len(q) > 3000
    found = stage.uncorrect(stage.correct(q).q)
    lost = np.abs(found - q).max(axis=1) > 1e-8
    assert np.mean(lost) <= share


@pytest.mark.parametrize("free_axis", [False, True])
def test_readings_anywhere_give_numbers_within_bounds(free_axis: bool) -> None:
    """Also in a singularity, where no command leads."""
    stage, q = bent_stage(9e-3, 2.9, free_axis), postures(1000)
    q[:200, 4] = 0.0
    q[200:400, 4] *= 1e-4
    found = stage.uncorrect(q)
    assert np.all(np.abs(found - q) <= 2.0 * (DRIFT + TOOL_BOUNDS))
