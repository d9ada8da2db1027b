# SPDX-License-Identifier: Apache-2.0
"""Compiled sums over Jacobians most of whose columns are zero in each sample.

Of a joint's function a pose sees four splines of a hundred or more. A sample's rows are kept
without the others: ``J`` (m, c, h) holds the columns that it sees, ``column`` (m, h) says which of
the k unknowns they are, -1 for none.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.compiled import kernel

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@kernel
def normal_equations(
    J: Array, column: Index, residual: Array, weight: Array, normal: Array, gradient: Array
) -> None:
    """Add the weighted J^T J (k, k) and J^T residual (k,) of residuals (m, c), weights (m,)."""
    m, c, h = J.shape
    for s in range(m):
        w = weight[s]
        if w == 0.0:
            continue
        for a in range(h):
            i = column[s, a]
            if i < 0:
                continue
            for r in range(c):
                x = w * J[s, r, a]
                gradient[i] += x * residual[s, r]
            for b in range(a + 1):
                j = column[s, b]
                if j < 0:
                    continue
                x = 0.0
                for r in range(c):
                    x += J[s, r, a] * J[s, r, b]
                normal[max(i, j), min(i, j)] += w * x
    for i in range(normal.shape[0]):
        for j in range(i):
            normal[j, i] = normal[i, j]


@kernel
def spreads(J: Array, column: Index, covariance: Array, spread: Array) -> None:
    """J covariance J^T (m, c, c) of each sample, for a covariance (k, k) of the unknowns."""
    m, c, h = J.shape
    seen, carried = np.empty(h, dtype=np.int64), np.empty((c, h))
    for s in range(m):
        for a in range(h):
            seen[a] = column[s, a]
        for r in range(c):
            for a in range(h):
                x = 0.0
                if seen[a] >= 0:
                    for b in range(h):
                        if seen[b] >= 0:
                            x += J[s, r, b] * covariance[seen[b], seen[a]]
                carried[r, a] = x
        for r in range(c):
            for p in range(r + 1):
                x = 0.0
                for a in range(h):
                    if seen[a] >= 0:
                        x += carried[r, a] * J[s, p, a]
                spread[s, r, p] = x
                spread[s, p, r] = x


def load_kernels() -> None:
    """Compile or load both."""
    J, column, zeros = np.zeros((1, 3, 1)), np.zeros((1, 1), dtype=np.int64), np.zeros((1, 3))
    normal_equations(J, column, zeros, np.zeros(1), np.zeros((1, 1)), np.zeros(1))
    spreads(J, column, np.zeros((1, 1)), np.zeros((1, 3, 3)))
