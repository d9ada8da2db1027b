"""Compiled kinematics of six turning joints with single numbers, for `straight`.

Frames are twelve numbers: axes x, y, z and origin. Twists and joints are six. A model's constants
stand in one array, at places that are known when this is compiled.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.compiled import lean
from robocal_ros.kinematics.kernels import reduced_cos_sin

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
