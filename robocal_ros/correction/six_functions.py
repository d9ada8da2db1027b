# SPDX-License-Identifier: Apache-2.0
"""Compiled joint functions and winding under load of six turning joints, as in `six_axis`.

``rows`` (ROWS * lanes,) hold so many points, row by row, from the joints given to those corrected:
`turn` puts a reference model's functions on before `six_axis`, and those of the actual model are
taken off behind. A model's load stands in the constants behind those of `six_axis`. See
`kinematics.kernels` for the equations, which these are without a branch.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction import six_axis
from robocal_ros.correction.damping import (
    CONVERGED,
    TCP_ROTATION,
    TCP_SHIFT,
    Six,
    Three,
    along,
    cross,
    dot,
    more,
    product,
)
from robocal_ros.correction.six_axis import (
    ACTUAL,
    AIM,
    CAME,
    GOES,
    LANES,
    SAID,
    Frame,
    Frames,
    N,
    put,
    put_sizes,
    six,
)
from robocal_ros.ground.compiled import inlined, kernel, lean
from robocal_ros.kinematics.kernels import CENTRE, COMPLIANCE, MASS, spline

Array = NDArray[np.float64]
Vectors = tuple[Three, Three, Three, Three, Three, Three]

# of a model's load: gravity, then six for each joint: what its link weighs, that times its centre
# in the frame that `six_axis` walks to, what all from there on weighs, and the compliance
CARRIED, PLIES, EACH = 4, 5, 6
LOAD = 3 + EACH * N
LOADS = six_axis.CONSTANTS
CONSTANTS = LOADS + 2 * LOAD

# Rows behind those of `six_axis`: joints given, of which a rigid reference arm reads those that
# come there; where the tool must go; how far load winds the actual arm at the joints given, and at
# those tried, with value and slope of their functions; squares of the step under load, of how that
# changed the load, and of the step behind it.
GIVEN = six_axis.ROWS
WINDS, WOUND, TRIED, VALUE, SLOPE, STEPS = (GIVEN + N * k for k in range(1, 7))
ROWS = STEPS + 3
# Squares (rad^2): the longest last steps, whose own squares are rounding, and what load may leave
# of them: of a step the square of the share by which it changed the load, of that behind it that.
UNDER_LOAD, BEHIND, LEFT = 1e-5**2, 1e-9**2, 1e-12**2


@lean
def loads(layer: Array, tool: Array, at: int, out: Array) -> None:
    """A model's load from its ``layer`` (see `SerialArm.layer`), with the tool walked to."""
    carried = layer[N, MASS]
    for r in range(3):
        out[at + r] = layer[N, r]
    for i in range(N - 1, -1, -1):
        each, mass = at + 3 + EACH * i, layer[i, MASS]
        for r in range(3):
            out[each + 1 + r] = mass * layer[i, CENTRE + r]
        if i == N - 1:
            mass += layer[N, MASS]
            for r in range(3):
                out[each + 1 + r] += layer[N, MASS] * layer[N, CENTRE + r] - mass * tool[r, 3]
        carried += layer[i, MASS]
        out[each], out[each + CARRIED], out[each + PLIES] = mass, carried, layer[i, COMPLIANCE]


@lean
def splines(layer: Array, rows: Array, at: int, lanes: int) -> None:
    """Values and slopes of the functions at the joints from row ``at`` on."""
    for i in range(N):
        for k in range(lanes):
            value, slope = spline(layer[i], rows[(at + i) * lanes + k])
            rows[(VALUE + i) * lanes + k], rows[(SLOPE + i) * lanes + k] = value, 1.0 + slope


@lean
def _with_link(moment: Three, c: Array, each: int, f: Frame) -> Three:
    """Add the moment of a link, in the frame behind its joint."""
    m, x, y, z = c[each], c[each + 1], c[each + 2], c[each + 3]
    return (
        moment[0] + (m * f[9] + x * f[0] + y * f[3] + z * f[6]),
        moment[1] + (m * f[10] + x * f[1] + y * f[4] + z * f[7]),
        moment[2] + (m * f[11] + x * f[2] + y * f[5] + z * f[8]),
    )


@lean
def _swept(moment: Three, mass: float, sign: float, f: Frame) -> tuple[Three, Three]:
    """A joint's axis, and how the moment of all that it carries moves with it."""
    axis = sign * f[6], sign * f[7], sign * f[8]
    return axis, cross(axis, along(moment, -mass, (f[9], f[10], f[11])))


@lean
def _carried(c: Array, at: int, load: int, f: Frames) -> tuple[Vectors, Vectors]:
    """Each joint's axis, and how the moment of what it carries moves with it."""
    i, s = load + 3, at + 7
    g, h, j, k, m = i + EACH, i + 2 * EACH, i + 3 * EACH, i + 4 * EACH, i + 5 * EACH
    moment = _with_link((0.0, 0.0, 0.0), c, m, f[6])
    a5, w5 = _swept(moment, c[m + CARRIED], c[s + 45], f[5])
    moment = _with_link(moment, c, k, f[5])
    a4, w4 = _swept(moment, c[k + CARRIED], c[s + 36], f[4])
    moment = _with_link(moment, c, j, f[4])
    a3, w3 = _swept(moment, c[j + CARRIED], c[s + 27], f[3])
    moment = _with_link(moment, c, h, f[3])
    a2, w2 = _swept(moment, c[h + CARRIED], c[s + 18], f[2])
    moment = _with_link(moment, c, g, f[2])
    a1, w1 = _swept(moment, c[g + CARRIED], c[s + 9], f[1])
    moment = _with_link(moment, c, i, f[1])
    a0, w0 = _swept(moment, c[i + CARRIED], c[s], f[0])
    return (a0, a1, a2, a3, a4, a5), (w0, w1, w2, w3, w4, w5)


@lean
def _yields(c: Array, load: int, torque: Six) -> Six:
    """Turns of the joints under torques."""
    i = load + 3 + PLIES
    return (
        c[i] * torque[0], c[i + EACH] * torque[1], c[i + 2 * EACH] * torque[2],
        c[i + 3 * EACH] * torque[3], c[i + 4 * EACH] * torque[4], c[i + 5 * EACH] * torque[5],
    )  # fmt: skip


@lean
def _wound(c: Array, load: int, w: Vectors) -> Six:
    """How far gravity winds each joint."""
    g = c[load], c[load + 1], c[load + 2]
    torque = (
        product(g, w[0]), product(g, w[1]), product(g, w[2]),
        product(g, w[3]), product(g, w[4]), product(g, w[5]),
    )  # fmt: skip
    return _yields(c, load, torque)


@lean
def _wound_by(c: Array, load: int, a: Vectors, w: Vectors, x: Six) -> Six:
    """How that changes with a small shift of the joints: what a joint carries turns with all."""
    g = c[load], c[load + 1], c[load + 2]
    b0 = along((0.0, 0.0, 0.0), x[0], a[0])
    b1 = along(b0, x[1], a[1])
    b2 = along(b1, x[2], a[2])
    b3 = along(b2, x[3], a[3])
    b4 = along(b3, x[4], a[4])
    b5 = along(b4, x[5], a[5])
    v4 = along((0.0, 0.0, 0.0), x[5], w[5])
    v3 = along(v4, x[4], w[4])
    v2 = along(v3, x[3], w[3])
    v1 = along(v2, x[2], w[2])
    v0 = along(v1, x[1], w[1])
    torque = (
        product(g, cross(b0, w[0])) + product(g, cross(a[0], v0)),
        product(g, cross(b1, w[1])) + product(g, cross(a[1], v1)),
        product(g, cross(b2, w[2])) + product(g, cross(a[2], v2)),
        product(g, cross(b3, w[3])) + product(g, cross(a[3], v3)),
        product(g, cross(b4, w[4])) + product(g, cross(a[4], v4)),
        product(g, cross(b5, w[5])),
    )
    return _yields(c, load, torque)


@lean
def _turn(c: Array, rows: Array, k: int, lanes: int) -> None:
    """What a rigid reference arm would read."""
    q = six(rows, GIVEN * lanes + k, lanes)
    _, w = _carried(c, 0, LOADS, six_axis.walk(c, 0, q))
    turned = more(more(q, 1.0, six(rows, VALUE * lanes + k, lanes)), 1.0, _wound(c, LOADS, w))
    put(turned, rows, CAME * lanes + k, lanes)


@lean
def _wind(c: Array, rows: Array, k: int, lanes: int) -> None:
    """How far load winds the actual arm at the joints given, and at those that `six_axis` found."""
    load = LOADS + LOAD
    w = _carried(c, ACTUAL, load, six_axis.walk(c, ACTUAL, six(rows, GIVEN * lanes + k, lanes)))[1]
    put(_wound(c, load, w), rows, WINDS * lanes + k, lanes)
    w = _carried(c, ACTUAL, load, six_axis.frames_found(c, rows, k, lanes))[1]
    put(_wound(c, load, w), rows, WOUND * lanes + k, lanes)


@lean
def _shift(c: Array, rows: Array, k: int, lanes: int) -> None:
    """The error at the tool without a correction: that of the true arms."""
    turned = more(six(rows, GIVEN * lanes + k, lanes), 1.0, six(rows, VALUE * lanes + k, lanes))
    here = six_axis.walk(c, ACTUAL, more(turned, 1.0, six(rows, WINDS * lanes + k, lanes)))[6]
    e, near = six_axis.residual(six_axis.frame(rows, AIM * lanes + k, lanes), here)
    put_sizes(e, rows, SAID + TCP_SHIFT, SAID + TCP_ROTATION, k, lanes)
    at = (SAID + CONVERGED) * lanes + k
    rows[at] = rows[at] if near else 0.0


@lean
def _towards(q: Six, wound: Six, rows: Array, k: int, lanes: int) -> Six:
    """A step from joints ``q`` that load winds so far, with the functions alone."""
    turned = more(more(q, 1.0, six(rows, VALUE * lanes + k, lanes)), 1.0, wound)
    x = more(six(rows, GOES * lanes + k, lanes), -1.0, turned)
    y = six(rows, SLOPE * lanes + k, lanes)
    return x[0] / y[0], x[1] / y[1], x[2] / y[2], x[3] / y[3], x[4] / y[4], x[5] / y[5]


@lean
def _try(rows: Array, at: int, k: int, lanes: int) -> float:
    """A step from joints ``at`` that load does not notice; its square."""
    q = six(rows, at * lanes + k, lanes)
    step = _towards(q, six(rows, WOUND * lanes + k, lanes), rows, k, lanes)
    put(more(q, 1.0, step), rows, TRIED * lanes + k, lanes)
    return dot(step, step)


@lean
def _step(c: Array, rows: Array, k: int, lanes: int) -> None:
    """A step towards the joints of which a rigid arm reads what is wanted, and the load there."""
    q, load = six(rows, TRIED * lanes + k, lanes), LOADS + LOAD
    a, w = _carried(c, ACTUAL, load, six_axis.walk(c, ACTUAL, q))
    wound = _wound(c, load, w)
    step = _towards(q, wound, rows, k, lanes)
    # a share of it is what the arm turns for the load's change, a share of that for its change
    change = _wound_by(c, load, a, w, more(step, -1.0, _wound_by(c, load, a, w, step)))
    put(more(more(q, 1.0, step), -1.0, change), rows, TRIED * lanes + k, lanes)
    put(more(wound, 1.0, change), rows, WOUND * lanes + k, lanes)
    rows[STEPS * lanes + k] = dot(step, step)
    rows[(STEPS + 1) * lanes + k] = dot(change, change)


@lean
def _end(rows: Array, k: int, lanes: int) -> None:
    """The last step, and the joints found, if they are."""
    behind = _try(rows, TRIED, k, lanes)
    at, steps = (SAID + CONVERGED) * lanes + k, STEPS * lanes + k
    step, change = rows[steps], rows[steps + lanes]
    small = (step <= UNDER_LOAD) & (behind <= BEHIND)
    small &= (change * change * change <= LEFT * step * step) & (change * behind <= LEFT * step)
    rows[at] = rows[at] if small else 0.0
    put(six(rows, TRIED * lanes + k, lanes), rows, GOES * lanes + k, lanes)


@inlined
def _turn_all(c: Array, layer: Array, rows: Array, lanes: int) -> None:
    splines(layer, rows, GIVEN, lanes)
    for k in range(lanes):
        _turn(c, rows, k, lanes)


@kernel
def turn(c: Array, layer: Array, rows: Array, lanes: int) -> None:
    """What a rigid reference arm would read at the joints given, of one point or sixteen."""
    if lanes == 1:
        _turn_all(c, layer, rows, 1)
    else:
        _turn_all(c, layer, rows, LANES)


@inlined
def _read(c: Array, layer: Array, rows: Array, lanes: int) -> None:
    for k in range(lanes):
        _wind(c, rows, k, lanes)
    splines(layer, rows, GIVEN, lanes)
    for k in range(lanes):
        _shift(c, rows, k, lanes)
    splines(layer, rows, GOES, lanes)
    for k in range(lanes):
        _try(rows, GOES, k, lanes)
    splines(layer, rows, TRIED, lanes)
    for k in range(lanes):
        _step(c, rows, k, lanes)
    splines(layer, rows, TRIED, lanes)
    for k in range(lanes):
        _end(rows, k, lanes)


@kernel
def read(c: Array, layer: Array, rows: Array, lanes: int) -> None:
    """Joints of what `six_axis` found, and the shift at the tool of the true arms."""
    if lanes == 1:
        _read(c, layer, rows, 1)
    else:
        _read(c, layer, rows, LANES)
