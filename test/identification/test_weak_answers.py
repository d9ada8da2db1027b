# SPDX-License-Identifier: Apache-2.0
"""Poses that leave something open: what predictions need is found, the rest is held and named."""

from dataclasses import replace

import numpy as np
import pytest
from bent_robot import NOISE_M, BentRobot
from long_form import more
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from robocal_ros.bags.ur10_campaigns import load_campaign
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import identify, identify_and_judge
from robocal_ros.identification.cell_model import linear_start
from robocal_ros.identification.judged import identification_document, require_match
from robocal_ros.kinematics.robots import load_robot

RIGID = {"size_rad": 0.0, "compliance": np.zeros(6)}
FLAT_REACH_M = (0.2, 0.25, 0.0)  # in one plane, as a milling program goes


def parts(data, count):
    return data.take(np.arange(count)), data.take(np.arange(count, len(data)))


def rms(found, data):
    return float(np.sqrt(np.mean(np.sum(found.residual(data) ** 2, axis=1))))


@pytest.mark.parametrize("sigma", [None, NOISE_M])
@pytest.mark.parametrize("reach_m", [(0.2, 0.25, 0.2), FLAT_REACH_M])
def test_one_orientation_is_answered_with_figures(reach_m, sigma):
    """Base and target trade places: where such poses go the model is as good as the noise."""
    robot = BentRobot(5, **RIGID)
    data = robot.measured(robot.oriented(100, reach_m=reach_m))
    data = replace(data, sigma=None if sigma is None else np.full(100, sigma))
    judged = identify_and_judge(robot.nominal, *parts(data, 60), model="full")
    # noise of a position, and of a model of at most 33 unknowns from 180 numbers
    assert judged.candidate.rms_m < np.sqrt(3.0) * NOISE_M * np.sqrt(1.0 + 33.0 / 147.0) * 1.15
    assert judged.predicted_total_rms_m == pytest.approx(judged.candidate.rms_m, rel=0.25)
    # a wrist joint stands still: how the rest of the workspace looks is not known
    assert judged.verdict.code is Code.POSES_NOT_INFORMATIVE
    assert len(judged.identification.weak) == 3
    assert all("turn the flange" in words for words in judged.identification.weak)
    document = identification_document(judged)
    assert set(judged.identification.weak) <= set(document["unobservable"])


def test_the_nominal_model_is_fitted_as_well_as_it_can_be():
    """A target that hardly turns, against a search of another make over base and target."""
    robot = BentRobot(6)
    data = robot.measured(robot.oriented(40, wobble_rad=0.01))
    found = identify(robot.nominal, data, fit=("base", "tool"), robust=False)
    assert found.estimate.converged
    flange = robot.nominal.fk(data.q)

    def residual(x):
        point = (flange @ np.append(x[6:9], 1.0))[:, :3]
        return (Rotation.from_rotvec(x[:3]).apply(point) + x[3:6] - data.position).ravel()

    T, tip = found.cell.T_frame_base, found.cell.T_flange_target[0, :3, 3]
    start = np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3], tip])
    best = least_squares(residual, start, x_scale="jac", xtol=1e-14, ftol=1e-14)
    assert rms(found.cell, data) == pytest.approx(np.sqrt(2.0 * best.cost / 40), rel=0.01)


@pytest.mark.parametrize("wobble_rad", [0.005, *more(0.0005, 0.02)])
@pytest.mark.parametrize("sigma", [None, NOISE_M])
def test_weak_directions_do_not_creep(wobble_rad, sigma):
    robot = BentRobot(7)
    data = robot.measured(robot.oriented(80, wobble_rad))
    data = replace(data, sigma=None if sigma is None else np.full(80, sigma))
    for model in ("geometric", "full"):
        judged = identify_and_judge(robot.nominal, *parts(data, 50), model=model)
        assert judged.identification.estimate.converged
        assert judged.candidate.rms_m < 1.1 * judged.current.rms_m
    assert judged.candidate.rms_m < 0.5 * judged.current.rms_m


def test_check_data_of_one_orientation_place_base_and_target_anew():
    robot = BentRobot(8)
    train = robot.measured(robot.poses(250))
    check = robot.measured(robot.oriented(60))
    moved = frames.transform(frames.exp_rotation(np.array([1.0, 0.2, 0.3])), [1.0, 2.0, 3.0])
    position = check.position @ moved[:3, :3].T + moved[:3, 3]
    other = replace(check, position=position, target=("peg",) * 60)
    both = identify_and_judge(
        robot.nominal, train, other, model="full", check_refit=("base", "tool")
    )
    only = identify_and_judge(
        robot.nominal, train, replace(check, target=("peg",) * 60), model="full",
        check_refit=("tool",),
    )  # fmt: skip
    for judged in (both, only):
        assert judged.verdict.accept
        assert judged.candidate.mean_m < 0.4 * judged.nominal.mean_m


def seen_from_flange(robot, q):
    """A ball that stands still, as a sensor on the flange sees it."""
    T_flange_sensor = frames.transform(frames.exp_rotation(np.array([0.3, 0.2, 0.1])), [0, 0, 0.1])
    ball = np.array([-0.7, 0.2, 0.3, 1.0])
    seen = (frames.invert(robot.rigid.fk(q) @ T_flange_sensor) @ ball)[:, :3]
    names = tuple(str(i) for i in range(len(q)))
    position = seen + NOISE_M * robot.rng.standard_normal(seen.shape)
    return Measurements(q=q, position=position, target=("ball",) * len(q), sample=names)


@pytest.mark.parametrize("sigma", [None, NOISE_M])
@pytest.mark.parametrize("method", ["map", "lsq"])
def test_a_ball_seen_from_the_flange_is_named(method, sigma):
    robot = BentRobot(9, **RIGID)
    data = seen_from_flange(robot, robot.poses(60))
    data = replace(data, sigma=None if sigma is None else np.full(60, sigma))
    with pytest.raises(InputError, match="the sensor sits on the flange"):
        require_match(robot.nominal, data, base=True, tool=True)
    judged = identify_and_judge(robot.nominal, *parts(data, 40), model="full", method=method)
    assert judged.verdict.code is Code.RESIDUAL_TOO_LARGE


def test_points_of_one_plane_place_base_and_target():
    """The linear form leaves the third axis open; the rotation does not."""
    robot = BentRobot(10, **RIGID, noise_m=0.0)
    robot.nominal = replace(robot.rigid, load=robot.nominal.load)  # without any error
    data = robot.measured(robot.oriented(30, reach_m=FLAT_REACH_M))
    assert rms(linear_start(robot.rigid, data, base=True, tool=True, hold=True), data) < 1e-6


@pytest.fixture(scope="module")
def judged_with_gross_rows():
    robot = BentRobot(11)
    train, check = robot.measured(robot.poses(200)), robot.measured(robot.poses(100))
    position = check.position.copy()
    position[[3, 40]] += 0.01
    return identify_and_judge(robot.nominal, train, replace(check, position=position), model="full")


def test_every_held_out_row_counts(judged_with_gross_rows):
    judged = judged_with_gross_rows
    assert judged.held_out_rejected == ("3", "40")
    assert judged.candidate.n == 100
    assert judged.candidate.max_m > 0.015
    robust = judged.robust["calibrated"]
    assert (robust.n, judged.verdict.accept) == (98, True)
    assert robust.max_m < 0.002
    document = identification_document(judged)["calibrated"]
    assert document["held_out"]["n"] == 100
    assert document["held_out_robust"]["n"] == 98


@pytest.mark.parametrize(("factor", "code"), [(1.0, Code.ACCEPT), (0.1, Code.RESIDUAL_TOO_LARGE)])
def test_a_sigma_that_residuals_contradict_changes_the_verdict(factor, code):
    robot = BentRobot(12, **RIGID)
    data = robot.measured(robot.poses(120))
    data = replace(data, sigma=np.full(120, factor * NOISE_M))
    judged = identify_and_judge(robot.nominal, *parts(data, 60), model="full")
    assert judged.verdict.code is code
    # of 150 numbers that are left, three standard deviations of the ratio are 0.17
    assert judged.identification.sigma_ratio == pytest.approx(1.0 / factor, rel=0.18)
    assert ("sigma_mm" in judged.verdict.reason) == (factor != 1.0)


def test_orientations_do_not_hide_that_a_sigma_is_too_small(make_cell):
    """Noise of 1.4 times what is stated of it, and orientations that scatter by little."""
    cell, rng = make_cell(), np.random.default_rng(9)
    train, check = (
        cell.measure(cell.postures(n, rng), rng, noise_m=NOISE_M, noise_rad=1e-5, sigma=True)
        for n in (150, 100)
    )
    stated = [replace(data, sigma=data.sigma / 1.4) for data in (train, check)]
    judged = identify_and_judge(cell.nominal, *stated)
    found = judged.identification
    # of 450 numbers less unknowns, four sigmas
    assert found.noise_m == pytest.approx(NOISE_M, rel=4.0 / np.sqrt(2.0 * 400.0))
    assert found.sigma_ratio == pytest.approx(1.4, rel=4.0 / np.sqrt(2.0 * 400.0))
    expected = judged.predicted_total_rms_m
    assert judged.candidate.rms_m == pytest.approx(expected, rel=4.0 / np.sqrt(2.0 * 300.0))


@pytest.mark.data
def test_orientations_of_a_real_grid(data_dir):
    """Series A has 25 orientations of the flange; 200 poses of one, positions alone."""
    arm, data = load_robot("ur10"), load_campaign("A", data_dir / "ur10_tmac")
    turned = Rotation.from_matrix(arm.fk(data.q)[:, :3, :3]).as_rotvec()
    _, group = np.unique(np.round(turned / np.radians(2.0)), axis=0, return_inverse=True)
    rows = np.flatnonzero(group == np.argmax(np.bincount(group)))
    rows = np.random.default_rng(0).permutation(rows)[:200]
    judged = identify_and_judge(
        arm, *parts(replace(data, rotation=None).take(rows), 100), model="full"
    )
    assert judged.verdict.accept
    assert judged.candidate.mean_m < 0.25 * judged.nominal.mean_m


@pytest.mark.data
def test_a_half_that_saw_other_angles_is_not_covered(data_dir):
    data = load_campaign("D", data_dir / "ur10_tmac")
    judged = identify_and_judge(load_robot("ur10"), *parts(data, 316), model="full")
    assert judged.check_outside > 0.5
    assert "of the check poses are not covered" in judged.verdict.reason
    coverage = identification_document(judged)["coverage"]
    assert coverage["not_covered"]["code"] == "POSES_NOT_INFORMATIVE"
    assert coverage["covered"]["code"] == judged.verdict.code.name
    # at poses that it claims to know it is better than geometry
    plain = identify_and_judge(load_robot("ur10"), *parts(data, 316))
    inside = ~np.any(judged.away, axis=1)
    check = data.take(np.arange(316, 632))
    full, geometric = (
        np.linalg.norm(found.identification.cell.residual(check), axis=1)[inside]
        for found in (judged, plain)
    )
    assert full.mean() < 0.7 * geometric.mean()
