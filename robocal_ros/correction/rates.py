"""Compiled rates of the joint correction: velocities and accelerations by the chain rule."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import lean
from robocal_ros.core.kinematics import newton
from robocal_ros.core.kinematics.kernels import walk
from robocal_ros.correction.room import Room, room_in, settle

Array = NDArray[np.float64]


@lean
def _stand(q: Array, links: Array, root: Array, tool: Array, room: Room) -> None:
    """Joint axes, pose ``here`` and Jacobian of a model's tool at joints q."""
    walk(q, links, root, room.turns, room.frames, room.here)
    newton.at_tool(room.here, tool)
    newton.columns(links, room.frames, room.here, room.J)


@lean
def rates_at(
    q: Array, qd: Array, qdd: Array, corrected: Array, room: Room, out_v: Array, out_a: Array
) -> None:
    """Rates of one point with settled models, see `rates_batch`."""
    n, J, L, v, a = q.shape[0], room.J, room.L, room.e, room.spare
    _stand(q, room.taught_links, room.taught_root, room.taught_tool, room)
    newton.bias(room.taught_links, room.frames, room.here, qd, v, a)
    for i in range(n):
        for r in range(6):
            a[r] += J[i, r] * qdd[i]
    _stand(corrected, room.links, room.root, room.tool, room)
    if not newton.factor(J, L):
        for i in range(n):
            out_v[i], out_a[i] = np.nan, np.nan
        return
    newton.solve(J, L, v, out_v, out_v)
    newton.bias(room.links, room.frames, room.here, out_v, v, room.spare_twist)
    for r in range(6):
        a[r] -= room.spare_twist[r]
    newton.solve(J, L, a, out_v, out_a)


@lean
def rates_batch(
    q: Array,
    qd: Array,
    qdd: Array,
    corrected: Array,
    models: Array,
    s: Array,
    work: Array,
    velocity: Array,
    acceleration: Array,
) -> None:
    """Joint rates (m, n) at corrected joints: the tool moves as the reference tool does.

    J' qd' = J qd, and its derivative J' qdd' + (dJ'/dt) qd' = J qdd + (dJ/dt) qd, analytically,
    for arms of six joints. Meaningful where a point was corrected in full; NaN where the pose is
    singular. ``work`` is scratch of `room.work_size` numbers.
    """
    room = room_in(work, q.shape[1], False)
    for i in range(q.shape[0]):
        if i == 0 or s[i] != s[i - 1]:
            settle(models, s[i], room)
        rates_at(q[i], qd[i], qdd[i], corrected[i], room, velocity[i], acceleration[i])
