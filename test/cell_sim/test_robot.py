"""The simulated truth: equal to the nominal model when nothing is wrong, else wrong as stated."""

from dataclasses import replace

import numpy as np
import pytest

from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.robot import Effects, TrueRobot, Warmth
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot

ROBOTS = ("kr150_r3100", "ur10", "bx200l", "p1r2p3")
SHIFT_DUTY = np.array([0.5, 1.0, 1.0, 0.8, 0.6, 0.6])


@pytest.fixture(scope="module")
def arm() -> SerialArm:
    return load_robot("kr150_r3100")


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
