# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms as 4 x 4 arrays, batched in the leading dimensions.

``T_a_b`` maps coordinates in frame b to frame a: ``p_a = T_a_b @ p_b``.
Quaternions are x, y, z, w. Nothing here needs scipy.spatial, whose import takes a node a tenth of a
second at its start.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from robocal_ros.ground.documents import PoseDocument

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Document = dict[str, Any]

GIMBAL_LOCK = 1e-8  # cosine of the pitch below which roll and yaw are one


def transform(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Assemble (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    R = np.asarray(rotation, dtype=np.float64)
    t = np.asarray(translation, dtype=np.float64)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def transform_from_quat(xyz: ArrayLike, quat_xyzw: ArrayLike) -> Array:
    """Assemble (..., 4, 4) from positions (..., 3), m, and quaternions (..., 4).

    Raises `ValueError` for a quaternion of length 0; all others are normalised.
    """
    quat = np.asarray(quat_xyzw, dtype=np.float64)
    length = np.linalg.norm(quat, axis=-1, keepdims=True)
    if np.any(length == 0.0):
        raise ValueError("a quaternion has the length 0")
    unit = quat / length
    return transform(_rotation_of_quat(unit[..., :3], unit[..., 3:]), xyz)


def _rotation_of_quat(v: Array, w: Array) -> Array:
    """Rotations (..., 3, 3) of unit quaternions: vectors (..., 3) and real parts (..., 1)."""
    V = skew(v)
    return np.asarray(np.eye(3) + 2.0 * (w[..., None] * V + V @ V))


def invert(T: Array) -> Array:
    """Inverse (..., 4, 4) of rigid transforms (..., 4, 4)."""
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(Rt, -(Rt @ T[..., :3, 3, None])[..., 0])


def apply(T: Array, points: Array) -> Array:
    """Points (..., 3), each by its own transform (..., 4, 4)."""
    return np.asarray(np.einsum("...ij,...j->...i", T[..., :3, :3], points) + T[..., :3, 3])


def quat_xyzw(T: Array) -> Array:
    """Unit quaternions (..., 4), w >= 0, of transforms (..., 4, 4) or rotations (..., 3, 3).

    Products of its numbers are sums of the rotation's (Bar-Itzhack 2000): the column of the
    largest square is the quaternion, scaled.
    """
    R = np.asarray(T[..., :3, :3], dtype=np.float64)
    trace = np.trace(R, axis1=-2, axis2=-1)
    products = np.empty((*R.shape[:-2], 4, 4))
    products[..., :3, :3] = R + np.swapaxes(R, -1, -2)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        products[..., i, i] += 1.0 - trace
        products[..., i, 3] = products[..., 3, i] = R[..., k, j] - R[..., j, k]
    products[..., 3, 3] = 1.0 + trace
    largest = np.argmax(np.diagonal(products, axis1=-2, axis2=-1), axis=-1)
    quat = np.take_along_axis(products, largest[..., None, None], axis=-1)[..., 0]
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    return np.asarray(np.where(quat[..., 3:] < 0.0, -quat, quat))


def exp_rotation(rotvec: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad."""
    w = np.asarray(rotvec, dtype=np.float64)
    half = 0.5 * np.linalg.norm(w, axis=-1, keepdims=True)
    return _rotation_of_quat(0.5 * np.sinc(half / np.pi) * w, np.cos(half))


def log_rotation(rotation: Array) -> Array:
    """Rotation vectors (..., 3), rad, of rotation matrices (..., 3, 3); no longer than pi."""
    quat = quat_xyzw(rotation)
    v, w = quat[..., :3], quat[..., 3:]
    half = np.arctan2(np.linalg.norm(v, axis=-1, keepdims=True), w)
    return np.asarray(2.0 / np.sinc(half / np.pi) * v)


def apart(T: Array, other: Array) -> tuple[float, float]:
    """Distance, m, and angle, rad, between two poses (4, 4)."""
    turn = log_rotation(T[:3, :3].T @ other[:3, :3])
    return float(np.linalg.norm(T[:3, 3] - other[:3, 3])), float(np.linalg.norm(turn))


def rotation_from_rpy(rpy: ArrayLike) -> Array:
    """Rotation (3, 3) of roll, pitch, yaw (3,), rad: about x, then y, then z of the fixed frame."""
    roll, pitch, yaw = np.asarray(rpy, dtype=np.float64)
    turns = ((0.0, 0.0, yaw), (0.0, pitch, 0.0), (roll, 0.0, 0.0))
    Rz, Ry, Rx = (exp_rotation(turn) for turn in turns)
    return Rz @ Ry @ Rx


def rpy(rotation: Array) -> Array:
    """Roll, pitch, yaw (3,), rad, of a rotation (3, 3): the inverse of `rotation_from_rpy`.

    With pitch at +-90 deg roll and yaw turn about one axis: yaw is 0 then.
    """
    R = rotation
    level = float(np.hypot(R[0, 0], R[1, 0]))
    pitch = np.arctan2(-R[2, 0], level)
    if level < GIMBAL_LOCK:
        return np.array([np.arctan2(-R[1, 2], R[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])


def skew(v: ArrayLike) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    x = np.asarray(v, dtype=np.float64)
    S = np.zeros((*x.shape, 3))
    S[..., 0, 1], S[..., 0, 2], S[..., 1, 2] = -x[..., 2], x[..., 1], -x[..., 0]
    return np.asarray(S - np.swapaxes(S, -1, -2))


def adjoint(T: Array) -> Array:
    """(..., 6, 6): twists (v, w) given on the right of a frame, on the left of T (..., 4, 4).

    ``exp(adjoint(T) x) T = T exp(x)``.
    """
    R, t = T[..., :3, :3], T[..., :3, 3]
    found = np.zeros((*T.shape[:-2], 6, 6))
    found[..., :3, :3] = found[..., 3:, 3:] = R
    found[..., :3, 3:] = skew(t) @ R
    return found


def left_jacobian_inverse(rotvec: ArrayLike) -> Array:
    """Inverse left Jacobian (..., 3, 3) of SO(3) at rotation vectors (..., 3).

    ``log(exp(w) R) = log(R) + J_l^-1(log R) w`` to first order in w
    (Solà, Deray, Atchuthan 2018, eq. 146).
    """
    w = np.asarray(rotvec, dtype=np.float64)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    half = 0.5 * angle
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(angle < 1e-4, 1.0 / 12.0, (1.0 - half / np.tan(half)) / angle**2)
    W = skew(w)
    return np.asarray(np.eye(3) - 0.5 * W + factor * (W @ W))


def nearest_rotation(matrix: ArrayLike) -> Array:
    """Rotations (..., 3, 3) nearest to matrices in the Frobenius norm, with determinant +1."""
    U, _, Vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    U[..., -1] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return np.asarray(U @ Vt)


# ---- frames as text: documents (JSON), fixed decimals, URDF -------------------------------------


def fixed(values: Array, digits: int) -> list[str]:
    """Fixed decimals; a zero has no sign."""
    rounded = np.round(values, digits) + 0.0
    return [f"{value:.{digits}f}" for value in rounded.tolist()]


def urdf_origin(T: Array) -> tuple[str, str]:
    """``xyz`` (m) and ``rpy`` (rad) of a pose (4, 4) as URDF writes them, 1e-4 mm and 1e-6 deg."""
    return " ".join(fixed(T[:3, 3], 7)), " ".join(fixed(rpy(T[:3, :3]), 8))


def urdf_joint(parent: str, child: str, xyz: str, rpy: str) -> str:
    """A fixed joint, and the link that it carries."""
    return (
        f'<link name="{child}"/>\n'
        f'<joint name="{parent}-{child}" type="fixed">\n'
        f'  <parent link="{parent}"/>\n'
        f'  <child link="{child}"/>\n'
        f'  <origin xyz="{xyz}" rpy="{rpy}"/>\n'
        "</joint>"
    )


def transform_document(T: Array) -> "PoseDocument":
    """A pose (4, 4) as ``xyz_mm`` and ``quat_xyzw``."""
    return {"xyz_mm": (T[:3, 3] * 1e3).tolist(), "quat_xyzw": quat_xyzw(T).tolist()}
