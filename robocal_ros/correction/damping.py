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
    z, g = tool_axis(T, tool), tool_axis(goal, tool)
    w = cross(z, g)
    factor = newton.angle_by_sine(product(w, w), product(z, g))
    for r in range(3):
        e[r] = goal[r, 3] - T[r, 3]
    e[3], e[4], e[5] = factor * w[0], factor * w[1], factor * w[2]


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
    a, b, c = (m[0], m[1], m[2]), (m[3], m[4], m[5]), (m[6], m[7], m[8])
    x, y, z = cross(b, c), cross(c, a), cross(a, b)
    s = 1.0 / product(a, x)
    return (
        s * x[0], s * y[0], s * z[0], s * x[1], s * y[1], s * z[1],
        s * x[2], s * y[2], s * z[2],
    )  # fmt: skip


@lean
def product(a: Three, b: Three) -> float:
    """Scalar product of vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@lean
def cross(a: Three, b: Three) -> Three:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@lean
def along(a: Three, s: float, b: Three) -> Three:
    """A + s b."""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


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
def _lone(m: Nine) -> tuple[float, Three]:
    """Eigenvalue of a symmetric matrix that stands apart from the two others, and its axis.

    Less their mean, in units in which their squares add up to 6, the eigenvalues solve
    v^3 - 3 v = det (O. K. Smith, Comm. ACM 4 (1961) 168). The largest amount, sqrt(3) to 2, is
    found by three steps of Newton's method from a line that errs by 0.008; its axis is a column of
    cofactors.
    """
    mean = (m[0] + m[4] + m[8]) * (1.0 / 3.0)
    a, b, x, y, z = m[0] - mean, m[4] - mean, m[1], m[2], m[5]
    c = -a - b  # their sum is 0 even where all are rounding
    unit = np.sqrt((a * a + b * b + c * c + 2.0 * (x * x + y * y + z * z)) * (1.0 / 6.0) + TINY)
    s = 1.0 / unit
    a, b, c, x, y, z = s * a, s * b, s * c, s * x, s * y, s * z
    det = a * (b * c - z * z) - x * (x * c - y * z) + y * (x * z - b * y)
    v = 1.7394 + 0.134 * abs(det)
    for _ in range(3):
        v -= (v * (v * v - 3.0) - abs(det)) / (3.0 * v * v - 3.0)
    v = v if det >= 0.0 else -v
    a, b, c = a - v, b - v, c - v
    p, q, r = b * c - z * z, a * c - y * y, a * b - x * x
    x, y, z = y * z - x * c, x * z - y * b, x * y - z * a
    axis = (x, q, z) if q >= r else (y, z, r)
    axis = (p, x, y) if (p >= q) & (p >= r) else axis
    s = 1.0 / np.sqrt(product(axis, axis))
    return mean + unit * v, (s * axis[0], s * axis[1], s * axis[2])


@lean
def _damp(s: float, square: float) -> float:
    rest = 1.0 - s / (WINDOW * square)
    rest = rest if rest > 0.0 else 0.0
    return square * rest * rest * rest


@lean
def _damped(m: Nine, square: float) -> tuple[Nine, Nine, float]:
    """Damping d(M) of a symmetric matrix, (M + d(M))^-1, and how many directions are damped."""
    z, r = _lone(m)
    s = r[0] / (1.0 + abs(r[2]))
    p = 1.0 - s * r[0], -s * r[1], -r[0] if r[2] >= 0.0 else r[0]
    q, mp = cross(r, p), on(m, p[0], p[1], p[2])
    x, y, o = product(p, mp), product(q, on(m, q[0], q[1], q[2])), product(q, mp)
    # Jacobi's rotation of p and q by the angle with tangent t, whose cosine's square is u
    apart = y - x
    t = 2.0 * o / (abs(apart) + np.sqrt(apart * apart + 4.0 * o * o) + TINY)
    t = t if apart >= 0.0 else -t
    x, y, p, q, u = x - t * o, y + t * o, along(p, -t, q), along(q, t, p), 1.0 / (1.0 + t * t)
    a, b, c = _damp(x, square), _damp(y, square), _damp(z, square)
    count = (1.0 if a > 0.0 else 0.0) + (1.0 if b > 0.0 else 0.0) + (1.0 if c > 0.0 else 0.0)
    whole = _spread(p, q, r, u / (x + a), u / (y + b), 1.0 / (z + c))
    return _spread(p, q, r, u * a, u * b, c), whole, count


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
