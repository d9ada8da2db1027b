"""Compiled parts of the joint correction: blended models, residuals, Newton steps.

A packed model (n + 2, 9) holds one row per joint (as ``kinematics.kernels.pack_links``), then
the root's pose in the base and the tool's pose on the flange (x, y, z, w of the quaternion, then
the translation). Angles in rad, lengths in m, twists [v; w] in base axes at the tool.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import kernel

Array = NDArray[np.float64]

# Pivots of J^T J below this share of its largest: the pose is singular to rounding.
SINGULAR_PIVOT = 1e-13
# Keeps J^T J of a redundant arm regular; the shift then is the shortest one.
REDUNDANT = 1e-9


@kernel
def copy(source: Array, target: Array) -> None:
    """Copy a matrix: element by element, which compiles in a tenth of an assignment's time."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@kernel
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


@kernel
def pose(row: Array, T: Array) -> None:
    """Transform (4, 4) of a packed pose."""
    x, y, z, w = row[0], row[1], row[2], row[3]
    T[0, 0], T[0, 1], T[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    T[1, 0], T[1, 1], T[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    T[2, 0], T[2, 1], T[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    T[0, 3], T[1, 3], T[2, 3] = row[4], row[5], row[6]
    T[3, 0], T[3, 1], T[3, 2], T[3, 3] = 0.0, 0.0, 0.0, 1.0


@kernel
def at_tool(T: Array, tool: Array) -> None:
    """Move the origin of a flange pose to the tool's; the flange's axes are kept."""
    x, y, z = tool[0, 3], tool[1, 3], tool[2, 3]
    for r in range(3):
        T[r, 3] += T[r, 0] * x + T[r, 1] * y + T[r, 2] * z


@kernel
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


@kernel
def largest_of(values: Array) -> float:
    """Largest magnitude of some numbers."""
    largest = 0.0
    for i in range(values.shape[0]):
        largest = max(largest, abs(values[i]))
    return largest


@kernel
def residual(goal: Array, T: Array, e: Array) -> float:
    """Twist ``e`` from ``T`` to ``goal``; returns its largest component."""
    for r in range(3):
        e[r] = goal[r, 3] - T[r, 3]
    w0, w1, w2, trace = 0.0, 0.0, 0.0, -1.0
    for c in range(3):
        a0, a1, a2 = T[0, c], T[1, c], T[2, c]
        b0, b1, b2 = goal[0, c], goal[1, c], goal[2, c]
        w0 += 0.5 * (a1 * b2 - a2 * b1)
        w1 += 0.5 * (a2 * b0 - a0 * b2)
        w2 += 0.5 * (a0 * b1 - a1 * b0)
        trace += a0 * b0 + a1 * b1 + a2 * b2
    square = w0 * w0 + w1 * w1 + w2 * w2
    factor = 1.0 + square / 6.0
    if square > 1e-8 or trace < 0.0:
        sine = np.sqrt(square)
        # at half a turn the axis is lost; the length still tells that the goal is far
        factor = np.arctan2(sine, 0.5 * trace) / max(sine, 1e-150)
    e[3], e[4], e[5] = factor * w0, factor * w1, factor * w2
    return largest_of(e)


@kernel
def columns(links: Array, frames: Array, T: Array, J: Array) -> None:
    """Columns of the geometric Jacobian at the origin of ``T``, as rows of ``J`` (n, 6)."""
    p0, p1, p2 = T[0, 3], T[1, 3], T[2, 3]
    for i in range(links.shape[0]):
        z0, z1, z2 = frames[i, 0, 0], frames[i, 0, 1], frames[i, 0, 2]
        if links[i, 7] < 0.0:
            z0, z1, z2 = -z0, -z1, -z2
        if links[i, 8] > 0.5:
            J[i, 0], J[i, 1], J[i, 2] = z0, z1, z2
            J[i, 3], J[i, 4], J[i, 5] = 0.0, 0.0, 0.0
            continue
        r0, r1, r2 = p0 - frames[i, 1, 0], p1 - frames[i, 1, 1], p2 - frames[i, 1, 2]
        J[i, 0] = z1 * r2 - z2 * r1
        J[i, 1] = z2 * r0 - z0 * r2
        J[i, 2] = z0 * r1 - z1 * r0
        J[i, 3], J[i, 4], J[i, 5] = z0, z1, z2


@kernel
def factor(J: Array, L: Array) -> bool:
    """Cholesky factor of J^T J (with 1 / diagonal on the diagonal); False where singular."""
    n = J.shape[0]
    largest = 0.0
    for i in range(n):
        for j in range(i + 1):
            value = 0.0
            for r in range(6):
                value += J[i, r] * J[j, r]
            L[i, j] = value
        if n > 6:
            L[i, i] += REDUNDANT
        largest = max(largest, L[i, i])
    for i in range(n):
        for j in range(i):
            value = L[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = value * L[j, j]
        value = L[i, i]
        for k in range(i):
            value -= L[i, k] * L[i, k]
        if not value > SINGULAR_PIVOT * largest:
            return False
        L[i, i] = 1.0 / np.sqrt(value)
    return True


@kernel
def solve(J: Array, L: Array, e: Array, x: Array, step: Array) -> None:
    """Joint step for the twist ``e``; of a redundant arm, the one that shortens ``x`` too."""
    n = J.shape[0]
    for i in range(n):
        value = -REDUNDANT * x[i] if n > 6 else 0.0
        for r in range(6):
            value += J[i, r] * e[r]
        for k in range(i):
            value -= L[i, k] * step[k]
        step[i] = value * L[i, i]
    for i in range(n - 1, -1, -1):
        value = step[i]
        for k in range(i + 1, n):
            value -= L[k, i] * step[k]
        step[i] = value * L[i, i]


@kernel
def length(e: Array, first: int) -> float:
    """Length of a twist's translation (``first`` 0) or rotation (3)."""
    return float(np.sqrt(e[first] ** 2 + e[first + 1] ** 2 + e[first + 2] ** 2))


@kernel
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


@kernel
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
