"""Compiled columns of Jacobians, from the axes that a walk along the chain kept.

``J`` (m, 3 or 6, k) holds twists [v; w] in the measuring frame; lengths in m, angles in rad.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.compiled import inlined

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@inlined
def joint_columns(
    links: Array, axes: Array, p0: float, p1: float, p2: float, J: Array, k: int
) -> None:
    """Row ``k`` of a geometric Jacobian: ``axes`` (n, 6) direction and point, p the flange."""
    for i in range(links.shape[0]):
        s = links[i, 7]
        a0, a1, a2 = s * axes[i, 0], s * axes[i, 1], s * axes[i, 2]
        if links[i, 8] > 0.5:
            J[k, 0, i], J[k, 1, i], J[k, 2, i] = a0, a1, a2
            J[k, 3, i], J[k, 4, i], J[k, 5, i] = 0.0, 0.0, 0.0
        else:
            r0, r1, r2 = p0 - axes[i, 3], p1 - axes[i, 4], p2 - axes[i, 5]
            J[k, 0, i], J[k, 1, i] = a1 * r2 - a2 * r1, a2 * r0 - a0 * r2
            J[k, 2, i] = a0 * r1 - a1 * r0
            J[k, 3, i], J[k, 4, i], J[k, 5, i] = a0, a1, a2


@inlined
def _turn(
    f: Array, i: int, axis: int, centre: int, p0: float, p1: float, p2: float,
    J: Array, k: int, c: int,
) -> None:  # fmt: skip
    """Column ``c`` of ``J[k]``: velocity of p (and, in six rows, the turn) about an axis."""
    a0, a1, a2 = f[i, axis, 0], f[i, axis, 1], f[i, axis, 2]
    r0, r1, r2 = p0 - f[i, centre, 0], p1 - f[i, centre, 1], p2 - f[i, centre, 2]
    J[k, 0, c] = a1 * r2 - a2 * r1
    J[k, 1, c] = a2 * r0 - a0 * r2
    J[k, 2, c] = a0 * r1 - a1 * r0
    if J.shape[1] == 6:
        J[k, 3, c], J[k, 4, c], J[k, 5, c] = a0, a1, a2


@inlined
def _slide(f: Array, i: int, axis: int, J: Array, k: int, c: int) -> None:
    """Column ``c`` of ``J[k]``, zeroed before: translation along an axis."""
    J[k, 0, c], J[k, 1, c], J[k, 2, c] = f[i, axis, 0], f[i, axis, 1], f[i, axis, 2]


@inlined
def model_columns(slot: Index, frames: Array, T: Array, J: Array, k: int) -> None:
    """Derivatives of the target ``T[k]`` by d, theta, a, alpha, beta; ``slot`` as for a batch."""
    p0, p1, p2 = T[k, 0, 3], T[k, 1, 3], T[k, 2, 3]
    for i in range(slot.shape[0]):
        if slot[i, 0] >= 0:
            _slide(frames, i, 0, J, k, slot[i, 0])
        if slot[i, 1] >= 0:
            _turn(frames, i, 0, 1, p0, p1, p2, J, k, slot[i, 1])
        if slot[i, 2] >= 0:
            _slide(frames, i, 2, J, k, slot[i, 2])
        if slot[i, 3] >= 0:
            _turn(frames, i, 2, 3, p0, p1, p2, J, k, slot[i, 3])
        if slot[i, 4] >= 0:
            _turn(frames, i, 4, 3, p0, p1, p2, J, k, slot[i, 4])


@inlined
def base_columns(T_root: Array, b: int, T: Array, J: Array, k: int) -> None:
    """Derivatives by a shift of the root and a turn about it, six columns from ``b``."""
    r0, r1, r2 = T[k, 0, 3] - T_root[0, 3], T[k, 1, 3] - T_root[1, 3], T[k, 2, 3] - T_root[2, 3]
    J[k, 0, b], J[k, 1, b + 1], J[k, 2, b + 2] = 1.0, 1.0, 1.0
    J[k, 1, b + 3], J[k, 2, b + 3] = -r2, r1
    J[k, 0, b + 4], J[k, 2, b + 4] = r2, -r0
    J[k, 0, b + 5], J[k, 1, b + 5] = -r1, r0
    if J.shape[1] == 6:
        J[k, 3, b + 3], J[k, 4, b + 4], J[k, 5, b + 5] = 1.0, 1.0, 1.0


@inlined
def tool_columns(T_flange: Array, t: int, J: Array, k: int) -> None:
    """Derivatives by the target's place on the flange, three or six columns from ``t``."""
    for r in range(3):
        for c in range(3):
            J[k, r, t + c] = T_flange[r, c]
            if J.shape[1] == 6:
                J[k, 3 + r, t + 3 + c] = T_flange[r, c]
