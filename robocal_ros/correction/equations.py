"""Compiled equations of the joint correction: all six, or five when the tool has a free axis.

A free axis is the tool's z: a turn about it is left out of the residual and of the Jacobian. Where
there are more joints than equations, the solution is the one with the shortest joint shift.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import lean
from robocal_ros.core.kinematics import newton

Array = NDArray[np.float64]


@lean
def wide(n: int, free: bool) -> bool:
    """Whether there are more joints than equations."""
    return n > 5 if free else n > 6


@lean
def unknowns(n: int, free: bool) -> int:
    """How many unknowns a step is found from: the joints, or the multipliers of the equations."""
    return 6 if wide(n, free) else n


@lean
def _axis(T: Array, tool: Array) -> tuple[float, float, float]:
    """Axis z of the tool on a flange with the axes of ``T``."""
    x, y, z = tool[0, 2], tool[1, 2], tool[2, 2]
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
    )


@lean
def residual(goal: Array, T: Array, tool: Array, free: bool, e: Array) -> float:
    """Twist ``e`` from ``T`` to ``goal``; returns its largest component.

    With a free axis its rotation is the least turn that brings the tool's z to the goal's.
    """
    if not free:
        return newton.residual(goal, T, e)
    z0, z1, z2 = _axis(T, tool)
    g0, g1, g2 = _axis(goal, tool)
    w0, w1, w2 = z1 * g2 - z2 * g1, z2 * g0 - z0 * g2, z0 * g1 - z1 * g0
    sine_square, cosine = w0 * w0 + w1 * w1 + w2 * w2, z0 * g0 + z1 * g1 + z2 * g2
    factor = newton.angle_by_sine(sine_square, cosine)
    for r in range(3):
        e[r] = goal[r, 3] - T[r, 3]
    e[3], e[4], e[5] = factor * w0, factor * w1, factor * w2
    return newton.largest_of(e)


@lean
def factor(J: Array, T: Array, tool: Array, free: bool, L: Array) -> bool:
    """Factor for `step`; False where singular. ``J`` (n, 6) loses its part about a free axis."""
    n = J.shape[0]
    z0, z1, z2 = 0.0, 0.0, 0.0
    if free:
        z0, z1, z2 = _axis(T, tool)
        for i in range(n):
            about = J[i, 3] * z0 + J[i, 4] * z1 + J[i, 5] * z2
            J[i, 3] -= about * z0
            J[i, 4] -= about * z1
            J[i, 5] -= about * z2
    if not wide(n, free):
        return newton.factor(J, L)
    # J J^T; a free axis, of which J knows nothing, fills its place with a one.
    z = (0.0, 0.0, 0.0, z0, z1, z2)
    for r in range(6):
        for c in range(r + 1):
            value = z[r] * z[c]
            for i in range(n):
                value += J[i, r] * J[i, c]
            L[r, c] = value
    return newton.factor_in_place(L)


@lean
def step(
    J: Array, L: Array, e: Array, x: Array, free: bool, shorten: bool, spare: Array, out: Array
) -> None:
    """Joint step for the twist ``e``.

    Where there are more joints than equations it is the shortest one, or, to ``shorten``, the one
    after which the whole shift from ``x`` is shortest. ``spare`` (6,) is scratch.
    """
    n = J.shape[0]
    if not wide(n, free):
        newton.solve(J, L, e, x, out)
        return
    back = 1.0 if shorten else 0.0
    for r in range(6):
        spare[r] = e[r]
        for i in range(n):
            spare[r] += back * J[i, r] * x[i]
    newton.solve_in_place(L, spare)
    for i in range(n):
        out[i] = -back * x[i]
        for r in range(6):
            out[i] += J[i, r] * spare[r]
