"""Compiled rates of the joint correction: velocities and accelerations by the chain rule."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import kernel, lean
from robocal_ros.core.joint_correction import kernels as k
from robocal_ros.core.kinematics import newton
from robocal_ros.core.kinematics.kernels import turns_size, walk

Array = NDArray[np.float64]


@lean
def _twist(
    q: Array,
    qd: Array,
    qdd: Array,
    model: Array,
    turns: Array,
    frames: Array,
    poses: Array,
    J: Array,
    v: Array,
    a: Array,
) -> None:
    """Twist ``v`` and its derivative ``a`` at the model's tool, and the rows ``J`` (n, 6)."""
    n = q.shape[0]
    root, tool, T = poses[0], poses[1], poses[2]
    newton.pose(model[n], root)
    newton.pose(model[n + 1], tool)
    walk(q, model[:n], root, turns, frames, T)
    newton.at_tool(T, tool)
    newton.columns(model[:n], frames, T, J)
    newton.bias(model[:n], frames, T, qd, v, a)
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
    model, frames, poses = np.empty((n + 2, 9)), np.empty((n, 2, 3)), np.empty((3, 4, 4))
    turns = np.empty(turns_size(n))
    J, L, zero = np.empty((n, 6)), np.empty((n, n)), np.zeros(n)
    v, a, v2, a2 = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    for i in range(q.shape[0]):
        k.blend(models[0], models[1], s[i], model)
        _twist(q[i], qd[i], qdd[i], model, turns, frames, poses, J, v, a)
        k.blend(models[2], models[3], s[i], model)
        _twist(corrected[i], zero, zero, model, turns, frames, poses, J, v2, a2)
        if not newton.factor(J, L):
            for j in range(n):
                velocity[i, j], acceleration[i, j] = np.nan, np.nan
            continue
        newton.solve(J, L, v, zero, velocity[i])
        _twist(corrected[i], velocity[i], zero, model, turns, frames, poses, J, v2, a2)
        for r in range(6):
            a[r] -= a2[r]
        newton.solve(J, L, a, zero, acceleration[i])
