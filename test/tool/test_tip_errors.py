# SPDX-License-Identifier: Apache-2.0
"""What joints that err add to a tip: by differences, and as a run's verdict says it."""

from dataclasses import replace

import numpy as np
import pytest
from tool_driver import TAUGHT, TRUTH, Driver, config_of, noisy_cell

from bench.measured_runs import Q_NEAR
from robocal_ros.cell_sim.beams import RoundTool
from robocal_ros.cell_sim.gears import ur10_gears
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.joint_errors import ALIKE_RAD
from robocal_ros.kinematics.joint_functions import JointFunctions
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.tool.judging import tip_errors
from robocal_ros.tool.session import ToolSession

ARM = load_robot("ur10")
TIP = TAUGHT[:3, 3]
TOLD = 1e-10 * np.eye(3)
SIZE_RAD, H = 3e-4, 1e-6


def seen_tip(q: np.ndarray, off: np.ndarray) -> np.ndarray:
    """A tip that truly is at the beams' crossing, in the flange of readings that are off."""
    crossing = ARM.fk(q)[:3, :3] @ TIP + ARM.fk(q)[:3, 3]
    T = ARM.fk(q - off)
    return T[:3, :3].T @ (crossing - T[:3, 3])


def by_differences(q: np.ndarray) -> np.ndarray:
    steps = H * np.eye(ARM.n)
    return np.array([seen_tip(q, h) - seen_tip(q, -h) for h in steps]).T / (2.0 * H)


def test_the_covariance_is_that_of_differences():
    """Alone, and of two runs whose joints share a part of what they err by."""
    other = Q_NEAR + np.radians([2.0, -1.0, 4.0, 0.0, 30.0, 3.0])
    now, before = by_differences(Q_NEAR), by_differences(other)
    alone = tip_errors(ARM, SIZE_RAD, (Q_NEAR, TIP), None, TOLD)
    assert alone.covariance == pytest.approx(SIZE_RAD**2 * now @ now.T, rel=1e-5)
    alike = np.exp(-0.5 * ((other - Q_NEAR) / ALIKE_RAD) ** 2)
    pair = np.block([[np.eye(6), np.diag(alike)], [np.diag(alike), np.eye(6)]])
    rows = np.hstack([now, -before])
    both = tip_errors(ARM, SIZE_RAD, (Q_NEAR, TIP), (other, TIP), TOLD)
    assert both.covariance == pytest.approx(SIZE_RAD**2 * rows @ pair @ rows.T, rel=1e-5)
    size = np.trace(both.covariance) / np.trace(TOLD)
    assert both.factor == pytest.approx(np.sqrt(1.0 + size))


def test_the_same_joints_cancel_and_nothing_is_said():
    same = tip_errors(ARM, SIZE_RAD, (Q_NEAR, TIP), (Q_NEAR, TIP), TOLD)
    assert same.factor == pytest.approx(1.0)
    assert same.words("tip") == ""


def test_what_the_model_in_force_holds_is_not_added():
    functions = JointFunctions(np.zeros(6), np.ones(6), np.full((6, 8), 1e-4), np.zeros(6))
    arm = replace(ARM, functions=functions)
    assert tip_errors(arm, SIZE_RAD, (Q_NEAR, TIP), None, TOLD) is None
    none = replace(ARM, functions=replace(functions, coefficients=np.zeros((6, 8))))
    assert tip_errors(none, SIZE_RAD, (Q_NEAR, TIP), None, TOLD) is not None


def test_joints_are_alike_as_far_as_those_of_a_real_arm():
    """Mean square of what a UR10's identified functions differ by, 1 to 4 deg apart."""
    gears, apart = ur10_gears(), np.radians([1.0, 2.0, 3.0, 4.0])
    squares = [np.sum(gears.amplitude**2 * (1.0 - np.cos(gears.frequency * d)), 1) for d in apart]
    real = np.mean(squares, axis=1)
    model = 2.0 * SIZE_RAD**2 * (1.0 - np.exp(-0.5 * (apart / ALIKE_RAD) ** 2))
    assert np.all(np.abs(model / real - 1.0) < 0.2)  # in sigmas a tenth


@pytest.mark.parametrize("healthy", [True, False])
def test_a_runs_verdict_says_it(tmp_path, healthy):
    """Of a bent tool, whose joints are others than the healthy one's; without that all of them."""
    cell = noisy_cell()
    with CalibrationHistory.open("K1", state_dir=tmp_path) as history:
        config = config_of(cell, joint_error_rad=SIZE_RAD)
        driver = Driver(
            ToolSession(cell.arm, history, config, "test"),
            cell,
            RoundTool.cylinder(TAUGHT if healthy else TRUTH, 2.5e-3),
        )
        if healthy:
            assert driver.measure("reference").done
            same = driver.measure()
            assert same.status is Code.NO_SIGNIFICANT_GAIN
            assert "joints that err" not in same.message  # at the healthy tool's joints
            assert same.document["joint_errors"]["factor"] < 1.1
            driver.program.tool = RoundTool.cylinder(TRUTH, 2.5e-3)
        found = driver.measure()
        factor = found.document["joint_errors"]["factor"]
        assert found.status is Code.ACCEPT, found.message
        assert "joints that err by 300 urad" in found.message
        assert found.message.endswith(f"count {factor:.1f} of it")
        assert factor > (1.2 if healthy else 3.0)
