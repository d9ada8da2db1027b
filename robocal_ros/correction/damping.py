"""Compiled algebra of the joint correction: goals, residuals, and the damping of weak directions.

Twists [v; w] in base axes at the tool, m and rad. Where they are weighed against each other, and in
the Jacobian, lengths are in units of `LENGTH`.

A free axis is the tool's z: a turn about it is left out of the residual and of the Jacobian.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.compiled import lean
from robocal_ros.kinematics import newton

Array = NDArray[np.float64]

# The length (m) that weighs as 1 rad: what a tool's flank or a sensor's range makes of a turn.
LENGTH = 0.3
WEIGHT = 1.0 / LENGTH
# Errors at the tool (m, rad) below this are damped as this: what no robot repeats to.
LEAST_ERROR = 1e-6
# Squared singular values from so many lambda^2 on are not damped; at 3 the damping of the first
# order cancels the singular value's own growth.
WINDOW = 3.0
MOST_SWEEPS = 12


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
def product(A: Array, B: Array, out: Array) -> None:
    """Sum over the joints of the columns' products: A^T B of (n, 6) arrays."""
    for r in range(6):
        for c in range(6):
            value = 0.0
            for i in range(A.shape[0]):
                value += A[i, r] * B[i, c]
            out[r, c] = value


@lean
def lambda_square(error_square: float, steepness: float, per_error: float) -> float:
    """Square l^2 of the damping for an error at the tool, see `joint_correction` (3)."""
    size = np.sqrt(error_square + LEAST_ERROR * LEAST_ERROR)
    bent = per_error * size
    return float(size * np.sqrt(steepness * steepness + bent * bent))


@lean
def inverse_norm(M: Array, L: Array, column: Array) -> float:
    """Trace of the inverse of a symmetric matrix (6, 6), infinite where it is singular."""
    newton.copy(M, L)
    if not newton.factor_in_place(L):
        return np.inf
    trace = 0.0
    for k in range(6):
        for r in range(6):
            column[r] = 1.0 if r == k else 0.0
        newton.solve_in_place(L, column)
        trace += column[k]
    return trace


@lean
def eigen(A: Array, U: Array) -> None:
    """Eigenvalues of a symmetric matrix (3, 3), onto its diagonal, and its vectors as columns.

    By Jacobi's rotations.
    """
    for r in range(3):
        for c in range(3):
            U[r, c] = 1.0 if r == c else 0.0
    for _ in range(MOST_SWEEPS):
        off = A[1, 0] * A[1, 0] + A[2, 0] * A[2, 0] + A[2, 1] * A[2, 1]
        on = A[0, 0] * A[0, 0] + A[1, 1] * A[1, 1] + A[2, 2] * A[2, 2]
        if off <= 1e-34 * on:
            return
        for p in range(2):
            for q in range(p + 1, 3):
                if A[p, q] == 0.0:
                    continue
                ratio = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
                t = 1.0 / (abs(ratio) + np.sqrt(ratio * ratio + 1.0))
                t = t if ratio >= 0.0 else -t
                cosine = 1.0 / np.sqrt(t * t + 1.0)
                sine = t * cosine
                for k in range(3):
                    x, y = A[k, p], A[k, q]
                    A[k, p], A[k, q] = cosine * x - sine * y, sine * x + cosine * y
                for k in range(3):
                    x, y = A[p, k], A[q, k]
                    A[p, k], A[q, k] = cosine * x - sine * y, sine * x + cosine * y
                    x, y = U[k, p], U[k, q]
                    U[k, p], U[k, q] = cosine * x - sine * y, sine * x + cosine * y


@lean
def damped(A: Array, square: float, out: Array, inverse: Array, U: Array) -> int:
    """Damping (3, 3) of a symmetric matrix ``A``, and (A + damping)^-1; how many are damped.

    ``A`` is used up.
    """
    eigen(A, U)
    count = 0
    for r in range(3):
        for c in range(3):
            out[r, c], inverse[r, c] = 0.0, 0.0
    for k in range(3):
        rest = 1.0 - A[k, k] / (WINDOW * square)
        d = square * rest * rest * rest if rest > 0.0 else 0.0
        count += 1 if rest > 0.0 else 0
        one = 1.0 / (A[k, k] + d)
        for r in range(3):
            for c in range(3):
                out[r, c] += U[r, k] * d * U[c, k]
                inverse[r, c] += U[r, k] * one * U[c, k]
    return count


@lean
def damping(M: Array, position: float, rotation: float, D: Array, U: Array) -> int:
    """Damping D (6, 6) of M = J J^T, see `joint_correction` (2); how many directions are damped.

    ``position`` and ``rotation`` are the squares l^2 of the two. ``M`` is used up.
    """
    A, B, C = M[:3, :3], M[:3, 3:], M[3:, 3:]
    T, L, inverse = D[:3, 3:], D[3:, :3], D[3:, 3:]  # in what is not filled in yet
    count = damped(A, position, D[:3, :3], inverse, U)
    for i in range(3):
        for c in range(3):
            T[i, c] = inverse[i, 0] * B[0, c] + inverse[i, 1] * B[1, c] + inverse[i, 2] * B[2, c]
    for r in range(3):
        for c in range(3):
            C[r, c] -= B[0, r] * T[0, c] + B[1, r] * T[1, c] + B[2, r] * T[2, c]
            L[r, c] = T[0, r] * T[0, c] + T[1, r] * T[1, c] + T[2, r] * T[2, c]
        L[r, r] += 1.0
    root(L)
    between(L, C)
    count += damped(C, rotation, D[3:, 3:], T, U)
    around(L, D[3:, 3:], T)
    for r in range(3):
        for c in range(3):
            D[r, 3 + c], D[3 + r, c] = 0.0, 0.0
    return count


@lean
def root(L: Array) -> None:
    """Lower factor of L L^T (3, 3), positive definite, in place; what is above it is zero."""
    for c in range(3):
        for r in range(c, 3):
            value = L[r, c]
            for k in range(c):
                value -= L[r, k] * L[c, k]
            L[r, c] = np.sqrt(value) if r == c else value / L[c, c]
        for r in range(c):
            L[r, c] = 0.0


@lean
def between(L: Array, C: Array) -> None:
    """L^-1 C L^-T of symmetric C (3, 3), in place, with a lower triangle L."""
    for _ in range(2):  # L^-1 C, turned over: the second time the whole
        for c in range(3):
            for r in range(3):
                for k in range(r):
                    C[r, c] -= L[r, k] * C[k, c]
                C[r, c] /= L[r, r]
        for r in range(3):
            for c in range(r):
                C[r, c], C[c, r] = C[c, r], C[r, c]


@lean
def around(L: Array, S: Array, scratch: Array) -> None:
    """L S L^T (3, 3), in place of S, with a lower triangle L."""
    for r in range(3):
        for c in range(3):
            value = 0.0
            for k in range(r + 1):
                value += L[r, k] * S[k, c]
            scratch[r, c] = value
    for r in range(3):
        for c in range(3):
            value = 0.0
            for k in range(c + 1):
                value += scratch[r, k] * L[c, k]
            S[r, c] = value


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
