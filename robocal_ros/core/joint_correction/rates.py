"""Compiled rates of the joint correction: velocities and accelerations by the chain rule."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import kernel
from robocal_ros.core.joint_correction import kernels as k
from robocal_ros.core.kinematics.kernels import walk

Array = NDArray[np.float64]


@kernel
def _bias(links: Array, frames: Array, T: Array, qd: Array, rate: Array, out: Array) -> None:
    """Twist ``rate`` (6,) at the origin of ``T``, and its derivative ``out`` at constant ``qd``."""
    w0, w1, w2 = 0.0, 0.0, 0.0
    v0, v1, v2 = 0.0, 0.0, 0.0
    b0, b1, b2 = 0.0, 0.0, 0.0  # derivative of w
    a0, a1, a2 = 0.0, 0.0, 0.0  # derivative of v
    p0, p1, p2 = frames[0, 1, 0], frames[0, 1, 1], frames[0, 1, 2]
    for i in range(links.shape[0] + 1):
        if i < links.shape[0]:
            n0, n1, n2 = frames[i, 1, 0], frames[i, 1, 1], frames[i, 1, 2]
        else:
            n0, n1, n2 = T[0, 3], T[1, 3], T[2, 3]
        # carry v and its derivative along the link to the next joint's point
        r0, r1, r2 = n0 - p0, n1 - p1, n2 - p2
        c0, c1, c2 = w1 * r2 - w2 * r1, w2 * r0 - w0 * r2, w0 * r1 - w1 * r0
        v0, v1, v2 = v0 + c0, v1 + c1, v2 + c2
        a0 += b1 * r2 - b2 * r1 + w1 * c2 - w2 * c1
        a1 += b2 * r0 - b0 * r2 + w2 * c0 - w0 * c2
        a2 += b0 * r1 - b1 * r0 + w0 * c1 - w1 * c0
        p0, p1, p2 = n0, n1, n2
        if i == links.shape[0]:
            break
        speed = links[i, 7] * qd[i]
        z0, z1, z2 = speed * frames[i, 0, 0], speed * frames[i, 0, 1], speed * frames[i, 0, 2]
        d0, d1, d2 = w1 * z2 - w2 * z1, w2 * z0 - w0 * z2, w0 * z1 - w1 * z0
        if links[i, 8] > 0.5:
            v0, v1, v2 = v0 + z0, v1 + z1, v2 + z2
            a0, a1, a2 = a0 + 2.0 * d0, a1 + 2.0 * d1, a2 + 2.0 * d2
        else:
            w0, w1, w2 = w0 + z0, w1 + z1, w2 + z2
            b0, b1, b2 = b0 + d0, b1 + d1, b2 + d2
    rate[0], rate[1], rate[2], rate[3], rate[4], rate[5] = v0, v1, v2, w0, w1, w2
    out[0], out[1], out[2], out[3], out[4], out[5] = a0, a1, a2, b0, b1, b2


@kernel
def _twist(
    q: Array,
    qd: Array,
    qdd: Array,
    model: Array,
    frames: Array,
    poses: Array,
    J: Array,
    v: Array,
    a: Array,
) -> None:
    """Twist ``v`` and its derivative ``a`` at the model's tool, and the rows ``J`` (n, 6)."""
    n = q.shape[0]
    root, tool, T = poses[0], poses[1], poses[2]
    k.pose(model[n], root)
    k.pose(model[n + 1], tool)
    walk(q, model[:n], root, frames, T)
    k.at_tool(T, tool)
    k.columns(model[:n], frames, T, J)
    _bias(model[:n], frames, T, qd, v, a)
    for i in range(n):
        for r in range(6):
            a[r] += J[i, r] * qdd[i]


@kernel
def rates_batch(
    q: Array,
    qd: Array,
    qdd: Array,
    corrected: Array,
    models: Array,
    s: Array,
    velocity: Array,
    acceleration: Array,
) -> None:
    """Joint rates (m, n) at corrected joints: the tool moves as the reference tool does.

    J' qd' = J qd, and its derivative J' qdd' + (dJ'/dt) qd' = J qdd + (dJ/dt) qd, analytically.
    Meaningful where a point was corrected in full; NaN where the pose is singular.
    """
    n = q.shape[1]
    model, frames, poses = np.empty((n + 2, 9)), np.empty((n, 5, 3)), np.empty((3, 4, 4))
    J, L, zero = np.empty((n, 6)), np.empty((n, n)), np.zeros(n)
    v, a, v2, a2 = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    for i in range(q.shape[0]):
        k.blend(models[0], models[1], s[i], model)
        _twist(q[i], qd[i], qdd[i], model, frames, poses, J, v, a)
        k.blend(models[2], models[3], s[i], model)
        _twist(corrected[i], zero, zero, model, frames, poses, J, v2, a2)
        if not k.factor(J, L):
            for j in range(n):
                velocity[i, j], acceleration[i, j] = np.nan, np.nan
            continue
        k.solve(J, L, v, zero, velocity[i])
        _twist(corrected[i], velocity[i], zero, model, frames, poses, J, v2, a2)
        for r in range(6):
            a[r] -= a2[r]
        k.solve(J, L, a, zero, acceleration[i])
