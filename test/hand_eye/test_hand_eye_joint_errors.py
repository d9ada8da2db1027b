# SPDX-License-Identifier: Apache-2.0
"""What joints that err add to a mount: of errors drawn as they are taken to be, many times."""

from dataclasses import replace

import numpy as np
import pytest
from long_form import amount
from scipy.stats import chi2

from bench.hand_eye_cell import HandEyeCell
from bench.hand_eye_profiles import EXACT, arm
from bench.hand_eye_worlds import CENTRE, Calibration, X, edge_set, sphere_set
from robocal_ros.ground import frames
from robocal_ros.hand_eye.mount_fit import MountFit, fit_mount, mount_errors
from robocal_ros.hand_eye.mount_problem import MountState, TargetView, pivot_of
from robocal_ros.hand_eye.result import PoseNoise, increment
from robocal_ros.hand_eye.solve import features, look
from robocal_ros.kinematics.joint_errors import (
    ALIKE_RAD,
    HONEST,
    JointErrors,
    ShotJoints,
    flange_errors,
)
from robocal_ros.kinematics.joint_functions import JointFunctions
from robocal_ros.kinematics.robots import load_robot

ARM = load_robot("ur10")
SIZE_RAD = 3e-4
REPEAT_M, REPEAT_RAD = 3e-5, 1e-5  # of a pose, anew each time
DRAWS = amount(32, 120)
DRAW_ALIKE = 1e-3  # chance of either end of the chi-squares


class Shots:
    """Sightings as they truly are, from true joints, and what is made of them as they err."""

    def __init__(self, make, tilt_deg: float) -> None:
        rng = np.random.default_rng(7)
        turn = float(np.radians(tilt_deg))
        cell = HandEyeCell(EXACT, arm(rng), tilt_rad=turn, roll_rad=2.4 * turn)
        made: Calibration = make(cell, rng)
        view = features(made.task(), made.data).view
        self.q = made.data.joints.q
        place = CENTRE if make is sphere_set else look(made.task(), view)[0].places[0]
        self.start = MountState(X, (place,))
        T = ARM.fk(self.q)[view.sightings.shot]
        value = view.model.see(T @ X, place).value
        self.view = TargetView(view.model, replace(view.sightings, T_base_flange=T, value=value))
        apart = self.q[:, None] - self.q
        alike = np.exp(-0.5 * (apart / ALIKE_RAD) ** 2)
        ridge = 1e-10 * np.eye(len(self.q))
        self.roots = [np.linalg.cholesky(alike[..., j] + ridge) for j in range(ARM.n)]

    def fit(self, rng, size_rad: float, given: PoseNoise | None = None) -> MountFit:
        """From readings that are off by smooth functions of each joint, and poses that scatter."""
        s = self.view.sightings
        off = [root @ rng.standard_normal(len(self.q)) for root in self.roots]
        T = ARM.fk(self.q - size_rad * np.array(off).T)
        noise = rng.standard_normal((len(T), 6)) * np.repeat([REPEAT_M, REPEAT_RAD], 3)
        T = (T @ frames.transform(frames.exp_rotation(noise[:, 3:]), noise[:, :3]))[s.shot]
        seen = s.value.copy()
        spread = np.linalg.cholesky(s.covariance)
        seen += (spread @ rng.standard_normal((*seen.shape, 1)))[..., 0] * (s.value != 0.0)
        view = replace(self.view, sightings=replace(s, T_base_flange=T, value=seen))
        return fit_mount((view,), self.start, given)

    def said(self, fit: MountFit, given: PoseNoise | None = None) -> JointErrors:
        joints = ShotJoints(ARM, self.q)
        found = mount_errors(fit, fit.covariance[:6, :6], joints, SIZE_RAD, given)
        assert found is not None
        return found


def squared_error(fit: MountFit, covariance) -> float:
    step = increment(fit.state.T_flange_sensor, X, pivot_of(fit.views))
    return float(step @ np.linalg.solve(covariance, step)) / 6.0


@pytest.mark.long
@pytest.mark.parametrize(
    ("make", "tilt_deg", "least"),
    [(sphere_set, 6.0, 1.6), (sphere_set, 25.0, 1.1), (edge_set, 25.0, 1.1)],
    ids=["a sphere from poses near one another", "a sphere", "an edge"],
)
def test_what_comes_is_what_was_foretold(make, tilt_deg, least):
    """Joints err by as much as is said, one draw of their functions after another."""
    shots, rng = Shots(make, tilt_deg), np.random.default_rng(8)
    rows = []
    for _ in range(DRAWS):
        fit = shots.fit(rng, SIZE_RAD)
        told, said = fit.covariance[:6, :6], shots.said(fit)
        of_both = squared_error(fit, told + said.covariance)
        rows.append([squared_error(fit, told), said.factor**2, of_both])
    came, foretold, both = np.mean(rows, axis=0)
    print(f"came {came:.2f}, foretold {foretold:.2f}; with it {both:.2f}")
    low, high = chi2.ppf([DRAW_ALIKE, 1.0 - DRAW_ALIKE], 6 * DRAWS) / (6 * DRAWS)
    assert low / HONEST < both < HONEST * high
    assert low / HONEST < came / foretold < HONEST * high
    assert foretold > least
    if least > HONEST:
        assert came > HONEST * high  # what is told alone does not hold it


def test_joints_that_show_less_scatter_err_less():
    """Of a robot without gears as much is said as its poses scatter; given noise is believed."""
    shots = Shots(sphere_set, 10.0)
    calm = shots.fit(np.random.default_rng(9), 0.0)
    said = shots.said(calm)
    assert said.size_rad < 0.3 * SIZE_RAD
    known = PoseNoise(REPEAT_M, REPEAT_RAD)
    believed = shots.fit(np.random.default_rng(9), 0.0, known)
    said_of_known = shots.said(believed, known)
    assert said_of_known.size_rad == SIZE_RAD
    assert said_of_known.factor > 2.0 * said.factor


def test_what_the_model_holds_is_not_added():
    shots = Shots(sphere_set, 10.0)
    fit = shots.fit(np.random.default_rng(9), SIZE_RAD)
    assert "joints that err by" in shots.said(fit).words("mount")
    functions = JointFunctions(np.zeros(6), np.ones(6), np.full((6, 8), 1e-4), np.zeros(6))
    joints = ShotJoints(replace(ARM, functions=functions), shots.q)
    assert mount_errors(fit, fit.covariance[:6, :6], joints, SIZE_RAD, None) is None


def test_a_pose_errs_as_its_joints_turn_it():
    """The covariance of one pose, and of two that share a part, from differences."""
    q = np.array([[0.1, -1.2, 1.4, -0.6, 0.8, 0.3], [0.13, -1.2, 1.3, -0.6, 0.8, 0.9]])
    h, moves = 1e-6, []
    for one in q:
        ends = [ARM.fk(one + sign * h * np.eye(6)) for sign in (1.0, -1.0)]
        D = frames.invert(ARM.fk(one)) @ (ends[0] - ends[1]) / (2.0 * h)
        v, W = D[:, :3, 3], D[:, :3, :3]
        moves.append(np.hstack([v, W[:, [2, 0, 1], [1, 2, 0]]]).T)
    found = flange_errors(ARM, SIZE_RAD, q)
    alike = np.exp(-0.5 * ((q[0] - q[1]) / ALIKE_RAD) ** 2)
    for row in range(2):
        alone = SIZE_RAD**2 * moves[row] @ moves[row].T
        assert np.allclose(found[row, :, row], alone, atol=1e-5 * alone.max())
    both = SIZE_RAD**2 * moves[0] * alike @ moves[1].T
    assert np.allclose(found[0, :, 1], both, atol=1e-5 * both.max())
