# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms: round trips, conventions, and the corners of SO(3)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocal_ros.ground import frames

seeds = st.integers(0, 2**31)
angles = st.one_of(st.floats(0.0, np.pi - 1e-3), st.floats(0.0, 1e-3), st.sampled_from([0.0, 1e-9]))


def direction(seed: int) -> np.ndarray:
    v = np.random.default_rng(seed).normal(size=3)
    return v / np.linalg.norm(v)


def random_transform(seed: int, *lead: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return frames.transform(
        frames.exp_rotation(rng.normal(size=(*lead, 3))), rng.normal(size=(*lead, 3))
    )


def test_a_quarter_turn_about_z_takes_x_to_y():
    R = frames.exp_rotation([0.0, 0.0, np.pi / 2.0])
    np.testing.assert_allclose(R @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)
    s = np.sqrt(0.5)
    T = frames.transform_from_quat([1.0, 2.0, 3.0], [0.0, 0.0, s, s])
    np.testing.assert_allclose(T, frames.transform(R, [1.0, 2.0, 3.0]), atol=1e-15)
    np.testing.assert_allclose(T @ [1.0, 0.0, 0.0, 1.0], [1.0, 3.0, 3.0, 1.0], atol=1e-15)


def test_turns_are_as_scipy_has_them():
    """Small and large, and half turns, whose vector points the same way."""
    rng = np.random.default_rng(11)
    w = rng.normal(size=(400, 3))
    length = np.concatenate([10.0 ** rng.uniform(-12.0, 0.0, 200), rng.uniform(0.0, np.pi, 200)])
    w *= (length / np.linalg.norm(w, axis=1))[:, None]
    w = np.vstack([w, np.zeros(3), np.pi * np.eye(3), 5.0 * w[-9:]])
    R = Rotation.from_rotvec(w).as_matrix()
    rounding = 64 * np.finfo(np.float64).eps  # some dozen operations on numbers up to 2 pi
    np.testing.assert_allclose(frames.exp_rotation(w), R, rtol=0.0, atol=rounding)
    expected = Rotation.from_matrix(R).as_rotvec()
    np.testing.assert_allclose(frames.log_rotation(R), expected, rtol=0.0, atol=rounding)
    assert frames.log_rotation(R[:0]).shape == (0, 3)
    assert frames.exp_rotation(w.reshape(-1, 1, 3)).shape == (len(w), 1, 3, 3)


@given(seeds, angles)
def test_log_undoes_exp(seed, angle):
    w = angle * direction(seed)
    np.testing.assert_allclose(frames.log_rotation(frames.exp_rotation(w)), w, atol=1e-12)


def test_log_near_half_a_turn():
    """The vector may flip there; the rotation must not."""
    for offset in (0.0, 1e-9, 1e-6):
        R = frames.exp_rotation((np.pi - offset) * direction(4))
        w = frames.log_rotation(R)
        assert np.linalg.norm(w) == pytest.approx(np.pi - offset, abs=1e-7)
        np.testing.assert_allclose(frames.exp_rotation(w), R, atol=1e-7)


@given(seeds)
@settings(max_examples=30)
def test_inverse(seed):
    T = random_transform(seed, 2, 3)
    identity = np.broadcast_to(np.eye(4), T.shape)
    np.testing.assert_allclose(frames.invert(T) @ T, identity, atol=1e-14)
    np.testing.assert_allclose(T @ frames.invert(T), identity, atol=1e-14)


@given(seeds)
@settings(max_examples=30)
def test_quaternions_round_trip_with_positive_w(seed):
    T = random_transform(seed, 2, 3)
    quat = frames.quat_xyzw(T)
    assert quat.shape == (2, 3, 4)
    assert np.all(quat[..., 3] >= 0.0)
    np.testing.assert_allclose(frames.transform_from_quat(T[..., :3, 3], quat), T, atol=1e-14)
    np.testing.assert_allclose(frames.quat_xyzw(T[..., :3, :3]), quat, atol=0.0)


@given(seeds)
@settings(max_examples=20)
def test_skew_is_the_cross_product(seed):
    a, b = np.random.default_rng(seed).normal(size=(2, 5, 3))
    np.testing.assert_allclose((frames.skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-14)


@given(seeds, st.one_of(st.floats(0.0, 3.0), st.floats(0.0, 2e-4)))
@settings(max_examples=60)
def test_left_jacobian_inverse_is_the_derivative_of_log(seed, angle):
    """Also where its series takes over (1e-4 rad): closed form and series agree to 1e-7."""
    w = angle * direction(seed)
    R, h = frames.exp_rotation(w), 1e-6
    numeric = np.stack(
        [
            frames.log_rotation(frames.exp_rotation(h * e) @ R)
            - frames.log_rotation(frames.exp_rotation(-h * e) @ R)
            for e in np.eye(3)
        ],
        axis=1,
    ) / (2.0 * h)
    np.testing.assert_allclose(frames.left_jacobian_inverse(w), numeric, atol=2e-8)


@given(seeds)
@settings(max_examples=30)
def test_nearest_rotation_is_never_a_reflection(seed):
    M = np.random.default_rng(seed).normal(size=(3, 3))
    for matrix in (M, -M):
        R = frames.nearest_rotation(matrix)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(R) == pytest.approx(1.0)
        near = np.linalg.norm(R - matrix)
        others = frames.exp_rotation(0.1 * np.vstack([np.eye(3), -np.eye(3)])) @ R
        assert all(near < np.linalg.norm(other - matrix) for other in others)
