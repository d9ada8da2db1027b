# SPDX-License-Identifier: Apache-2.0
"""Compiled algebra of the joint correction: goals, residuals, and the damping of weak directions.

Twists [v; w] in base axes at the tool, m and rad. Where they are weighed against each other, and in
the Jacobian, lengths are in units of `LENGTH`. Twists are six numbers, matrices (3, 3) nine, row by
row, without a branch: `six_axis` works on several points at a time in vector registers.

A free axis is the tool's z: a turn about it is left out of the residual and of the Jacobian.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.compiled import lean
from robocal_ros.kinematics import newton

Array = NDArray[np.float64]
Three = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]

# The length (m) that weighs as 1 rad: what a tool's flank or a sensor's range makes of a turn.
LENGTH = 0.3
WEIGHT = 1.0 / LENGTH
# Errors at the tool (m, rad) below this are damped as this: what no robot repeats to.
LEAST_ERROR = 1e-6
# Squared singular values from so many lambda^2 on are not damped; at 3 the damping of the first
# order cancels the singular value's own growth.
WINDOW = 3.0
TINY = 1e-300
# What is said of a point, after its n joints.
POSITION_ERROR, ROTATION_ERROR, ITERATIONS, CONVERGED, TCP_SHIFT, TCP_ROTATION, WEAK = range(7)
REPORT = 7


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
def tool_axis(T: Array, tool: Array) -> tuple[float, float, float]:
    """Axis z of the tool on a flange with the axes of ``T``."""
    x, y, z = tool[0, 2], tool[1, 2], tool[2, 2]
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
    )


@lean
def residual(goal: Array, T: Array, tool: Array, free: bool, e: Array) -> None:
    """Twist ``e`` from ``T`` to ``goal``; with a free axis its rotation is that of the tool's z."""
    if not free:
        newton.residual(goal, T, e)
        return
    z0, z1, z2 = tool_axis(T, tool)
    g0, g1, g2 = tool_axis(goal, tool)
    w0, w1, w2 = z1 * g2 - z2 * g1, z2 * g0 - z0 * g2, z0 * g1 - z1 * g0
    sine_square, cosine = w0 * w0 + w1 * w1 + w2 * w2, z0 * g0 + z1 * g1 + z2 * g2
    factor = newton.angle_by_sine(sine_square, cosine)
    for r in range(3):
        e[r] = goal[r, 3] - T[r, 3]
    e[3], e[4], e[5] = factor * w0, factor * w1, factor * w2


@lean
def weighed(e: Six) -> Six:
    """A twist with lengths in units of `LENGTH`."""
    return WEIGHT * e[0], WEIGHT * e[1], WEIGHT * e[2], e[3], e[4], e[5]


@lean
def dot(a: Six, b: Six) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4] + a[5] * b[5]


@lean
def more(a: Six, s: float, b: Six) -> Six:
    """A + s b."""
    return (
        a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2],
        a[3] + s * b[3], a[4] + s * b[4], a[5] + s * b[5],
    )  # fmt: skip


@lean
def total(m: Nine, s: float, n: Nine) -> Nine:
    """M + s N."""
    return (
        m[0] + s * n[0], m[1] + s * n[1], m[2] + s * n[2], m[3] + s * n[3], m[4] + s * n[4],
        m[5] + s * n[5], m[6] + s * n[6], m[7] + s * n[7], m[8] + s * n[8],
    )  # fmt: skip


@lean
def times(m: Nine, n: Nine) -> Nine:
    """M N."""
    a, b, c, d, e, f, g, h, i = m
    return (
        a * n[0] + b * n[3] + c * n[6], a * n[1] + b * n[4] + c * n[7],
        a * n[2] + b * n[5] + c * n[8], d * n[0] + e * n[3] + f * n[6],
        d * n[1] + e * n[4] + f * n[7], d * n[2] + e * n[5] + f * n[8],
        g * n[0] + h * n[3] + i * n[6], g * n[1] + h * n[4] + i * n[7],
        g * n[2] + h * n[5] + i * n[8],
    )  # fmt: skip


@lean
def on(m: Nine, x: float, y: float, z: float) -> Three:
    """M applied to a vector."""
    return (
        m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z,
        m[6] * x + m[7] * y + m[8] * z,
    )  # fmt: skip


@lean
def inverse(m: Nine) -> Nine:
    """By cofactors."""
    a, b, c, d, e, f, g, h, i = m
    x, y, z = e * i - f * h, f * g - d * i, d * h - e * g
    s = 1.0 / (a * x + b * y + c * z)
    return (
        s * x, s * (c * h - b * i), s * (b * f - c * e),
        s * y, s * (a * i - c * g), s * (c * d - a * f),
        s * z, s * (b * g - a * h), s * (a * e - b * d),
    )  # fmt: skip


@lean
def _turned_over(m: Nine) -> Nine:
    return m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]


@lean
def _root(T: Nine) -> Nine:
    """Lower factor L of I + T^T T = L L^T."""
    n = times(_turned_over(T), T)
    a = np.sqrt(1.0 + n[0])
    b, c = n[1] / a, n[2] / a
    d = np.sqrt(1.0 + n[4] - b * b)
    e = (n[5] - b * c) / d
    return a, 0.0, 0.0, b, d, 0.0, c, e, np.sqrt(1.0 + n[8] - c * c - e * e)


@lean
def _spread(p: Three, q: Three, r: Three, a: float, b: float, c: float) -> Nine:
    """A p p^T + b q q^T + c r r^T."""
    xy = a * p[0] * p[1] + b * q[0] * q[1] + c * r[0] * r[1]
    xz = a * p[0] * p[2] + b * q[0] * q[2] + c * r[0] * r[2]
    yz = a * p[1] * p[2] + b * q[1] * q[2] + c * r[1] * r[2]
    return (
        a * p[0] * p[0] + b * q[0] * q[0] + c * r[0] * r[0], xy, xz,
        xy, a * p[1] * p[1] + b * q[1] * q[1] + c * r[1] * r[1], yz,
        xz, yz, a * p[2] * p[2] + b * q[2] * q[2] + c * r[2] * r[2],
    )  # fmt: skip


@lean
def _turn(
    a: float, b: float, o: float, y: float, z: float, p: Three, q: Three
) -> tuple[float, float, float, float, Three, Three]:
    """Jacobi's rotation for two diagonal elements and theirs beside, which becomes 0.

    With it turn the elements that the two have with the third one, and the axes found so far.
    """
    apart = b - a
    t = 2.0 * o / (abs(apart) + np.sqrt(apart * apart + 4.0 * o * o) + TINY)
    t = t if apart >= 0.0 else -t
    c = 1.0 / np.sqrt(t * t + 1.0)
    s = t * c
    return (
        a - t * o, b + t * o, c * y - s * z, s * y + c * z,
        (c * p[0] - s * q[0], c * p[1] - s * q[1], c * p[2] - s * q[2]),
        (s * p[0] + c * q[0], s * p[1] + c * q[1], s * p[2] + c * q[2]),
    )  # fmt: skip


@lean
def _sweep(m: Six, p: Three, q: Three, r: Three) -> tuple[Six, Three, Three, Three]:
    """A rotation for each element beside the diagonal: ``m`` is the diagonal, then ab, ac, bc."""
    a, b, c, x, y, z = m
    a, b, y, z, p, q = _turn(a, b, x, y, z, p, q)
    a, c, x, z, p, r = _turn(a, c, y, 0.0, z, p, r)
    b, c, x, y, q, r = _turn(b, c, z, x, 0.0, q, r)
    return (a, b, c, x, y, 0.0), p, q, r


@lean
def _damp(s: float, square: float) -> float:
    rest = 1.0 - s / (WINDOW * square)
    rest = rest if rest > 0.0 else 0.0
    return square * rest * rest * rest


@lean
def _damped(m: Nine, square: float) -> tuple[Nine, Nine, float]:
    """Damping d(M) of a symmetric matrix, (M + d(M))^-1, and how many directions are damped."""
    p, q, r = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    s, p, q, r = _sweep((m[0], m[4], m[8], m[1], m[2], m[5]), p, q, r)
    s, p, q, r = _sweep(s, p, q, r)
    s, p, q, r = _sweep(s, p, q, r)
    s, p, q, r = _sweep(s, p, q, r)
    a, b, c = _damp(s[0], square), _damp(s[1], square), _damp(s[2], square)
    count = (1.0 if a > 0.0 else 0.0) + (1.0 if b > 0.0 else 0.0) + (1.0 if c > 0.0 else 0.0)
    whole = _spread(p, q, r, 1.0 / (s[0] + a), 1.0 / (s[1] + b), 1.0 / (s[2] + c))
    return _spread(p, q, r, a, b, c), whole, count


@lean
def damping(
    A: Nine, B: Nine, C: Nine, e: Six, steepness: float, per_error: float
) -> tuple[Nine, Nine, float]:
    """P and R for the blocks of J J^T and the weighed error; how many directions are damped.

    See `joint_correction` (2) and (3).
    """
    position = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
    P, first, count = _damped(A, lambda_square(position, steepness, per_error))
    T = times(first, B)
    L = _root(T)
    back = inverse(L)
    C = total(C, -1.0, times(_turned_over(B), T))
    C = times(times(back, C), _turned_over(back))
    R, _, more_weak = _damped(C, lambda_square(dot(e, e), steepness, per_error))
    return P, times(times(L, R), _turned_over(L)), count + more_weak


@lean
def left(e: Six, y: Six, P: Nine, R: Nine) -> Six:
    """What is left to do, e - D y."""
    p, w = on(P, y[0], y[1], y[2]), on(R, y[3], y[4], y[5])
    return e[0] - p[0], e[1] - p[1], e[2] - p[2], e[3] - w[0], e[4] - w[1], e[5] - w[2]


@lean
def lambda_square(error_square: float, steepness: float, per_error: float) -> float:
    """Square l^2 of the damping for an error at the tool, see `joint_correction` (3)."""
    size = np.sqrt(error_square + LEAST_ERROR * LEAST_ERROR)
    bent = per_error * size
    return float(size * np.sqrt(steepness * steepness + bent * bent))


@lean
def add_product(A: Array, B: Array, out: Array) -> None:
    """Add A^T B of (n, 6) arrays: the columns' products over the joints."""
    for r in range(6):
        for c in range(6):
            for i in range(A.shape[0]):
                out[r, c] += A[i, r] * B[i, c]


@lean
def block(M: Array, r: int, c: int) -> Nine:
    """The (3, 3) part of a matrix that begins there."""
    return (
        M[r, c], M[r, c + 1], M[r, c + 2], M[r + 1, c], M[r + 1, c + 1], M[r + 1, c + 2],
        M[r + 2, c], M[r + 2, c + 1], M[r + 2, c + 2],
    )  # fmt: skip


@lean
def fill(m: Nine, k: int, M: Array) -> None:
    """Put a block onto the diagonal of a matrix, from ``k`` on; beside it are zeros."""
    for r in range(3):
        for c in range(6):
            M[k + r, c] = 0.0
    M[k, k], M[k, k + 1], M[k, k + 2] = m[0], m[1], m[2]
    M[k + 1, k], M[k + 1, k + 1], M[k + 1, k + 2] = m[3], m[4], m[5]
    M[k + 2, k], M[k + 2, k + 1], M[k + 2, k + 2] = m[6], m[7], m[8]


@lean
def eliminate(B: Array, order: Array) -> bool:
    """Factor (6, 6) in place, rows by the largest pivot; False where singular."""
    for k in range(6):
        best = k
        for r in range(k + 1, 6):
            if abs(B[r, k]) > abs(B[best, k]):
                best = r
        order[k] = best
        if not abs(B[best, k]) > 1e-300:
            return False
        if best != k:
            for c in range(6):
                B[k, c], B[best, c] = B[best, c], B[k, c]
        for r in range(k + 1, 6):
            B[r, k] /= B[k, k]
            for c in range(k + 1, 6):
                B[r, c] -= B[r, k] * B[k, c]
    return True


@lean
def substitute(B: Array, order: Array, x: Array) -> None:
    """Solve in place with the factors of `eliminate`."""
    for k in range(6):
        best = int(order[k])
        x[k], x[best] = x[best], x[k]
    for r in range(6):
        for c in range(r):
            x[r] -= B[r, c] * x[c]
    for r in range(5, -1, -1):
        for c in range(r + 1, 6):
            x[r] -= B[r, c] * x[c]
        x[r] /= B[r, r]
