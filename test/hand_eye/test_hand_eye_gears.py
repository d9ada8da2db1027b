# SPDX-License-Identifier: Apache-2.0
"""What is told of a mount where the robot's joints err as a real UR10's do, with backlash.

Each draw has another robot, its gears set elsewhere, other poses and other noise. The model in
force knows nothing of the gears.
"""

from collections.abc import Callable

import numpy as np
import pytest
from long_form import amount, more
from scipy.stats import chi2

from bench.hand_eye_cell import HandEyeCell
from bench.hand_eye_profiles import EXACT, with_gears
from bench.hand_eye_worlds import Calibration, X, edge_set, sphere_set, step_set
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.mount_fit import fit_mount, mount_errors
from robocal_ros.hand_eye.mount_problem import pivot_of
from robocal_ros.hand_eye.result import HandEyeSettings, PoseNoise, increment
from robocal_ros.hand_eye.solve import features, look, verify
from robocal_ros.kinematics.joint_errors import HONEST

Make = Callable[[HandEyeCell, np.random.Generator], Calibration]
GEARS_RAD = 3e-4  # rms of a UR10's joints, 240 to 380 urad (docs/simulation.md)
DRAWS: dict[Make, int] = {
    step_set: amount(16, 200),
    sphere_set: amount(16, 200),
    edge_set: amount(6, 60),
}


def squared_errors(made: Calibration) -> tuple[float, float, float]:
    """Over what is told, and with what joints that err add; the square of what is said of it."""
    task = made.task()
    view = features(task, made.data).view
    fit = fit_mount((view,), look(task, view)[0])
    step = increment(fit.state.T_flange_sensor, X, pivot_of(fit.views))
    told, joints = fit.covariance[:6, :6], made.data.joints
    assert joints is not None
    said = mount_errors(fit, told, joints, GEARS_RAD, None)
    assert said is not None
    alone, both = (step @ np.linalg.solve(C, step) for C in (told, told + said.covariance))
    return float(alone), float(both), said.factor**2


@pytest.mark.parametrize("make", [sphere_set, *more(step_set, edge_set)])
def test_sigmas_of_a_mount_hold_with_gears(make: Make):
    """By chi-square of six numbers a draw, with what the verdict says that gears add.

    Poses far apart show most of the gears as scatter. The frame of stairs is known as well as that
    scatter allows. Along an edge a few joints turn slowly, and what they err by is not all scatter.
    """
    squared = []
    for seed in range(DRAWS[make]):
        rng = np.random.default_rng([80, seed])
        cell = HandEyeCell(sensor=EXACT, robot=with_gears(rng))
        squared.append(squared_errors(make(cell, rng)))
    numbers = 6 * DRAWS[make]
    low, high = chi2.ppf([5e-4, 1.0 - 5e-4], numbers) / numbers
    alone, both, said = np.mean(squared, axis=0) / [6.0, 6.0, 1.0]
    print(f"{make.__name__}: {alone:.2f}, said {said:.2f}; {both:.2f} ({low:.2f} to {high:.2f})")
    assert low / HONEST < both < high
    assert low / HONEST < alone / said < high


def test_a_taught_frame_is_no_better_than_the_robot_that_taught_it():
    """The told sigma of its place is not below that of the robot's poses, as found or as given."""
    rng = np.random.default_rng(1)
    made = step_set(HandEyeCell(sensor=EXACT, robot=with_gears(rng)), rng)
    alone = PoseNoise(1e-6, 1e-6)
    model = features(made.task(), made.data).view.model
    for sigma_m in (1e-6, 1e-4, 5e-4):
        known = np.sqrt(1.0 / np.diag(model.prior(PoseNoise(sigma_m, sigma_m / 3.0))))
        told = np.sqrt(1.0 / np.diag(model.prior(alone)))
        assert known[:3] == pytest.approx(np.hypot(told[:3], sigma_m), rel=1e-3)
    exact = step_set(HandEyeCell(sensor=EXACT), rng)  # a frame that is told to be exact stays it
    assert features(exact.task(), exact.data).view.model.names == ()


@pytest.mark.parametrize("seed", range(amount(2, 20)))
def test_a_taught_frame_shows_a_mount_that_is_off(seed: int):
    """What a mount is off by is not taken for the robot's scatter, by which the frame may move."""
    rng = np.random.default_rng([81, seed])
    made = step_set(HandEyeCell(sensor=EXACT, robot=with_gears(rng)), rng)
    assert verify(made.task(), made.data, X, HandEyeSettings()).verdict.accept
    for axis in np.eye(3):
        off = X.copy()
        off[:3, 3] += 3e-3 * axis  # three times the limit; the gears are half of it
        found = verify(made.task(), made.data, off, HandEyeSettings())
        assert found.verdict.code is Code.RESIDUAL_TOO_LARGE
