# SPDX-License-Identifier: Apache-2.0
"""Bounded inverse kinematics along a path: recovers joints and rates, and refuses in words."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_cell import POSTURES

from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.kinematics import newton
from robocal_ros.kinematics.arm import SMALLEST_SINGULAR_VALUE, follow, inverse
from robocal_ros.kinematics.robots import load_robot

P_FLANGE = np.array([0.02, -0.03, 0.2])
H = 1e-4


def way(q, rng, t):
    """Joints that swing by up to 0.1 rad around a posture; smooth in t."""
    swing = 0.1 * rng.uniform(-1.0, 1.0, (2, len(q)))
    return q + np.sin(t)[:, None] * swing[0] + (1.0 - np.cos(1.7 * t))[:, None] * swing[1]


def at_point(arm, q):
    return arm.fk(q) @ frames.transform(np.eye(3), P_FLANGE)


@pytest.mark.parametrize("robot", POSTURES)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_joints_of_a_path_are_found_again(robot, seed):
    arm, rng = load_robot(robot), np.random.default_rng(seed)
    q = way(POSTURES[robot], rng, np.linspace(0.0, 1.0, 40))
    found = inverse(arm, arm.fk(q), q[0] + 0.01 * rng.uniform(-1.0, 1.0, 6))
    # rounding of 3 m and rad, over the smallest singular value that is let pass
    np.testing.assert_allclose(found, q, atol=1e-14 / SMALLEST_SINGULAR_VALUE * 3.0 * 5.0)


@pytest.mark.parametrize("robot", POSTURES)
def test_rates_of_the_joints_are_those_of_the_path(robot):
    arm, rng = load_robot(robot), np.random.default_rng(1)
    t = np.linspace(0.0, 1.0, 30)
    law = np.random.default_rng(5).integers(1 << 30)
    q = {s: way(POSTURES[robot], np.random.default_rng(law), t + s * H) for s in (-1, 0, 1)}
    T = {s: at_point(arm, q[s]) for s in q}
    v = {s: (arm.jacobian(q[s]) @ _rate(robot, law, t + s * H)[:, :, None])[:, :, 0] for s in q}
    for s in q:  # the point's velocity, not the flange's
        v[s][:, :3] += np.cross(v[s][:, 3:], T[s][:, :3, 3] - arm.fk(q[s])[:, :3, 3])
    a = (v[1] - v[-1]) / (2.0 * H)
    found = follow(arm, T[0], v[0], a, q[0][0] + 1e-3 * rng.normal(size=6), P_FLANGE)
    np.testing.assert_allclose(found.qd, _rate(robot, law, t), atol=1e-11)
    # central differences of a smooth path: H^2 / 6 of its third derivatives, a few 1/s^3
    bent = (q[1] - 2.0 * q[0] + q[-1]) / H**2
    np.testing.assert_allclose(found.qdd, bent, atol=2e-6)


def _rate(robot, law, t):
    """Derivative of ``way`` by t, by the complex step."""
    step = 1e-30
    return way(POSTURES[robot], np.random.default_rng(law), t + 1j * step).imag / step


def test_a_redundant_arm_reaches_its_poses():
    ur10 = load_robot("ur10")
    seven = type(ur10)(
        "seven",
        ("rail", *ur10.joint_names),
        np.vstack([[0.0, 0.0, 0.0, np.pi / 2.0, 0.0], ur10.mdh]),
        np.ones(7),
        np.arange(7) == 0,
        np.append(-2.0, ur10.lower),
        np.append(2.0, ur10.upper),
    )
    q = way(np.append(0.1, POSTURES["ur10"]), np.random.default_rng(2), np.linspace(0.0, 1.0, 20))
    found = inverse(seven, seven.fk(q), q[0])
    np.testing.assert_allclose(seven.fk(found), seven.fk(q), atol=1e-11)


def test_a_passed_joint_limit_is_named_with_value_and_limit():
    arm = load_robot("ur10")
    q = np.tile(POSTURES["ur10"], (20, 1))
    q[:, 2] += np.linspace(0.0, 0.4, 20)
    upper = arm.upper.copy()
    upper[2] = POSTURES["ur10"][2] + 0.2
    with pytest.raises(LimitError, match=r"elbow_joint would be at (-\d+\.\d+) deg") as caught:
        inverse(replace(arm, upper=upper), arm.fk(q), q[0])
    assert f"{np.degrees(upper[2]):.3f} deg" in str(caught.value)


def test_a_singularity_is_not_approached():
    arm = load_robot("ur10")
    q = np.tile(POSTURES["ur10"], (80, 1))
    q[:, 4] = np.linspace(-1.0, 0.2, 80)  # through the wrist's singularity at 0
    smallest = np.linalg.svd(arm.jacobian(q), compute_uv=False)[:, -1]
    first = int(np.argmax(smallest < SMALLEST_SINGULAR_VALUE))
    with pytest.raises(LimitError, match=rf"pose {first + 1} of .* near a singularity"):
        inverse(arm, arm.fk(q), q[0])


def test_a_pose_out_of_reach_is_named():
    arm = load_robot("ur10")
    T = np.tile(arm.fk(POSTURES["ur10"]), (60, 1, 1))
    T[:, :3, 3] *= np.linspace(1.0, 3.0, 60)[:, None]
    with pytest.raises(LimitError, match=r"pose \d+ .* mm"):
        inverse(arm, T, POSTURES["ur10"])
    with pytest.raises(LimitError, match=r"pose 1 of 1 .*reach"):
        inverse(arm, T[-1:], POSTURES["ur10"])


def test_a_jump_to_another_posture_is_no_path():
    arm = load_robot("ur10")
    q = np.stack([POSTURES["ur10"], POSTURES["ur10"] + 0.5])
    with pytest.raises(LimitError, match=r"pose 2 of 2 .*jump"):
        inverse(arm, arm.fk(q), q[0])


def test_what_is_not_finite_is_refused():
    arm = load_robot("ur10")
    T = arm.fk(POSTURES["ur10"])[None]
    with pytest.raises(LimitError, match="not finite"):
        inverse(arm, T * np.nan, POSTURES["ur10"])
    with pytest.raises(LimitError, match="not finite"):
        inverse(arm, T, np.full(6, np.nan))


@pytest.mark.parametrize("at", range(6))
def test_a_number_that_is_none_is_no_small_residual(at):
    """Comparisons with NaN are false: a maximum that is taken so would lose it."""
    values = np.full(6, 1e-13)
    values[at] = np.nan
    assert np.isnan(newton.largest_of(values))
    values[at] = -np.inf
    assert newton.largest_of(values) == np.inf
