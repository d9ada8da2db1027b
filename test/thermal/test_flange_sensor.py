# SPDX-License-Identifier: Apache-2.0
"""A measuring robot: geometry, hand-eye and sphere centres from constancy alone."""

from dataclasses import replace

import numpy as np
import pytest

from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError, RankDeficientError, TooFewSamplesError
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.flange_sensor import (
    FlangeSensorProblem,
    MeasuringRobot,
    hand_eye_start,
    identify_and_judge_flange_sensor,
    identify_flange_sensor,
    in_sessions,
)

SIGMA = 3e-5
T_FLANGE_SENSOR = frames.transform(frames.exp_rotation([0.1, -0.4, 0.8]), [0.08, -0.05, 0.22])
CENTRES = {"a": np.array([1.6, 0.2, 0.6]), "b": np.array([1.2, -0.8, 0.9])}


def robot(nominal: SerialArm, seed: int) -> SerialArm:
    """An arm as built: tenths of a millimetre and hundredths of a degree off."""
    rng, chosen = np.random.default_rng(seed), nominal.parameters
    size = np.where(chosen.is_length, 4e-4, np.radians(0.02))
    return nominal.with_mdh(chosen.add(nominal.mdh, size * rng.standard_normal(len(chosen))))


@pytest.fixture(scope="module")
def built(nominal: SerialArm) -> SerialArm:
    return robot(nominal, 5)


def look(
    arm: SerialArm, count: int, seed: int, spheres: tuple[str, ...] = ("a", "b"), sigma: float = 0.0
) -> Measurements:
    """Random postures throughout the workspace; what the sensor would see of the spheres there."""
    rng = np.random.default_rng(seed)
    q = np.radians([0, -70, 110, 0, -40, 0]) + np.radians([60, 25, 30, 150, 60, 170]) * rng.uniform(
        -1.0, 1.0, (count, 6)
    )
    target = tuple(spheres[i % len(spheres)] for i in range(count))
    T = frames.invert(arm.fk(q) @ T_FLANGE_SENSOR)
    c = np.array([CENTRES[name] for name in target])
    p = np.einsum("mij,mj->mi", T[:, :3, :3], c) + T[:, :3, 3]
    p += sigma * rng.standard_normal(p.shape)
    return Measurements(
        q=q,
        position=p,
        target=target,
        sample=tuple(f"{seed}-{i}" for i in range(count)),
        sigma=np.full(count, sigma) if sigma else None,
    )


def test_the_start_is_exact_for_the_true_arm(built):
    start = hand_eye_start(built, look(built, 12, 1))
    assert start.T_flange_sensor == pytest.approx(T_FLANGE_SENSOR, abs=1e-9)
    assert start.centres == pytest.approx(np.array(list(CENTRES.values())), abs=1e-9)


def test_jacobian_equals_the_numeric_one(built):
    data = look(built, 8, 2)
    problem = FlangeSensorProblem(built, data, data.targets, True, np.ones(8))
    state = MeasuringRobot(built, T_FLANGE_SENSOR, data.targets, np.array(list(CENTRES.values())))
    _, J = problem.linearise(state)
    step = 1e-6
    for i in range(len(problem.names)):
        one = np.zeros(len(problem.names))
        one[i] = step
        after = problem.linearise(problem.retract(state, one))[0]
        before = problem.linearise(problem.retract(state, -one))[0]
        assert J[:, :, i] == pytest.approx((after - before) / (2.0 * step), abs=1e-8)


def test_unseen_poses_are_predicted_to_the_noise(nominal, built):
    train, check = look(built, 80, 3, sigma=SIGMA), look(built, 60, 4, sigma=SIGMA)
    plain = identify_flange_sensor(nominal, train, geometry=False)
    found = identify_flange_sensor(nominal, train)
    before = np.linalg.norm(plain.cell.scatter(check), axis=1)
    after = np.linalg.norm(found.cell.scatter(check), axis=1)
    assert before.mean() > 3e-4
    assert after.mean() < 2.0 * SIGMA * np.sqrt(8.0 / np.pi)


def test_unseen_poses_are_as_far_off_as_predicted(nominal):
    """Squared distances over their predicted variance, of 24 robots: one on average.

    A robot's distances share its model's error, so that each robot counts once; a centre that
    is the mean of 30 takes 1/30 of the noise away.
    """
    ratios = []
    for seed in range(24):
        arm = robot(nominal, seed)
        train, check = (look(arm, n, k + seed, sigma=SIGMA) for n, k in ((80, 1000), (60, 2000)))
        found = identify_flange_sensor(nominal, train)
        squared = np.sum(found.cell.scatter(check) ** 2, axis=1)
        noise = 3.0 * SIGMA**2 * (1.0 - 1.0 / 30.0)
        ratios.append(np.mean(squared / (found.predicted_variance(check) + noise)))
    error = np.std(ratios, ddof=1) / np.sqrt(len(ratios))
    assert error < 0.1  # else the next line would say nothing
    assert np.mean(ratios) == pytest.approx(1.0, abs=4.0 * error)


def test_what_constancy_does_not_show_is_named(nominal, built):
    """A move of the whole cell (d1, theta1), and the last joint against the mounting (four)."""
    found = identify_flange_sensor(nominal, look(built, 80, 3, sigma=SIGMA))
    seen = found.estimate.observability
    assert seen.rank == 24 + 6 + 6 - 6
    words = " ".join(found.unobservable)
    assert len(found.unobservable) == 6
    for name in ("d1_mm", "d6_mm", "theta6_deg", "a6_mm", "alpha6_deg"):
        assert name in words


def test_a_moved_base_gives_the_same_answer(nominal, built):
    data = look(built, 60, 6, sigma=SIGMA)
    move = frames.transform(frames.exp_rotation([0.2, 0.5, -1.0]), [3.0, -2.0, 1.0])
    elsewhere = replace(nominal, T_base_root=move @ nominal.T_base_root)
    here = identify_flange_sensor(nominal, data).cell
    there = identify_flange_sensor(elsewhere, data).cell
    assert there.T_flange_sensor == pytest.approx(here.T_flange_sensor, abs=1e-8)
    moved = here.centres @ move[:3, :3].T + move[:3, 3]
    assert there.centres == pytest.approx(moved, abs=1e-7)


def test_a_wrong_sample_is_named(nominal, built):
    data = look(built, 80, 7, sigma=SIGMA)
    data.position[10, 2] += 2e-3
    assert identify_flange_sensor(nominal, data).rejected == ("7-10",)


def test_spheres_may_move_between_sessions(nominal, built):
    first, second = look(built, 40, 8, sigma=SIGMA), look(built, 40, 9, sigma=SIGMA)
    T = built.fk(second.q) @ T_FLANGE_SENSOR
    shift = np.einsum("mji,j->mi", T[:, :3, :3], [0.05, 0.02, -0.03])
    second.position[:] += shift
    found = identify_flange_sensor(nominal, in_sessions([first, second]))
    assert found.cell.spheres == ("a@1", "b@1", "a@2", "b@2")
    assert found.rejected == ()
    moved = found.cell.centres[2:] - found.cell.centres[:2]
    assert moved == pytest.approx(np.tile([0.05, 0.02, -0.03], (2, 1)), abs=10.0 * SIGMA)


def test_a_still_sphere_from_one_place_is_refused(nominal, built):
    data = look(built, 40, 10, ("a",))
    still = replace(
        data, q=np.tile(data.q[:1], (40, 1)), position=np.tile(data.position[:1], (40, 1))
    )
    with pytest.raises(RankDeficientError, match="two axes"):
        identify_flange_sensor(nominal, still)
    with pytest.raises(TooFewSamplesError, match="4 measurements"):
        identify_flange_sensor(nominal, look(built, 4, 11, ("a",)))


def test_a_calibration_is_judged_on_an_unseen_session(nominal, built):
    train, check = look(built, 80, 3, sigma=SIGMA), look(built, 40, 4, sigma=SIGMA)
    judged = identify_and_judge_flange_sensor(nominal, [train], check)
    assert judged.verdict.accept, judged.verdict.reason
    assert judged.candidate.mean_m < 0.3 * judged.nominal.mean_m
    assert judged.candidate.rms_m < 1.2 * judged.predicted_total_rms_m
    held_out = identify_and_judge_flange_sensor(nominal, [train])
    assert held_out.candidate.n == 40


@pytest.mark.parametrize("seed", range(6))
def test_what_makes_an_unseen_session_worse_is_never_accepted(nominal, built, seed):
    """Solved on one robot, checked on one that is off to the other side, as far as the first."""
    opposite = nominal.with_mdh(2.0 * nominal.mdh - built.mdh)
    train = look(built, 80, 20 + seed, sigma=SIGMA)
    judged = identify_and_judge_flange_sensor(
        nominal, [train], look(opposite, 40, 40 + seed, sigma=SIGMA)
    )
    assert judged.candidate.rms_m > 1.2 * judged.nominal.rms_m
    assert judged.verdict.code is Code.WORSE_THAN_CURRENT


def test_sigma_must_be_given_in_all_sessions(built):
    with pytest.raises(InputError, match="in all"):
        in_sessions([look(built, 10, 1, sigma=SIGMA), look(built, 10, 2)])
