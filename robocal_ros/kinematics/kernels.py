# SPDX-License-Identifier: Apache-2.0
"""Compiled kinematics of serial arms: forward kinematics and Jacobians over many poses.

Every kernel takes ``links`` (n, 9): d, theta, a, cos/sin alpha, cos/sin beta, sign, prismatic
(see ``pack_links``), and walks the chain
``Trans(z, d) Rot(z, theta) Trans(x, a) Rot(x, alpha) Rot(y, beta)`` (Hayati's five-parameter
form) column by column, so that no matrix product is formed. Angles in rad, lengths in m.
"""

import math

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.compiled import inlined, kernel, lean

# ---- sines --------------------------------------------------------------------------------------


# pi/2 in three parts: the first two have 33 bits, so that n times them is exact for n < 2^20.
_HALF_PI = (
    float.fromhex("0x1.921fb544p+0"),
    float.fromhex("0x1.0b4611a6p-34"),
    2.0222662487959506e-21,
)
LARGEST_ANGLE = 1e6
_S = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(1, 9))
_C = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(2, 9))


@inlined
def reduced_cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine to 2 ulp, without a branch, for angles up to 1e6.

    Taylor series about the nearest multiple of pi/2. Unlike libm's it runs in vector registers,
    ten times faster, and gives the same bits on every machine.
    """
    n = np.rint(angle * (2.0 / np.pi))
    r = ((angle - n * _HALF_PI[0]) - n * _HALF_PI[1]) - n * _HALF_PI[2]
    z = r * r
    odd = z * (_S[4] + z * (_S[5] + z * (_S[6] + z * _S[7])))
    odd = r + r * z * (_S[0] + z * (_S[1] + z * (_S[2] + z * (_S[3] + odd))))
    even = z * (_C[3] + z * (_C[4] + z * (_C[5] + z * _C[6])))
    even = (1.0 - 0.5 * z) + z * z * (_C[0] + z * (_C[1] + z * (_C[2] + even)))
    quarter = n - 4.0 * np.floor(0.25 * n)
    swapped = (quarter == 1.0) | (quarter == 3.0)
    sine, cosine = (even, odd) if swapped else (odd, even)
    return (
        -cosine if (quarter == 1.0) | (quarter == 2.0) else cosine,
        -sine if quarter >= 2.0 else sine,
    )


@inlined
def cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine of any angle."""
    if abs(angle) > LARGEST_ANGLE:
        return np.cos(angle), np.sin(angle)
    return reduced_cos_sin(angle)


# ---- compiled columns of Jacobians, from the axes that a walk along the chain kept --------------
#
# ``J`` (m, 3 or 6, k) holds twists [v; w] in the measuring frame; lengths in m, angles in rad.


Array = NDArray[np.float64]
Index = NDArray[np.int64]


@inlined
def joint_columns(
    links: Array, axes: Array, p0: float, p1: float, p2: float, J: Array, k: int
) -> None:
    """Row ``k`` of a geometric Jacobian: ``axes`` (n, 6) direction and point, p the flange."""
    for i in range(links.shape[0]):
        s = links[i, 7]
        a0, a1, a2 = s * axes[i, 0], s * axes[i, 1], s * axes[i, 2]
        if links[i, 8] > 0.5:
            J[k, 0, i], J[k, 1, i], J[k, 2, i] = a0, a1, a2
            J[k, 3, i], J[k, 4, i], J[k, 5, i] = 0.0, 0.0, 0.0
        else:
            r0, r1, r2 = p0 - axes[i, 3], p1 - axes[i, 4], p2 - axes[i, 5]
            J[k, 0, i], J[k, 1, i] = a1 * r2 - a2 * r1, a2 * r0 - a0 * r2
            J[k, 2, i] = a0 * r1 - a1 * r0
            J[k, 3, i], J[k, 4, i], J[k, 5, i] = a0, a1, a2


@inlined
def _turned_column(
    f: Array, i: int, axis: int, centre: int, p0: float, p1: float, p2: float,
    J: Array, k: int, c: int,
) -> None:  # fmt: skip
    """Column ``c`` of ``J[k]``: velocity of p (and, in six rows, the turn) about an axis."""
    a0, a1, a2 = f[i, axis, 0], f[i, axis, 1], f[i, axis, 2]
    r0, r1, r2 = p0 - f[i, centre, 0], p1 - f[i, centre, 1], p2 - f[i, centre, 2]
    J[k, 0, c] = a1 * r2 - a2 * r1
    J[k, 1, c] = a2 * r0 - a0 * r2
    J[k, 2, c] = a0 * r1 - a1 * r0
    if J.shape[1] == 6:
        J[k, 3, c], J[k, 4, c], J[k, 5, c] = a0, a1, a2


@inlined
def _slide(f: Array, i: int, axis: int, J: Array, k: int, c: int) -> None:
    """Column ``c`` of ``J[k]``, zeroed before: translation along an axis."""
    J[k, 0, c], J[k, 1, c], J[k, 2, c] = f[i, axis, 0], f[i, axis, 1], f[i, axis, 2]


@inlined
def model_columns(slot: Index, frames: Array, T: Array, J: Array, k: int) -> None:
    """Derivatives of the target ``T[k]`` by d, theta, a, alpha, beta; ``slot`` as for a batch."""
    p0, p1, p2 = T[k, 0, 3], T[k, 1, 3], T[k, 2, 3]
    for i in range(slot.shape[0]):
        if slot[i, 0] >= 0:
            _slide(frames, i, 0, J, k, slot[i, 0])
        if slot[i, 1] >= 0:
            _turned_column(frames, i, 0, 1, p0, p1, p2, J, k, slot[i, 1])
        if slot[i, 2] >= 0:
            _slide(frames, i, 2, J, k, slot[i, 2])
        if slot[i, 3] >= 0:
            _turned_column(frames, i, 2, 3, p0, p1, p2, J, k, slot[i, 3])
        if slot[i, 4] >= 0:
            _turned_column(frames, i, 4, 3, p0, p1, p2, J, k, slot[i, 4])


@inlined
def base_columns(T_root: Array, b: int, T: Array, J: Array, k: int) -> None:
    """Derivatives by a shift of the root and a turn about it, six columns from ``b``."""
    r0, r1, r2 = T[k, 0, 3] - T_root[0, 3], T[k, 1, 3] - T_root[1, 3], T[k, 2, 3] - T_root[2, 3]
    J[k, 0, b], J[k, 1, b + 1], J[k, 2, b + 2] = 1.0, 1.0, 1.0
    J[k, 1, b + 3], J[k, 2, b + 3] = -r2, r1
    J[k, 0, b + 4], J[k, 2, b + 4] = r2, -r0
    J[k, 0, b + 5], J[k, 1, b + 5] = -r1, r0
    if J.shape[1] == 6:
        J[k, 3, b + 3], J[k, 4, b + 4], J[k, 5, b + 5] = 1.0, 1.0, 1.0


@inlined
def tool_columns(T_flange: Array, t: int, J: Array, k: int) -> None:
    """Derivatives by the target's place on the flange, three or six columns from ``t``."""
    for r in range(3):
        for c in range(3):
            J[k, r, t + c] = T_flange[r, c]
            if J.shape[1] == 6:
                J[k, 3 + r, t + 3 + c] = T_flange[r, c]


# ---- compiled kinematics of serial arms: forward kinematics and Jacobians over many poses -------


_BLOCK = 256  # poses whose sines are formed at once
_LANES = 8  # joints of one pose whose sines are


def pack_links(mdh: Array, sign: Array, prismatic: NDArray[np.bool_]) -> Array:
    """Constants of each joint for the kernels: (n, 9) from ``mdh`` (n, 5)."""
    d, theta, a, alpha, beta = mdh.T
    trig = (np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta))
    return np.ascontiguousarray(
        np.stack((d, theta, a, *trig, sign, prismatic.astype(np.float64)), axis=1)
    )


@inlined
def _theta(links: Array, i: int, q: float) -> float:
    return float(links[i, 1] if links[i, 8] > 0.5 else links[i, 1] + links[i, 7] * q)


@kernel
def _turn_block(q: Array, first: int, last: int, links: Array, turns: Array) -> None:
    """Rows cos, sin of ``turns`` (3, block * n): of each theta of poses ``first`` to ``last``."""
    n = links.shape[0]
    count = (last - first) * n
    angle, cosine, sine = turns[0], turns[1], turns[2]
    for k in range(last - first):
        for i in range(n):
            angle[k * n + i] = _theta(links, i, q[first + k, i])
    largest = 0.0
    for j in range(count):
        largest = max(largest, abs(angle[j]))
        cosine[j], sine[j] = reduced_cos_sin(angle[j])
    if largest > LARGEST_ANGLE:
        for j in range(count):
            cosine[j], sine[j] = cos_sin(angle[j])


# Frames are carried as twelve numbers: LLVM keeps them in registers, which arrays would prevent.
Frame = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float
]  # columns x, y, z and origin p


@inlined
def _root(T: Array) -> Frame:
    """The columns of a transform."""
    # fmt: off
    return (
        T[0, 0], T[1, 0], T[2, 0], T[0, 1], T[1, 1], T[2, 1],
        T[0, 2], T[1, 2], T[2, 2], T[0, 3], T[1, 3], T[2, 3],
    )
    # fmt: on


@inlined
def _link(links: Array, i: int, q: float, c: float, s: float, frame: Frame) -> Frame:
    """One link but for beta: Trans(z, d) Rot(z, theta) Trans(x, a) Rot(x, alpha).

    ``c``, ``s``: cosine and sine of theta.
    """
    x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2 = frame
    d = links[i, 0] + links[i, 7] * q if links[i, 8] > 0.5 else links[i, 0]
    # fmt: off
    x0, x1, x2, y0, y1, y2 = (
        c * x0 + s * y0, c * x1 + s * y1, c * x2 + s * y2,
        c * y0 - s * x0, c * y1 - s * x1, c * y2 - s * x2,
    )
    a, ca, sa = links[i, 2], links[i, 3], links[i, 4]
    return (
        x0, x1, x2, ca * y0 + sa * z0, ca * y1 + sa * z1, ca * y2 + sa * z2,
        ca * z0 - sa * y0, ca * z1 - sa * y1, ca * z2 - sa * y2,
        p0 + (d * z0 + a * x0), p1 + (d * z1 + a * x1), p2 + (d * z2 + a * x2),
    )
    # fmt: on


@inlined
def _bend(links: Array, i: int, frame: Frame) -> Frame:
    """The rest of a link: Rot(y, beta)."""
    cb, sb = links[i, 5], links[i, 6]
    if sb == 0.0 and cb == 1.0:
        return frame
    x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2 = frame
    # fmt: off
    return (
        cb * x0 - sb * z0, cb * x1 - sb * z1, cb * x2 - sb * z2, y0, y1, y2,
        cb * z0 + sb * x0, cb * z1 + sb * x1, cb * z2 + sb * x2, p0, p1, p2,
    )
    # fmt: on


@inlined
def _store(frame: Frame, T: Array) -> None:
    x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2 = frame
    T[0, 0], T[0, 1], T[0, 2], T[0, 3] = x0, y0, z0, p0
    T[1, 0], T[1, 1], T[1, 2], T[1, 3] = x1, y1, z1, p1
    T[2, 0], T[2, 1], T[2, 2], T[2, 3] = x2, y2, z2, p2
    T[3, 0], T[3, 1], T[3, 2], T[3, 3] = 0.0, 0.0, 0.0, 1.0


@inlined
def _keep_axis(frame: Frame, frames: Array, i: int) -> None:
    frames[i, 0, 0], frames[i, 0, 1], frames[i, 0, 2] = frame[6], frame[7], frame[8]
    frames[i, 1, 0], frames[i, 1, 1], frames[i, 1, 2] = frame[9], frame[10], frame[11]


@inlined
def _keep_link(frame: Frame, frames: Array, i: int) -> None:
    frames[i, 2, 0], frames[i, 2, 1], frames[i, 2, 2] = frame[0], frame[1], frame[2]
    frames[i, 3, 0], frames[i, 3, 1], frames[i, 3, 2] = frame[9], frame[10], frame[11]
    frames[i, 4, 0], frames[i, 4, 1], frames[i, 4, 2] = frame[3], frame[4], frame[5]


@inlined
def turns_size(n: int) -> int:
    """How many scratch numbers `walk` needs for n joints."""
    return _LANES * 3 * ((n + _LANES - 1) // _LANES)


@lean
def _turn_lanes(lanes: Array) -> None:
    """Cosines and sines of eight angles, behind them: with the number known, in one register."""
    for j in range(_LANES):
        c, s = reduced_cos_sin(lanes[j])
        lanes[_LANES + j], lanes[2 * _LANES + j] = c, s


@lean
def _turn(q: Array, links: Array, turns: Array) -> None:
    """Angle, cosine and sine of each theta: for each eight joints eight, eight and eight."""
    n = links.shape[0]
    for i in range(n):
        turns[_lane(i)] = _theta(links, i, q[i])
    for first in range(0, n, _LANES):
        _turn_lanes(turns[3 * first : 3 * (first + _LANES)])
    for i in range(n):
        at = _lane(i)
        if abs(turns[at]) > LARGEST_ANGLE:
            turns[at + _LANES], turns[at + 2 * _LANES] = cos_sin(turns[at])


@inlined
def _lane(i: int) -> int:
    return i + 2 * _LANES * (i // _LANES)


@lean
def walk(q: Array, links: Array, T_root: Array, turns: Array, frames: Array, T_out: Array) -> None:
    """Forward kinematics that keeps each joint's axis.

    ``frames`` (n, 2, 3) receives per joint: z of the joint axis and its point. ``turns`` is
    scratch of `turns_size` numbers.
    """
    _turn(q, links, turns)
    frame = _root(T_root)
    for i in range(links.shape[0]):
        _keep_axis(frame, frames, i)
        at = _lane(i)
        frame = _link(links, i, q[i], turns[at + _LANES], turns[at + 2 * _LANES], frame)
        frame = _bend(links, i, frame)
    _store(frame, T_out)


@kernel
def fk_batch(q: Array, links: Array, T_root: Array, T_out: Array) -> None:
    """Flange poses (m, 4, 4) of joint vectors (m, n)."""
    n = links.shape[0]
    turns = np.empty((3, _BLOCK * n))
    for first in range(0, q.shape[0], _BLOCK):
        last = min(first + _BLOCK, q.shape[0])
        _turn_block(q, first, last, links, turns)
        for k in range(first, last):
            frame = _root(T_root)
            for i in range(n):
                j = (k - first) * n + i
                frame = _link(links, i, q[k, i], turns[1, j], turns[2, j], frame)
                frame = _bend(links, i, frame)
            _store(frame, T_out[k])


@kernel
def jacobian_batch(q: Array, links: Array, T_root: Array, J: Array) -> None:
    """Geometric Jacobians (m, 6, n) of joint vectors (m, n): [v; w] of the flange in base."""
    n = links.shape[0]
    turns, axes = np.empty((3, _BLOCK * n)), np.empty((n, 6))
    for first in range(0, q.shape[0], _BLOCK):
        last = min(first + _BLOCK, q.shape[0])
        _turn_block(q, first, last, links, turns)
        for k in range(first, last):
            frame = _root(T_root)
            for i in range(n):
                axes[i, 0], axes[i, 1], axes[i, 2] = frame[6], frame[7], frame[8]
                axes[i, 3], axes[i, 4], axes[i, 5] = frame[9], frame[10], frame[11]
                j = (k - first) * n + i
                frame = _link(links, i, q[k, i], turns[1, j], turns[2, j], frame)
                frame = _bend(links, i, frame)
            joint_columns(links, axes, frame[9], frame[10], frame[11], J, k)


@inlined
def _carry(T: Array, tools: Array, t: int, T_out: Array, k: int) -> None:
    """``T_out[k]`` = T tools[t]."""
    for r in range(3):
        for c in range(4):
            value = T[r, 3] if c == 3 else 0.0
            for j in range(3):
                value += T[r, j] * tools[t, j, c]
            T_out[k, r, c] = value
    T_out[k, 3, 0], T_out[k, 3, 1], T_out[k, 3, 2], T_out[k, 3, 3] = 0.0, 0.0, 0.0, 1.0


@kernel
def parameter_batch(
    q: Array,
    links: Array,
    T_root: Array,
    tools: Array,
    target: Index,
    slot: Index,
    base_column: int,
    tool_column: Index,
    T_out: Array,
    J: Array,
) -> None:
    """Target poses and their derivatives by model, base and tool parameters.

    ``tools`` (t, 4, 4) T_flange_target; ``target`` (m,) index into it; ``slot`` (n, 5) column of
    each (d, theta, a, alpha, beta) or -1; ``base_column`` first of six columns (translation of
    the root, turn about it, both in the measuring frame) or -1; ``tool_column`` (t,) first of
    three columns (six when ``J`` has six rows) in flange axes, or -1. ``T_out`` (m, 4, 4) is
    T_frame_target; ``J`` (m, 3 or 6, k), zeroed by the caller, is its twist [v; w] at the target.
    """
    n = links.shape[0]
    frames, turns = np.empty((n, 5, 3)), np.empty((3, _BLOCK * n))
    T_flange = np.empty((4, 4))
    for first in range(0, q.shape[0], _BLOCK):
        last = min(first + _BLOCK, q.shape[0])
        _turn_block(q, first, last, links, turns)
        for k in range(first, last):
            frame = _root(T_root)
            for i in range(n):
                _keep_axis(frame, frames, i)
                j = (k - first) * n + i
                frame = _link(links, i, q[k, i], turns[1, j], turns[2, j], frame)
                _keep_link(frame, frames, i)
                frame = _bend(links, i, frame)
            _store(frame, T_flange)
            _carry(T_flange, tools, target[k], T_out, k)
            model_columns(slot, frames, T_out, J, k)
            if base_column >= 0:
                base_columns(T_root, base_column, T_out, J, k)
            if tool_column[target[k]] >= 0:
                tool_columns(T_flange, tool_column[target[k]], J, k)


# ---- joint functions and winding under load: what the joints turn besides what is read ----------
#
# ``layer`` (n + 1, 15 + m), see `SerialArm.layer`: all about a joint in a row, then the payload.
# Four zeros stand on either side of a table's m coefficients: beyond it a function is zero.


PER_STEP, COMPLIANCE, MASS, CENTRE, TABLE = 1, 2, 3, 4, 7
BESIDE = 4
# A joint's row of scratch: axis, a point of it, what of the arm it moves; turned value, its slope.
MOVED, TURNED, SLOPE, SCRATCH = 6, 9, 10, 11
MOST_ROUNDS = 20
EXACT_TURN = 1e-13  # rad, m


@lean
def spline(row: Array, q: float) -> tuple[float, float]:
    """Value and slope of a joint's cubic B-spline, without a branch; zero outside its table."""
    u, last = (q - row[0]) * row[PER_STEP], row.shape[0] - TABLE - 4
    cell = np.floor(u)
    cell = cell if cell > 0.0 else 0.0  # as for NaN
    cell = cell if cell < last else float(last)
    s, k = u - cell, TABLE + int(cell)
    r = 1.0 - s
    c0, c1, c2, c3 = row[k], row[k + 1], row[k + 2], row[k + 3]
    b1, b2 = 4.0 - 3.0 * s * s * (1.0 + r), 4.0 - 3.0 * r * r * (1.0 + s)
    value = (c0 * r * r * r + c1 * b1 + c2 * b2 + c3 * s * s * s) * (1.0 / 6.0)
    rise = 0.5 * ((c3 - c2) * s * s + (c1 - c0) * r * r) + (c2 - c1) * (0.5 + s * r)
    return value, rise * row[PER_STEP]


@lean
def _moved_point(frame: Frame, c0: float, c1: float, c2: float, mass: float, sums: Array) -> None:
    """Add a mass at a point of a frame, and its moment about the base's origin."""
    x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2 = frame
    sums[0] += mass * (p0 + c0 * x0 + c1 * y0 + c2 * z0)
    sums[1] += mass * (p1 + c0 * x1 + c1 * y1 + c2 * z1)
    sums[2] += mass * (p2 + c0 * x2 + c1 * y2 + c2 * z2)


@lean
def _weigh(q: Array, links: Array, T_root: Array, layer: Array, scratch: Array) -> None:
    """Per joint its axis and how the moment of all mass moves with it: their rows of scratch.

    The potential is -g . sum m p: its derivatives by the joints are the torques, its second
    derivatives their change.
    """
    n = links.shape[0]
    frame = _root(T_root)
    for i in range(n):
        row = scratch[i]
        s = links[i, 7]
        row[0], row[1], row[2] = s * frame[6], s * frame[7], s * frame[8]
        row[3], row[4], row[5] = frame[9], frame[10], frame[11]
        c, sine = cos_sin(_theta(links, i, q[i]))
        frame = _bend(links, i, _link(links, i, q[i], c, sine, frame))
        moved = row[MOVED:TURNED]
        moved[0], moved[1], moved[2] = 0.0, 0.0, 0.0
        part = layer[i]
        _moved_point(frame, part[CENTRE], part[CENTRE + 1], part[CENTRE + 2], part[MASS], moved)
        if i == n - 1:
            part = layer[n]
            _moved_point(frame, part[CENTRE], part[CENTRE + 1], part[CENTRE + 2], part[MASS], moved)
    mass, m0, m1, m2 = layer[n, MASS], 0.0, 0.0, 0.0
    for back in range(n):
        i = n - 1 - back
        row = scratch[i]
        mass += layer[i, MASS]
        m0, m1, m2 = m0 + row[MOVED], m1 + row[MOVED + 1], m2 + row[MOVED + 2]
        a0, a1, a2 = row[0], row[1], row[2]
        if links[i, 8] > 0.5:
            row[MOVED], row[MOVED + 1], row[MOVED + 2] = mass * a0, mass * a1, mass * a2
        else:
            r0, r1, r2 = m0 - mass * row[3], m1 - mass * row[4], m2 - mass * row[5]
            row[MOVED], row[MOVED + 1] = a1 * r2 - a2 * r1, a2 * r0 - a0 * r2
            row[MOVED + 2] = a0 * r1 - a1 * r0


@lean
def turn_joints(q: Array, links: Array, T_root: Array, layer: Array, scratch: Array) -> None:
    """What a rigid arm would read at joints ``q`` (n,), and slopes 1 + delta', into ``scratch``."""
    n, bends = links.shape[0], False
    for i in range(n):
        value, slope = spline(layer[i], q[i])
        scratch[i, TURNED], scratch[i, SLOPE] = q[i] + value, 1.0 + slope
        bends = bends or layer[i, COMPLIANCE] > 0.0
    if bends:
        _weigh(q, links, T_root, layer, scratch)
        for i in range(n):
            torque = 0.0
            for r in range(3):
                torque += layer[n, r] * scratch[i, MOVED + r]
            scratch[i, TURNED] += layer[i, COMPLIANCE] * torque


@lean
def read_joints(
    turned: Array, links: Array, T_root: Array, layer: Array, scratch: Array, q: Array
) -> bool:
    """Joints ``q`` (n,) of which `turn_joints` makes ``turned``; False where they are not found.

    Newton's method with the functions' slopes; what is left is of the order of how the load
    changes, a thousandth of it each round.
    """
    n = q.shape[0]
    for i in range(n):
        q[i] = turned[i]
    for _ in range(MOST_ROUNDS):
        turn_joints(q, links, T_root, layer, scratch)
        size = 0.0
        for i in range(n):
            step = (turned[i] - scratch[i, TURNED]) / scratch[i, SLOPE]
            q[i] += step
            size = max(size, abs(step))
        if size <= EXACT_TURN:
            return True
    return False


@kernel
def turned_batch(q: Array, links: Array, T_root: Array, layer: Array, out: Array) -> None:
    """What a rigid arm would read (m, n) at joints (m, n)."""
    scratch = np.empty((q.shape[1], SCRATCH))
    for k in range(q.shape[0]):
        turn_joints(q[k], links, T_root, layer, scratch)
        for i in range(q.shape[1]):
            out[k, i] = scratch[i, TURNED]


@kernel
def turned_jacobian_batch(q: Array, links: Array, T_root: Array, layer: Array, out: Array) -> None:
    """Derivatives (m, n, n) of `turned_batch` by the joints read."""
    n = q.shape[1]
    scratch = np.empty((n, SCRATCH))
    for k in range(q.shape[0]):
        turn_joints(q[k], links, T_root, layer, scratch)
        _weigh(q[k], links, T_root, layer, scratch)
        for i in range(n):
            for j in range(i + 1):
                # d tau_i / d q_j: what joint i moves turns about axis j, or slides with it
                a, w, change = scratch[j], scratch[i], 0.0
                if links[j, 8] < 0.5:
                    change = (
                        layer[n, 0] * (a[1] * w[MOVED + 2] - a[2] * w[MOVED + 1])
                        + layer[n, 1] * (a[2] * w[MOVED] - a[0] * w[MOVED + 2])
                        + layer[n, 2] * (a[0] * w[MOVED + 1] - a[1] * w[MOVED])
                    )
                out[k, i, j] = layer[i, COMPLIANCE] * change
                out[k, j, i] = layer[j, COMPLIANCE] * change
            out[k, i, i] += scratch[i, SLOPE]


@kernel
def read_batch(turned: Array, links: Array, T_root: Array, layer: Array, out: Array) -> int:
    """Joints (m, n) of which `turned_batch` makes ``turned``; of how many they were found."""
    scratch, found = np.empty((turned.shape[1], SCRATCH)), 0
    for k in range(turned.shape[0]):
        if read_joints(turned[k], links, T_root, layer, scratch, out[k]):
            found += 1
    return found
