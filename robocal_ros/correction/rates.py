"""Compiled work on corrected points: bounds, and rates by the chain rule or by differences."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.room import Workspace, room_in
from robocal_ros.correction.solution import CONVERGED, TCP_ROTATION, TCP_SHIFT, correct_staged
from robocal_ros.ground.compiled import lean
from robocal_ros.kinematics import newton
from robocal_ros.kinematics.kernels import walk

Array = NDArray[np.float64]

# Where rounding and the fourth derivative weigh alike in an acceleration: some 1e-7 rad/s^2.
RATE_STEP_S = 2e-4
# Where they do in a velocity from one side: some 1e-6 rad/s.
STEP_AHEAD_S = 5e-7
VELOCITY_EXACT = 1e-6  # rad/s, m/s: of a reading's velocity
MOST_STEPS = 20


@lean
def _stand(q: Array, links: Array, root: Array, tool: Array, room: Workspace) -> None:
    """Joint axes, pose ``here`` and Jacobian of a model's tool at joints q."""
    walk(q, links, root, room.turns, room.frames, room.here)
    newton.at_tool(room.here, tool)
    newton.columns(links, room.frames, room.here, room.J)


@lean
def rates_batch(
    q: Array, qd: Array, qdd: Array, corrected: Array, first: Array, last: Array, out_v: Array,
    out_a: Array,
) -> None:  # fmt: skip
    """Joint rates (m, 6) at corrected joints: the tool moves as the reference tool does.

    J' qd' = J qd, and its derivative J' qdd' + (dJ'/dt) qd' = J qdd + (dJ/dt) qd, analytically.
    Meaningful where no direction is weak; NaN where the pose is singular. ``first`` holds the
    reference model, ``last`` the actual one: ``work`` of the first and of the last stage.
    """
    taught, room = room_in(first, q.shape[1]), room_in(last, q.shape[1])
    n, J, L, v, a = q.shape[1], room.J, room.B, room.e, room.spare
    for m in range(q.shape[0]):
        velocity, acceleration = out_v[m], out_a[m]
        _stand(q[m], taught.taught_links, taught.taught_root, taught.taught_tool, room)
        newton.bias(taught.taught_links, room.frames, room.here, qd[m], v, a)
        for i in range(n):
            for r in range(6):
                a[r] += J[i, r] * qdd[m, i]
        _stand(corrected[m], room.links, room.root, room.tool, room)
        if not newton.factor(J, L):
            for i in range(n):
                velocity[i], acceleration[i] = np.nan, np.nan
            continue
        newton.solve(J, L, v, velocity, velocity)
        newton.bias(room.links, room.frames, room.here, velocity, v, room.step)
        for r in range(6):
            a[r] -= room.step[r]
        newton.solve(J, L, a, velocity, acceleration)


@lean
def velocity_by_chain(
    q: Array, qd: Array, corrected: Array, first: Array, last: Array, out: Array
) -> bool:
    """The velocities (6,) of `rates_batch` for one point; whether they are finite."""
    n = q.shape[0]
    taught, room = room_in(first, n), room_in(last, n)
    J, L, v = room.J, room.B, room.e
    _stand(q, taught.taught_links, taught.taught_root, taught.taught_tool, room)
    for r in range(6):
        v[r] = 0.0
        for i in range(n):
            v[r] += J[i, r] * qd[i]
    _stand(corrected, room.links, room.root, room.tool, room)
    if not newton.factor(J, L):
        return False
    newton.solve(J, L, v, out, out)
    size = 0.0
    for i in range(n):
        size += abs(out[i])
    return size < np.inf


@lean
def velocity_by_differences(
    q: Array, velocity: Array, corrected: Array, largest: Array, free: bool, works: Array,
    at: Array, report: Array, out: Array,
) -> None:  # fmt: skip
    """Velocities ``out`` (n,) of the ``corrected`` joints of taught ones ``q`` (n,), anywhere.

    ``at`` (n,) and ``report`` (k, n + 7) are scratch.
    """
    n, h, last = q.shape[0], STEP_AHEAD_S, works.shape[0] - 1
    for j in range(n):
        at[j] = q[j] + velocity[j] * h
    correct_staged(at, largest, free, works, report)
    for j in range(n):
        out[j] = velocity[j] + ((report[last, j] - at[j]) - (corrected[j] - q[j])) / h


@lean
def taught_velocity_by_differences(
    q: Array, velocity: Array, corrected: Array, largest: Array, free: bool, works: Array,
    spare: Array, report: Array, out: Array,
) -> None:  # fmt: skip
    """Velocities ``out`` (n,) of the taught joints ``q``, of those of the corrected ones (n,).

    The shift changes slower than the joints move. ``spare`` (2, n) is scratch.
    """
    n = q.shape[0]
    for j in range(n):
        out[j] = velocity[j]
    for _ in range(MOST_STEPS):
        velocity_by_differences(q, out, corrected, largest, free, works, spare[0], report, spare[1])
        size = 0.0
        for j in range(n):
            miss = velocity[j] - spare[1, j]
            size = max(size, abs(miss))
            out[j] += miss
        if not size > VELOCITY_EXACT:
            return


@lean
def within(q: Array, out: Array, bounds: Array, tcp: Array, offset: Array) -> bool:
    """Whether a point (n,) is solved within all bounds, by ``out`` (k, n + 7); its offset (n,)."""
    n, stages = q.shape[0], out.shape[0]
    fine = out[0, n + TCP_SHIFT] <= tcp[0] and out[0, n + TCP_ROTATION] <= tcp[1]
    for stage in range(stages):
        fine = fine and out[stage, n + CONVERGED] > 0.5
        for j in range(n):
            before = q[j] if stage == 0 else out[stage - 1, j]
            fine = fine and abs(out[stage, j] - before) <= bounds[stage, j]
    for j in range(n):
        offset[j] = out[stages - 1, j] - q[j]
    return fine


@lean
def ordinary(position: Array, most: Array, index: NDArray[np.int64]) -> bool:
    """Whether positions (k,) of joints ``index`` are finite, and none beyond ``most`` (n,)."""
    fine = True
    for i in range(position.shape[0]):
        fine = fine and abs(position[i]) <= most[index[i]]
    return fine
