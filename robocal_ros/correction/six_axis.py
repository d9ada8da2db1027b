# SPDX-License-Identifier: Apache-2.0
"""Compiled correction of six turning joints without a branch, for many points at once.

Newton's method as in `solution`, with three matrices (of a `large` change of the tool four) and two
steps each, written with single numbers: the compiler works on several points at a time in vector
registers. Each gets the bits that it gets alone. What that does not solve is left to `solution`.

Frames are twelve numbers: axes x, y, z and origin. Twists and joints are six. A model's
constants stand in one array, at places that are known when this is compiled.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.damping import (
    CONVERGED,
    ITERATIONS,
    POSITION_ERROR,
    REPORT,
    ROTATION_ERROR,
    TCP_ROTATION,
    TCP_SHIFT,
    WEAK,
    WEIGHT,
    Nine,
    Six,
    damping,
    dot,
    inverse,
    left,
    more,
    on,
    times,
    total,
    weighed,
)
from robocal_ros.ground.compiled import inlined, kernel, lean
from robocal_ros.kinematics.kernels import LARGEST_ANGLE, reduced_cos_sin

Array = NDArray[np.float64]
Frame = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float
]  # fmt: skip
Frames = tuple[Frame, Frame, Frame, Frame, Frame, Frame, Frame]
Rows = tuple[Six, Six, Six, Six, Six, Six]
# Inverses of the position's block and of what the turn's is without it; those beside the diagonal.
BlockFactor = tuple[Nine, Nine, Nine, Nine]

N = 6
# of a model's constants: nine for each joint, twelve of the root's frame, three of the tool's place
ROOT, TOOL, MODEL = 54, 66, 69
# of all: the taught model, the actual one, the turn from the taught tool to it, the largest
# shifts, the damping's steepness and its rise, and whether the change of the tool is large
ACTUAL, SWAP, LARGEST, DAMPING, LARGE, CONSTANTS = (
    2 * MODEL + k for k in (-MODEL, 0, 9, 15, 17, 18)
)
# The angle by its sine's series, to 1e-17: largest square of the sine, 5.7 deg.
SERIES = 1e-2
# Square of a tool's change (1.1 deg, 6 mm) from which on three matrices leave more than rounding.
LARGE_CHANGE = 4e-4
LANES = 16
# ``rows`` hold so many points, row by row: the joints that came, those corrected, their report.
CAME, GOES, SAID = 0, N, 2 * N
# Then what is worked out: the goal, frames behind each joint, residual and Jacobian at the joints
# that came, the damping, multipliers and shift, and how well that goes.
AIM, FRAMES = SAID + REPORT, SAID + REPORT + 12
TOOL_FRAME = FRAMES + 60
ERROR, JACOBIAN = FRAMES + 72, FRAMES + 78
DAMPED = JACOBIAN + N * N
STEPS, FINE, FOUND = DAMPED + 18, DAMPED + 30, DAMPED + 32
ROWS = FINE + N

# A residual (m, rad) that is left alone.
AT_GOAL = 1e-12
BESIDE = 0.5  # longest second step as a share of the first
# The last matrix was made so near to the solution that its second step, this short, is the last:
# what is left is their product, times a curvature that even beside a singularity is below 1e4.
NEAR, SHORT = 1e-6, 1e-11
FAR = 2.0  # a solution so many times beyond the bound is another posture


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
def serves(c: Array) -> bool:
    """Whether the tool turns within the reach of the series; notes whether its change is large."""
    s, shift = SWAP, 0.0
    for r in range(3):
        x = (c[ACTUAL + TOOL + r] - c[TOOL + r]) * WEIGHT
        shift += x * x
    w0, w1, w2 = c[s + 7] - c[s + 5], c[s + 2] - c[s + 6], c[s + 3] - c[s + 1]
    sine = 0.25 * (w0 * w0 + w1 * w1 + w2 * w2)
    c[LARGE] = 1.0 if sine + shift > LARGE_CHANGE else 0.0
    return bool((sine <= SERIES) & (c[s] + c[s + 4] + c[s + 8] >= 1.0))


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
    f0 = frame(c, at + ROOT, 1)
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
    tail = square * (231.0 / 13312.0 + square * (143.0 / 10240.0))
    tail = square * (105.0 / 3456.0 + square * (945.0 / 42240.0 + tail))
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
def _factor(there: Rows, at: Rows, P: Nine, R: Nine) -> BlockFactor:
    """Factor the matrix of a step, J' J^T + D."""
    a, b, c, d, e, f = there
    p, q, r, s, t, u = at
    upper, lower = _product(a, b, c, s, t, u), _product(d, e, f, p, q, r)
    first = inverse(total(_product(a, b, c, p, q, r), 1.0, P))
    turn = total(_product(d, e, f, s, t, u), 1.0, R)
    return first, inverse(total(turn, -1.0, times(times(lower, first), upper))), upper, lower


@lean
def _step(factor: BlockFactor, e: Six) -> Six:
    """Step of the multipliers for what is left."""
    first, second, upper, lower = factor
    p = on(first, e[0], e[1], e[2])
    w = on(lower, p[0], p[1], p[2])
    w = on(second, e[3] - w[0], e[4] - w[1], e[5] - w[2])
    u = on(upper, w[0], w[1], w[2])
    p = on(first, e[0] - u[0], e[1] - u[1], e[2] - u[2])
    return p[0], p[1], p[2], w[0], w[1], w[2]


@lean
def _joints(J: Rows, y: Six) -> Six:
    """J^T y."""
    a, b, c, d, e, f = J
    x = more(more((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), y[0], a), y[1], b)
    return more(more(more(more(x, y[2], c), y[3], d), y[4], e), y[5], f)


@lean
def six(rows: Array, first: int, lanes: int) -> Six:
    """Six numbers of a point, from the place ``first`` on: those of ``lanes`` stand in a row."""
    return (
        rows[first], rows[first + lanes], rows[first + 2 * lanes],
        rows[first + 3 * lanes], rows[first + 4 * lanes], rows[first + 5 * lanes],
    )  # fmt: skip


@lean
def put(x: Six, rows: Array, first: int, lanes: int) -> None:
    """Keep them there."""
    rows[first], rows[first + lanes], rows[first + 2 * lanes] = x[0], x[1], x[2]
    rows[first + 3 * lanes], rows[first + 4 * lanes] = x[3], x[4]
    rows[first + 5 * lanes] = x[5]


@lean
def _nine(rows: Array, first: int, lanes: int) -> Nine:
    a, b, c, d, e, f = six(rows, first, lanes)
    g = first + 6 * lanes
    return a, b, c, d, e, f, rows[g], rows[g + lanes], rows[g + 2 * lanes]


@lean
def _put_nine(m: Nine, rows: Array, first: int, lanes: int) -> None:
    put((m[0], m[1], m[2], m[3], m[4], m[5]), rows, first, lanes)
    g = first + 6 * lanes
    rows[g], rows[g + lanes], rows[g + 2 * lanes] = m[6], m[7], m[8]


@lean
def frame(rows: Array, first: int, lanes: int) -> Frame:
    """A frame of a point, from the place ``first`` on."""
    x0, x1, x2, y0, y1, y2 = six(rows, first, lanes)
    z0, z1, z2, p0, p1, p2 = six(rows, first + N * lanes, lanes)
    return x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2


@lean
def _put_frame(f: Frame, rows: Array, first: int, lanes: int) -> None:
    put((f[0], f[1], f[2], f[3], f[4], f[5]), rows, first, lanes)
    put((f[6], f[7], f[8], f[9], f[10], f[11]), rows, first + N * lanes, lanes)


@lean
def frames_found(c: Array, rows: Array, k: int, lanes: int) -> Frames:
    """Frames of the actual arm at the joints found for point ``k`` of ``lanes``."""
    at, each = FRAMES * lanes + k, 12 * lanes
    return (
        frame(c, ACTUAL + ROOT, 1), frame(rows, at, lanes), frame(rows, at + each, lanes),
        frame(rows, at + 2 * each, lanes), frame(rows, at + 3 * each, lanes),
        frame(rows, at + 4 * each, lanes), frame(rows, at + 5 * each, lanes),
    )  # fmt: skip


@lean
def _put_frames(f: Frames, rows: Array, k: int, lanes: int) -> None:
    at, each = FRAMES * lanes + k, 12 * lanes
    _put_frame(f[1], rows, at, lanes)
    _put_frame(f[2], rows, at + each, lanes)
    _put_frame(f[3], rows, at + 2 * each, lanes)
    _put_frame(f[4], rows, at + 3 * each, lanes)
    _put_frame(f[5], rows, at + 4 * each, lanes)
    _put_frame(f[6], rows, at + 5 * each, lanes)


@lean
def put_sizes(e: Six, rows: Array, shift: int, turn: int, k: int, lanes: int) -> None:
    """Keep the sizes of a twist of point ``k`` in two rows."""
    rows[shift * lanes + k] = np.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    rows[turn * lanes + k] = np.sqrt(e[3] * e[3] + e[4] * e[4] + e[5] * e[5])


# What is worked out of a point stays in its rows, so that all pairs of steps are one loop: written
# one after the other, they would take the compiler half a minute.


@lean
def _begin(c: Array, rows: Array, k: int, lanes: int) -> None:
    """Residual, goal, frames and Jacobian of point ``k`` at the joints that came; the damping."""
    q = six(rows, CAME * lanes + k, lanes)
    aim, frames = goal(c, q), walk(c, ACTUAL, q)
    error, near = residual(aim, frames[6])
    fine = near & turns_little(c, 0, q) & turns_little(c, ACTUAL, q)
    J = _rows(c, frames)
    r, s, t, u, v, w = J
    A, B, C = _product(r, s, t, r, s, t), _product(r, s, t, u, v, w), _product(u, v, w, u, v, w)
    P, R, weak = damping(A, B, C, weighed(error), c[DAMPING], c[DAMPING + 1])
    put(error, rows, ERROR * lanes + k, lanes)
    _put_frame(aim, rows, AIM * lanes + k, lanes)
    _put_frames(frames, rows, k, lanes)
    at, each = JACOBIAN * lanes + k, N * lanes
    put(J[0], rows, at, lanes)
    put(J[1], rows, at + each, lanes)
    put(J[2], rows, at + 2 * each, lanes)
    put(J[3], rows, at + 3 * each, lanes)
    put(J[4], rows, at + 4 * each, lanes)
    put(J[5], rows, at + 5 * each, lanes)
    _put_nine(P, rows, DAMPED * lanes + k, lanes)
    _put_nine(R, rows, (DAMPED + 9) * lanes + k, lanes)
    zero = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    put(zero, rows, STEPS * lanes + k, lanes)
    put(zero, rows, (STEPS + N) * lanes + k, lanes)
    put((1.0 if fine else 0.0, weak, 1.0, 0.0, 0.0, 0.0), rows, FINE * lanes + k, lanes)


@lean
def _two_steps(c: Array, rows: Array, k: int, lanes: int, beside: float) -> None:
    """Multipliers, shift and frames of point ``k`` after two steps with one matrix.

    ``beside``: what the second one's square may have besides its share of the first one's.
    """
    at, each = JACOBIAN * lanes + k, N * lanes
    J = (
        six(rows, at, lanes), six(rows, at + each, lanes), six(rows, at + 2 * each, lanes),
        six(rows, at + 3 * each, lanes), six(rows, at + 4 * each, lanes),
        six(rows, at + 5 * each, lanes),
    )  # fmt: skip
    P, R = _nine(rows, DAMPED * lanes + k, lanes), _nine(rows, (DAMPED + 9) * lanes + k, lanes)
    y, x = six(rows, STEPS * lanes + k, lanes), six(rows, (STEPS + N) * lanes + k, lanes)
    q, aim = six(rows, CAME * lanes + k, lanes), frame(rows, AIM * lanes + k, lanes)
    frames = frames_found(c, rows, k, lanes)
    e, near = residual(aim, frames[6])
    factor = _factor(_rows(c, frames), J, P, R)
    y = more(y, 1.0, _step(factor, left(weighed(e), y, P, R)))
    once = _joints(J, y)
    step = more(once, -1.0, x)
    first = dot(step, step)
    e, still = residual(aim, walk(c, ACTUAL, more(q, 1.0, once))[6])
    y = more(y, 1.0, _step(factor, left(weighed(e), y, P, R)))
    x = _joints(J, y)
    step = more(x, -1.0, once)
    second = dot(step, step)
    _put_frames(walk(c, ACTUAL, more(q, 1.0, x)), rows, k, lanes)
    put(y, rows, STEPS * lanes + k, lanes)
    put(x, rows, (STEPS + N) * lanes + k, lanes)
    found, good = FOUND * lanes + k, near & still & (second <= BESIDE * BESIDE * first + beside)
    rows[found] = rows[found] if good else 0.0
    rows[found + lanes], rows[found + 2 * lanes] = first, second


@lean
def _end(c: Array, rows: Array, k: int, lanes: int) -> None:
    """Keep the corrected joints of point ``k`` and their report."""
    fine, weak, found, first, second, _ = six(rows, FINE * lanes + k, lanes)
    solved = (found > 0.5) & (first <= NEAR * NEAR) & (second <= SHORT * SHORT)
    x, error = six(rows, (STEPS + N) * lanes + k, lanes), six(rows, ERROR * lanes + k, lanes)
    aim, end = frame(rows, AIM * lanes + k, lanes), frame(rows, TOOL_FRAME * lanes + k, lanes)
    last, _ = residual(aim, end)
    # of no more than this nothing is left to do, and nothing is done
    still = dot(error, error) <= AT_GOAL * AT_GOAL * N
    solved &= within(c, x, FAR)
    x = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0) if still else x
    put(more(six(rows, CAME * lanes + k, lanes), 1.0, x), rows, GOES * lanes + k, lanes)
    last = error if still else last
    put_sizes(last, rows, SAID + POSITION_ERROR, SAID + ROTATION_ERROR, k, lanes)
    put_sizes(error, rows, SAID + TCP_SHIFT, SAID + TCP_ROTATION, k, lanes)
    rows[(SAID + ITERATIONS) * lanes + k] = 0.0 if still else 3.0 + c[LARGE]
    rows[(SAID + CONVERGED) * lanes + k] = 1.0 if (fine > 0.5) & (solved | still) else 0.0
    rows[(SAID + WEAK) * lanes + k] = 0.0 if still | (weak <= 0.0) else 1.0


@inlined
def _correct(c: Array, rows: Array, lanes: int) -> None:
    for k in range(lanes):
        _begin(c, rows, k, lanes)
    for i in range(4 if c[LARGE] > 0.5 else 3):
        beside = 0.0 if i == 0 else np.inf
        for k in range(lanes):
            _two_steps(c, rows, k, lanes, beside)
    for k in range(lanes):
        _end(c, rows, k, lanes)


@kernel
def correct(c: Array, rows: Array, lanes: int) -> None:
    """Corrected joints of one point or sixteen, and their reports."""
    if lanes == 1:
        _correct(c, rows, 1)
    else:
        _correct(c, rows, LANES)
