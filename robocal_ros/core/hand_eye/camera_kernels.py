"""Compiled parts of a camera's hand-eye calibration: its model, and the likelihood of its noise.

Poses (m, 4, 4) as of ``pose_pairs``; rows of six are position and turn along the camera's axes.
Arrays that a kernel fills come last.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import kernel, lean

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_STRAIGHT = 1e-12  # sine of an angle that is its sine to the last digit
_SMALL = 1e-4  # angle below which a series is exact


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
        B, L = columns[i], root[i]
        for a in range(6):
            for b in range(a + 1):
                entry = rest[i, a, b]
                for c in range(owner.shape[0]):
                    entry += variances[owner[c]] * B[a, c] * B[b, c]
                V[i, a, b] = V[i, b, a] = entry
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
def tell(
    explained: Array, left: Array, white: Array, owner: Index,
    slope: Array, bend: Array, pull: Array,
) -> None:  # fmt: skip
    """What whitened columns (m, 6, c) of variances (n,), zero before, tell of them.

    With U = ``explained`` (m, 6, k), orthonormal over all rows, e = ``left`` (m, 6) and P_l = the
    columns of variance l times their transpose: ``slope`` (n,) tr((I - U U^T) P_l) - e^T P_l e,
    ``bend`` (n, n) e^T P_l P_m e, ``pull`` (n, k) U^T P_l e.
    """
    k, n = explained.shape[2], slope.shape[0]
    S, s = np.empty((6, 6)), np.empty((n, 6))
    for i in range(explained.shape[0]):
        U, e, B = explained[i], left[i], white[i]
        for a in range(6):
            for b in range(a + 1):
                entry = e[a] * e[b]
                for j in range(k):
                    entry += U[a, j] * U[b, j]
                S[a, b] = -2.0 * entry  # of what is symmetrical half the entries, doubled
            S[a, a] = 1.0 + 0.5 * S[a, a]
        s[:] = 0.0
        for c in range(owner.shape[0]):
            one = owner[c]
            along = 0.0
            for a in range(6):
                value = B[a, c]
                if value != 0.0:
                    along += value * e[a]
                    entry = 0.0
                    for b in range(a + 1):
                        entry += S[a, b] * B[b, c]
                    slope[one] += value * entry
            for a in range(6):
                s[one, a] += along * B[a, c]
        for p in range(n):
            for a in range(6):
                value = s[p, a]
                if value != 0.0:
                    for j in range(k):
                        pull[p, j] += value * U[a, j]
                    for q in range(p + 1):
                        bend[p, q] += value * s[q, a]
    for p in range(n):
        for q in range(p):
            bend[q, p] = bend[p, q]
