"""Compiled parts of the joint correction: blended models, goals, shares.

A packed model (n + 2, 9) holds one row per joint (as ``kinematics.kernels.pack_links``), then
the root's pose in the base and the tool's pose on the flange (as ``kinematics.newton`` packs
them). Angles in rad, lengths in m, twists [v; w] in base axes at the tool.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import lean
from robocal_ros.core.kinematics.newton import copy, length

Array = NDArray[np.float64]


@lean
def blend(a: Array, b: Array, s: float, out: Array) -> None:
    """Model between two packed ones: lengths and angles linear, rotations along the chord."""
    n = a.shape[0] - 2
    if s <= 0.0 or s >= 1.0:
        copy(a if s <= 0.0 else b, out)
        return
    for i in range(n):
        for c in range(3):
            out[i, c] = a[i, c] + s * (b[i, c] - a[i, c])
        for c in (3, 5):
            x = a[i, c] + s * (b[i, c] - a[i, c])
            y = a[i, c + 1] + s * (b[i, c + 1] - a[i, c + 1])
            norm = np.sqrt(x * x + y * y)
            out[i, c], out[i, c + 1] = x / norm, y / norm
        out[i, 7], out[i, 8] = b[i, 7], b[i, 8]
    for i in (n, n + 1):
        same = 0.0
        for c in range(4):
            same += a[i, c] * b[i, c]
        sign = -1.0 if same < 0.0 else 1.0
        square = 0.0
        for c in range(4):
            out[i, c] = a[i, c] + s * (sign * b[i, c] - a[i, c])
            square += out[i, c] * out[i, c]
        for c in range(4):
            out[i, c] /= np.sqrt(square)
        for c in range(4, 7):
            out[i, c] = a[i, c] + s * (b[i, c] - a[i, c])
        out[i, 7], out[i, 8] = 0.0, 0.0


@lean
def swap_tool(T: Array, old: Array, new: Array) -> None:
    """Turn the axes of a flange pose with tool ``old`` to those of the flange with tool ``new``."""
    for r in range(3):
        x0, x1, x2 = 0.0, 0.0, 0.0
        for c in range(3):
            x = T[r, 0] * old[0, c] + T[r, 1] * old[1, c] + T[r, 2] * old[2, c]
            x0 += x * new[0, c]
            x1 += x * new[1, c]
            x2 += x * new[2, c]
        T[r, 0], T[r, 1], T[r, 2] = x0, x1, x2


@lean
def part_of_the_way(T: Array, e: Array, share: float, goal: Array) -> None:
    """Pose ``goal``: ``T`` moved by a share of the twist ``e``."""
    turn = length(e, 3)
    c, s = np.cos(share * turn), np.sin(share * turn)
    turn = max(turn, 1e-300)
    u0, u1, u2 = e[3] / turn, e[4] / turn, e[5] / turn
    for k in range(3):
        a0, a1, a2 = T[0, k], T[1, k], T[2, k]
        along = (u0 * a0 + u1 * a1 + u2 * a2) * (1.0 - c)
        goal[0, k] = a0 * c + (u1 * a2 - u2 * a1) * s + u0 * along
        goal[1, k] = a1 * c + (u2 * a0 - u0 * a2) * s + u1 * along
        goal[2, k] = a2 * c + (u0 * a1 - u1 * a0) * s + u2 * along
    for r in range(3):
        goal[r, 3] = T[r, 3] + share * e[r]


@lean
def share(step: Array, largest: Array) -> float:
    """How much of the correction is made: all of it while the first step is within bounds.

    Towards a singularity the step grows without end; the share falls with its square, so that
    the shift made falls back to zero there and changes sign without a jump.
    """
    excess = 0.0
    for i in range(step.shape[0]):
        excess = max(excess, abs(step[i]) / largest[i])
    if not excess < np.inf:
        return 0.0
    return 1.0 if excess <= 1.0 else 1.0 / (excess * excess)
