# SPDX-License-Identifier: Apache-2.0
"""Compiled solution of the joint correction: one point, a point through all stages, or many.

Nearly all points of six turning joints are solved by `six_axis`, with joint functions by
`six_functions`; the others, and all other arms, here.
``work`` holds `work_size` numbers, so that a point allocates nothing; `prepare` puts the models and
the constants of a correction there, once. Equations: see `joint_correction`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction import damping, six_axis, six_functions
from robocal_ros.correction.damping import (
    CONVERGED,
    ITERATIONS,
    POSITION_ERROR,
    REPORT,
    ROTATION_ERROR,
    TCP_ROTATION,
    TCP_SHIFT,
    WEAK,
    Nine,
    Six,
)
from robocal_ros.correction.six_axis import CAME, GOES, LANES, N
from robocal_ros.correction.six_functions import CONSTANTS, GIVEN, ROWS
from robocal_ros.ground.compiled import bare, lean
from robocal_ros.kinematics import newton
from robocal_ros.kinematics.kernels import (
    PER_STEP,
    SCRATCH,
    TURNED,
    read_joints,
    turn_joints,
    turns_size,
    walk,
)

Array = NDArray[np.float64]

MOST_ITERATIONS = 16
# A residual (m, rad) of which nothing is left to do.
SMALL_RESIDUAL = 1e-12
# A step (rad, m) below which the next one with the same matrix ends at the rounding floor.
SMALL_STEP = 1e-7
FINAL_STEPS = 2
# A solution this many times beyond the bound is another posture of the arm.
MOST_OVER = 3.0

# Where rounding and the fourth derivative weigh alike in an acceleration: some 1e-7 rad/s^2.
RATE_STEP_S = 2e-4
# Where they do in a velocity from one side: some 1e-6 rad/s.
STEP_AHEAD_S = 5e-7
VELOCITY_EXACT = 1e-6  # rad/s, m/s: of a reading's velocity
MOST_STEPS = 20
POSES, TWISTS = 6, 4
# of the settings: the damping's steepness and its rise, see `joint_correction` (3); whether
# `six_axis` serves; whether a model has joint functions, and whether the reference model has
STEEPNESS, PER_ERROR, IS_STRAIGHT, TURNS, TAUGHT_TURNS, SETTINGS = range(6)


class SixJoints(NamedTuple):
    """The first parts of ``work``, for `six_axis` and `six_functions`."""

    settings: Array
    constants: Array
    rows: Array  # sixteen points


class Workspace(NamedTuple):
    """Where a solution is worked out otherwise: further parts of ``work``.

    Poses have the axes of the flange, their origin is the tool's.
    """

    taught_links: Array  # (n, 9) joints of the reference model, and of the actual one
    links: Array
    taught_root: Array  # (4, 4) T_base_root and T_flange_tool of both
    taught_tool: Array
    root: Array
    tool: Array
    goal: Array  # (4, 4) where the tool must go, and where it is at the joints tried last
    here: Array
    turns: Array  # scratch of `walk`
    frames: Array
    J: Array  # (n, 6) Jacobian at the taught joints, and at those tried last
    there: Array
    B: Array  # (6, 6) matrix of a step
    e: Array  # (6,) residual, step of the multipliers, and scratch
    step: Array
    spare: Array
    order: Array
    x: Array  # (n,) shift of the joints
    settings: Array
    taught_layer: Array  # (n + 1, w) joint functions of both models; w is 0 where neither has some
    layer: Array
    scratch: Array  # (n, SCRATCH) of `turn_joints`
    turned: Array  # (n,) what rigid arms would read: the reference one, the actual one
    back: Array


@lean
def work_size(n: int, w: int) -> int:
    """How many scratch numbers a solution needs: n joints, w columns of their functions."""
    many = CONSTANTS + LANES * ROWS
    small = 16 * POSES + 24 * (n // 8 + 1) + 36 + 6 * TWISTS + SETTINGS
    return (18 + 18 + 1 + SCRATCH + 2) * n + small + many + 2 * (n + 1) * w


@lean
def six_in(work: Array) -> SixJoints:
    """Divide the beginning of ``work``, at places that are known when this is compiled."""
    first, rows = SETTINGS + CONSTANTS, SETTINGS + CONSTANTS + LANES * ROWS
    return SixJoints(work[:SETTINGS], work[SETTINGS:first], work[first:rows])


@lean
def layers_in(work: Array, n: int) -> tuple[Array, Array]:
    """Joint functions (n + 1, w) of both models, at the end of ``work``."""
    at = work_size(n, 0)
    layers = work[at:].reshape(2, n + 1, (work.shape[0] - at) // (2 * (n + 1)))
    return layers[0], layers[1]


@lean
def room_in(work: Array, n: int) -> Workspace:
    """Divide ``work``. A reshaped part costs some 20 ns: none is made for nothing."""
    at = SETTINGS + CONSTANTS + LANES * ROWS
    links, at = work[at : at + 18 * n].reshape(2, n, 9), at + 18 * n
    poses, at = work[at : at + 16 * POSES].reshape(POSES, 4, 4), at + 16 * POSES
    turns, at = work[at : at + turns_size(n)], at + turns_size(n)
    frames, at = work[at : at + 6 * n].reshape(n, 2, 3), at + 6 * n
    J, at = work[at : at + 12 * n].reshape(2, n, 6), at + 12 * n
    B, at = work[at : at + 36].reshape(6, 6), at + 36
    twists, at = work[at : at + 6 * TWISTS].reshape(TWISTS, 6), at + 6 * TWISTS
    x, at = work[at : at + n], at + n
    scratch, at = work[at : at + SCRATCH * n].reshape(n, SCRATCH), at + SCRATCH * n
    both = work[at : at + 2 * n].reshape(2, n)
    taught_layer, layer = layers_in(work, n)
    return Workspace(
        links[0], links[1], poses[0], poses[1], poses[2], poses[3], poses[4], poses[5],
        turns, frames, J[0], J[1], B, twists[0], twists[1], twists[2], twists[3], x,
        work[:SETTINGS], taught_layer, layer, scratch, both[0], both[1],
    )  # fmt: skip


@bare
def prepare(
    models: Array, largest: Array, steepness: float, per_error: float, free: bool, work: Array
) -> None:
    """Put models (2, n + 2, 9 + w), reference and actual, and the damping's settings into ``work``.

    The last w columns are the joint functions' layers.
    """
    n = models.shape[1] - 2
    room, six, taught_turns = room_in(work, n), six_in(work), False
    newton.copy(models[0, :n, :9], room.taught_links)
    newton.copy(models[1, :n, :9], room.links)
    newton.copy(models[0, : n + 1, 9:], room.taught_layer)
    newton.copy(models[1, : n + 1, 9:], room.layer)
    newton.pose(models[0, n], room.taught_root)
    newton.pose(models[0, n + 1], room.taught_tool)
    newton.pose(models[1, n], room.root)
    newton.pose(models[1, n + 1], room.tool)
    turns = room.layer.shape[1] > 0
    for i in range(n):
        taught_turns = taught_turns or (turns and room.taught_layer[i, PER_STEP] > 0.0)
    six.settings[STEEPNESS], six.settings[PER_ERROR] = steepness, per_error
    six.settings[TURNS] = 1.0 if turns else 0.0
    six.settings[TAUGHT_TURNS] = 1.0 if taught_turns else 0.0
    turning = not free and n == N
    for i in range(n):
        turning = turning and room.links[i, 8] < 0.5
    six.settings[IS_STRAIGHT] = 0.0
    if not turning:
        return
    constants, taught, tool = six.constants, room.taught_tool, room.tool
    for i in range(N):
        constants[six_axis.LARGEST + i] = largest[i]
    constants[six_axis.DAMPING], constants[six_axis.DAMPING + 1] = steepness, per_error
    six_axis.constants(room.taught_links, room.taught_root, taught, taught, 0, constants)
    six_axis.constants(room.links, room.root, tool, taught, six_axis.ACTUAL, constants)
    six.settings[IS_STRAIGHT] = 1.0 if six_axis.serves(constants) else 0.0
    if turns:
        six_functions.loads(room.taught_layer, taught, six_functions.LOADS, constants)
        actual = six_functions.LOADS + six_functions.LOAD
        six_functions.loads(room.layer, tool, actual, constants)


@lean
def _residual_at(q: Array, free: bool, room: Workspace) -> None:
    """Residual ``e`` of the pose ``here`` at joints q + x."""
    for i in range(q.shape[0]):
        room.x[i] += q[i]
    walk(room.x, room.links, room.root, room.turns, room.frames, room.here)
    for i in range(q.shape[0]):
        room.x[i] -= q[i]
    newton.at_tool(room.here, room.tool)
    damping.residual(room.goal, room.here, room.tool, free, room.e)


@lean
def _jacobian(free: bool, room: Workspace, J: Array) -> None:
    """Columns of the Jacobian ``here``, without what is about a free axis."""
    newton.columns(room.links, room.frames, room.here, J)
    for i in range(J.shape[0]):
        for r in range(3):
            J[i, r] *= damping.WEIGHT
    if free:
        z0, z1, z2 = damping.tool_axis(room.here, room.tool)
        for i in range(J.shape[0]):
            about = J[i, 3] * z0 + J[i, 4] * z1 + J[i, 5] * z2
            J[i, 3] -= about * z0
            J[i, 4] -= about * z1
            J[i, 5] -= about * z2


@lean
def _weighed(room: Workspace) -> Six:
    return damping.weighed(six_axis.six(room.e, 0, 1))


@lean
def _damp(room: Workspace) -> tuple[Nine, Nine, float]:
    """Damping P and R for J and the residual at the taught joints; how many directions have it."""
    M, settings = room.B, room.settings
    for r in range(6):
        for c in range(6):
            M[r, c] = 0.0
    damping.add_product(room.J, room.J, M)
    A, B, C = damping.block(M, 0, 0), damping.block(M, 0, 3), damping.block(M, 3, 3)
    return damping.damping(A, B, C, _weighed(room), settings[STEEPNESS], settings[PER_ERROR])


@lean
def _add_step(q: Array, free: bool, room: Workspace, y: Six, P: Nine, R: Nine) -> tuple[Six, float]:
    """Multipliers after a step with the factored matrix, and its largest component in the joints.

    The shift is J^T y.
    """
    size = 0.0
    six_axis.put(damping.left(_weighed(room), y, P, R), room.step, 0, 1)
    damping.substitute(room.B, room.order, room.step)
    y = damping.more(y, 1.0, six_axis.six(room.step, 0, 1))
    for i in range(room.x.shape[0]):
        before = room.x[i]
        room.x[i] = damping.dot(six_axis.six(room.J[i], 0, 1), y)
        size = max(size, abs(room.x[i] - before))
    _residual_at(q, free, room)
    return y, size


@lean
def _newton(q: Array, free: bool, room: Workspace, P: Nine, R: Nine) -> int:
    """Multipliers y and shift x = J^T y with e(q + x) = D y; iterations, 0 where none is found."""
    y = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for iteration in range(1, MOST_ITERATIONS + 1):
        if iteration > 1:
            _jacobian(free, room, room.there)
        damping.fill(P, 0, room.B)
        damping.fill(R, 3, room.B)
        damping.add_product(room.J if iteration == 1 else room.there, room.J, room.B)
        if not damping.eliminate(room.B, room.order):
            return 0
        y, size = _add_step(q, free, room, y, P, R)
        if size <= SMALL_STEP:
            for _ in range(FINAL_STEPS):
                y, _ = _add_step(q, free, room, y, P, R)
            return iteration
        if not size < 10.0:
            return 0
    return 0


@lean
def _correct(q: Array, largest: Array, free: bool, room: Workspace, out: Array) -> None:
    """One point: ``out`` (n + 7), joints, then the report."""
    n, e = q.shape[0], room.e
    walk(q, room.taught_links, room.taught_root, room.turns, room.frames, room.goal)
    newton.at_tool(room.goal, room.taught_tool)
    damping.swap_tool(room.goal, room.taught_tool, room.tool)
    for i in range(n):
        room.x[i] = 0.0
    _residual_at(q, free, room)
    out[n + TCP_SHIFT], out[n + TCP_ROTATION] = newton.length(e, 0), newton.length(e, 3)
    out[n + ITERATIONS], out[n + CONVERGED], out[n + WEAK] = 0.0, 1.0, 0.0
    if newton.largest_of(e) > SMALL_RESIDUAL or not newton.largest_of(e) < np.inf:
        _jacobian(free, room, room.J)
        P, R, count = _damp(room)
        # more than those in which no joint moves the tool
        out[n + WEAK] = 1.0 if count > max(6 - n, 1 if free else 0) else 0.0
        out[n + ITERATIONS] = _newton(q, free, room, P, R)
        fine = out[n + ITERATIONS] > 0.0
        for i in range(n):
            fine = fine and abs(room.x[i]) <= MOST_OVER * largest[i]
        if not fine:
            for i in range(n):
                room.x[i] = 0.0
            _residual_at(q, free, room)
            out[n + CONVERGED] = 0.0
    for i in range(n):
        out[i] = q[i] + room.x[i]
    out[n + POSITION_ERROR], out[n + ROTATION_ERROR] = newton.length(e, 0), newton.length(e, 3)


# Where joints turn otherwise than they read, what a rigid reference arm would read is corrected to
# what a rigid actual one would, and that is read off the joints: of a joint's own function nothing
# is given up, whatever direction is weak.


@lean
def _read(q: Array, free: bool, room: Workspace, out: Array) -> None:
    """Make joints of what a rigid arm would read, in ``out``, and its shift that of the true arms.

    The goal is that of what a rigid reference arm would read at ``q``.
    """
    n, e, back = q.shape[0], room.e, room.back
    turn_joints(q, room.links, room.root, room.layer, room.scratch)
    for i in range(n):
        back[i], room.x[i] = room.scratch[i, TURNED], 0.0
    _residual_at(back, free, room)
    out[n + TCP_SHIFT], out[n + TCP_ROTATION] = newton.length(e, 0), newton.length(e, 3)
    fine = out[n + CONVERGED] > 0.5
    for i in range(n):
        back[i] = out[i]
    if fine:
        fine = read_joints(back, room.links, room.root, room.layer, room.scratch, out[:n])
    if not fine:
        for i in range(n):
            out[i] = q[i]
        out[n + CONVERGED] = 0.0
        out[n + POSITION_ERROR] = out[n + TCP_SHIFT]
        out[n + ROTATION_ERROR] = out[n + TCP_ROTATION]


@bare
def _correct_alone(q: Array, largest: Array, free: bool, work: Array, out: Array) -> None:
    """A point (n,) of any arm, by `_correct`."""
    room = room_in(work, q.shape[0])
    if room.settings[TURNS] < 0.5:
        _correct(q, largest, free, room, out)
        return
    turn_joints(q, room.taught_links, room.taught_root, room.taught_layer, room.scratch)
    for i in range(q.shape[0]):
        room.turned[i] = room.scratch[i, TURNED]
    _correct(room.turned, largest, free, room, out)
    _read(q, free, room, out)


@lean
def _give(q: Array, six: SixJoints, lane: int, lanes: int) -> None:
    """Put a point (n,) where `_solve` takes it from."""
    given = GIVEN if six.settings[TURNS] > 0.5 else CAME
    for i in range(N):
        six.rows[(given + i) * lanes + lane] = q[i]


@lean
def _solve(lanes: int, six: SixJoints, work: Array) -> None:
    """Solve the points of ``lanes`` that were given."""
    constants, rows = six.constants, six.rows
    if six.settings[TURNS] < 0.5:
        six_axis.correct(constants, rows, lanes)
        return
    taught_layer, layer = layers_in(work, N)
    if six.settings[TAUGHT_TURNS] > 0.5:
        six_functions.turn(constants, taught_layer, rows, lanes)
    else:
        for k in range(N * lanes):
            rows[CAME * lanes + k] = rows[GIVEN * lanes + k]
    six_axis.correct(constants, rows, lanes)
    six_functions.read(constants, layer, rows, lanes)


@lean
def _take_over(six: SixJoints, lane: int, lanes: int, out: Array) -> bool:
    """A solved point with its report; False where it must be solved alone."""
    for r in range(N + REPORT):
        out[r] = six.rows[(GOES + r) * lanes + lane]
    return bool(out[N + CONVERGED] > 0.5)


@lean
def _correct_one(q: Array, largest: Array, free: bool, work: Array, out: Array) -> None:
    """A point (n,) of any arm."""
    six, solved = six_in(work), False
    if six.settings[IS_STRAIGHT] > 0.5:
        _give(q, six, 0, 1)
        _solve(1, six, work)
        solved = _take_over(six, 0, 1, out)
    if not solved:
        _correct_alone(q, largest, free, work, out)


@bare
def correct_staged(q: Array, largest: Array, free: bool, works: Array, out: Array) -> None:
    """One point (n,) through k stages with ``works`` (k, size); ``out`` (k, n + 7)."""
    n = q.shape[0]
    for stage in range(works.shape[0]):
        start = q if stage == 0 else out[stage - 1, :n]
        _correct_one(start, largest[stage], free, works[stage], out[stage])


@bare
def correct_batch(q: Array, largest: Array, free: bool, work: Array, out: Array) -> None:
    """Joints that put the actual tool where the reference tool is at ``q`` (m, n).

    ``largest`` (n,) bounds the joint shift; ``free``: the turn about the tool's z is free.
    ``out`` (m, n + 7): joints, then the report.
    """
    six, first = six_in(work), 0
    while six.settings[IS_STRAIGHT] > 0.5 and q.shape[0] - first >= LANES:
        for lane in range(LANES):
            _give(q[first + lane], six, lane, LANES)
        _solve(LANES, six, work)
        for lane in range(LANES):
            if not _take_over(six, lane, LANES, out[first + lane]):
                _correct_alone(q[first + lane], largest, free, work, out[first + lane])
        first += LANES
    for i in range(first, q.shape[0]):
        _correct_one(q[i], largest, free, work, out[i])


@bare
def uncorrect_staged(
    corrected: Array, largest: Array, free: bool, works: Array, steps: int, exact: float,
    out: Array, q: Array,
) -> bool:  # fmt: skip
    """Taught joints ``q`` (n,) of corrected ones, by q <- q' - shift(q); whether that is exact.

    The last step is the one behind which, at the slowest rate so far, no more than ``exact`` is
    left. ``out`` (k, n + 7) is scratch.
    """
    n, before, slowest = corrected.shape[0], 0.0, 0.0
    for i in range(n):
        q[i] = corrected[i]
    for _ in range(steps):
        correct_staged(q, largest, free, works, out)
        size = 0.0
        for i in range(n):
            miss = corrected[i] - out[works.shape[0] - 1, i]
            size = max(size, abs(miss))
            if abs(miss) > exact:
                q[i] += miss
        if before > 0.0:
            slowest = max(slowest, size / before)
        if size <= exact or (before > 0.0 and slowest * size <= exact * (1.0 - slowest)):
            return True
        before = size
    return False


@lean
def _stand(q: Array, links: Array, root: Array, tool: Array, room: Workspace) -> None:
    """Joint axes, pose ``here`` and Jacobian of a model's tool at joints q."""
    walk(q, links, root, room.turns, room.frames, room.here)
    newton.at_tool(room.here, tool)
    newton.columns(links, room.frames, room.here, room.J)


@bare
def rates_at(
    q: Array, qd: Array, qdd: Array, corrected: Array, first: Array, last: Array,
    velocity: Array, acceleration: Array,
) -> bool:  # fmt: skip
    """Joint rates (6,) at corrected joints: the tool moves as the reference tool does.

    J' qd' = J qd, and its derivative J' qdd' + (dJ'/dt) qd' = J qdd + (dJ/dt) qd, analytically.
    Meaningful where no direction is weak; False where the pose is singular, and for joint
    functions. ``first`` holds the reference model, ``last`` the actual one: ``work`` of the first
    and of the last stage.
    """
    n = q.shape[0]
    taught, room = room_in(first, n), room_in(last, n)
    J, L, v, a = room.J, room.B, room.e, room.spare
    if room.settings[TURNS] > 0.5:
        return False
    _stand(q, taught.taught_links, taught.taught_root, taught.taught_tool, room)
    newton.bias(taught.taught_links, room.frames, room.here, qd, v, a)
    for i in range(n):
        for r in range(6):
            a[r] += J[i, r] * qdd[i]
    _stand(corrected, room.links, room.root, room.tool, room)
    if not newton.factor(J, L):
        return False
    newton.solve(J, L, v, velocity, velocity)
    newton.bias(room.links, room.frames, room.here, velocity, v, room.step)
    for r in range(6):
        a[r] -= room.step[r]
    newton.solve(J, L, a, velocity, acceleration)
    return newton.largest_of(velocity) < np.inf


@bare
def rates_batch(
    q: Array, qd: Array, qdd: Array, corrected: Array, first: Array, last: Array, out_v: Array,
    out_a: Array,
) -> None:  # fmt: skip
    """`rates_at` for points (m, 6); NaN where that is False."""
    for m in range(q.shape[0]):
        if not rates_at(q[m], qd[m], qdd[m], corrected[m], first, last, out_v[m], out_a[m]):
            for i in range(q.shape[1]):
                out_v[m, i], out_a[m, i] = np.nan, np.nan


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


@bare
def taught_velocity(
    corrected: Array, velocity: Array, q: Array, largest: Array, free: bool, works: Array,
    back: Array, report: Array, spare: Array, out: Array,
) -> None:  # fmt: skip
    """Velocities ``out`` (n,) of the taught joints ``q``, of those of the corrected ones (n,).

    ``back``: works of the correction with the models exchanged; ``report`` (k, n + 7) and ``spare``
    (3, n) are scratch. By differences the shift changes slower than the joints move.
    """
    n, last, at_q = q.shape[0], works.shape[0] - 1, spare[1]
    correct_staged(q, largest, free, works, report)
    whole = n == 6 and not free
    for stage in range(last + 1):
        whole = whole and report[stage, n + WEAK] == 0.0
    for j in range(n):
        out[j], at_q[j], spare[0, j] = velocity[j], report[last, j], 0.0
    if whole and rates_at(corrected, velocity, spare[0], q, back[0], back[last], out, spare[2]):
        return
    for j in range(n):
        out[j] = velocity[j]
    for _ in range(MOST_STEPS):
        velocity_by_differences(q, out, at_q, largest, free, works, spare[0], report, spare[2])
        size = 0.0
        for j in range(n):
            miss = velocity[j] - spare[2, j]
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
