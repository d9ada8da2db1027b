# SPDX-License-Identifier: Apache-2.0
"""Joint functions and compliances: simulated by other code, found, and never for the worse."""

import json
from dataclasses import replace

import numpy as np
import pytest
from bent_robot import COMPLIANCE, LOWER, NOISE_M, TIP, UPPER, BentRobot
from long_form import more
from scipy.linalg import null_space
from scipy.stats import beta, binom, chi2
from scipy.stats import f as fisher

from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.robot import Effects, Warmth
from robocal_ros.estimation.estimation import chi2_quantile
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import (
    full_model,
    identify,
    identify_and_hold_out,
    identify_and_judge,
    row_kernels,
)
from robocal_ros.identification import known_model as model_knowledge
from robocal_ros.identification.full_model import (
    FullIdentification,
    identify_full,
    without_masses,
)
from robocal_ros.identification.joint_functions import (
    FunctionPrior,
    JointEvidence,
    JointTerms,
)
from robocal_ros.identification.judged import (
    held_out_errors,
    identification_document,
    identified_model_document,
)
from robocal_ros.identification.known_model import gravity_torque, known_model
from robocal_ros.kinematics.arm import arm_of, model_document
from robocal_ros.kinematics.joint_functions import ArmLoad
from robocal_ros.kinematics.robots import load_robot, save_robot

WEIGHTLESS = ArmLoad(np.zeros(6), np.zeros((6, 3)))


def rms_mm(found, data):
    return float(np.sqrt(np.mean(np.sum(found.cell.residual(data) ** 2, axis=1)))) * 1e3


@pytest.fixture(scope="module")
def bent():
    robot = BentRobot(1)
    data, check = robot.measured(robot.poses(1200)), robot.measured(robot.poses(1000), 0.0)
    return robot, data, check, identify_full(robot.nominal, data)


@pytest.fixture(scope="module")
def fewer(bent):
    """Robot, and as many of its measurements as find functions and compliances."""
    robot, data, *_ = bent
    return robot, data.take(np.arange(400))


def test_torque_is_the_slope_of_the_potential():
    robot = BentRobot(0)
    q = robot.poses(20)
    expected = robot.torque(q)
    assert gravity_torque(robot.nominal, q) == pytest.approx(expected, abs=1e-6 * 300.0)
    assert gravity_torque(replace(robot.nominal, load=None), q) is None


def test_functions_and_compliances_are_found(bent):
    """What is left is a fraction of what a rigid model leaves, and as large as the model says."""
    robot, data, check, found = bent
    plain = identify(robot.nominal, data)
    assert rms_mm(found, check) < 0.25 * rms_mm(plain, check)
    assert isinstance(found, FullIdentification)
    functions = found.cell.arm.functions
    assert np.array_equal(functions.compliance > 0.0, COMPLIANCE > 0.0)
    assert functions.compliance == pytest.approx(COMPLIANCE, abs=1e-6)
    error = found.cell.residual(check)
    variance = found.predicted_variance(check.q, np.zeros(len(check), dtype=np.int64))
    squared = np.sum(error * np.linalg.solve(variance, error[..., None])[..., 0], axis=1)
    # errors of neighbours go together: of 1000 poses some hundred are independent
    assert 0.7 < np.mean(squared) / 3.0 < 1.4
    assert np.mean(squared < chi2_quantile(0.95, 3.0)) > 0.9
    assert found.noise_m == pytest.approx(NOISE_M, rel=0.25)


def test_function_is_the_joints_error_within_its_band(bent):
    """Of the elbow, but for what the geometry explains: its mean and one slow harmonic."""
    robot, _, _, found = bent
    q = np.zeros((400, 6))
    q[:, 2] = np.linspace(LOWER[2] + 0.1, UPPER[2] - 0.1, 400)
    slow = np.stack([np.ones(400), np.sin(q[:, 2]), np.cos(q[:, 2])], axis=1)
    difference = found.cell.arm.functions.delta(q)[:, 2] - robot.own_error(q)[:, 2]
    difference -= slow @ np.linalg.lstsq(slow, difference, rcond=None)[0]
    sigma = found.known.function_sigma(q)[:, 2]
    assert np.sqrt(np.mean(difference**2)) < 1.3 * np.sqrt(np.mean(sigma**2))
    assert np.sqrt(np.mean(difference**2)) < 0.3 * robot.own_error(q)[:, 2].std()


@pytest.mark.parametrize("method", ["map", "lsq"])
def test_a_function_has_mean_zero_where_its_zero_is_free(method):
    """A mean that goes into theta0 changes no prediction where joints were measured, nor its sigma.

    What `lsq` holds stays as it is, function and zero.
    """
    robot = BentRobot(5)
    data, check = robot.measured(robot.poses(250)), robot.measured(robot.poses(200), 0.0)
    arm = replace(robot.nominal, load=WEIGHTLESS)  # torques go with the zeros
    lower, upper = data.q.min(axis=0), data.q.max(axis=0)
    check = check.take(np.all((check.q > lower) & (check.q < upper), axis=1))
    solved, _ = full_model._solved(arm, data, ("base", "tool", "geometry"), method)
    at, found = solved.at, solved.reported(1.0)
    target = np.zeros(len(check), dtype=np.int64)
    before = at.cell.predict(check.q, target)
    assert found.cell.predict(check.q, target) == pytest.approx(before, abs=1e-12)
    known = replace(found.known, cell=at.cell, covariance=at.posterior.covariance)
    told = found.predicted_variance(check.q, target)
    assert told == pytest.approx(known.predicted_variance(check.q, target), rel=1e-6, abs=1e-18)

    functions, terms = found.cell.arm.functions, found.known.terms
    free = np.array([f"theta{joint}_deg" in found.layout.names for joint in range(1, 7)])
    assert free.tolist() == [method == "map", True, True, True, True, method == "map"]
    measured = terms.count - 9  # three splines beyond either end
    for joint in np.flatnonzero(terms.count):
        step = terms.step[joint]
        edges = lower[joint] + step * np.arange(measured[joint] + 1)
        assert edges[-2] < upper[joint] <= edges[-1] + 1e-12
        node, weight = np.polynomial.legendre.leggauss(4)
        q = np.zeros((4 * measured[joint], 6))
        q[:, joint] = (edges[:-1, None] + 0.5 * step * (1.0 + node)).ravel()
        mean = np.tile(weight, measured[joint]) @ functions.delta(q)[:, joint] / 2.0
        mean /= measured[joint]
        was = at.cell.arm.functions
        if free[joint]:
            assert mean == pytest.approx(0.0, abs=1e-15)
        else:
            assert functions.coefficients[joint] == pytest.approx(was.coefficients[joint])


def test_a_mean_that_moves_takes_the_torques_along(bent, fewer):
    """Torques are of the arm as it stands: less than a micrometre, where noise is tens of them."""
    (robot, data), check = fewer, bent[2]
    solved, _ = full_model._solved(robot.nominal, data, ("base", "tool", "geometry"), "map")
    target = np.zeros(len(check), dtype=np.int64)
    places = [cell.predict(check.q, target) for cell in (solved.at.cell, solved.reported(1.0).cell)]
    assert places[1][:, :3, 3] == pytest.approx(places[0][:, :3, 3], abs=1e-6)


def test_outside_of_what_was_measured_the_prior_is_left(bent):
    robot, _, _, found = bent
    far = robot.poses(200, UPPER + 0.5, UPPER + 0.9)
    assert np.all(found.cell.arm.functions.delta(far) == 0.0)
    present = found.known.terms.count > 0
    expected = np.broadcast_to(np.where(present, found.known.prior.amplitude, 0.0), far.shape)
    assert found.known.function_sigma(far) == pytest.approx(expected)
    target = np.zeros(200, dtype=np.int64)
    near = found.predicted_variance(robot.poses(200), target)
    assert np.mean(np.trace(found.predicted_variance(far, target), axis1=1, axis2=2)) > 10.0 * (
        np.mean(np.trace(near, axis1=1, axis2=2))
    )


@pytest.mark.parametrize("way", ["document", "robot file"])
def test_a_model_that_was_read_back_is_known_as_well_as_when_it_was_found(bent, tmp_path, way):
    """Its readings are rounded to 1e-6 rad, and the last step of the solution moved its rows."""
    robot, _, check, found = bent
    arm = found.cell.arm
    if way == "document":
        back = arm_of(json.loads(json.dumps(model_document(arm))), robot.nominal)
    else:
        save_robot(arm, tmp_path / "bent.yaml")
        back = load_robot(tmp_path / "bent.yaml")
    known, target = known_model(back), np.zeros(len(check), dtype=np.int64)
    assert np.array_equal(known.uncovered(check.q), found.known.uncovered(check.q))
    sigma = known.function_sigma(check.q)
    assert sigma == pytest.approx(found.known.function_sigma(check.q), rel=0.01, abs=1e-7)
    told = [
        np.trace(f.predicted_variance(check.q, target, ("base", "tool")), axis1=1, axis2=2)
        for f in (found, known)
    ]
    assert told[1] == pytest.approx(told[0], rel=0.01)


def test_of_many_poses_those_are_kept_that_tell_the_covariance(bent, monkeypatch):
    robot, data, check, found = bent
    monkeypatch.setattr(model_knowledge, "MOST_POSES", 600)
    arm, target = identify_full(robot.nominal, data).cell.arm, np.zeros(len(check), dtype=np.int64)
    kept = arm.functions.identified_from
    assert abs(len(kept.q) - 600) <= 1
    assert np.sum(kept.weight) == pytest.approx(1200.0, rel=0.1)
    told = [
        np.mean(np.trace(f.predicted_variance(check.q, target, ("base", "tool")), axis1=1, axis2=2))
        for f in (found, known_model(arm))
    ]
    assert np.sqrt(told[1] / told[0]) == pytest.approx(1.0, abs=0.1)


def test_a_model_of_an_arm_with_functions_corrects_that_arm(bent, fewer):
    """Its history asks for the hash of the nominal model, functions and all."""
    robot, data = fewer
    functions = bent[3].cell.arm.functions
    wrong = replace(functions, coefficients=-functions.coefficients, identified_from=None)
    arm = robot.nominal.with_model(robot.nominal.mdh, wrong, robot.nominal.load)
    found = identify_full(arm, data)
    assert isinstance(found, FullIdentification)
    assert found.nominal.model_hash == arm.model_hash != robot.nominal.model_hash


def test_a_joint_that_stood_still_has_no_function():
    """As one that was locked: what its function would be there its zero is, too."""
    robot = BentRobot(6)
    q = robot.poses(250)
    q[:, 2] = 0.3
    found = identify_full(robot.nominal, robot.measured(q))
    assert isinstance(found, FullIdentification)
    assert found.known.terms.count[2] == 0
    known_model(found.cell.arm)


def test_an_arm_that_keeps_nothing_says_so(bent):
    robot, *_ = bent
    with pytest.raises(InputError, match="does not say what it was identified from"):
        known_model(robot.nominal)


def test_outliers_are_named_and_not_learned(bent):
    robot, data, check, found = bent
    wrong = np.arange(5, 1200, 60)
    position = data.position.copy()
    position[wrong] += 1.5e-3 * robot.rng.choice([-1.0, 1.0], (len(wrong), 3))
    spoiled = identify_full(robot.nominal, replace(data, position=position))
    assert set(spoiled.rejected) >= {data.sample[i] for i in wrong}
    assert len(spoiled.rejected) <= len(wrong) + 3
    assert rms_mm(spoiled, check) < 1.1 * rms_mm(found, check)


@pytest.mark.parametrize("size_m", [3e-3, 2e-2])
def test_outliers_do_not_widen_what_is_stated_of_the_others(size_m):
    """Three rows of a hundred, as trackers have them: errors at other poses as large as stated."""
    ratios = []
    for seed in range(3):
        robot = BentRobot(seed)
        data, check = robot.measured(robot.poses(300)), robot.measured(robot.poses(300))
        position = data.position.copy()
        position[:9] += size_m * robot.rng.standard_normal((9, 3))
        found = identify_full(robot.nominal, replace(data, position=position))
        variance = found.predicted_variance(check.q, np.zeros(300, dtype=np.int64))
        expected = np.trace(variance, axis1=1, axis2=2) + 3.0 * found.noise_m**2
        ratios.append(np.mean(np.sum(found.cell.residual(check) ** 2, axis=1) / expected))
    assert 0.8 < np.mean(ratios) < 1.25


@pytest.mark.parametrize("heavy", [False, True])
@pytest.mark.parametrize("count", [12, 19, 40, 120, 700])
def test_a_bound_is_missed_by_one_new_error_in_twenty(count, heavy):
    """Normal errors and those with the tails of Student's t of 4: squares over their variance.

    A rank among so many holds a share by a beta distribution; normal errors are always held.
    """
    draws, rng = 4000, np.random.default_rng(count)
    spread, keep = fisher(3, 4) if heavy else chi2(3, scale=1.0 / 3.0), np.full(count, True)
    held = [
        spread.cdf(full_model.bound_squared(3.0 * own, keep) / 3.0)
        for own in spread.rvs((draws, count), random_state=rng)
    ]
    rank = min(int(np.ceil(0.95 * (count + 1))), count)
    by_rank = beta(rank, count + 1 - rank).rvs(100 * draws, random_state=rng)
    expected = np.maximum(by_rank, spread.cdf(chi2_quantile(0.95, 3) / 3.0))
    assert np.mean(held) == pytest.approx(np.mean(expected), abs=3.5 * np.std(held) / draws**0.5)
    if count >= 19:
        assert np.mean(held) > 0.945


def test_rejected_samples_do_not_pull_a_bound_out():
    """They have the highest ranks; one in ten of any size leaves the farthest one that is kept."""
    squared = np.random.default_rng(0).chisquare(3, 200)
    few, many = np.full(200, True), np.full(200, True)
    few[:6], many[:20] = False, False
    for keep, rank in ((few, 191), (many, 180)):
        squared[~keep] = 1e6
        own = np.sort(squared[keep])
        assert full_model.bound_squared(squared, keep) == own[rank - 1]


@pytest.mark.long
@pytest.mark.parametrize(("count", "heavy"), [(120, True), (300, False), (120, False), (300, True)])
def test_stated_bounds_hold_95_percent_whatever_the_noise(count, heavy):
    """One draw's bound holds 95 % give or take what a rank among so many poses scatters.

    Heavy: points by Student's t of 3, of which bounds by normal errors hold 92.5 %.
    """
    inside, seeds, others = [], 16, 1500
    for robot in map(BentRobot, range(seeds)):
        data, check = (robot.measured(robot.poses(n), 0.0) for n in (count, others))
        noise = NOISE_M * robot.rng.standard_normal((count + others, 3))
        if heavy:
            noise /= np.sqrt(robot.rng.chisquare(3, (len(noise), 1)) / 3.0)
        found = identify_full(robot.nominal, replace(data, position=data.position + noise[:count]))
        error = found.cell.residual(replace(check, position=check.position + noise[count:]))
        variance = found.predicted_variance(check.q, np.zeros(others, dtype=np.int64))
        variance = variance + found.noise_m**2 * np.eye(3)
        squared = np.sum(error * np.linalg.solve(variance, error[..., None])[..., 0], axis=1)
        inside.append(np.mean(squared < found.bound_squared))
    scatter = np.sqrt(0.95 * 0.05 * (1.0 / count + 1.0 / others) / seeds)
    assert abs(np.mean(inside) - 0.95) < 2.58 * scatter


def test_a_robot_that_only_sags_has_compliances_alone():
    robot = BentRobot(1, size_rad=0.0, compliance=10.0 * COMPLIANCE)
    data, check = robot.measured(robot.poses(300)), robot.measured(robot.poses(300), 0.0)
    found, plain = (solved(robot.nominal, data) for solved in (identify_full, identify))
    assert np.all(found.known.terms.count == 0)
    assert found.cell.arm.functions.compliance == pytest.approx(10.0 * COMPLIANCE, abs=1e-6)
    assert rms_mm(found, check) < 0.5 * rms_mm(plain, check)


@pytest.mark.long
@pytest.mark.parametrize(("gears", "sag"), [(False, True), (True, True), (True, False)])
def test_each_term_is_there_where_a_heavy_robot_has_it(gears, sag):
    """A KR 150 with 120 kg; functions that are not there gain enough once in twenty times or less.

    Its last joint is loaded by little: what that one winds up cannot be seen.
    """
    draws, wrong = 20, 0
    count = 250 if gears else 120  # gears take more poses
    nominal, load = load_robot("kr150_r3100"), ArmLoad(kr150.BODY.mass, kr150.BODY.centre)
    effects = replace(Effects.none(), static=True, noise=True, compliance=sag, gears=gears)
    for seed in range(draws):
        rng = np.random.default_rng([44, seed])
        robot = kr150.true_robot(nominal, rng, effects)
        q = rng.uniform(nominal.lower, nominal.upper, (count, 6))
        position = robot.point(q, Warmth.cold(6), TIP, rng) + 5e-5 * rng.normal(size=(count, 3))
        data = Measurements(q, position, ("p",) * count, tuple(map(str, range(count))))
        known = identify_full(replace(nominal, load=load), data).known
        wrong += bool(np.any(known.terms.count > 0)) != gears
        bends = known.cell.arm.functions.compliance > 0.0
        assert bends.tolist() == [False, sag, sag, sag, sag, False]
    assert wrong <= binom.ppf(0.999, draws, 0.05)


@pytest.mark.long
def test_of_a_heavy_robot_without_masses_compliances_of_one_at_the_flange_are_found():
    """A KR 150 with 120 kg that sags; only the products count: 1 kg does as 100 do."""
    rng = np.random.default_rng(44)
    nominal, load = load_robot("kr150_r3100"), ArmLoad(kr150.BODY.mass, kr150.BODY.centre)
    effects = replace(Effects.none(), static=True, noise=True, compliance=True, eccentricity=True)
    robot = kr150.true_robot(nominal, rng, effects)
    q = rng.uniform(nominal.lower, nominal.upper, (240, 6))
    position = robot.point(q, Warmth.cold(6), TIP, rng) + 5e-5 * rng.normal(size=(240, 3))
    data = Measurements(q, position, ("p",) * 240, tuple(map(str, range(240))))
    at_flange = ArmLoad(100.0 * np.eye(6)[5], np.zeros((6, 3)))
    unknown, known, rough = (
        identify_and_hold_out(arm, data, share=0.5, seed=0, model="full")
        for arm in (nominal, replace(nominal, load=load), replace(nominal, load=at_flange))
    )
    assert 1e3 * unknown.candidate.mean_m <= 0.15  # of 3.7 mm of the nominal model
    assert known.candidate.mean_m < unknown.candidate.mean_m
    assert rough.candidate.mean_m == pytest.approx(unknown.candidate.mean_m, rel=1e-4)
    found, of_rough = (judged.identification.cell.arm for judged in (unknown, rough))
    assert (found.masses, of_rough.masses) == ("found", "given")
    winds = found.functions.compliance
    assert winds == pytest.approx(100.0 * of_rough.functions.compliance, rel=1e-3)
    told = "sought with 1 kg at the flange of an upright arm: that holds for the payload and"
    assert told in unknown.verdict.reason
    assert "masses" not in known.verdict.reason
    assert [identification_document(j)["masses"] for j in (unknown, known)] == ["found", "given"]
    plain = identify_and_hold_out(nominal, data, share=0.5, seed=0)
    assert "masses" not in plain.verdict.reason
    assert plain.identification.cell.arm.load is None
    again = identify_full(found.with_mdh(nominal.mdh), data.take(np.arange(120)))
    assert again.cell.arm.masses == "found"


@pytest.mark.parametrize("pulled", [0.0, -1.0], ids=["by nothing", "upwards, as it hangs"])
def test_without_masses_a_robot_that_does_not_bend_has_no_load(pulled):
    robot = BentRobot(2, compliance=pulled * COMPLIANCE)
    arm, data = replace(robot.nominal, load=None), robot.measured(robot.poses(300))
    found = identify_full(arm, data)
    assert isinstance(found, FullIdentification)
    assert found.cell.arm.load is None
    assert found.cell.arm.masses is None
    known = identify_full(replace(arm, load=WEIGHTLESS), data)  # of which nothing is sought
    check = robot.measured(robot.poses(300), 0.0)
    assert rms_mm(found, check) == pytest.approx(rms_mm(known, check), rel=0.03)
    told = without_masses(arm, found)
    assert "sought with 1 kg at the flange of an upright arm: none was worth it" in told


def test_gross_rows_cost_no_more_than_their_number():
    """A tracker's wrong reflector, 0.1 m off, in each tenth row; and some millimetres."""
    robot = BentRobot(1)
    data, check = robot.measured(robot.poses(400)), robot.measured(robot.poses(600), 0.0)
    bad = robot.rng.choice(400, 40, replace=False)
    for size in (0.1, 0.003):
        position = data.position.copy()
        way = robot.rng.standard_normal((40, 3))
        position[bad] += size * way / np.linalg.norm(way, axis=1, keepdims=True)
        found = identify_full(robot.nominal, replace(data, position=position))
        assert set(found.rejected) >= {data.sample[i] for i in bad}
        without = identify_full(robot.nominal, data.take(np.delete(np.arange(400), bad)))
        assert rms_mm(found, check) < 1.02 * rms_mm(without, check)


@pytest.mark.parametrize("noise_m", [0.0, 1e-9, 1e-7])
def test_almost_exact_data_are_solved(noise_m):
    """Of a robot with errors in its geometry alone; what a target cannot show is the prior's."""
    robot = BentRobot(2, size_rad=0.0, compliance=np.zeros(6), noise_m=noise_m)
    data, check = robot.measured(robot.poses(250)), robot.measured(robot.poses(100), 0.0)
    found = identify_full(robot.nominal, data)
    # 27 numbers of 750 are found; rounding of positions of 2 m is 1e-15 of them
    assert rms_mm(found, check) <= 1e3 * max(0.5 * noise_m, 1e-12)
    target = np.zeros(100, dtype=np.int64)
    assert np.all(np.linalg.eigvalsh(found.predicted_variance(check.q, target)) > 0.0)
    if noise_m:
        assert found.noise_m == pytest.approx(noise_m, rel=4.0 / np.sqrt(2 * 720))


def test_of_data_without_noise_rounding_is_not_learned():
    robot = BentRobot(3, size_rad=0.0, compliance=np.zeros(6), noise_m=0.0)
    found = identify_full(robot.nominal, robot.measured(robot.poses(200)))
    assert not isinstance(found, FullIdentification)
    assert rms_mm(found, robot.measured(robot.poses(100))) < 1e-5


@pytest.mark.parametrize(
    ("count", "masses"),
    [(16, True), (40, False), *more((40, True), (16, False), (200, True), (200, False))],
)
def test_a_robot_without_joint_errors_loses_nothing(count, masses):
    ratios = []
    for seed in range(8):
        robot = BentRobot(seed, size_rad=0.0, compliance=np.zeros(6))
        data, check = robot.measured(robot.poses(count)), robot.measured(robot.poses(300), 0.0)
        arm = robot.nominal if masses else replace(robot.nominal, load=None)
        found, plain = (solved(arm, data) for solved in (identify_full, identify))
        ratios.append(rms_mm(found, check) / rms_mm(plain, check))
    assert np.sqrt(np.mean(np.square(ratios))) <= 1.03


def test_visits_of_one_pose_are_no_new_poses():
    """What no model explains comes back at each of three visits: as much is known as of one."""
    robot = BentRobot(3)
    data, check = robot.measured(robot.poses(300)), robot.measured(robot.poses(300), 0.0)
    thrice = Measurements(
        q=np.tile(data.q, (3, 1)),
        position=np.tile(data.position, (3, 1)) + 1e-6 * robot.rng.standard_normal((900, 3)),
        target=("tip",) * 900,
        sample=tuple(str(i) for i in range(900)),
    )
    once, again = (identify_full(robot.nominal, d) for d in (data, thrice))
    target = np.zeros(300, dtype=np.int64)
    told = [np.sqrt(np.mean(f.predicted_variance(check.q, target))) for f in (once, again)]
    assert told[1] == pytest.approx(told[0], rel=0.2)
    assert rms_mm(again, check) == pytest.approx(rms_mm(once, check), rel=0.1)


def test_what_is_stated_of_few_poses_holds_however_often_each_was_measured():
    """Twenty poses with twelve rows each are no 240: a bound of 95 % at others, about as wide."""
    robot = BentRobot(7)
    data, target = robot.measured(robot.poses(20)), np.zeros(300, dtype=np.int64)
    often = data.take(np.repeat(np.arange(20), 12))
    position = often.position + 1e-5 * robot.rng.standard_normal((240, 3))
    often = replace(often, position=position, sample=tuple(map(str, range(240))))
    q, bounds = robot.poses(300), []
    for found in (identify_full(robot.nominal, one) for one in (data, often)):
        variance = found.predicted_variance(q, target) + found.noise_m**2 * np.eye(3)
        total = np.mean(np.trace(variance, axis1=1, axis2=2))
        bounds.append(np.sqrt(total * found.bound_squared))
    assert bounds[1] == pytest.approx(bounds[0], rel=0.25)


def test_a_pose_left_out_errs_as_by_a_fit_without_it():
    """All visits of a pose left out together, by normal equations that never had them."""
    robot = BentRobot(4)
    data = robot.measured(np.repeat(robot.poses(60), 3, axis=0))
    solved, _ = full_model._solved(robot.nominal, data, ("base", "tool", "geometry"), "map")
    problem, at, weight = solved.problem, solved.at, solved.weight
    error, expected = problem.left_out(at, weight)
    residual, rows, k = at.linear, at.rows, at.terms.size
    x = problem.values(at.cell, at.terms)
    for pose in range(0, 60, 7):
        out = problem.pose == pose
        normal, pull = np.zeros((k, k)), np.zeros(k)
        none = np.where(out, 0.0, weight)
        row_kernels.normal_equations(rows.J, rows.column, -residual, none, normal, pull)
        evidence = replace(
            problem.evidence(at, residual, rows, weight), normal=normal, pull=pull + normal @ x
        )
        without = evidence.posterior(at.prior)
        step = np.append(without.mean - x, 0.0)
        by_fit = residual + np.einsum("mch,mh->mc", rows.J, step[rows.column])
        spread = np.empty((len(data), 3, 3))
        row_kernels.spreads(rows.J, rows.column, without.covariance, spread)
        spread += at.prior.noise**2 * np.eye(3)
        assert error[out] == pytest.approx(by_fit[out], rel=0.02, abs=2e-7)
        assert expected[out] == pytest.approx(spread[out], rel=0.02, abs=1e-11)


@pytest.mark.long
def test_without_masses_half_of_what_they_gain_is_gained_at_least(bent, tmp_path):
    """As on the real UR10; what one mass cannot explain is in the noise that is told."""
    robot, data, check, known = bent
    none, found = (
        identify_full(replace(robot.nominal, load=load), data) for load in (WEIGHTLESS, None)
    )
    assert none.cell.arm.masses is None
    assert np.array_equal(found.cell.arm.functions.compliance > 0.0, COMPLIANCE > 0.0)
    assert rms_mm(found, check) < 0.5 * (rms_mm(none, check) + rms_mm(known, check))
    variance = found.predicted_variance(check.q, np.zeros(len(check), dtype=np.int64))
    told = np.mean(np.trace(variance, axis1=1, axis2=2)) + 3.0 * found.noise_m**2
    again = robot.measured(check.q)
    assert 0.8 < (1e-3 * rms_mm(found, again)) ** 2 / told < 1.25
    save_robot(found.cell.arm, tmp_path / "found.yaml")
    back = load_robot(tmp_path / "found.yaml")
    assert back.masses == "found"
    assert back.fk(check.q) == pytest.approx(found.cell.arm.fk(check.q), abs=1e-12)
    sigma = known_model(back).function_sigma(check.q)
    assert sigma == pytest.approx(found.known.function_sigma(check.q), rel=0.01, abs=1e-7)


@pytest.mark.parametrize("visits", [1, *more(2)])
def test_a_target_of_a_single_pose_is_foretold_by_nothing(bent, visits):
    """The folds of few poses leave out none of it, and it costs the others nothing."""
    robot, _, check, _ = bent
    q = robot.poses(150)
    q[:visits] = q[0]
    data = robot.measured(q)
    plain = identify_full(robot.nominal, data)
    other = replace(data, target=("other",) * visits + data.target[visits:])
    found = identify_full(robot.nominal, other)
    assert isinstance(found, FullIdentification)
    assert rms_mm(found, check) == pytest.approx(rms_mm(plain, check), rel=0.05)


def test_where_the_model_is_not_covered_is_told(fewer):
    robot, data = fewer
    check = robot.measured(robot.poses(300, LOWER, UPPER + np.radians([60.0, 0, 0, 0, 0, 0])))
    judged = identify_and_judge(robot.nominal, data, check, model="full")
    beyond = np.mean(check.q[:, 0] > data.q[:, 0].max())
    assert judged.check_outside == pytest.approx(beyond, abs=0.02)
    assert judged.measured[:, 1] == pytest.approx(data.q.max(axis=0))


def test_errors_are_found_again_from_what_is_kept(fewer):
    """Of those that judged it, to the bit but for the JSON's millimetres and quaternions."""
    robot, data = fewer
    judged = identify_and_hold_out(robot.nominal, data, share=0.3, seed=4, model="full")
    kept = json.loads(json.dumps(identification_document(judged)))
    model = json.loads(json.dumps(identified_model_document(judged.identification)))
    arm = arm_of(model, robot.nominal)
    q, before, after = held_out_errors(kept, robot.nominal, arm, data, share=0.3, seed=4)
    assert np.array_equal(q, judged.q)
    assert before == pytest.approx(judged.errors["in_force"], abs=1e-12)
    assert after == pytest.approx(judged.errors["calibrated"], abs=1e-12)
    assert not np.allclose(after, before, atol=1e-5)


def test_a_gap_within_the_measured_angles_is_told(fewer):
    robot, data = fewer
    low, high = np.radians([-60.0, -10.0])
    data = data.take((data.q[:, 0] < low) | (data.q[:, 0] > high))
    known = identify_full(robot.nominal, data).known
    ((begin, end),) = known.gaps(0)
    assert low < begin < end < high
    q = np.tile(data.q[0], (1000, 1))
    q[:, 0] = np.linspace(data.q[:, 0].min(), data.q[:, 0].max(), 1000)
    assert np.array_equal(known.uncovered(q)[:, 0], (q[:, 0] > begin) & (q[:, 0] < end))
    assert all(len(known.gaps(joint)) == 0 for joint in range(1, 6))


def evidence_of(robot, seed=0):
    """A small linear problem of two joints."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-0.6, 0.6, (60, 2))
    terms = JointTerms.cover(q, rng.standard_normal((60, 2)), before=2, coarse=True)
    torque = rng.standard_normal((60, 2))
    J, column = terms.rows(q, rng.standard_normal((60, 3, 2)), torque)
    dense = rng.standard_normal((60, 3, 2))
    J = np.concatenate([dense, J], axis=2)
    column = np.concatenate([np.tile(np.arange(2), (60, 1)), column], axis=1)
    y = 1e-4 * rng.standard_normal((60, 3))
    k = terms.size
    normal, pull = np.zeros((k, k)), np.zeros(k)
    row_kernels.normal_equations(J, column, y, np.ones(60), normal, pull)
    flat = np.zeros(k, dtype=np.bool_)
    flat[1] = True
    squares = float(np.sum(y**2))
    fixed = np.array([[1e-3]])
    evidence = JointEvidence(terms, normal, pull, squares, 180.0, flat, fixed, 0.0)
    full = np.zeros((60, 3, k + 1))
    for s in range(60):
        full[s][:, column[s]] += J[s]  # column -1 falls into the last one
    return evidence, full[..., :k].reshape(180, k), y.ravel(), normal, pull, (J, column)


def test_sparse_sums_equal_dense_ones():
    _, J, y, normal, pull, (rows, column) = evidence_of(None)
    assert normal == pytest.approx(J.T @ J, abs=1e-9)
    assert pull == pytest.approx(J.T @ y, abs=1e-12)
    A = np.random.default_rng(1).standard_normal((len(pull), len(pull)))
    spread = np.empty((60, 3, 3))
    row_kernels.spreads(rows, column, A @ A.T, spread)
    own = J.reshape(60, 3, -1)
    assert spread == pytest.approx(own @ (A @ A.T) @ np.swapaxes(own, 1, 2))


def prior_at(x):
    length, amplitude = np.exp(x[[0, 2]]), np.exp(x[[1, 3]])
    return FunctionPrior(length, amplitude, float(np.exp(x[4])))


def test_evidence_is_the_density_of_the_data():
    """Against the normal density of all data, the flat unknown with a wide prior."""
    evidence, J, y, *_ = evidence_of(None)
    priors = [
        FunctionPrior(np.array([0.1, 0.2]), np.array([a, 3e-4]), s)
        for a, s in ((2e-4, 1e-4), (5e-4, 2e-4))
    ]
    costs = [evidence._likelihood(prior)[0] for prior in priors]
    exact = []
    for prior in priors:
        K = np.zeros((J.shape[1], J.shape[1]))
        rest = np.flatnonzero(~evidence.flat)
        for block, L in evidence._factors(prior)[0]:
            K[np.ix_(rest[block], rest[block])] = L @ L.T
        K[1, 1] = 1e2
        covariance = J @ K @ J.T + prior.noise**2 * np.eye(len(y))
        _, determinant = np.linalg.slogdet(covariance)
        exact.append(0.5 * float(determinant + y @ np.linalg.solve(covariance, y)))
    assert costs[1] - costs[0] == pytest.approx(exact[1] - exact[0], abs=1e-3)


def test_evidence_has_the_slope_that_it_tells():
    evidence, *_ = evidence_of(None)
    at = np.log([0.1, 2e-4, 0.2, 3e-4, 1e-4])
    slope = evidence._likelihood(prior_at(at))[1]
    for i, step in enumerate(1e-4 * np.eye(5)):
        ahead, back = (evidence._likelihood(prior_at(at + s))[0] for s in (step, -step))
        assert slope[i] == pytest.approx((ahead - back) / 2e-4, rel=1e-4, abs=1e-4)


def test_evidence_has_the_information_of_fisher():
    """Half the trace of S^-1 dS S^-1 dS, with S the covariance of what no flat unknown explains."""
    evidence, J, *_ = evidence_of(None)
    at = np.log([0.1, 2e-4, 0.2, 3e-4, 1e-4])
    flat, rest = np.flatnonzero(evidence.flat), np.flatnonzero(~evidence.flat)
    apart = null_space(J[:, flat].T).T

    def covariance(x):
        total = np.exp(2.0 * x[4]) * np.eye(len(apart))
        for block, L in evidence._factors(prior_at(x))[0]:
            own = apart @ J[:, rest[block]] @ L
            total += own @ own.T
        return total

    inverse = np.linalg.inv(covariance(at))
    steps = 1e-5 * np.eye(5)
    by = [inverse @ (covariance(at + s) - covariance(at - s)) / 2e-5 for s in steps]
    exact = [[0.5 * np.sum(one * other.T) for other in by] for one in by]
    assert evidence._likelihood(prior_at(at))[2] == pytest.approx(np.array(exact), rel=1e-4)
