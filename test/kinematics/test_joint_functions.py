# SPDX-License-Identifier: Apache-2.0
"""Joint functions and winding under load: against the definition, numeric derivatives, and back."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from drawn_arms import arms, twist
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import (
    SMALLEST_SINGULAR_VALUE,
    arm_of,
    follow,
    inverse,
    model_document,
    payload_note,
)
from robocal_ros.kinematics.joint_functions import ArmLoad, JointFunctions
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.kinematics.universal_robots import link_transform

NM = 1e-9
# Knots of half the length over which a real UR10's functions change, and their size; compliances
# as of its joints 2 and 3, which its real measurements show (8 to 12 urad per N m).
STEP, SIZE, COMPLIANCE = np.radians(2.5), 350e-6, 1.2e-5
# Rounding of 3 m and rad over the smallest singular value that is let pass.
FOUND = 5.0 * 3.0 * 1e-14 / SMALLEST_SINGULAR_VALUE
POSTURE = np.array([0.3, -1.2, 1.4, -0.9, -1.3, 0.4])


def with_layer(arm: SerialArm, seed: int, turns: float = 1.0) -> SerialArm:
    """The arm with functions within so many turns either way, compliances and a load."""
    rng, n = np.random.default_rng(seed), arm.n
    m = int(4.0 * np.pi * turns / STEP)
    functions = JointFunctions(
        np.full(n, -m / 2 * STEP),
        np.full(n, STEP),
        rng.uniform(-SIZE, SIZE, (n, m)),
        rng.uniform(0.0, COMPLIANCE, n),
    )
    load = ArmLoad(
        rng.uniform(0.0, 10.0, n),
        rng.uniform(-0.3, 0.3, (n, 3)),
        rng.uniform(0.0, 10.0),
        rng.uniform(-0.1, 0.1, 3),
        rng.normal(0.0, 6.0, 3),
    )
    return replace(arm, functions=functions, load=load)


def potential(arm: SerialArm, q: np.ndarray) -> float:
    """Of the masses in the field of gravity, J, link by link."""
    T, load, height = arm.T_base_root, arm.load, 0.0
    for i, row in enumerate(arm.mdh):
        d, theta, a, alpha, beta = row
        moved = arm.sign[i] * q[i]
        d, theta = (d + moved, theta) if arm.prismatic[i] else (d, theta + moved)
        T = T @ link_transform(np.array([d, theta, a, alpha, beta]))
        height -= load.mass[i] * load.gravity @ (T @ np.append(load.centre[i], 1.0))[:3]
    tip = (T @ np.append(load.payload_centre, 1.0))[:3]
    return float(height - load.payload_mass * load.gravity @ tip)


def torque(arm: SerialArm, q: np.ndarray, h: float = 1e-5) -> np.ndarray:
    """Numeric: what a joint's motion takes from the potential."""
    ways = h * np.eye(arm.n)
    return np.array([potential(arm, q - w) - potential(arm, q + w) for w in ways]) / (2.0 * h)


def splines(arm: SerialArm) -> list[BSpline]:
    """SciPy's, zero outside."""
    made = []
    for first, step, row in zip(
        arm.functions.first, arm.functions.step, arm.functions.coefficients, strict=True
    ):
        knots = first + step * np.arange(-3, len(row) + 7)
        made.append(BSpline(knots, np.pad(row, (3, 3)), 3, extrapolate=False))
    return made


@given(arms(), st.integers(0, 2**31))
@settings(max_examples=40, deadline=None)
def test_a_joint_turns_by_its_function_and_its_torque(drawn, seed):
    bare, q = drawn
    arm = with_layer(bare, seed)
    delta = [np.nan_to_num(f(x)) for f, x in zip(splines(arm), q, strict=True)]
    turned = q + delta + arm.functions.compliance * torque(arm, q)
    np.testing.assert_allclose(arm.functions.delta(q), delta, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(arm.turned(q), turned, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(arm.fk(q), bare.fk(turned), rtol=0.0, atol=NM / 10.0)
    np.testing.assert_array_equal(arm.fk(np.stack([q, q]))[1], arm.fk(q))


@given(arms(), st.integers(0, 2**31))
@settings(max_examples=40, deadline=None)
def test_derivatives_are_the_numeric_ones(drawn, seed):
    bare, q = drawn
    arm, h = with_layer(bare, seed), 1e-6
    S = np.array([arm.turned(q + w) - arm.turned(q - w) for w in h * np.eye(arm.n)]).T / (2.0 * h)
    np.testing.assert_allclose(arm.turned_jacobian(q), S, rtol=0.0, atol=1e-8)
    slope = (arm.functions.delta(q + h) - arm.functions.delta(q - h)) / (2.0 * h)
    np.testing.assert_allclose(arm.functions.slope(q), slope, rtol=0.0, atol=1e-8)
    J = [twist(arm.fk(q - w), arm.fk(q + w)) / (2.0 * h) for w in h * np.eye(arm.n)]
    np.testing.assert_allclose(arm.jacobian(q), np.array(J).T, rtol=0.0, atol=1e-7)


@given(arms(), st.integers(0, 2**31))
@settings(max_examples=40, deadline=None)
def test_readings_are_found_again(drawn, seed):
    bare, q = drawn
    arm = with_layer(bare, seed)
    np.testing.assert_allclose(arm.read(arm.turned(q)), q, rtol=0.0, atol=1e-13)


def test_a_parameter_moves_the_flange_where_the_joints_really_are():
    arm = with_layer(load_robot("ur10"), 3)
    change, parameters = 1e-6, arm.parameters
    J = arm.parameter_jacobian(POSTURE)
    for column in range(len(parameters)):
        step = change * np.eye(len(parameters))[column]
        ends = [arm.with_mdh(parameters.add(arm.mdh, sign * step)) for sign in (-1.0, 1.0)]
        moved = twist(ends[0].fk(POSTURE), ends[1].fk(POSTURE)) / (2.0 * change)
        # that the torques depend on it is left out: of some 300 N m for a unit, at 1 m and 1 rad
        np.testing.assert_allclose(J[:, column], moved, rtol=0.0, atol=2.0 * COMPLIANCE * 300.0)


def test_outside_its_table_a_function_is_zero_and_an_arm_without_one_is_the_same():
    bare = load_robot("ur10")
    arm = with_layer(bare, 1, turns=0.1)
    free = replace(arm, functions=replace(arm.functions, compliance=np.zeros(6)))
    beyond = np.array([2.0, -2.0, 1e9, 4.0, 3.0, -3.0])
    np.testing.assert_array_equal(free.turned(beyond), beyond)
    assert np.all(free.functions.delta(beyond) == 0.0)
    nothing = JointFunctions(np.zeros(6), np.ones(6), np.zeros((6, 0)), np.zeros(6))
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (300, 6))
    np.testing.assert_array_equal(replace(bare, functions=nothing).fk(q), bare.fk(q))


def test_joints_of_a_path_and_their_rates_are_those_that_are_read():
    arm, t, h = with_layer(load_robot("ur10"), 5), np.linspace(0.0, 1.0, 30), 1e-4
    swing = 0.1 * np.random.default_rng(2).uniform(-1.0, 1.0, 6)

    def joints(t):
        return POSTURE + np.sin(t)[:, None] * swing, np.cos(t)[:, None] * swing

    def twists(t):
        q, qd = joints(t)
        return (arm.jacobian(q) @ qd[:, :, None])[:, :, 0]

    q, qd = joints(t)
    rate = (twists(t + h) - twists(t - h)) / (2.0 * h)
    found = follow(arm, arm.fk(q), twists(t), rate, q[0] + 1e-3)
    np.testing.assert_allclose(found.q, q, rtol=0.0, atol=FOUND)
    np.testing.assert_allclose(found.qd, qd, rtol=0.0, atol=1e-11)
    # the difference of the twists steps over knots, where a third derivative of up to
    # 6 SIZE / STEP^3 jumps: times the rate squared, h and a metre
    np.testing.assert_allclose(found.qdd, -np.sin(t)[:, None] * swing, rtol=0.0, atol=2e-5)
    np.testing.assert_allclose(inverse(arm, arm.fk(q), q[0]), q, rtol=0.0, atol=FOUND)


@given(arms(), st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_a_model_document_reads_back_to_the_last_bit(drawn, seed):
    bare, q = drawn
    arm = with_layer(bare, seed)
    document = json.loads(json.dumps(model_document(arm)))
    nominal = replace(bare, mdh=bare.mdh + 1e-3)
    back = arm_of(document, nominal)
    np.testing.assert_array_equal(back.fk(q), arm.fk(q))
    assert back.model_hash == arm.model_hash != bare.model_hash
    # a document of before has no functions, and neither has its arm
    plain = arm_of(model_document(bare), replace(arm, mdh=nominal.mdh))
    np.testing.assert_array_equal(plain.fk(q), bare.fk(q))


def test_the_hash_tells_functions_and_compliances_apart_but_not_what_is_carried():
    arm = with_layer(load_robot("ur10"), 7)
    functions, load = arm.functions, arm.load
    carried = replace(load, payload_mass=9.0, gravity=np.array([0.0, 9.8, 0.0]))
    assert replace(arm, load=carried).model_hash == arm.model_hash
    different = [
        replace(arm, functions=replace(functions, first=functions.first + 1e-6)),
        replace(arm, functions=replace(functions, coefficients=functions.coefficients * 1.01)),
        replace(arm, functions=replace(functions, compliance=functions.compliance * 1.01)),
        replace(arm, load=replace(load, mass=load.mass + 0.1)),
        replace(arm, functions=None),
    ]
    assert len({other.model_hash for other in [arm, *different]}) == 1 + len(different)


def test_a_model_is_used_with_what_the_robot_file_says_it_carries_and_tells_what_that_may_cost():
    nominal = replace(load_robot("ur10"), load=None)
    identified = with_layer(nominal, 7)
    load = replace(identified.load, payload_mass=0.0)
    identified = replace(identified, load=load)
    carries = replace(load, mass=np.ones(6), payload_mass=5.0, payload_centre=np.full(3, 0.1))
    used = arm_of(model_document(identified), replace(nominal, load=carries))
    np.testing.assert_array_equal(used.load.mass, load.mass)
    assert used.load.payload_mass == 5.0
    q = np.random.default_rng(1).uniform(used.lower / 2.0, used.upper / 2.0, (5000, 6))
    moved = np.linalg.norm((used.fk(q) - identified.fk(q))[:, :3, 3], axis=1)
    note = payload_note(used, load, carries)
    found = re.search(r"payload of 0 kg .* says 5 kg .* up to ([0-9.]+) mm", note)
    # the largest of so many poses, in words of two digits
    assert float(found[1]) == pytest.approx(1e3 * np.max(moved), rel=0.15)
    assert payload_note(identified, load, load) == payload_note(nominal, load, None) == ""
    bare = replace(used, functions=None)
    words = "how far that bends the arm is not in the model"
    assert payload_note(bare, load, carries).endswith(words)


def test_masses_that_were_found_carry_no_payload_and_follow_no_other_mounting():
    """They are a unit: what a robot file says in kilograms does not go with them, and is told."""
    nominal = replace(load_robot("ur10"), load=None)
    found = ArmLoad.unknown(6)
    identified = replace(with_layer(nominal, 7), load=found)
    assert identified.masses == "found"
    document = json.loads(json.dumps(model_document(identified)))
    q = np.random.default_rng(1).uniform(-2.0, 2.0, (100, 6))
    real = load_robot("ur10").load
    hung = replace(real, payload_mass=5.0, gravity=np.array([0.0, 9.8, 0.0]))
    for present in (None, real, hung):
        used = arm_of(document, replace(nominal, load=present))
        np.testing.assert_array_equal(used.fk(q), identified.fk(q))
        assert used.model_hash == identified.model_hash
        assert used.load.found
        note = payload_note(used, found, present)
        assert (note == "") == (present is None)
        told = "payload of what nobody stated .* without masses the model cannot follow"
        assert note == "" or re.search(told, note)
    said = replace(identified, load=replace(found, found=False))
    assert said.model_hash != identified.model_hash
    assert replace(said, functions=None).masses is None
    with pytest.raises(ValueError, match="a payload of 5 kg beside masses that were found"):
        replace(found, payload_mass=5.0)
    # a model with masses keeps its own, and its payload, where the robot file's were found
    assert real.carrying(found) is real
    del document["load"]["found"]  # a document of before, whose masses were given
    assert not arm_of(document, nominal).load.found


def parts(**changed):
    given = {
        "first": np.zeros(2),
        "step": np.ones(2),
        "coefficients": np.zeros((2, 5)),
        "compliance": np.zeros(2),
    }
    return given | changed


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"first": np.zeros(3)}, "do not fit"),
        ({"step": np.array([1.0, 0.0])}, "steps must be above 0"),
        ({"compliance": np.array([0.0, -1e-9])}, "compliances not below"),
        ({"coefficients": np.full((2, 5), np.nan)}, "coefficients .* not finite"),
        ({"coefficients": np.full((2, 5), 0.6)}, "joint 1 has a slope of up to 0.6"),
    ],
)
def test_functions_that_cannot_be_are_refused(changed, words):
    with pytest.raises(ValueError, match=words):
        JointFunctions(**parts(**changed))


def test_a_load_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="mass must not be below 0"):
        ArmLoad(np.array([-1.0]), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="centre must be"):
        ArmLoad(np.ones(2), np.zeros((1, 3)))
    bare = replace(load_robot("ur10"), load=None)
    with pytest.raises(ValueError, match="not of 6 joints"):
        replace(bare, functions=JointFunctions(**parts()))
    winds = parts(compliance=np.ones(6), first=np.zeros(6), step=np.ones(6))
    with pytest.raises(ValueError, match="compliances without a load"):
        replace(bare, functions=JointFunctions(**winds | {"coefficients": np.zeros((6, 0))}))
