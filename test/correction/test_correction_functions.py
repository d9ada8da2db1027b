# SPDX-License-Identifier: Apache-2.0
"""Correction of an arm whose joints have functions and wind under load: exact, smooth, undone."""

import re
from dataclasses import replace

import correction_robot
import numpy as np
import pytest
from correction_robot import DT, HOME, NAMES, NOMINAL, Robot, offer
from joint_errors import with_joint_errors
from test_correction_solution import bent, drifted, pose_error, robot, staged, well_conditioned

from robocal_ros.correction.bounds import (
    CorrectionConfig,
    Policy,
    correction_between,
    require_within,
    survey,
)
from robocal_ros.correction.damping import CONVERGED
from robocal_ros.correction.interface import JointCommand, Reason, RefusedError
from robocal_ros.correction.joint_correction import JointCorrection, pack_model
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.correction.six_axis import GOES, LANES, SAID
from robocal_ros.correction.six_functions import CONSTANTS, ROWS
from robocal_ros.correction.solution import SETTINGS, correct_staged
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_functions import ArmLoad

NM = 1e-9
WIDE = CorrectionConfig(thermal=CorrectionConfig().tool)


def pairs() -> list[tuple[SerialArm, SerialArm]]:
    """Taught with the nominal arm, or with the cold one as it is; then drifted, and bent."""
    rng = np.random.default_rng(4)
    made = []
    for name in ("kr150_r3100", "ur10"):
        nominal = robot(name)
        cold = with_joint_errors(nominal, 1)
        warm = drifted(cold, rng, 2e-4)
        made += [(nominal, cold), (nominal, bent(warm, rng, 5e-4, 0.1)), (cold, warm)]
    return [*made, (made[0][1], made[0][0])]


PAIRS = pairs()


@pytest.mark.parametrize(("reference", "actual"), PAIRS)
def test_the_arm_as_it_is_reaches_what_was_taught_and_it_is_undone(
    reference: SerialArm, actual: SerialArm
) -> None:
    rng = np.random.default_rng(1)
    q = well_conditioned(actual, rng, 1000)
    stage = staged(reference, actual)
    result = stage.correct(q)
    whole = result.whole
    assert np.mean(whole) > 0.3  # elsewhere a direction is weak
    goal = reference.fk(q[whole]) @ reference.T_flange_tool
    for error in pose_error(actual, result.q[whole], goal):
        assert error < NM
    one = np.empty_like(stage.reports[0])
    for point, found in zip(q[:20], result.q, strict=False):
        correct_staged(point, stage.largest, False, stage.works, one)
        np.testing.assert_array_equal(one[-1, :6], found)
        np.testing.assert_allclose(stage.uncorrect_one(found), point, atol=1e-11)
    np.testing.assert_allclose(stage.uncorrect(result.q[whole]), q[whole], atol=1e-11)


def test_what_load_leaves_of_a_step_is_measured_and_not_taken_for_small() -> None:
    """An arm as soft as none is, far wound: within 1e-11 rad at six joints and 4 m of reach."""
    nominal = robot("kr150_r3100")
    cold = with_joint_errors(nominal, 1)
    functions = replace(cold.functions, compliance=50.0 * cold.functions.compliance)
    soft = drifted(replace(cold, functions=functions), np.random.default_rng(2), 2e-4)
    q = well_conditioned(nominal, np.random.default_rng(1), 4000)
    found = JointCorrection.between(nominal, soft, np.radians(5.0)).correct(q)
    whole = found.converged & ~found.weak
    assert np.mean(whole) > 0.9
    goal = nominal.fk(q[whole]) @ nominal.T_flange_tool
    for error in pose_error(soft, found.q[whole], goal):
        assert error < 6 * 1e-11 * 4.0


def test_joint_functions_alone_are_taken_off_sixteen_points_at_a_time() -> None:
    """Where the geometry is the same nothing was to solve, and each point was solved alone."""
    nominal = robot("ur10")
    correction = JointCorrection.between(nominal, with_joint_errors(nominal, 1))
    q = well_conditioned(nominal, np.random.default_rng(1), 200)[:LANES]
    found = correction.correct(q)
    rows = correction.work[SETTINGS + CONSTANTS :][: LANES * ROWS].reshape(ROWS, LANES)
    np.testing.assert_array_equal(rows[SAID + CONVERGED], 1.0)
    np.testing.assert_array_equal(found.q.T, rows[GOES : GOES + 6])
    assert np.all(found.iterations == 0)


def test_its_shift_at_the_tool_is_that_of_the_arms_as_they_are() -> None:
    nominal = robot("ur10")
    cold = with_joint_errors(nominal, 1)
    q = well_conditioned(cold, np.random.default_rng(1), 500)
    found = JointCorrection.between(nominal, cold).correct(q)
    before = (cold.fk(q) - nominal.fk(q)) @ nominal.T_flange_tool
    moved = np.linalg.norm(before[:, :3, 3], axis=1)
    np.testing.assert_allclose(found.tcp_shift_m, moved, atol=NM)
    assert np.max(moved) > 0.3e-3  # the geometric models are the same


def test_rates_are_the_derivatives_of_the_corrected_joints() -> None:
    """J' qd' = J qd with the true Jacobians at the tool, joint functions and all."""
    reference, actual = PAIRS[1]
    rng = np.random.default_rng(2)
    q = well_conditioned(actual, rng, 300)
    qd, qdd = rng.uniform(-1.0, 1.0, (2, *q.shape))
    stage = staged(reference, actual)
    result = stage.correct(q)
    whole = result.whole
    velocity, acceleration = stage.rates(q, qd, qdd, result)

    def twists(arm: SerialArm, at: np.ndarray, rate: np.ndarray) -> np.ndarray:
        twist = (arm.jacobian(at) @ rate[:, :, None])[:, :, 0]
        lever = arm.fk(at)[:, :3, :3] @ arm.T_flange_tool[:3, 3]
        twist[:, :3] += np.cross(twist[:, 3:], lever)
        return twist

    def taught(t: float) -> tuple[np.ndarray, np.ndarray]:
        return q + qd * t + 0.5 * qdd * t * t, qd + qdd * t

    def corrected(t: float) -> tuple[np.ndarray, np.ndarray]:
        v = velocity + acceleration * t
        return result.q + velocity * t + 0.5 * acceleration * t * t, v

    given, found = twists(reference, q, qd), twists(actual, result.q, velocity)
    np.testing.assert_allclose(found[whole], given[whole], atol=1e-6)
    h = 1e-4
    bends = [
        (twists(arm, *path(h)) - twists(arm, *path(-h))) / (2.0 * h)
        for arm, path in ((reference, taught), (actual, corrected))
    ]
    # over 0.2 ms, in which a function's second derivative changes by 6 SIZE / STEP^3 h
    np.testing.assert_allclose(bends[1][whole], bends[0][whole], atol=5e-3)
    for k in np.flatnonzero(whole)[:20]:
        back = stage.taught_velocity_one(result.q[k], velocity[k], stage.uncorrect_one(result.q[k]))
        np.testing.assert_allclose(back, qd[k], atol=5e-6)


def test_it_stays_smooth_through_a_singular_wrist_where_functions_alone_are_exact() -> None:
    nominal = robot("kr150_r3100")
    cold = with_joint_errors(nominal, 2)
    for actual in (cold, drifted(cold, np.random.default_rng(0), 1e-3)):
        stage, steps = staged(nominal, actual), []
        for m in (2001, 20001):
            q = np.tile(HOME, (m, 1))
            q[:, 4] = np.linspace(-0.1, 0.1, m)
            result = stage.correct(q)
            assert result.arm.converged.all()
            steps.append(np.max(np.abs(np.diff(result.q - q, axis=0))))
        assert steps[1] < 0.2 * steps[0]  # ten times as near: a jump would stay as large
        if actual is cold:
            assert result.whole.all()
            assert max(pose_error(cold, result.q, nominal.fk(q) @ nominal.T_flange_tool)) < NM
        else:
            assert result.weak.any()


@pytest.mark.parametrize("policy", [Policy.CLAMP, Policy.REFUSE])
def test_the_bounds_see_all_of_it(policy: Policy) -> None:
    nominal = NOMINAL
    actual = with_joint_errors(nominal, 3, size=6e-3)
    config = CorrectionConfig(policy=policy)
    stage = correction_between(pack_model(nominal), pack_model(actual), nominal, config)
    q = HOME + np.random.default_rng(0).uniform(-0.3, 0.3, (200, 6))
    result = stage.correct(q)
    if policy is Policy.REFUSE:
        with pytest.raises(RefusedError, match=r"mm and .* deg at most, allowed 1 mm"):
            require_within(result, config, nominal)
    else:
        assert np.all(np.abs(result.q - q) <= config.thermal.joint_rad + 1e-12)
        assert result.reason is Reason.TCP_BOUND
        assert np.max(np.abs(stage.correct(stage.uncorrect(result.q)).q - result.q)) < 1e-9
    seen = survey(nominal, actual, config.thermal)
    assert seen.beyond > 0.5
    assert seen.worst_m > 5e-3


def test_a_session_takes_the_model_over_and_corrects_with_it() -> None:
    cold = with_joint_errors(correction_robot.drifted(), 5)
    robot = Robot(thermal=WIDE.thermal)
    robot.session.offer_model(offer(cold))
    robot.session.enable(True)
    out = robot.settle()
    for error in pose_error(cold, out, NOMINAL.fk(HOME) @ NOMINAL.T_flange_tool):
        assert error < NM
    reading = robot.session.reading(JointCommand(NAMES, out), robot.now + DT)
    np.testing.assert_allclose(reading.position, HOME, atol=1e-11)
    assert robot.session.status().payload == ""
    # the same model again is no other one; with other functions it is
    robot.session.offer_model(offer(cold))
    other = replace(cold, functions=replace(cold.functions, compliance=np.zeros(6)))
    with pytest.raises(RefusedError, match="revision 1 with other numbers after 1"):
        robot.session.offer_model(offer(other))


def test_another_payload_than_the_models_is_told_with_what_it_may_cost() -> None:
    cold = with_joint_errors(drifted(NOMINAL, np.random.default_rng(0), 1e-4), 5)
    present = replace(cold.load, payload_mass=120.0)
    session = CorrectionSession(
        replace(NOMINAL, load=present), NOMINAL, "s1", CorrectionConfig(thermal=WIDE.thermal)
    )
    session.offer_model(offer(cold))
    # the reference's file, which says nothing of a load, uses the model as it was identified
    assert session.status().payload == ""
    carries = replace(NOMINAL, load=present)
    session = CorrectionSession(carries, carries, "s1", CorrectionConfig(thermal=WIDE.thermal))
    session.offer_model(offer(cold))
    words = session.status().payload
    told = "payload of what nobody stated .* without masses the model cannot follow"
    found = replace(cold, load=ArmLoad.unknown(6))
    session = CorrectionSession(carries, carries, "s1", CorrectionConfig(thermal=WIDE.thermal))
    session.offer_model(offer(found))
    assert re.search(told, session.status().payload)
    assert re.search(r"payload of 10 kg .* the robot file says 120 kg .* up to [0-9.]+ mm", words)
