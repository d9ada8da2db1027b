"""Compiled kinematics of serial arms: forward kinematics and Jacobians over many poses.

Every kernel takes ``links`` (n, 9): d, theta, a, cos/sin alpha, cos/sin beta, sign, prismatic
(see ``pack_links``), and walks the chain
``Trans(z, d) Rot(z, theta) Trans(x, a) Rot(x, alpha) Rot(y, beta)`` (Hayati's five-parameter
form) column by column, so that no matrix product is formed. Angles in rad, lengths in m.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.compiled import inlined, kernel, lean
from robocal_ros.kinematics.columns import base_columns, joint_columns, model_columns, tool_columns
from robocal_ros.kinematics.sines import LARGEST_ANGLE, cos_sin, reduced_cos_sin

Array = NDArray[np.float64]
Index = NDArray[np.int64]

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
