# SPDX-License-Identifier: Apache-2.0
"""The simulated truth: equal to the nominal model when nothing is wrong, else wrong as stated."""

from dataclasses import replace

import numpy as np
import pytest
from joint_errors import with_joint_errors

from bench.measured_shifts import ShiftPlan, drifting_cell, poses, simulate
from bench.thermal import SEEDS
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.beams import SmoothPath, readings
from robocal_ros.cell_sim.gears import BacklashPlay, GearErrors, gear_errors, ur10_gears
from robocal_ros.cell_sim.kr150 import UNCORRECTED
from robocal_ros.cell_sim.robot import Effects, FlexibleBody, TrueRobot, Warmth
from robocal_ros.cell_sim.sensors import SphereSensor
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_functions import JointFunctions
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.screening import share_within

ROBOTS = ("kr150_r3100", "ur10", "bx200l", "p1r2p3")
SHIFT_DUTY = np.array([0.5, 1.0, 1.0, 0.8, 0.6, 0.6])


@pytest.fixture(scope="module")
def robot(arm) -> TrueRobot:
    return kr150.true_robot(arm, np.random.default_rng(7))


def only(robot: TrueRobot, **switched: bool) -> TrueRobot:
    return replace(robot, effects=replace(Effects.none(), **switched))


def postures(arm: SerialArm, count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = np.maximum(arm.lower, -2.0), np.minimum(arm.upper, 2.0)
    return rng.uniform(low, high, (count, arm.n))


def warm(hours: float) -> Warmth:
    return kr150.WARM_UP.step(Warmth.cold(6), SHIFT_DUTY, 3600.0 * hours)


@pytest.mark.filterwarnings("ignore:.*limit")
@pytest.mark.parametrize("name", ROBOTS)
def test_without_effects_it_is_the_nominal_arm(name):
    """Another code path, the same robot: matrices multiplied one by one against the kernels."""
    arm = load_robot(name)
    n = arm.n
    robot = TrueRobot(
        nominal=arm,
        static_error=np.full((n, 5), 1e-3),
        motor_gain=np.full((n, 5, n), 1e-6),
        link_gain=np.full((n, 5, n), 1e-6),
        body=replace(kr150.BODY, stiffness=kr150.BODY.stiffness[:n]),
        eccentricity=np.full(n, 1e-4),
        phase=np.zeros(n),
        repeatability=1e-4,
        effects=Effects.none(),
    )
    q = postures(arm, 200)
    flange = robot.flange(q, warm(3.0) if n == 6 else Warmth.cold(n), np.random.default_rng(0))
    np.testing.assert_allclose(flange, arm.fk(q), atol=1e-12)


def as_splines(gears: GearErrors, functions: JointFunctions) -> JointFunctions:
    """Sines as cardinal splines: exact to the fourth power of their step, here 2e-5 of them."""
    step = np.radians(0.1)
    centres = np.arange(-2500, 2500) * step
    factor = 6.0 / (4.0 + 2.0 * np.cos(gears.frequency * step))
    waves = np.sin(gears.frequency[..., None] * centres + gears.phase[..., None])
    table = np.sum((gears.amplitude * factor)[..., None] * waves, axis=1)
    n = len(table)
    first = np.full(n, centres[0] - 2.0 * step)
    return replace(functions, first=first, step=np.full(n, step), coefficients=table)


@pytest.mark.filterwarnings("ignore:.*limit")
@pytest.mark.parametrize("name", ROBOTS)
def test_joint_functions_and_stiffness_are_those_of_the_model(name):
    """An arm with joint functions, compliances and a load, and the same robot by plain products."""
    arm = with_joint_errors(load_robot(name), 4)
    gears = gear_errors(arm.n, np.random.default_rng(1))
    arm = replace(arm, functions=as_splines(gears, arm.functions))
    n, load = arm.n, arm.load
    whole = load.mass[-1] + load.payload_mass  # the payload is the last link's
    moment = load.mass[-1] * load.centre[-1] + load.payload_mass * load.payload_centre
    robot = TrueRobot(
        nominal=load_robot(name),
        static_error=np.zeros((n, 5)),
        motor_gain=np.zeros((n, 5, n)),
        link_gain=np.zeros((n, 5, n)),
        body=FlexibleBody(
            mass=np.append(load.mass[:-1], whole),
            centre=np.vstack([load.centre[:-1], moment / whole]),
            stiffness=1.0 / arm.functions.compliance,
            softening=0.0,
        ),
        eccentricity=np.zeros(n),
        phase=np.zeros(n),
        repeatability=0.0,
        effects=replace(Effects.none(), gears=True, compliance=True),
        gears=gears,
    )
    q = postures(arm, 200)
    moved = np.linalg.norm((robot.flange(q, Warmth.cold(n)) - arm.fk(q))[:, :3, 3], axis=1)
    sag = np.linalg.norm((arm.fk(q) - robot.nominal.fk(q))[:, :3, 3], axis=1)
    # the truth's load is that of the bent arm, a thousandth (1 mrad) of it another one, and pulls
    # with 9.81 m/s² for 9.80665
    assert np.max(moved) < 2e-3 * np.max(sag)


def test_static_errors_are_those_of_the_model(arm, robot):
    q = postures(arm, 50)
    built = arm.with_mdh(arm.mdh + robot.static_error)
    np.testing.assert_allclose(
        only(robot, static=True).flange(q, warm(3.0)), built.fk(q), atol=1e-12
    )


def test_drift_of_a_length_is_steels_expansion(arm, robot):
    """The second link, 1.35 m, warmed by 10 K grows by 1.35 * 12e-6 * 10 = 0.162 mm."""
    warmth = Warmth(np.zeros(6), np.array([0.0, 10.0, 0.0, 0.0, 0.0, 0.0]))
    grown = only(robot, drift=True).mdh(warmth) - arm.mdh
    assert grown[1, 2] == pytest.approx(1.35 * 12e-6 * 10.0)


def test_every_parameter_drifts(robot):
    moved = robot.mdh(warm(3.0)) - robot.mdh(Warmth.cold(6))
    assert np.all(moved != 0.0)


@pytest.mark.parametrize("seed", range(8))
def test_three_hours_move_the_tool_as_published(arm, seed):
    """0.1 to 0.5 mm per axis after three hours for an arm of 3.1 m (rms over the workspace)."""
    robot = kr150.true_robot(arm, np.random.default_rng(seed))
    q = postures(arm, 200)
    moved = robot.point(q, warm(3.0), kr150.TOOL) - robot.point(q, Warmth.cold(6), kr150.TOOL)
    per_axis = np.sqrt(np.mean(moved**2)) * 1e3
    assert 0.1 < per_axis < 0.5


def test_encoder_eccentricity_turns_a_joint_by_ten_seconds_of_arc(arm, robot):
    """Joint 1 alone moves the tool by at most 10 arc seconds times its distance to the axis."""
    alone = replace(robot, eccentricity=robot.eccentricity * np.eye(6)[0])
    q = np.tile([0.0, -1.2, 1.4, 0.3, 0.8, 0.0], (180, 1))
    q[:, 0] = np.linspace(-np.pi, np.pi, 180)
    moved = only(alone, eccentricity=True).point(q, Warmth.cold(6), kr150.TOOL)
    moved = moved - only(alone).point(q, Warmth.cold(6), kr150.TOOL)
    reach = np.hypot(*only(alone).point(q, Warmth.cold(6), kr150.TOOL)[0, :2])
    largest = np.max(np.linalg.norm(moved, axis=1))
    assert largest == pytest.approx(reach * np.radians(10.0 / 3600.0), rel=1e-3)


def test_gears_err_by_a_minute_of_arc_between_the_extremes(robot):
    """As makers of gears allow: over a turn, in the mean of the joints of many robots."""
    q = np.tile(np.linspace(-np.pi, np.pi, 2000)[:, None], (1, 6))
    ranges = [
        np.ptp(gear_errors(6, np.random.default_rng(seed)).at(q), axis=0) for seed in range(30)
    ]
    assert np.degrees(np.mean(ranges)) * 60.0 == pytest.approx(1.0, abs=0.1)
    # a real UR10's are identified at 240 to 380 urad (accuracy.md); here most of them
    real = np.std(ur10_gears().at(q), axis=0)
    assert np.all((real > 0.7 * 240e-6) & (real < 1.2 * 380e-6))


def test_backlash_holds_a_joint_back_until_its_play_is_taken_up(robot):
    gears = robot.gears
    half, rng = 0.5 * gears.lost_motion, np.random.default_rng(2)
    there = np.linspace(0.0, 20.0, 50)[:, None] * half
    play = BacklashPlay(gears, np.zeros(6))
    play.follow(np.arange(50.0), there)
    np.testing.assert_allclose(play.at(np.array([49.0]))[0], half)
    play.follow(np.arange(49.0, 99.0), there[::-1])
    np.testing.assert_allclose(play.at(np.array([98.0]))[0], -half)
    np.testing.assert_allclose(gears.behind(there[0] - there[-1]), -half)
    way = np.cumsum(rng.normal(size=(400, 6)), axis=0) * 0.3 * half + there[0]
    play = BacklashPlay(gears, way[0])
    for begin in range(0, 399, 57):
        stretch = np.arange(begin, min(begin + 58, 400))
        play.follow(stretch.astype(float), way[stretch])
        behind = play.at(stretch.astype(float))
        assert np.all(np.abs(behind) <= half * (1.0 + 1e-9))
        joint = way[stretch] - behind
        # it never goes further than the reading does, nor against it
        step, told = np.diff(joint, axis=0), np.diff(way[stretch], axis=0)
        assert np.all(step * told >= -1e-18)
        assert np.all(np.abs(step) <= np.abs(told) + 1e-12)


def test_gravity_bends_the_arm_down(arm, robot):
    """A cantilever by hand: each joint's torque over its stiffness, times its lever arm."""
    q = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])  # stretched out
    sagging, stiff = only(robot, compliance=True), only(robot)
    moved = sagging.point(q, Warmth.cold(6), [0, 0, 0]) - stiff.point(q, Warmth.cold(6), [0, 0, 0])
    frames = [np.eye(4)]
    for row, sign in zip(arm.mdh, arm.sign, strict=True):
        single = SerialArm("x", ("j",), row[None], np.ones(1), np.zeros(1, bool), [-9.0], [9.0])
        frames.append(frames[-1] @ single.fk([0.0]))
        assert sign in (-1.0, 1.0)
    down = 0.0
    for i in range(6):
        axis, origin = frames[i][:3, 2], frames[i][:3, 3]
        torque = sum(
            axis @ np.cross((frames[k + 1] @ [*kr150.BODY.centre[k], 1.0])[:3] - origin,
                            [0.0, 0.0, -9.81 * kr150.BODY.mass[k]])
            for k in range(i, 6)
        )  # fmt: skip
        turned = torque / kr150.BODY.stiffness[i] * axis
        down += np.cross(turned, frames[-1][:3, 3] - origin)[2]
    assert down < -1e-3
    assert moved[0, 2] == pytest.approx(down, rel=0.02)  # the sag itself changes the levers


def test_a_warm_gear_is_softer(robot):
    q = np.array([[0.0, -0.3, 0.6, 0.0, 0.5, 0.0]])
    soft = only(robot, compliance=True)
    cold, hot = Warmth.cold(6), Warmth(np.full(6, 30.0), np.zeros(6))
    sag = soft.point(q, cold, kr150.TOOL) - only(robot).point(q, cold, kr150.TOOL)
    more = soft.point(q, hot, kr150.TOOL) - only(robot).point(q, hot, kr150.TOOL)
    assert np.linalg.norm(more) / np.linalg.norm(sag) == pytest.approx(1.003, abs=2e-4)


def test_repeatability_is_two_hundredths_at_the_tool(arm, robot):
    """Per axis 0.02 mm, averaged over the workspace; the joints' mean is exact."""
    noisy, q = only(robot, noise=True), postures(arm, 4000)
    rng = np.random.default_rng(3)
    moved = noisy.point(q, Warmth.cold(6), kr150.TOOL, rng)
    moved = moved - noisy.point(q, Warmth.cold(6), kr150.TOOL)
    assert np.sqrt(np.mean(moved**2)) == pytest.approx(2e-5, rel=0.25)
    assert np.abs(moved.mean(axis=0)).max() < 4.0 * 2e-5 / np.sqrt(4000)


def test_the_same_seed_is_the_same_robot(arm):
    one, two = (kr150.true_robot(arm, np.random.default_rng(5)) for _ in range(2))
    q = postures(arm, 20)
    assert np.array_equal(one.flange(q, warm(2.0)), two.flange(q, warm(2.0)))


def test_warm_up_follows_its_closed_form():
    """A motor alone: rise (1 - exp(-t / tau)); a link tends to its share of the motors'."""
    for hours in (0.2, 1.0, 4.0):
        expected = kr150.WARM_UP.motor_rise * SHIFT_DUTY
        expected = expected * (1.0 - np.exp(-3600.0 * hours / kr150.WARM_UP.motor_tau_s))
        np.testing.assert_allclose(warm(hours).motor, expected, rtol=1e-12)
    ends = kr150.WARM_UP.motor_rise * SHIFT_DUTY
    settled = kr150.WARM_UP.link_share * 0.5 * (ends + np.append(ends[1:], ends[-1]))
    np.testing.assert_allclose(warm(24.0).link, settled, rtol=1e-6)
    cooled = kr150.WARM_UP.step(warm(24.0), np.zeros(6), 48 * 3600.0)
    assert np.abs(cooled.link).max() < 1e-6


FLANGE = np.array([[1.0, 0, 0, 1.2], [0, 0, -1.0, 0.1], [0, 1.0, 0, 0.8], [0, 0, 0, 1.0]])


def sensor(**switched: bool) -> SphereSensor:
    return kr150.sphere_sensor(replace(Effects.none(), **switched))


def exact() -> np.ndarray:
    return (kr150.T_SENSOR_BASE @ FLANGE @ np.append(kr150.BALL, 1.0))[:3]


def test_a_perfect_sensor_tells_the_truth():
    measured = sensor().measure(FLANGE, 30.0, 1e4, np.random.default_rng(0))
    np.testing.assert_allclose(measured, exact(), atol=1e-15)


def test_noise_is_two_hundredths():
    noisy, rng = sensor(noise=True), np.random.default_rng(1)
    error = np.array([noisy.measure(FLANGE, 0.0, 0.0, rng) for _ in range(5000)]) - exact()
    # a standard deviation from 15000 draws has a relative standard error of 0.6 %
    assert error.std() == pytest.approx(2e-5, rel=0.03)


def test_the_stem_grows_with_the_flange():
    """A stem of 0.219 m warmed by 5 K: 0.219 * 12e-6 * 5 = 0.013 mm along itself."""
    grown = sensor(stem=True).measure(FLANGE, 5.0, 0.0, np.random.default_rng(0)) - exact()
    stem = exact() - (kr150.T_SENSOR_BASE @ FLANGE)[:3, 3]
    np.testing.assert_allclose(grown, stem * 12e-6 * 5.0, atol=1e-12)
    assert np.linalg.norm(grown) == pytest.approx(1.3e-5, rel=0.02)


def test_the_sensor_itself_warms_up_by_ten_micrometres():
    warm = sensor(sensor_warm_up=True)
    moved = [
        np.linalg.norm(warm.measure(FLANGE, 0.0, t, np.random.default_rng(0)) - exact())
        for t in (0.0, 1800.0, 1e5)
    ]
    assert moved == pytest.approx([0.0, 1e-5 * (1.0 - np.exp(-1.0)), 1e-5], abs=1e-9)


def test_one_in_a_hundred_is_an_outlier_of_a_millimetre():
    odd, rng = sensor(outliers=True), np.random.default_rng(2)
    error = np.array([odd.measure(FLANGE, 0.0, 0.0, rng) for _ in range(5000)]) - exact()
    size = np.linalg.norm(error, axis=1)
    assert np.allclose(size[size > 1e-6], 1e-3)
    assert np.sum(size > 1e-6) == pytest.approx(50, abs=4 * np.sqrt(50))


def test_switching_an_effect_off_leaves_the_other_draws_alone():
    rng = np.random.default_rng
    both = sensor(noise=True, outliers=True)
    quiet = [sensor(noise=True).measure(FLANGE, 0, 0, g) for g in [rng(4)] * 50]
    loud = [both.measure(FLANGE, 0, 0, g) for g in [rng(4)] * 50]
    apart = np.linalg.norm(np.array(quiet) - loud, axis=1)
    assert np.all((apart < 1e-12) | np.isclose(apart, 1e-3))
    assert np.sum(apart < 1e-12) > 40


def test_a_path_rests_where_it_says_and_never_jumps():
    path = SmoothPath(
        np.array([0.0, 5.0, 12.0]), np.array([0.0, 6.0, 13.0]), np.diag([1.0, 2.0, 3.0])
    )
    time_s = np.linspace(-1.0, 15.0, 8001)
    q = path.at(time_s)
    resting = (time_s >= 5.0) & (time_s <= 6.0)
    assert np.array_equal(q[resting], np.tile(path.q[1], (resting.sum(), 1)))
    # minimum jerk: the largest speed is 1.875 times the mean one
    assert np.abs(np.diff(q, axis=0)).max() <= 1.875 * 3.0 / 5.0 * 0.002 * 1.001
    assert np.abs(readings(path, time_s, np.random.default_rng(0)) - q).max() < 1e-5


@pytest.fixture(scope="module")
def plan() -> ShiftPlan:
    rng = np.random.default_rng(9)
    pose = np.array([0.3, -1.3, 1.7, 0.4, 0.9, 0.2])
    poses = pose + 0.1 * rng.standard_normal((8, 6))
    return ShiftPlan(
        reference=poses[:4],
        cycle=poses[:3],
        check=poses[4:],
        phases=((0.5, 1.0), (0.25, 0.0), (0.25, 0.6)),
        duty=np.ones(6),
        period_s=600.0,
    )


def shift(plan: ShiftPlan, effects: Effects | None = None, seed: int = 0):
    body, course = np.random.default_rng(seed).spawn(2)
    robot = kr150.true_robot(load_robot("kr150_r3100"), body, effects)
    sensor = kr150.sphere_sensor(effects)
    return robot, simulate(robot, sensor, kr150.WARM_UP, plan, kr150.TOOL, course)


def test_a_shift_visits_each_pose_in_each_cycle(plan):
    _, found = shift(plan)
    names = [cycle.name for cycle in found.cycles]
    assert names == ["reference", *(f"cycle-{i:02d}" for i in range(1, 7))]
    for cycle in found.cycles:
        poses = plan.reference if cycle.name == "reference" else plan.cycle
        visits = [visit for visit in found.visits if visit.cycle == cycle.name]
        reached = np.array([visit.reading for visit in visits])
        assert np.abs(reached - poses).max() < 2e-4
        assert all(visit.time_s < cycle.time_s for visit in visits)
        for visit in visits:  # at rest when it is measured
            around = found.path.at(visit.time_s + np.array([-0.3, 0.0, 0.1]))
            assert np.array_equal(around, np.tile(visit.reading, (3, 1)))


def test_cycles_come_at_their_period(plan):
    _, found = shift(plan)
    apart = np.diff([cycle.time_s for cycle in found.cycles])
    assert np.all(np.abs(apart - plan.period_s) <= 10.0)


def test_the_truth_is_the_warm_robot_at_the_check_poses(plan):
    robot, found = shift(plan)
    for cycle in found.cycles:
        expected = robot.point(plan.check, cycle.warmth, kr150.TOOL)
        assert np.array_equal(cycle.check, expected)
    heat = [cycle.warmth.motor[1] for cycle in found.cycles]
    assert heat[0] == 0.0
    assert heat[3] > heat[2] > heat[1]
    assert heat[4] < heat[3]  # the break


def test_the_same_seed_is_the_same_shift(plan):
    (_, one), (_, two), (_, other) = shift(plan), shift(plan), shift(plan, seed=1)
    assert all(
        np.array_equal(a.position, b.position) and a.time_s == b.time_s
        for a, b in zip(one.visits, two.visits, strict=True)
    )
    assert np.array_equal(one.path.q, two.path.q)
    assert not np.array_equal(one.visits[0].position, other.visits[0].position)


def test_without_effects_the_visits_are_the_nominal_ones(plan):
    robot, found = shift(plan, Effects.none())
    for visit in found.visits:
        flange = robot.nominal.fk(visit.reading)
        expected = kr150.T_SENSOR_BASE @ flange @ np.append(kr150.BALL, 1.0)
        np.testing.assert_allclose(visit.position, expected[:3], atol=1e-12)


@pytest.mark.parametrize("seed", [3, 7])
def test_a_robot_counts_where_six_lengths_do_as_published(seed):
    robot = kr150.true_robot(load_robot("kr150_r3100"), np.random.default_rng(seed))
    cell = drifting_cell(robot, poses("sphere"), poses("check"))
    assert cell.as_published == (seed in SEEDS)
    # Scaled at every sixth cycle of 90: the others may differ by a cycle's share on either side.
    for plan in cell.plans:
        assert share_within(cell.truth(plan)) == pytest.approx(UNCORRECTED, abs=2.0 / 90.0)
