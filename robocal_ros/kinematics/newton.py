# SPDX-License-Identifier: Apache-2.0
"""Compiled parts of Newton's method on poses: residual, geometric Jacobian, solution.

Poses (4, 4) in base, twists [v; w] in base axes at the pose's origin; angles in rad, lengths in m.
A packed pose holds x, y, z, w of its quaternion, then the translation.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.compiled import inlined, kernel, lean
from robocal_ros.kinematics.kernels import turns_size, walk

Array = NDArray[np.float64]

# Pivots of J^T J (or J J^T) below this share of its largest: the pose is singular to rounding.
SINGULAR_PIVOT = 1e-13
# Keeps J^T J of a redundant arm regular; the shift then is the shortest one.
REDUNDANT = 1e-9
# On the diagonal of J^T J: per square of the residual, and always.
DAMPED, LEAST_DAMPED = 1e-3, 1e-14


@lean
def copy(source: Array, target: Array) -> None:
    """Copy a matrix: element by element, which compiles in a tenth of an assignment's time."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@lean
def pose(row: Array, T: Array) -> None:
    """Transform (4, 4) of a packed pose."""
    x, y, z, w = row[0], row[1], row[2], row[3]
    T[0, 0], T[0, 1], T[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    T[1, 0], T[1, 1], T[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    T[2, 0], T[2, 1], T[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    T[0, 3], T[1, 3], T[2, 3] = row[4], row[5], row[6]
    T[3, 0], T[3, 1], T[3, 2], T[3, 3] = 0.0, 0.0, 0.0, 1.0


@lean
def at_tool(T: Array, tool: Array) -> None:
    """Move the origin of a flange pose to the tool's; the flange's axes are kept."""
    x, y, z = tool[0, 3], tool[1, 3], tool[2, 3]
    for r in range(3):
        T[r, 3] += T[r, 0] * x + T[r, 1] * y + T[r, 2] * z


@lean
def largest_of(values: Array) -> float:
    """Largest magnitude of some numbers; NaN where one is."""
    largest = 0.0
    for i in range(values.shape[0]):
        size = abs(values[i])
        if size > largest or size != size:
            largest = size
    return largest


@lean
def angle_by_sine(square: float, cosine: float) -> float:
    """Angle over its sine, of which the square is given."""
    if square > 1e-3 or cosine < 0.0:
        sine = np.sqrt(square)
        # at half a turn the axis is lost; the length still tells that the goal is far
        return float(np.arctan2(sine, cosine) / max(sine, 1e-150))
    # arcsine's series, to 1e-17
    tail = square * (105.0 / 3456.0 + square * (945.0 / 42240.0))
    return 1.0 + square * (1.0 / 6.0 + square * (3.0 / 40.0 + square * (15.0 / 336.0 + tail)))


@lean
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
    factor = angle_by_sine(w0 * w0 + w1 * w1 + w2 * w2, 0.5 * trace)
    e[3], e[4], e[5] = factor * w0, factor * w1, factor * w2
    return largest_of(e)


@lean
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


@lean
def factor(J: Array, L: Array) -> bool:
    """Factor of J^T J, see `factor_in_place`; False where singular."""
    n = J.shape[0]
    if n == 6:
        _square(J, L, 6)
        return factor_in_place(L)
    _square(J, L, n)
    if n > 6:
        for i in range(n):
            L[i, i] += REDUNDANT
    return factor_in_place(L)


# Six is a constant in the code of six joints: the compiler unrolls its loops.
@inlined
def _square(J: Array, L: Array, n: int) -> None:
    for i in range(n):
        for j in range(i + 1):
            value = 0.0
            for r in range(6):
                value += J[i, r] * J[j, r]
            L[i, j] = value


@lean
def factor_in_place(L: Array) -> bool:
    """L D L^T of the matrix in the lower half, with 1 / D on the diagonal; False where singular."""
    return _factored(L, 6) if L.shape[0] == 6 else _factored(L, L.shape[0])


@inlined
def _factored(L: Array, n: int) -> bool:
    largest, regular = 0.0, True
    for i in range(n):
        largest = max(largest, L[i, i])
    for k in range(n):
        regular = regular and L[k, k] > SINGULAR_PIVOT * largest
        inverse = 1.0 / L[k, k]
        L[k, k] = inverse
        for i in range(k + 1, n):
            value = L[i, k] * inverse
            for j in range(k + 1, i + 1):
                L[i, j] -= value * L[j, k]
        for i in range(k + 1, n):
            L[i, k] *= inverse
    return regular


@lean
def solve(J: Array, L: Array, e: Array, x: Array, step: Array) -> None:
    """Joint step for the twist ``e``; of a redundant arm, the one that shortens ``x`` too."""
    n = J.shape[0]
    if n == 6:
        _multiply(J, e, step, 6)
    else:
        _multiply(J, e, step, n)
    if n > 6:
        for i in range(n):
            step[i] -= REDUNDANT * x[i]
    solve_in_place(L, step)


@inlined
def _multiply(J: Array, e: Array, out: Array, n: int) -> None:
    for i in range(n):
        value = 0.0
        for r in range(6):
            value += J[i, r] * e[r]
        out[i] = value


@lean
def solve_in_place(L: Array, x: Array) -> None:
    """Solve with the factor of `factor_in_place`."""
    if L.shape[0] == 6:
        _solved(L, x, 6)
    else:
        _solved(L, x, L.shape[0])


@inlined
def _solved(L: Array, x: Array, n: int) -> None:
    for i in range(n):
        value = x[i]
        for k in range(i):
            value -= L[i, k] * x[k]
        x[i] = value
    for i in range(n - 1, -1, -1):
        value = x[i] * L[i, i]
        for k in range(i + 1, n):
            value -= L[k, i] * x[k]
        x[i] = value


@kernel
def reach_batch(
    goals: Array,
    links: Array,
    root: Array,
    steps: int,
    longest: float,
    close: float,
    q: Array,
    left: Array,
) -> None:
    """Move joints (m, n), each from where it is, towards its goal (m, 4, 4).

    Steps that no joint makes longer than ``longest``, damped as far as the goal is away (Levenberg
    and Marquardt), until it is nearer than ``close``; ``left`` (m,): by how much it is missed.
    """
    n = links.shape[0]
    frames, turns, T = np.empty((n, 2, 3)), np.empty(turns_size(n)), np.empty((4, 4))
    J, L, e, step = np.empty((n, 6)), np.empty((n, n)), np.empty(6), np.empty(n)
    for k in range(goals.shape[0]):
        for taken in range(steps + 1):
            walk(q[k], links, root, turns, frames, T)
            left[k] = residual(goals[k], T, e)
            if left[k] < close or taken == steps:
                break
            columns(links, frames, T, J)
            _square(J, L, n)
            square = length(e, 0) ** 2 + length(e, 3) ** 2
            for i in range(n):
                L[i, i] += DAMPED * min(square, 1.0) + LEAST_DAMPED
            factor_in_place(L)
            _multiply(J, e, step, n)
            solve_in_place(L, step)
            share = min(1.0, longest / max(largest_of(step), 1e-300))
            for i in range(n):
                q[k, i] += share * step[i]


@lean
def length(e: Array, first: int) -> float:
    """Length of a twist's translation (``first`` 0) or rotation (3)."""
    return float(np.sqrt(e[first] ** 2 + e[first + 1] ** 2 + e[first + 2] ** 2))


@lean
def bias(links: Array, frames: Array, T: Array, qd: Array, rate: Array, out: Array) -> None:
    """Twist ``rate`` (6,) at the origin of ``T``, and its derivative ``out`` at constant ``qd``."""
    w0, w1, w2 = 0.0, 0.0, 0.0
    v0, v1, v2 = 0.0, 0.0, 0.0
    b0, b1, b2 = 0.0, 0.0, 0.0  # derivative of w
    a0, a1, a2 = 0.0, 0.0, 0.0  # derivative of v
    p0, p1, p2 = frames[0, 1, 0], frames[0, 1, 1], frames[0, 1, 2]
    for i in range(links.shape[0] + 1):
        if i < links.shape[0]:
            n0, n1, n2 = frames[i, 1, 0], frames[i, 1, 1], frames[i, 1, 2]
        else:
            n0, n1, n2 = T[0, 3], T[1, 3], T[2, 3]
        # carry v and its derivative along the link to the next joint's point
        r0, r1, r2 = n0 - p0, n1 - p1, n2 - p2
        c0, c1, c2 = w1 * r2 - w2 * r1, w2 * r0 - w0 * r2, w0 * r1 - w1 * r0
        v0, v1, v2 = v0 + c0, v1 + c1, v2 + c2
        a0 += b1 * r2 - b2 * r1 + w1 * c2 - w2 * c1
        a1 += b2 * r0 - b0 * r2 + w2 * c0 - w0 * c2
        a2 += b0 * r1 - b1 * r0 + w0 * c1 - w1 * c0
        p0, p1, p2 = n0, n1, n2
        if i == links.shape[0]:
            break
        speed = links[i, 7] * qd[i]
        z0, z1, z2 = speed * frames[i, 0, 0], speed * frames[i, 0, 1], speed * frames[i, 0, 2]
        d0, d1, d2 = w1 * z2 - w2 * z1, w2 * z0 - w0 * z2, w0 * z1 - w1 * z0
        if links[i, 8] > 0.5:
            v0, v1, v2 = v0 + z0, v1 + z1, v2 + z2
            a0, a1, a2 = a0 + 2.0 * d0, a1 + 2.0 * d1, a2 + 2.0 * d2
        else:
            w0, w1, w2 = w0 + z0, w1 + z1, w2 + z2
            b0, b1, b2 = b0 + d0, b1 + d1, b2 + d2
    rate[0], rate[1], rate[2], rate[3], rate[4], rate[5] = v0, v1, v2, w0, w1, w2
    out[0], out[1], out[2], out[3], out[4], out[5] = a0, a1, a2, b0, b1, b2


# ---- compiled inverse kinematics along a path of poses, with the rates of the joints ------------


MOST_ITERATIONS = 15
# A residual (m, rad) that is the rounding floor, and a step after which the next one is below it.
SMALL_RESIDUAL = 1e-12
SMALL_STEP = 1e-9

REACHED, SINGULAR, MISSED = range(3)


@kernel
def _reach(
    goal: Array, links: Array, poses: Array, turns: Array, frames: Array, J: Array, L: Array,
    near: Array, longest: float, q: Array,
) -> int:  # fmt: skip
    """Newton's steps in ``q`` from ``near`` to ``goal``; ``poses``: root, tool, pose at q."""
    n = q.shape[0]
    e, x, step = np.empty(6), np.zeros(n), np.empty(n)
    for i in range(n):
        q[i] = near[i]
    small = False
    for _ in range(MOST_ITERATIONS):
        walk(q, links, poses[0], turns, frames, poses[2])
        at_tool(poses[2], poses[1])
        columns(links, frames, poses[2], J)
        if not factor(J, L):
            return SINGULAR
        if residual(goal, poses[2], e) <= SMALL_RESIDUAL or small:
            return REACHED
        solve(J, L, e, x, step)
        for i in range(n):
            x[i] += step[i]
            q[i] = near[i] + x[i]
        if not largest_of(x) <= longest:
            return MISSED
        small = largest_of(step) <= SMALL_STEP
    return MISSED


@kernel
def follow_batch(
    goals: Array,
    twist: Array,
    rate: Array,
    near: Array,
    links: Array,
    root_and_tool: Array,
    longest: float,
    q: Array,
    qd: Array,
    qdd: Array,
) -> tuple[int, int]:
    """Joints (m, n) at goals (m, 4, 4), each from the one before, and their rates.

    ``root_and_tool`` (2, 4, 4): T_base_root and where on the flange the goals are; ``twist`` and
    its derivative ``rate`` (m, 6) of the goals; ``longest``: no joint moves further from one goal
    to the next. Gives how many were reached and what became of the next.
    """
    n = links.shape[0]
    poses, frames = np.empty((3, 4, 4)), np.empty((n, 2, 3))
    turns = np.empty(turns_size(n))
    J, L, zero = np.empty((n, 6)), np.empty((n, n)), np.zeros(n)
    v, a = np.empty(6), np.empty(6)
    copy(root_and_tool[0], poses[0])
    copy(root_and_tool[1], poses[1])
    for i in range(goals.shape[0]):
        start = near if i == 0 else q[i - 1]
        outcome = _reach(goals[i], links, poses, turns, frames, J, L, start, longest, q[i])
        if outcome != REACHED:
            return i, outcome
        solve(J, L, twist[i], zero, qd[i])
        bias(links, frames, poses[2], qd[i], v, a)
        for r in range(6):
            a[r] = rate[i, r] - a[r]
        solve(J, L, a, zero, qdd[i])
    return goals.shape[0], REACHED
