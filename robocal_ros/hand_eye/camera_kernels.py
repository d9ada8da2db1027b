# SPDX-License-Identifier: Apache-2.0
"""Compiled parts of a camera's hand-eye calibration: its model, and the likelihood of its noise.

Poses (m, 4, 4) as of ``pose_pairs``; rows of six are position and turn along the camera's axes.
Arrays that a kernel fills come last.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.compiled import kernel, lean

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_STRAIGHT = 1e-12  # sine of an angle that is its sine to the last digit
_SMALL = 1e-4  # angle below which a series is exact
_TOLD = 1e-14  # part of what an unknown would tell alone, below which it tells nothing


@kernel
def predict(carrier: Array, X: Array, Z: Array, T: Array) -> None:
    """(carrier X)^-1 Z for each carrier."""
    R, p = np.empty((3, 3)), np.empty(3)
    for i in range(carrier.shape[0]):
        A = carrier[i]
        for r in range(3):
            for c in range(3):
                R[r, c] = A[r, 0] * X[0, c] + A[r, 1] * X[1, c] + A[r, 2] * X[2, c]
            p[r] = Z[r, 3] - A[r, 3]
            p[r] -= A[r, 0] * X[0, 3] + A[r, 1] * X[1, 3] + A[r, 2] * X[2, 3]
        for r in range(3):
            for c in range(3):
                T[i, r, c] = R[0, r] * Z[0, c] + R[1, r] * Z[1, c] + R[2, r] * Z[2, c]
            T[i, r, 3] = R[0, r] * p[0] + R[1, r] * p[1] + R[2, r] * p[2]
            T[i, 3, r] = 0.0
        T[i, 3, 3] = 1.0


@kernel
def advance(T: Array, step: Array, out: Array) -> None:
    """T after an increment (v, w) (6,), m and rad, along its own axes."""
    x, y, z = step[3], step[4], step[5]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    first, second = 1.0 - square / 6.0, 0.5 - square / 24.0
    if angle > _SMALL:
        first, second = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    E = np.empty((3, 4))
    w = step[3:]
    for r in range(3):
        for c in range(3):
            E[r, c] = second * w[r] * w[c]
        E[r, r] += 1.0 - second * square
        E[r, 3] = step[r]
    E[0, 1], E[1, 0] = E[0, 1] - first * z, E[1, 0] + first * z
    E[0, 2], E[2, 0] = E[0, 2] + first * y, E[2, 0] - first * y
    E[1, 2], E[2, 1] = E[1, 2] - first * x, E[2, 1] + first * x
    for r in range(3):
        for c in range(4):
            out[r, c] = T[r, 0] * E[0, c] + T[r, 1] * E[1, c] + T[r, 2] * E[2, c]
        out[r, 3] += T[r, 3]
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0


@kernel
def compare(T: Array, seen: Array, miss: Array) -> float:
    """Difference (m, 6) of T from seen poses; returns the cosine of the largest turn.

    Near half a turn the sine loses the axis.
    """
    least = 1.0
    Q = np.empty((3, 3))
    for i in range(T.shape[0]):
        A, B = T[i], seen[i]
        for r in range(3):
            for c in range(3):
                Q[r, c] = A[r, 0] * B[c, 0] + A[r, 1] * B[c, 1] + A[r, 2] * B[c, 2]
            miss[i, r] = A[r, 3] - B[r, 3]
        x, y, z = 0.5 * (Q[2, 1] - Q[1, 2]), 0.5 * (Q[0, 2] - Q[2, 0]), 0.5 * (Q[1, 0] - Q[0, 1])
        sine = np.sqrt(x * x + y * y + z * z)
        cosine = 0.5 * (Q[0, 0] + Q[1, 1] + Q[2, 2] - 1.0)
        stretch = np.arctan2(sine, cosine) / sine if sine > _STRAIGHT else 1.0
        miss[i, 3], miss[i, 4], miss[i, 5] = stretch * x, stretch * y, stretch * z
        least = min(least, cosine)
    return least


@lean
def _turning(w: Array, K: Array) -> None:
    """Inverse left Jacobian (3, 3) of SO(3) at w (Solà, Deray, Atchuthan 2018, eq. 146)."""
    square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(square)
    factor = 1.0 / 12.0
    if angle > _SMALL:
        factor = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / square
    for r in range(3):
        for c in range(3):
            K[r, c] = factor * w[r] * w[c]
        K[r, r] += 1.0 - factor * square
    K[0, 1] += 0.5 * w[2]
    K[1, 0] -= 0.5 * w[2]
    K[2, 0] += 0.5 * w[1]
    K[0, 2] -= 0.5 * w[1]
    K[1, 2] += 0.5 * w[0]
    K[2, 1] -= 0.5 * w[0]


@kernel
def differentiate(T: Array, miss: Array, J: Array) -> None:
    """Columns 0 to 11 of J (m, 6, 12 + s), zero before: of X and of Z, along their own axes."""
    K = np.empty((3, 3))
    for i in range(T.shape[0]):
        A, D = T[i], J[i]
        _turning(miss[i, 3:], K)
        D[0, 4], D[0, 5], D[1, 5] = -A[2, 3], A[1, 3], -A[0, 3]
        D[1, 3], D[2, 3], D[2, 4] = A[2, 3], -A[1, 3], A[0, 3]
        for r in range(3):
            D[r, r] = -1.0
            for c in range(3):
                D[r, 6 + c] = A[r, c]
                D[3 + r, 3 + c] = -K[r, c]
                D[3 + r, 9 + c] = K[r, 0] * A[0, c] + K[r, 1] * A[1, c] + K[r, 2] * A[2, c]


@kernel
def factorise(
    columns: Array, owner: Index, variances: Array, rest: Array, V: Array, root: Array
) -> float:
    """V = columns diag(variances[owner]) columns^T + rest (m, 6, 6), and its lower root.

    ``columns`` (m, 6, c), ``owner`` (c,). Returns the logarithm of all determinants.
    """
    total = 0.0
    for i in range(columns.shape[0]):
        B, L, S = columns[i], root[i], V[i]
        S[:] = rest[i]
        for c in range(owner.shape[0]):
            variance = variances[owner[c]]
            for a in range(6):
                value = variance * B[a, c]
                if value != 0.0:
                    for b in range(a + 1):
                        S[a, b] += value * B[b, c]
        for a in range(6):
            for b in range(a + 1):
                entry = S[a, b]
                S[b, a] = entry
                for c in range(b):
                    entry -= L[a, c] * L[b, c]
                L[a, b] = np.sqrt(entry) if a == b else entry / L[b, b]
            total += 2.0 * np.log(L[a, a])
    return total


@kernel
def whiten(root: Array, rows: Array) -> None:
    """Put root^-1 rows in the place of rows (m, 6, w)."""
    width = rows.shape[2]
    for i in range(rows.shape[0]):
        L, W = root[i], rows[i]
        for a in range(6):
            for b in range(a):
                factor = L[a, b]
                for j in range(width):
                    W[a, j] -= factor * W[b, j]
            factor = 1.0 / L[a, a]
            for j in range(width):
                W[a, j] *= factor


@kernel
def _without(N: Array, apart: Array) -> float:
    """From products N (k + 1, k + 1) of whitened rows [J, miss], which are lost.

    ``apart`` (k + 1, k + 1): [J, miss] apart = [U, e] with orthonormal U and what J leaves of the
    miss. Returns -2 log likelihood but for the noise's part: e^T e, and the determinant of J^T J;
    infinite where J tells less than k unknowns.
    """
    k = N.shape[0] - 1
    determinant = 0.0
    for p in range(k + 1):
        least = _TOLD * N[p, p] if p < k else 0.0
        for r in range(p):  # the rows above hold the root already
            for q in range(p, k + 1):
                N[p, q] -= N[r, p] * N[r, q]
        if p == k:
            break
        if not N[p, p] > least:
            return np.inf
        factor = np.sqrt(N[p, p])
        for q in range(p, k + 1):
            N[p, q] /= factor
        determinant += 2.0 * np.log(factor)
    left, N[k, k] = N[k, k], 1.0
    apart[:] = 0.0
    for p in range(k + 1):
        apart[p, p] = 1.0 / N[p, p]
        for r in range(p):
            entry = 0.0
            for q in range(r, p):
                entry += apart[r, q] * N[q, p]
            apart[r, p] = -entry / N[p, p]
    return float(determinant + left)


@kernel
def _tell(U: Array, B: Array, owner: Index, slope: Array, bend: Array, pull: Array) -> None:
    """Add what one sample's whitened columns B (6, c) tell, see `weigh`; U (6, k + 1) with e."""
    k, n = U.shape[1] - 1, slope.shape[0]
    s, h = np.zeros((n, 6)), np.empty(k + 1)
    for c in range(owner.shape[0]):
        one = owner[c]
        h[:] = 0.0
        length = 0.0
        for a in range(6):
            value = B[a, c]
            if value != 0.0:
                length += value * value
                for j in range(k + 1):
                    h[j] += value * U[a, j]
        along = h[k]
        for j in range(k + 1):
            length -= h[j] * h[j]
            pull[one, j] += along * h[j]
        slope[one] += length
        for a in range(6):
            s[one, a] += along * B[a, c]
    for p in range(n):
        for a in range(6):
            value = s[p, a]
            if value != 0.0:
                for q in range(p + 1):
                    bend[p, q] += value * s[q, a]


@kernel
def weigh(
    rows: Array, columns: Array, owner: Index, rest: Array, variances: Array,
    step: Array, slope: Array, bend: Array, drift: Array,
) -> float:  # fmt: skip
    """-2 log restricted likelihood of variances (n,), and its derivatives.

    ``rows`` (m, 6, k + 1): Jacobian and differences; ``columns``, ``owner``, ``rest``: see
    `factorise`. With P the covariance's inverse that the unknowns leave, and P_l the derivative of
    the covariance by variance l: ``slope`` (n,) tr(P P_l) - r^T P P_l P r, ``bend`` (n, n)
    r^T P P_l P P_m P r, ``step`` (k,) to the best unknowns, ``drift`` (n, k) its derivatives; zero
    before. Infinite, and nothing told, where the rows do not determine the unknowns.
    """
    m, k, n = rows.shape[0], rows.shape[2] - 1, slope.shape[0]
    V, root = np.empty((m, 6, 6)), np.zeros((m, 6, 6))
    cost = factorise(columns, owner, variances, rest, V, root)
    white, B = rows.copy(), columns.copy()
    whiten(root, white)
    whiten(root, B)
    flat = white.reshape(6 * m, k + 1)
    apart, pull = np.empty((k + 1, k + 1)), np.zeros((n, k + 1))
    cost += _without(flat.T @ flat, apart)
    if cost == np.inf:
        return cost
    step[:] = apart[:k, k]
    U = (flat @ apart).reshape(m, 6, k + 1)
    for i in range(m):
        _tell(U[i], B[i], owner, slope, bend, pull)
    for p in range(n):
        for q in range(p + 1):
            for j in range(k):
                bend[p, q] -= pull[p, j] * pull[q, j]
            bend[q, p] = bend[p, q]
        for j in range(k):
            for q in range(j, k):
                drift[p, j] += apart[j, q] * pull[p, q]
    return cost
