"""Compiled rates of the joint correction: velocities and accelerations by the chain rule."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import kernel, lean
from robocal_ros.core.joint_correction import kernels as k
from robocal_ros.core.kinematics import newton
from robocal_ros.core.kinematics.kernels import turns_size, walk

Array = NDArray[np.float64]


@lean
def _stand(
    q: Array, model: Array, poses: Array, turns: Array, frames: Array, T: Array, J: Array
) -> None:
    """Joint axes, pose ``T`` and Jacobian rows ``J`` (n, 6) of the model's tool at joints q."""
    n = q.shape[0]
    newton.pose(model[n], poses[0])
    newton.pose(model[n + 1], poses[1])
    walk(q, model[:n], poses[0], turns, frames, T)
    newton.at_tool(T, poses[1])
    newton.columns(model[:n], frames, T, J)


@lean
def _rates_at(
    q: Array, qd: Array, qdd: Array, corrected: Array, taught: Array, actual: Array, poses: Array,
    turns: Array, frames: Array, J: Array, L: Array, twists: Array, out_v: Array, out_a: Array,
) -> None:  # fmt: skip
    """Rates of one point, see `rates_batch`."""
    n, T, v, a = q.shape[0], poses[2], twists[0], twists[1]
    _stand(q, taught, poses, turns, frames, T, J)
    newton.bias(taught[:n], frames, T, qd, v, a)
    for i in range(n):
        for r in range(6):
            a[r] += J[i, r] * qdd[i]
    _stand(corrected, actual, poses, turns, frames, T, J)
    if not newton.factor(J, L):
        for i in range(n):
            out_v[i], out_a[i] = np.nan, np.nan
        return
    newton.solve(J, L, v, out_v, out_v)
    newton.bias(actual[:n], frames, T, out_v, v, twists[2])
    for r in range(6):
        a[r] -= twists[2, r]
    newton.solve(J, L, a, out_v, out_a)


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

    J' qd' = J qd, and its derivative J' qdd' + (dJ'/dt) qd' = J qdd + (dJ/dt) qd, analytically,
    for arms of up to six joints. Meaningful where a point was corrected in full; NaN where the
    pose is singular.
    """
    n = q.shape[1]
    taught, actual = np.empty((n + 2, 9)), np.empty((n + 2, 9))
    poses, turns, frames = np.empty((3, 4, 4)), np.empty(turns_size(n)), np.empty((n, 2, 3))
    J, L, twists = np.empty((n, 6)), np.empty((n, n)), np.empty((3, 6))
    for i in range(q.shape[0]):
        if i == 0 or s[i] != s[i - 1]:
            k.blend(models[0], models[1], s[i], taught)
            k.blend(models[2], models[3], s[i], actual)
        _rates_at(
            q[i], qd[i], qdd[i], corrected[i], taught, actual, poses, turns, frames, J, L, twists,
            velocity[i], acceleration[i],
        )  # fmt: skip
