# SPDX-License-Identifier: Apache-2.0
"""Errors that models leave: none by the true model, the whole drift by the cold one."""

import numpy as np
import pytest

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.reference import (
    ColdReference,
    capture_reference,
    measured_errors,
    true_errors,
)

TOOL = np.array([0.1, 0.05, 0.2])
T_SENSOR_BASE = frames.transform(frames.exp_rotation(np.array([0.3, -0.2, 1.0])), [2.0, 1.0, -0.5])
ARM = load_robot("kr150_r3100")
Q = np.random.default_rng(2).uniform(-1.2, 1.2, (12, 6))
SECOND_ORDER_M = 1e-6  # drifts of 0.2 mm and 0.1 mrad over 3 m: their products stay below


def drifted() -> SerialArm:
    chosen = ARM.parameters
    size = np.where(chosen.is_length, 2e-4, 1e-4)
    return ARM.with_mdh(chosen.add(ARM.mdh, size * np.random.default_rng(3).normal(size=len(size))))


def visit(arm: SerialArm, q: np.ndarray = Q, noise_m: float = 0.0) -> Measurements:
    at = (T_SENSOR_BASE @ arm.fk(q) @ np.append(TOOL, 1.0))[:, :3]
    noise = noise_m * np.random.default_rng(4).standard_normal(at.shape)
    names = tuple(map(str, range(len(q))))
    stamps = np.arange(len(q), dtype=np.int64)
    return Measurements(q, at + noise, ("ball",) * len(q), names, stamp_ns=stamps)


@pytest.fixture(scope="module")
def reference() -> ColdReference:
    return capture_reference(ARM, visit(ARM))


def test_in_truth_the_true_model_leaves_nothing_and_the_cold_one_everything():
    warm, point = drifted(), np.append(TOOL, 1.0)
    moved = ((warm.fk(Q) - ARM.fk(Q)) @ point)[:, :3]
    np.testing.assert_allclose(true_errors(ARM, warm, Q, TOOL, moved), 0.0, atol=1e-15)
    np.testing.assert_array_equal(true_errors(ARM, ARM, Q, TOOL, moved), moved)


def test_what_the_true_model_leaves_is_what_corrected_joints_miss():
    """Joints corrected by a model that knows half of the drift, executed by the true robot."""
    warm, point = drifted(), np.append(TOOL, 1.0)
    half = ARM.with_mdh(0.5 * (ARM.mdh + warm.mdh))
    wanted = (ARM.fk(Q) @ point)[:, :3]
    q = Q.copy()
    for _ in range(3):
        miss = wanted - (half.fk(q) @ point)[:, :3]
        J = np.stack([((half.fk(q + 1e-6 * e) - half.fk(q)) @ point)[:, :3] / 1e-6
                      for e in np.eye(6)], axis=2)  # fmt: skip
        q = q + np.einsum("mij,mj->mi", np.linalg.pinv(J), miss)
    executed = (warm.fk(q) @ point)[:, :3] - wanted
    moved = ((warm.fk(Q) - ARM.fk(Q)) @ point)[:, :3]
    told = true_errors(ARM, half, Q, TOOL, moved)
    assert np.abs(told).max() > 1e-4
    np.testing.assert_allclose(executed, told, atol=SECOND_ORDER_M)


def test_measured_errors_are_the_drift_and_nothing(reference):
    warm = drifted()
    data = visit(warm)
    cold, none = measured_errors(reference, data, [ARM, warm], sigma_m=1e-5)
    moved = ((warm.fk(Q) - ARM.fk(Q)) @ np.append(TOOL, 1.0))[:, :3] @ T_SENSOR_BASE[:3, :3].T
    order = [list(reference.spots.match(data)).index(i) for i in range(len(Q))]
    seen = {tuple(np.round(row, 6)) for row in cold[order]}
    assert seen == {tuple(np.round(row, 6)) for row in moved}
    np.testing.assert_allclose(none, 0.0, atol=SECOND_ORDER_M)


def test_a_visit_left_out_is_not_counted(reference):
    (all_of_them,) = measured_errors(reference, visit(drifted()), [ARM], sigma_m=1e-5)
    (rest,) = measured_errors(reference, visit(drifted()), [ARM], left_out=["3"], sigma_m=1e-5)
    assert (len(all_of_them), len(rest)) == (12, 11)


def test_a_pose_without_a_cold_visit_is_refused(reference):
    with pytest.raises(InputError, match="was not measured in the cold reference"):
        measured_errors(reference, visit(ARM, Q + 0.1), [ARM], sigma_m=1e-5)
