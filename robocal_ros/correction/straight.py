"""Compiled correction of six turning joints without a branch, for many points at once.

Newton's method as in `solution`, three factored matrices with two steps each, written with single
numbers: the compiler works on several points at a time in vector registers. Each gets the
bits that it gets alone. Where that does not do (a direction may be weak, or a shift is so large
that it needs more steps) a point is left to `straight_damped`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.kernels import WEIGHT, WINDOW, lambda_square
from robocal_ros.ground.compiled import kernel, lean
from robocal_ros.kinematics import newton
from robocal_ros.kinematics.kernels import LARGEST_ANGLE, reduced_cos_sin, turns_size

# ---- compiled kinematics of six turning joints with single numbers, for `straight` --------------
#
# Frames are twelve numbers: axes x, y, z and origin. Twists and joints are six. A model's
# constants stand in one array, at places that are known when this is compiled.


Array = NDArray[np.float64]
Six = tuple[float, float, float, float, float, float]
Frame = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float
]  # fmt: skip
Frames = tuple[Frame, Frame, Frame, Frame, Frame, Frame, Frame]

N = 6
# of a model's constants: nine for each joint, twelve of the root's frame, three of the tool's place
ROOT, TOOL, MODEL = 54, 66, 69
# of all: the taught model, the actual one, the turn from the taught tool to it, the largest
# shifts, and the damping's steepness and its rise
ACTUAL, SWAP, LARGEST, DAMPING, CONSTANTS = (2 * MODEL + k for k in (-MODEL, 0, 9, 15, 17))
# The angle by its sine's series: largest square of the sine.
SERIES = 1e-3


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


# ---- compiled correction of six turning joints without a branch, for many points at once --------


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


Factor = tuple[Six, Six, Six, Six, Six, Six, Six, Six, Six, Six]


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
    """A twist with lengths in units of `kernels.LENGTH`."""
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


# ---- where the joint correction is worked out: its two models, and scratch numbers --------------
#
# ``work`` holds `work_size` numbers, so that a point allocates nothing; `settle` puts the models
# and the constants of a correction there, once.


POSES, SQUARES, TWISTS = 6, 3, 5
STEEPNESS, PER_ERROR, IS_STRAIGHT, SETTINGS = 0, 1, 2, 3


class Workspace(NamedTuple):
    """Where a solution is worked out: parts of ``work``.

    Attributes
    ----------
    taught_links, links : (n, 9) joints of the reference and of the actual model.
    taught_root, taught_tool, root, tool : their (4, 4) ends, T_base_root and T_flange_tool.
    goal, here : (4, 4) where the tool must go, and where it is at the joints tried last. Such
        poses have the axes of the flange, their origin is the tool's.
    turns, frames : scratch of `walk`.
    J, there : (n, 6) Jacobian at the taught joints, and at those tried last.
    M, D, B : (6, 6) J J^T, the damping, and the matrix of a step.
    U : (3, 3) vectors of a part of M.
    e, y, step, spare, order : (6,) residual, multipliers, their step, and scratch.
    x : (n,) shift of the joints.
    settings : steepness and its rise, and whether `straight` serves; see `joint_correction` (3).
    constants, came, goes, late : of `straight` and `straight_damped`, for sixteen points.
    """

    taught_links: Array
    links: Array
    taught_root: Array
    taught_tool: Array
    root: Array
    tool: Array
    goal: Array
    here: Array
    turns: Array
    frames: Array
    J: Array
    there: Array
    M: Array
    U: Array
    D: Array
    B: Array
    e: Array
    y: Array
    step: Array
    spare: Array
    order: Array
    x: Array
    settings: Array
    constants: Array
    came: Array
    goes: Array
    late: Array


def work_size(n: int) -> int:
    """How many scratch numbers a solution for n joints needs."""
    many = CONSTANTS + LANES * (N + ROWS + 1)
    small = 16 * POSES + 24 * (n // 8 + 1) + 36 * SQUARES + 9 + 6 * TWISTS + SETTINGS
    return 18 * n + 18 * n + n + small + many


@lean
def room_in(work: Array, n: int) -> Workspace:
    """Divide ``work``."""
    links, at = work[: 18 * n].reshape(2, n, 9), 18 * n
    poses, at = work[at : at + 16 * POSES].reshape(POSES, 4, 4), at + 16 * POSES
    turns, at = work[at : at + turns_size(n)], at + turns_size(n)
    frames, at = work[at : at + 6 * n].reshape(n, 2, 3), at + 6 * n
    J, at = work[at : at + 12 * n].reshape(2, n, 6), at + 12 * n
    squares, at = work[at : at + 36 * SQUARES].reshape(SQUARES, 6, 6), at + 36 * SQUARES
    U, at = work[at : at + 9].reshape(3, 3), at + 9
    twists, at = work[at : at + 6 * TWISTS].reshape(TWISTS, 6), at + 6 * TWISTS
    x, at = work[at : at + n], at + n
    settings, at = work[at : at + SETTINGS], at + SETTINGS
    constants, at = work[at : at + CONSTANTS], at + CONSTANTS
    came, at = work[at : at + LANES * N], at + LANES * N
    goes, at = work[at : at + LANES * ROWS], at + LANES * ROWS
    return Workspace(
        links[0], links[1], poses[0], poses[1], poses[2], poses[3], poses[4], poses[5],
        turns, frames, J[0], J[1], squares[0], U, squares[1], squares[2],
        twists[0], twists[1], twists[2], twists[3], twists[4], x, settings,
        constants, came, goes, work[at : at + LANES],
    )  # fmt: skip


@lean
def settle(
    models: Array, largest: Array, steepness: float, per_error: float, free: bool, room: Workspace
) -> None:
    """Put models (2, n + 2, 9), reference and actual, and the damping's settings into a room."""
    n = room.links.shape[0]
    newton.copy(models[0, :n], room.taught_links)
    newton.copy(models[1, :n], room.links)
    newton.pose(models[0, n], room.taught_root)
    newton.pose(models[0, n + 1], room.taught_tool)
    newton.pose(models[1, n], room.root)
    newton.pose(models[1, n + 1], room.tool)
    room.settings[STEEPNESS], room.settings[PER_ERROR] = steepness, per_error
    turning = not free and n == N
    for i in range(n):
        turning = turning and room.links[i, 8] < 0.5
    room.settings[IS_STRAIGHT] = 1.0 if turning else 0.0
    if not turning:
        return
    for i in range(N):
        room.constants[LARGEST + i] = largest[i]
    room.constants[DAMPING], room.constants[DAMPING + 1] = steepness, per_error
    taught, tool = room.taught_tool, room.tool
    constants(room.taught_links, room.taught_root, taught, taught, 0, room.constants)
    constants(room.links, room.root, tool, taught, ACTUAL, room.constants)
