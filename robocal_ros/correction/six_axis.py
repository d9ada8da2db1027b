"""Compiled correction of six turning joints without a branch, for many points at once.

Newton's method as in `solution`, three factored matrices with two steps each, written with single
numbers: the compiler works on several points at a time in vector registers. Each gets the
bits that it gets alone. What that does not solve, as a direction may be weak or a shift so large
that it needs more steps, is left to the second half: there the damping of `solution` in closed
form, two matrices of three by three, whose eigenvectors come of so many rotations each. What that
does not solve is left to `solution`.

Frames are twelve numbers: axes x, y, z and origin. Twists and joints are six. A model's
constants stand in one array, at places that are known when this is compiled.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.damping import WEIGHT, WINDOW, lambda_square
from robocal_ros.ground.compiled import kernel, lean
from robocal_ros.kinematics.kernels import LARGEST_ANGLE, reduced_cos_sin

Array = NDArray[np.float64]
Six = tuple[float, float, float, float, float, float]
Frame = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float
]  # fmt: skip
Frames = tuple[Frame, Frame, Frame, Frame, Frame, Frame, Frame]
Factor = tuple[Six, Six, Six, Six, Six, Six, Six, Six, Six, Six]
Three = tuple[float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]  # row by row
Rows = tuple[Six, Six, Six, Six, Six, Six]
# Inverses of the position's block and of what the turn's is without it; those beside the diagonal.
BlockFactor = tuple[Nine, Nine, Nine, Nine]

N = 6
# of a model's constants: nine for each joint, twelve of the root's frame, three of the tool's place
ROOT, TOOL, MODEL = 54, 66, 69
# of all: the taught model, the actual one, the turn from the taught tool to it, the largest
# shifts, and the damping's steepness and its rise
ACTUAL, SWAP, LARGEST, DAMPING, CONSTANTS = (2 * MODEL + k for k in (-MODEL, 0, 9, 15, 17))
# The angle by its sine's series: largest square of the sine.
SERIES = 1e-3
LANES = 16
# what is written for each point
ROWS = 12
POSITION_LEFT, ROTATION_LEFT, FINE, WEAK, TCP_SHIFT, TCP_ROTATION = range(N, ROWS)
ITERATIONS = 3.0

# A residual (m, rad) that is left alone.
AT_GOAL = 1e-12
# Longest second step as a share of the first: see `solution`.
AHEAD, BESIDE = 0.2, 0.5
# The last matrix was made so near to the solution that its second step, this short, is the last:
# what is left is their product, times a curvature that even beside a singularity is below 1e4.
NEAR, SHORT = 1e-6, 1e-11
SINGULAR = 1e-13  # square of a column's part that no column before has, beside the first's
FAR = 2.0  # a solution so many times beyond the bound is another posture
TINY = 1e-300


@lean
def constants(model: Array, root: Array, tool: Array, old_tool: Array, at: int, out: Array) -> None:
    """Constants of a model from ``at`` on; of the second one also the turn from the old tool."""
    for i in range(N):
        for c in range(9):
            out[at + 9 * i + c] = model[i, c]
    for c in range(4):
        for r in range(3):
            out[at + ROOT + 3 * c + r] = root[r, c]
    for r in range(3):
        out[at + TOOL + r] = tool[r, 3]
        for c in range(3):
            out[SWAP + 3 * r + c] = (
                old_tool[r, 0] * tool[c, 0]
                + old_tool[r, 1] * tool[c, 1]
                + old_tool[r, 2] * tool[c, 2]
            )


@lean
def _link(c: Array, at: int, q: float, frame: Frame) -> Frame:
    """The next joint's frame; see `kinematics.kernels`."""
    x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2 = frame
    cosine, sine = reduced_cos_sin(c[at + 1] + c[at + 7] * q)
    d, a, ca, sa, cb, sb = c[at], c[at + 2], c[at + 3], c[at + 4], c[at + 5], c[at + 6]
    u0, u1, u2 = cosine * x0 + sine * y0, cosine * x1 + sine * y1, cosine * x2 + sine * y2
    v0, v1, v2 = cosine * y0 - sine * x0, cosine * y1 - sine * x1, cosine * y2 - sine * x2
    w0, w1, w2 = ca * z0 - sa * v0, ca * z1 - sa * v1, ca * z2 - sa * v2
    # fmt: off
    return (
        cb * u0 - sb * w0, cb * u1 - sb * w1, cb * u2 - sb * w2,
        ca * v0 + sa * z0, ca * v1 + sa * z1, ca * v2 + sa * z2,
        cb * w0 + sb * u0, cb * w1 + sb * u1, cb * w2 + sb * u2,
        p0 + (d * z0 + a * u0), p1 + (d * z1 + a * u1), p2 + (d * z2 + a * u2),
    )
    # fmt: on


@lean
def walk(c: Array, at: int, q: Six) -> Frames:
    """Frames of all joints, then the flange's axes at the tool's origin."""
    r = at + ROOT
    # fmt: off
    f0 = (
        c[r], c[r + 1], c[r + 2], c[r + 3], c[r + 4], c[r + 5],
        c[r + 6], c[r + 7], c[r + 8], c[r + 9], c[r + 10], c[r + 11],
    )
    # fmt: on
    f1 = _link(c, at, q[0], f0)
    f2 = _link(c, at + 9, q[1], f1)
    f3 = _link(c, at + 18, q[2], f2)
    f4 = _link(c, at + 27, q[3], f3)
    f5 = _link(c, at + 36, q[4], f4)
    x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2 = _link(c, at + 45, q[5], f5)
    t0, t1, t2 = c[at + TOOL], c[at + TOOL + 1], c[at + TOOL + 2]
    p0 += x0 * t0 + y0 * t1 + z0 * t2
    p1 += x1 * t0 + y1 * t1 + z1 * t2
    p2 += x2 * t0 + y2 * t1 + z2 * t2
    return f0, f1, f2, f3, f4, f5, (x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2)


@lean
def goal(c: Array, q: Six) -> Frame:
    """Where the tool was taught to be, with the axes of a flange that carries the new one."""
    x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2 = walk(c, 0, q)[6]
    s, t, u = SWAP, SWAP + 3, SWAP + 6
    # fmt: off
    return (
        x0 * c[s] + y0 * c[t] + z0 * c[u],
        x1 * c[s] + y1 * c[t] + z1 * c[u],
        x2 * c[s] + y2 * c[t] + z2 * c[u],
        x0 * c[s + 1] + y0 * c[t + 1] + z0 * c[u + 1],
        x1 * c[s + 1] + y1 * c[t + 1] + z1 * c[u + 1],
        x2 * c[s + 1] + y2 * c[t + 1] + z2 * c[u + 1],
        x0 * c[s + 2] + y0 * c[t + 2] + z0 * c[u + 2],
        x1 * c[s + 2] + y1 * c[t + 2] + z1 * c[u + 2],
        x2 * c[s + 2] + y2 * c[t + 2] + z2 * c[u + 2],
        p0, p1, p2,
    )
    # fmt: on


@lean
def residual(goal: Frame, here: Frame) -> tuple[Six, bool]:
    """Twist from a frame to another, and whether they are near enough for the series."""
    x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2 = here
    g0, g1, g2, h0, h1, h2, k0, k1, k2, o0, o1, o2 = goal
    w0 = 0.5 * ((x1 * g2 - x2 * g1) + (y1 * h2 - y2 * h1) + (z1 * k2 - z2 * k1))
    w1 = 0.5 * ((x2 * g0 - x0 * g2) + (y2 * h0 - y0 * h2) + (z2 * k0 - z0 * k2))
    w2 = 0.5 * ((x0 * g1 - x1 * g0) + (y0 * h1 - y1 * h0) + (z0 * k1 - z1 * k0))
    trace = x0 * g0 + x1 * g1 + x2 * g2 + y0 * h0 + y1 * h1 + y2 * h2 + z0 * k0 + z1 * k1 + z2 * k2
    square = w0 * w0 + w1 * w1 + w2 * w2
    tail = square * (105.0 / 3456.0 + square * (945.0 / 42240.0))
    tail = 3.0 / 40.0 + square * (15.0 / 336.0 + tail)
    factor = 1.0 + square * (1.0 / 6.0 + square * tail)
    near = (square <= SERIES) & (trace >= 1.0)
    return (o0 - p0, o1 - p1, o2 - p2, factor * w0, factor * w1, factor * w2), near


@lean
def column(sign: float, frame: Frame, end: Frame) -> Six:
    """A joint's column of the geometric Jacobian."""
    z0, z1, z2 = sign * frame[6], sign * frame[7], sign * frame[8]
    r0, r1, r2 = end[9] - frame[9], end[10] - frame[10], end[11] - frame[11]
    return z1 * r2 - z2 * r1, z2 * r0 - z0 * r2, z0 * r1 - z1 * r0, z0, z1, z2


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
def _factor(c: Array, f: Frames) -> tuple[Factor, bool]:
    """Orthogonal columns of the Jacobian, its triangle in two sixes and a half, 1 / squares.

    By the modified Gram-Schmidt process; False where singular.
    """
    s, e = ACTUAL + 7, f[6]
    a0 = weighed(column(c[s], f[0], e))
    a1, a2 = weighed(column(c[s + 9], f[1], e)), weighed(column(c[s + 18], f[2], e))
    a3, a4 = weighed(column(c[s + 27], f[3], e)), weighed(column(c[s + 36], f[4], e))
    a5 = weighed(column(c[s + 45], f[5], e))
    n0 = dot(a0, a0)
    i0 = 1.0 / n0
    r01, r02, r03 = dot(a0, a1) * i0, dot(a0, a2) * i0, dot(a0, a3) * i0
    r04, r05 = dot(a0, a4) * i0, dot(a0, a5) * i0
    a1, a2, a3 = more(a1, -r01, a0), more(a2, -r02, a0), more(a3, -r03, a0)
    a4, a5 = more(a4, -r04, a0), more(a5, -r05, a0)
    n1 = dot(a1, a1)
    i1 = 1.0 / n1
    r12, r13, r14, r15 = (
        dot(a1, a2) * i1, dot(a1, a3) * i1, dot(a1, a4) * i1, dot(a1, a5) * i1
    )  # fmt: skip
    a2, a3 = more(a2, -r12, a1), more(a3, -r13, a1)
    a4, a5 = more(a4, -r14, a1), more(a5, -r15, a1)
    n2 = dot(a2, a2)
    i2 = 1.0 / n2
    r23, r24, r25 = dot(a2, a3) * i2, dot(a2, a4) * i2, dot(a2, a5) * i2
    a3, a4, a5 = more(a3, -r23, a2), more(a4, -r24, a2), more(a5, -r25, a2)
    n3 = dot(a3, a3)
    i3 = 1.0 / n3
    r34, r35 = dot(a3, a4) * i3, dot(a3, a5) * i3
    a4, a5 = more(a4, -r34, a3), more(a5, -r35, a3)
    n4 = dot(a4, a4)
    i4 = 1.0 / n4
    r45 = dot(a4, a5) * i4
    a5 = more(a5, -r45, a4)
    n5 = dot(a5, a5)
    least = SINGULAR * n0
    regular = (n1 > least) & (n2 > least) & (n3 > least) & (n4 > least) & (n5 > least)
    i, r = (i0, i1, i2, i3, i4, 1.0 / n5), (r01, r02, r03, r04, r05, r12)
    t, u = (r13, r14, r15, r23, r24, r25), (r34, r35, r45, 0.0, 0.0, 0.0)
    return (a0, a1, a2, a3, a4, a5, i, r, t, u), regular


@lean
def weighed(e: Six) -> Six:
    """A twist with lengths in units of `damping.LENGTH`."""
    return WEIGHT * e[0], WEIGHT * e[1], WEIGHT * e[2], e[3], e[4], e[5]


@lean
def _inverse_norm(factor: Factor) -> float:
    """Square of the inverse Jacobian's Frobenius norm: no singular value is below 1 / its root."""
    _, _, _, _, _, _, i, r, t, u = factor
    a01 = r[0]
    a12 = r[5]
    a02 = r[1] - r[0] * a12
    a23 = t[3]
    a13 = t[0] - r[5] * a23
    a03 = r[2] - r[0] * a13 - r[1] * a23
    a34 = u[0]
    a24 = t[4] - t[3] * a34
    a14 = t[1] - r[5] * a24 - t[0] * a34
    a04 = r[3] - r[0] * a14 - r[1] * a24 - r[2] * a34
    a45 = u[2]
    a35 = u[1] - u[0] * a45
    a25 = t[5] - t[3] * a35 - t[4] * a45
    a15 = t[2] - r[5] * a25 - t[0] * a35 - t[1] * a45
    a05 = r[4] - r[0] * a15 - r[1] * a25 - r[2] * a35 - r[3] * a45
    n1, n2 = 1.0 + a01 * a01, 1.0 + a02 * a02 + a12 * a12
    n3 = 1.0 + a03 * a03 + a13 * a13 + a23 * a23
    n4 = 1.0 + a04 * a04 + a14 * a14 + a24 * a24 + a34 * a34
    n5 = 1.0 + a05 * a05 + a15 * a15 + a25 * a25 + a35 * a35 + a45 * a45
    return i[0] + i[1] * n1 + i[2] * n2 + i[3] * n3 + i[4] * n4 + i[5] * n5


@lean
def _step(factor: Factor, e: Six) -> Six:
    """Joint step for a twist."""
    a0, a1, a2, a3, a4, a5, i, r, t, u = factor
    e = weighed(e)
    y0 = dot(a0, e) * i[0]
    y1 = dot(a1, e) * i[1]
    y2 = dot(a2, e) * i[2]
    y3 = dot(a3, e) * i[3]
    y4 = dot(a4, e) * i[4]
    x5 = dot(a5, e) * i[5]
    x4 = y4 - u[2] * x5
    x3 = y3 - (u[0] * x4 + u[1] * x5)
    x2 = y2 - (t[3] * x3 + t[4] * x4 + t[5] * x5)
    x1 = y1 - (r[5] * x2 + t[0] * x3 + t[1] * x4 + t[2] * x5)
    x0 = y0 - (r[0] * x1 + r[1] * x2 + r[2] * x3 + r[3] * x4 + r[4] * x5)
    return x0, x1, x2, x3, x4, x5


@lean
def within(c: Array, x: Six, times: float) -> bool:
    """Whether no joint is shifted by more than so many times its bound."""
    b = LARGEST
    return bool(
        (abs(x[0]) <= times * c[b])
        & (abs(x[1]) <= times * c[b + 1])
        & (abs(x[2]) <= times * c[b + 2])
        & (abs(x[3]) <= times * c[b + 3])
        & (abs(x[4]) <= times * c[b + 4])
        & (abs(x[5]) <= times * c[b + 5])
    )


@lean
def turns_little(c: Array, at: int, q: Six) -> bool:
    """Whether all angles are within the reach of their sines; False for NaN."""
    return bool(
        (abs(c[at + 1] + c[at + 7] * q[0]) <= LARGEST_ANGLE)
        & (abs(c[at + 10] + c[at + 16] * q[1]) <= LARGEST_ANGLE)
        & (abs(c[at + 19] + c[at + 25] * q[2]) <= LARGEST_ANGLE)
        & (abs(c[at + 28] + c[at + 34] * q[3]) <= LARGEST_ANGLE)
        & (abs(c[at + 37] + c[at + 43] * q[4]) <= LARGEST_ANGLE)
        & (abs(c[at + 46] + c[at + 52] * q[5]) <= LARGEST_ANGLE)
    )


@lean
def _two_steps(c: Array, q: Six, aim: Frame, x: Six) -> tuple[Six, Six, float, float, bool]:
    """Shift after two steps with one matrix, the residual before the last, the steps' squares."""
    frames = walk(c, ACTUAL, more(q, 1.0, x))
    e, near = residual(aim, frames[6])
    factor, regular = _factor(c, frames)
    step = _step(factor, e)
    x, before = more(x, 1.0, step), dot(step, step)
    last, still_near = residual(aim, walk(c, ACTUAL, more(q, 1.0, x))[6])
    step = _step(factor, last)
    return more(x, 1.0, step), last, before, dot(step, step), near & regular & still_near


@lean
def _solve(c: Array, q: Six) -> tuple[Six, Six, Six, bool]:
    """Shift of the joints, first and last residual, and whether the shift is the solution."""
    aim = goal(c, q)
    frames = walk(c, ACTUAL, q)
    first, near = residual(aim, frames[6])
    fine = near & turns_little(c, 0, q) & turns_little(c, ACTUAL, q)
    # of no more than this nothing is left to do, and nothing is done
    fine &= dot(first, first) > AT_GOAL * AT_GOAL * N
    factor, regular = _factor(c, frames)
    x = _step(factor, first)
    e = weighed(first)
    square = lambda_square(dot(e, e), c[DAMPING], c[DAMPING + 1])
    fine &= regular & (WINDOW * square * _inverse_norm(factor) <= 1.0)
    e, near = residual(aim, walk(c, ACTUAL, more(q, 1.0, x))[6])
    step = _step(factor, e)
    length, along = dot(x, x), dot(x, step)
    fine &= near & (along <= AHEAD * length) & (dot(step, step) <= BESIDE * BESIDE * length)
    x, _, _, _, good = _two_steps(c, q, aim, more(x, 1.0, step))
    fine &= good
    x, last, before, size, good = _two_steps(c, q, aim, x)
    fine &= good & (before <= NEAR * NEAR) & (size <= SHORT * SHORT) & within(c, x, FAR)
    return x, first, last, fine


@lean
def _length(x: float, y: float, z: float) -> float:
    return float(np.sqrt(x * x + y * y + z * z))


@lean
def write(
    x: Six, first: Six, last: Six, fine: bool, weak: bool, k: int, lanes: int, out: Array
) -> None:
    """Corrected joints of point ``k`` of ``lanes``, with their report."""
    out[k], out[lanes + k], out[2 * lanes + k] = x[0], x[1], x[2]
    out[3 * lanes + k], out[4 * lanes + k], out[5 * lanes + k] = x[3], x[4], x[5]
    out[POSITION_LEFT * lanes + k] = _length(last[0], last[1], last[2])
    out[ROTATION_LEFT * lanes + k] = _length(last[3], last[4], last[5])
    out[FINE * lanes + k] = 1.0 if fine else 0.0
    out[WEAK * lanes + k] = 1.0 if weak else 0.0
    out[TCP_SHIFT * lanes + k] = _length(first[0], first[1], first[2])
    out[TCP_ROTATION * lanes + k] = _length(first[3], first[4], first[5])


@lean
def _correct(c: Array, q: Array, k: int, lanes: int, out: Array) -> None:
    """Point ``k`` of ``lanes``."""
    at = (
        q[k], q[lanes + k], q[2 * lanes + k],
        q[3 * lanes + k], q[4 * lanes + k], q[5 * lanes + k],
    )  # fmt: skip
    x, first, last, fine = _solve(c, at)
    write(more(at, 1.0, x), first, last, fine, False, k, lanes, out)


@kernel
def correct_one(c: Array, q: Array, out: Array) -> None:
    """Corrected joints of one point (6,) and its report: ``out`` (12,)."""
    _correct(c, q, 0, 1, out)


@kernel
def correct_lanes(c: Array, q: Array, out: Array) -> None:
    """`correct_one` for sixteen points: ``q`` (96,) and ``out`` (192,), joint by joint."""
    for k in range(LANES):
        _correct(c, q, k, LANES, out)


@lean
def _rows(c: Array, f: Frames) -> Rows:
    """The Jacobian's rows, lengths in units of `damping.LENGTH`."""
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
    """Damping of a symmetric matrix, see `damping.damped`, and its trace."""
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


@lean
def _damped_factor(there: Rows, at: Rows, P: Nine, R: Nine) -> BlockFactor:
    """Factor the matrix of a step, J' J^T + D."""
    a, b, c, d, e, f = there
    p, q, r, s, t, u = at
    upper, lower = _product(a, b, c, s, t, u), _product(d, e, f, p, q, r)
    first = _inverse(_sum(_product(a, b, c, p, q, r), 1.0, P))
    turn = _sum(_product(d, e, f, s, t, u), 1.0, R)
    return first, _inverse(_sum(turn, -1.0, _times(_times(lower, first), upper))), upper, lower


@lean
def _multiplier_step(factor: BlockFactor, e: Six) -> Six:
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
    factor = _damped_factor(_rows(c, frames), J, P, R)
    y = more(y, 1.0, _multiplier_step(factor, _left(e, y, P, R)))
    moved = _joints(J, y)
    step = more(moved, -1.0, x)
    e, still = residual(aim, walk(c, ACTUAL, more(q, 1.0, moved))[6])
    y = more(y, 1.0, _multiplier_step(factor, _left(e, y, P, R)))
    x = _joints(J, y)
    last = more(x, -1.0, moved)
    return y, x, dot(step, step), dot(last, last), near & still


@lean
def _solve_damped(c: Array, q: Six) -> tuple[Six, Six, Six, bool, bool]:
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
def _correct_damped(c: Array, q: Array, k: int, lanes: int, out: Array) -> None:
    """Point ``k`` of ``lanes``."""
    at = (
        q[k], q[lanes + k], q[2 * lanes + k],
        q[3 * lanes + k], q[4 * lanes + k], q[5 * lanes + k],
    )  # fmt: skip
    x, first, last, fine, weak = _solve_damped(c, at)
    write(more(at, 1.0, x), first, last, fine, weak, k, lanes, out)


@kernel
def correct_one_damped(c: Array, q: Array, out: Array) -> None:
    """Corrected joints of one point (6,) and its report: ``out`` (12,)."""
    _correct_damped(c, q, 0, 1, out)


@kernel
def correct_lanes_damped(c: Array, q: Array, out: Array) -> None:
    """`correct_one_damped` for sixteen points: ``q`` (96,) and ``out`` (192,), joint by joint."""
    for k in range(LANES):
        _correct_damped(c, q, k, LANES, out)
