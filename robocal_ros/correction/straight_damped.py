"""Compiled correction of six turning joints where directions are weak, for many points at once.

As `straight`, with the damping of `solution` in closed form: two matrices of three by three, whose
eigenvectors come of so many rotations each. What that does not solve is left to `solution`.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.kernels import WINDOW, lambda_square
from robocal_ros.correction.straight import (
    ACTUAL,
    AT_GOAL,
    DAMPING,
    FAR,
    LANES,
    NEAR,
    SHORT,
    Frame,
    Frames,
    N,
    Six,
    column,
    dot,
    goal,
    more,
    residual,
    turns_little,
    walk,
    weighed,
    within,
    write,
)
from robocal_ros.ground.compiled import kernel, lean

Array = NDArray[np.float64]
Three = tuple[float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]  # row by row
Rows = tuple[Six, Six, Six, Six, Six, Six]

TINY = 1e-300


@lean
def _rows(c: Array, f: Frames) -> Rows:
    """The Jacobian's rows, lengths in units of `kernels.LENGTH`."""
    s, e = ACTUAL + 7, f[6]
    a = weighed(column(c[s], f[0], e))
    b, d = weighed(column(c[s + 9], f[1], e)), weighed(column(c[s + 18], f[2], e))
    g, h = weighed(column(c[s + 27], f[3], e)), weighed(column(c[s + 36], f[4], e))
    k = weighed(column(c[s + 45], f[5], e))
    # fmt: off
    return (
        (a[0], b[0], d[0], g[0], h[0], k[0]), (a[1], b[1], d[1], g[1], h[1], k[1]),
        (a[2], b[2], d[2], g[2], h[2], k[2]), (a[3], b[3], d[3], g[3], h[3], k[3]),
        (a[4], b[4], d[4], g[4], h[4], k[4]), (a[5], b[5], d[5], g[5], h[5], k[5]),
    )
    # fmt: on


@lean
def _product(a: Six, b: Six, d: Six, x: Six, y: Six, z: Six) -> Nine:
    """Products of three rows with three others."""
    # fmt: off
    return (
        dot(a, x), dot(a, y), dot(a, z), dot(b, x), dot(b, y), dot(b, z),
        dot(d, x), dot(d, y), dot(d, z),
    )
    # fmt: on


@lean
def _turn(p: float, q: float, o: float) -> tuple[float, float, float]:
    """Cosine, sine and tangent of Jacobi's rotation for two diagonal elements and theirs beside."""
    apart = q - p
    t = 2.0 * o / (abs(apart) + np.sqrt(apart * apart + 4.0 * o * o) + TINY)
    t = t if apart >= 0.0 else -t
    cosine = 1.0 / np.sqrt(t * t + 1.0)
    return cosine, t * cosine, t


@lean
def _both(cosine: float, sine: float, x: float, y: float) -> tuple[float, float]:
    return cosine * x - sine * y, sine * x + cosine * y


@lean
def _spread(u: Nine, a: float, b: float, c: float) -> Nine:
    """U diag(a, b, c) U^T."""
    u0, u1, u2, u3, u4, u5, u6, u7, u8 = u
    xy = a * u0 * u3 + b * u1 * u4 + c * u2 * u5
    xz = a * u0 * u6 + b * u1 * u7 + c * u2 * u8
    yz = a * u3 * u6 + b * u4 * u7 + c * u5 * u8
    return (
        a * u0 * u0 + b * u1 * u1 + c * u2 * u2, xy, xz,
        xy, a * u3 * u3 + b * u4 * u4 + c * u5 * u5, yz,
        xz, yz, a * u6 * u6 + b * u7 * u7 + c * u8 * u8,
    )  # fmt: skip


@lean
def _damp(s: float, square: float) -> float:
    rest = 1.0 - s / (WINDOW * square)
    rest = rest if rest > 0.0 else 0.0
    return square * rest * rest * rest


@lean
def _sweep(m: Six, u: Nine) -> tuple[Six, Nine]:
    """A rotation for each element beside the diagonal: ``m`` is the diagonal, then ab, ac, bc."""
    a, b, c, x, y, z = m
    u0, u1, u2, u3, u4, u5, u6, u7, u8 = u
    cosine, sine, t = _turn(a, b, x)
    a, b, x = a - t * x, b + t * x, 0.0
    y, z = _both(cosine, sine, y, z)
    u0, u1 = _both(cosine, sine, u0, u1)
    u3, u4 = _both(cosine, sine, u3, u4)
    u6, u7 = _both(cosine, sine, u6, u7)
    cosine, sine, t = _turn(a, c, y)
    a, c, y = a - t * y, c + t * y, 0.0
    x, z = _both(cosine, sine, x, z)
    u0, u2 = _both(cosine, sine, u0, u2)
    u3, u5 = _both(cosine, sine, u3, u5)
    u6, u8 = _both(cosine, sine, u6, u8)
    cosine, sine, t = _turn(b, c, z)
    b, c, z = b - t * z, c + t * z, 0.0
    x, y = _both(cosine, sine, x, y)
    u1, u2 = _both(cosine, sine, u1, u2)
    u4, u5 = _both(cosine, sine, u4, u5)
    u7, u8 = _both(cosine, sine, u7, u8)
    return (a, b, c, x, y, z), (u0, u1, u2, u3, u4, u5, u6, u7, u8)


@lean
def _damping(m: Nine, square: float) -> tuple[Nine, float]:
    """Damping of a symmetric matrix, see `kernels.damped`, and its trace."""
    s, u = (m[0], m[4], m[8], m[1], m[2], m[5]), (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    s, u = _sweep(s, u)
    s, u = _sweep(s, u)
    s, u = _sweep(s, u)
    s, u = _sweep(s, u)
    a, b, c = _damp(s[0], square), _damp(s[1], square), _damp(s[2], square)
    return _spread(u, a, b, c), a + b + c


@lean
def _inverse(m: Nine) -> Nine:
    a, b, c, d, e, f, g, h, i = m
    x, y, z = e * i - f * h, f * g - d * i, d * h - e * g
    s = 1.0 / (a * x + b * y + c * z)
    return (
        s * x, s * (c * h - b * i), s * (b * f - c * e),
        s * y, s * (a * i - c * g), s * (c * d - a * f),
        s * z, s * (b * g - a * h), s * (a * e - b * d),
    )  # fmt: skip


@lean
def _times(m: Nine, n: Nine) -> Nine:
    a, b, c, d, e, f, g, h, i = m
    return (
        a * n[0] + b * n[3] + c * n[6], a * n[1] + b * n[4] + c * n[7],
        a * n[2] + b * n[5] + c * n[8], d * n[0] + e * n[3] + f * n[6],
        d * n[1] + e * n[4] + f * n[7], d * n[2] + e * n[5] + f * n[8],
        g * n[0] + h * n[3] + i * n[6], g * n[1] + h * n[4] + i * n[7],
        g * n[2] + h * n[5] + i * n[8],
    )  # fmt: skip


@lean
def _turned_over(m: Nine) -> Nine:
    return m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]


@lean
def _root(T: Nine) -> Nine:
    """Lower factor L of I + T^T T = L L^T."""
    n = _times(_turned_over(T), T)
    a = np.sqrt(1.0 + n[0])
    b, c = n[1] / a, n[2] / a
    d = np.sqrt(1.0 + n[4] - b * b)
    e = (n[5] - b * c) / d
    return a, 0.0, 0.0, b, d, 0.0, c, e, np.sqrt(1.0 + n[8] - c * c - e * e)


@lean
def _on(m: Nine, x: float, y: float, z: float) -> Three:
    return (
        m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z,
        m[6] * x + m[7] * y + m[8] * z,
    )  # fmt: skip


@lean
def _sum(m: Nine, s: float, n: Nine) -> Nine:
    """M + s N."""
    return (
        m[0] + s * n[0], m[1] + s * n[1], m[2] + s * n[2], m[3] + s * n[3], m[4] + s * n[4],
        m[5] + s * n[5], m[6] + s * n[6], m[7] + s * n[7], m[8] + s * n[8],
    )  # fmt: skip


# Inverses of the position's block and of what the turn's is without it; those beside the diagonal.
Factor = tuple[Nine, Nine, Nine, Nine]


@lean
def _factor(there: Rows, at: Rows, P: Nine, R: Nine) -> Factor:
    """Factor the matrix of a step, J' J^T + D."""
    a, b, c, d, e, f = there
    p, q, r, s, t, u = at
    upper, lower = _product(a, b, c, s, t, u), _product(d, e, f, p, q, r)
    first = _inverse(_sum(_product(a, b, c, p, q, r), 1.0, P))
    turn = _sum(_product(d, e, f, s, t, u), 1.0, R)
    return first, _inverse(_sum(turn, -1.0, _times(_times(lower, first), upper))), upper, lower


@lean
def _step(factor: Factor, e: Six) -> Six:
    """Step of the multipliers for what is left."""
    first, second, upper, lower = factor
    p = _on(first, e[0], e[1], e[2])
    w = _on(lower, p[0], p[1], p[2])
    w = _on(second, e[3] - w[0], e[4] - w[1], e[5] - w[2])
    u = _on(upper, w[0], w[1], w[2])
    p = _on(first, e[0] - u[0], e[1] - u[1], e[2] - u[2])
    return p[0], p[1], p[2], w[0], w[1], w[2]


@lean
def _joints(J: Rows, y: Six) -> Six:
    """J^T y."""
    a, b, c, d, e, f = J
    x = more(more((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), y[0], a), y[1], b)
    return more(more(more(more(x, y[2], c), y[3], d), y[4], e), y[5], f)


@lean
def _left(e: Six, y: Six, P: Nine, R: Nine) -> Six:
    """What is left to do, e - D y."""
    e = weighed(e)
    p, w = _on(P, y[0], y[1], y[2]), _on(R, y[3], y[4], y[5])
    return e[0] - p[0], e[1] - p[1], e[2] - p[2], e[3] - w[0], e[4] - w[1], e[5] - w[2]


@lean
def _again(
    c: Array, q: Six, aim: Frame, J: Rows, y: Six, P: Nine, R: Nine
) -> tuple[Six, Six, float, float, bool]:
    """Multipliers after two steps with one matrix, shift, the steps' squares, all near enough."""
    x = _joints(J, y)
    frames = walk(c, ACTUAL, more(q, 1.0, x))
    e, near = residual(aim, frames[6])
    factor = _factor(_rows(c, frames), J, P, R)
    y = more(y, 1.0, _step(factor, _left(e, y, P, R)))
    moved = _joints(J, y)
    step = more(moved, -1.0, x)
    e, still = residual(aim, walk(c, ACTUAL, more(q, 1.0, moved))[6])
    y = more(y, 1.0, _step(factor, _left(e, y, P, R)))
    x = _joints(J, y)
    last = more(x, -1.0, moved)
    return y, x, dot(step, step), dot(last, last), near & still


@lean
def _solve(c: Array, q: Six) -> tuple[Six, Six, Six, bool, bool]:
    """Shift, first and last residual, whether it is the solution, and whether something is weak."""
    aim = goal(c, q)
    frames = walk(c, ACTUAL, q)
    first, near = residual(aim, frames[6])
    fine = near & turns_little(c, 0, q) & turns_little(c, ACTUAL, q)
    fine &= dot(first, first) > AT_GOAL * AT_GOAL * N
    J = _rows(c, frames)
    i, j, k, l, m, n = J
    e = weighed(first)
    position = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
    turn = position + e[3] * e[3] + e[4] * e[4] + e[5] * e[5]
    A, B = _product(i, j, k, i, j, k), _product(i, j, k, l, m, n)
    P, weak = _damping(A, lambda_square(position, c[DAMPING], c[DAMPING + 1]))
    T = _times(_inverse(_sum(A, 1.0, P)), B)
    C = _sum(_product(l, m, n, l, m, n), -1.0, _times(_product(l, m, n, i, j, k), T))
    L = _root(T)
    inverse = _inverse(L)
    C = _times(_times(inverse, C), _turned_over(inverse))
    R, more_weak = _damping(C, lambda_square(turn, c[DAMPING], c[DAMPING + 1]))
    R = _times(_times(L, R), _turned_over(L))
    y = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    y, x, _, _, good = _again(c, q, aim, J, y, P, R)
    fine &= good
    y, x, _, _, good = _again(c, q, aim, J, y, P, R)
    fine &= good
    y, x, before, size, good = _again(c, q, aim, J, y, P, R)
    fine &= good & (before <= NEAR * NEAR) & (size <= SHORT * SHORT) & within(c, x, FAR)
    last, _ = residual(aim, walk(c, ACTUAL, more(q, 1.0, x))[6])
    return x, first, last, fine, weak + more_weak > 0.0


@lean
def _correct(c: Array, q: Array, k: int, lanes: int, out: Array) -> None:
    """Point ``k`` of ``lanes``."""
    at = (
        q[k], q[lanes + k], q[2 * lanes + k],
        q[3 * lanes + k], q[4 * lanes + k], q[5 * lanes + k],
    )  # fmt: skip
    x, first, last, fine, weak = _solve(c, at)
    write(more(at, 1.0, x), first, last, fine, weak, k, lanes, out)


@kernel
def correct_one(c: Array, q: Array, out: Array) -> None:
    """Corrected joints of one point (6,) and its report: ``out`` (12,)."""
    _correct(c, q, 0, 1, out)


@kernel
def correct_lanes(c: Array, q: Array, out: Array) -> None:
    """`correct_one` for sixteen points: ``q`` (96,) and ``out`` (192,), joint by joint."""
    for k in range(LANES):
        _correct(c, q, k, LANES, out)
