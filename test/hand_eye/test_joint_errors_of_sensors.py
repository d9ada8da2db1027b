# SPDX-License-Identifier: Apache-2.0
"""What is said of joints that err is what comes, of a camera and of a sensor by laser tracker.

The truth is a UR10 with its gears as identified, set anywhere on them, and random poses.
"""

from dataclasses import replace

import numpy as np
import pytest
from long_form import amount, more
from scipy.stats import chi2

from bench.hand_eye_cell import IN_HAND, TO_HAND
from bench.hand_eye_joints import (
    NARROW_RAD,
    SIZE_RAD,
    WIDE_RAD,
    camera_cell,
    camera_pairs,
    camera_run,
    repeated,
    tracker_run,
    ur10,
)
from bench.laser_tracker import six_axis_cell
from bench.measured_runs import Q_NEAR
from robocal_ros.hand_eye.camera import joint_errors
from robocal_ros.hand_eye.camera_fit import GivenNoise, fit_pairs
from robocal_ros.hand_eye.result import hand_eye_document
from robocal_ros.hand_eye.tracker import solve_tracker
from robocal_ros.kinematics.joint_errors import HONEST
from robocal_ros.kinematics.joint_functions import JointFunctions
from robocal_ros.kinematics.robots import load_robot

CASES = {
    "in hand": (camera_run(IN_HAND, WIDE_RAD), 40, 1.0),
    "in hand, poses near one another": (camera_run(IN_HAND, NARROW_RAD), 40, 1.3),
    "to hand": (camera_run(TO_HAND, WIDE_RAD), 40, 1.3),
    "to hand, poses near one another": (camera_run(TO_HAND, NARROW_RAD), 40, 1.3),
    "tracker": (tracker_run, 16, 5.0),
}
ENDS = 1e-3  # chance of either end of the chi-squares


@pytest.mark.parametrize("case", ["in hand", "tracker", *more(*list(CASES)[1:-1])])
def test_what_comes_is_what_was_foretold(case):
    run, runs, least = CASES[case]
    found, refused = repeated(run, runs := amount(runs, 10 * runs))
    solved = runs - refused
    print(f"{case}: {found}, {refused} of {runs} refused")
    low, high = chi2.ppf([ENDS, 1.0 - ENDS], 6 * solved) / (6 * solved)
    assert solved > 0.5 * runs
    assert low / HONEST < found.both < HONEST * high
    assert low / HONEST < found.came / found.foretold < HONEST * high
    assert found.foretold > least


@pytest.mark.parametrize("case", ["in hand", *more(*list(CASES)[1:])])
def test_a_robot_that_shows_less_scatter_errs_less(case):
    """What is told holds; of joints as much is said as residuals leave open, and no more."""
    run, runs, _ = CASES[case]
    found, refused = repeated(run, runs := amount(runs, 10 * runs), erring=False)
    print(f"{case}: {found}")
    low, high = chi2.ppf([ENDS, 1.0 - ENDS], 6 * runs) / (6 * runs)
    assert refused == 0
    assert low / HONEST < found.came < HONEST * high
    assert found.size_rad < (0.1 if case == "tracker" else 0.7) * SIZE_RAD


def test_joints_err_by_no_more_than_positions_of_both_sides_scatter():
    """Which is found, whatever is given of the robot's: of tables a camera has no covariance."""
    rng = np.random.default_rng(4)
    fit = fit_pairs(camera_pairs(camera_cell(IN_HAND), ur10(rng), WIDE_RAD, rng))
    found, given = (joint_errors(fit, 1e-2, known) for known in (GivenNoise(), GivenNoise(1e-4)))
    assert found is not None
    assert given is not None
    assert found.size_rad < 2e-3
    assert (given.size_rad, given.factor) == (found.size_rad, found.factor)


def test_nothing_else_of_a_result_changes():
    """And nothing is said where that is not wanted, or where the model holds what joints err by."""
    cell = six_axis_cell(load_robot("ur10"), Q_NEAR)
    data = cell.measure(np.random.default_rng(1))

    def document(size_rad, functions=None):
        told = (
            data if functions is None else replace(data, arm=replace(data.arm, functions=functions))
        )
        noise = cell.sizes.noise
        found = solve_tracker(told, cell.sizes.target, noise, joint_error_rad=size_rad)
        return hand_eye_document(found)

    without, with_it = document(0.0), document(SIZE_RAD)
    assert without.pop("joint_errors") is None
    assert set(with_it.pop("joint_errors")) == {"size_urad", "sigma_mm", "factor"}
    assert without.pop("verdict")["code"] == with_it.pop("verdict")["code"]
    assert without == with_it
    held = JointFunctions(np.zeros(6), np.ones(6), np.full((6, 8), 1e-9), np.zeros(6))
    assert document(SIZE_RAD, held)["joint_errors"] is None
