"""Compiled solution of the joint correction: one point, or a trajectory.

``models`` (4, n + 2, 9) are the packed reference and actual model, each at the start and at the
end of a blend. ``work`` is scratch of `work_size` numbers, so that a point allocates nothing.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import lean
from robocal_ros.core.joint_correction import equations
from robocal_ros.core.joint_correction import kernels as k
from robocal_ros.core.kinematics import newton
from robocal_ros.core.kinematics.kernels import turns_size, walk

Array = NDArray[np.float64]

MOST_ITERATIONS = 10
# How often a step is repeated with the same matrix, from the second one on.
REPEATS = 3
# A step that is at most this share of the one before, with the same matrix: what follows is too.
CALM = 2e-3
# A residual (m, rad) below which one more step with the last matrix reaches the rounding floor.
SMALL_RESIDUAL = 1e-12
# A step below which the next one is under the rounding floor (convergence is quadratic).
SMALL_STEP = 1e-9
# Longest second step with the first one's matrix, as a share of the first: in its direction (at
# 0.25 the goal leaves the arm's reach), and in any.
AHEAD, BESIDE = 0.2, 0.5
# A solution this many times beyond the bound is another posture of the arm.
MOST_OVER = 2.0

# What `correct_point` writes after the n joints.
POSITION_ERROR, ROTATION_ERROR, ITERATIONS, CONVERGED, TCP_SHIFT, TCP_ROTATION, SHARE = range(7)
REPORT = 7


class Room(NamedTuple):
    """Where a solution is worked out: parts of ``work``, made once for a batch.

    Attributes
    ----------
    taught, actual : (n + 2, 9) blended models.
    taught_links, links : (n, 9) their joints.
    taught_root, taught_tool, root, tool : their (4, 4) ends, T_base_root and T_flange_tool.
    goal, aim : (4, 4) where the tool must go, and the part of the way there that is gone. Such
        poses have the axes of the flange, their origin is the tool's.
    here : (4, 4) pose of the tool at the joints tried last.
    turns, frames : scratch of `walk`.
    J, L : (n, 6) Jacobian, and the factor for its steps.
    e, spare, spare_twist : (6,) residual to ``aim``, and scratch.
    x, step : (n,) shift of the joints, and its last step.
    """

    taught: Array
    actual: Array
    taught_links: Array
    links: Array
    taught_root: Array
    taught_tool: Array
    root: Array
    tool: Array
    goal: Array
    aim: Array
    here: Array
    turns: Array
    frames: Array
    J: Array
    L: Array
    e: Array
    spare: Array
    spare_twist: Array
    x: Array
    step: Array


def work_size(n: int) -> int:
    """How many scratch numbers a solution for n joints needs."""
    return 18 * (n + 2) + 7 * 16 + 24 * (n // 8 + 1) + 6 * n + 6 * n + max(n, 6) ** 2 + 18 + 2 * n


@lean
def room_in(work: Array, n: int, free: bool) -> Room:
    """Divide ``work``."""
    m = 9 * (n + 2)
    taught, actual, at = work[:m].reshape(n + 2, 9), work[m : 2 * m].reshape(n + 2, 9), 2 * m
    poses, at = work[at : at + 112].reshape(7, 4, 4), at + 112
    turns, at = work[at : at + turns_size(n)], at + turns_size(n)
    frames, at = work[at : at + 6 * n].reshape(n, 2, 3), at + 6 * n
    J, at = work[at : at + 6 * n].reshape(n, 6), at + 6 * n
    size = equations.unknowns(n, free)
    L, at = work[at : at + size * size].reshape(size, size), at + size * size
    twists, at = work[at : at + 18].reshape(3, 6), at + 18
    return Room(
        taught, actual, taught[:n], actual[:n], poses[0], poses[1], poses[2], poses[3], poses[4],
        poses[5], poses[6], turns, frames, J, L, twists[0], twists[1], twists[2],
        work[at : at + n], work[at + n : at + 2 * n],
    )  # fmt: skip


@lean
def settle(models: Array, s: float, room: Room) -> None:
    """Models at blend s, and their ends."""
    n = room.links.shape[0]
    k.blend(models[0], models[1], s, room.taught)
    k.blend(models[2], models[3], s, room.actual)
    newton.pose(room.taught[n], room.taught_root)
    newton.pose(room.taught[n + 1], room.taught_tool)
    newton.pose(room.actual[n], room.root)
    newton.pose(room.actual[n + 1], room.tool)


@lean
def _residual_at(q: Array, free: bool, room: Room) -> float:
    """Residual of the pose at joints q."""
    walk(q, room.links, room.root, room.turns, room.frames, room.here)
    newton.at_tool(room.here, room.tool)
    return equations.residual(room.aim, room.here, room.tool, free, room.e)


@lean
def _moved(q: Array, free: bool, room: Room, out: Array) -> float:
    """Residual of the pose at q + x, which goes to ``out``."""
    n = q.shape[0]
    for i in range(n):
        out[i] = q[i] + room.x[i]
    return _residual_at(out[:n], free, room)


@lean
def _next_step(free: bool, shorten: bool, room: Room) -> None:
    equations.step(room.J, room.L, room.e, room.x, free, shorten, room.spare, room.step)


@lean
def _first_steps(q: Array, largest: Array, free: bool, room: Room, out: Array) -> float:
    """Newton's step and a second one with the same matrix, shortened near a singularity.

    The aim becomes the pose that lies the returned share of the way. The second step tells how
    far the first may be trusted: towards the edge of the reach (where sigma x + kappa x^2 / 2 = e
    has a solution while the second step is at most a quarter of the first, in its direction), and
    where the arm bends too much for Newton's method.
    """
    n, x, step = q.shape[0], room.x, room.step
    _next_step(free, False, room)
    share = k.share(step, largest)
    if share < 1.0:
        k.part_of_the_way(room.here, room.e, share, room.aim)
    for i in range(n):
        x[i] = share * step[i]
    _moved(q, free, room, out)
    _next_step(free, False, room)
    length, second, along = 1e-300, 0.0, 0.0
    for i in range(n):
        length += x[i] * x[i]
        second += step[i] * step[i]
        along += x[i] * step[i]
    trust = min(1.0, AHEAD * length / max(along, 1e-300))
    trust = min(trust, BESIDE * np.sqrt(length / max(second, 1e-300)))
    if trust < 1.0:
        share *= trust
        newton.copy(room.goal, room.aim)
        _residual_at(q, free, room)
        k.part_of_the_way(room.here, room.e, share, room.aim)
    for i in range(n):
        x[i] = trust * x[i] + trust * trust * step[i]
    return share


@lean
def _add_step(free: bool, shorten: bool, room: Room) -> float:
    """One step with a factored matrix; returns its largest component."""
    _next_step(free, shorten, room)
    for i in range(room.x.shape[0]):
        room.x[i] += room.step[i]
    return newton.largest_of(room.step)


@lean
def _take(q: Array, x: Array, largest: Array, converged: bool, out: Array) -> bool:
    """Joints ``q + x``; where that is no solution within reach, the point stays as it came."""
    n = q.shape[0]
    for i in range(n):
        converged = converged and abs(x[i]) <= MOST_OVER * largest[i]
    for i in range(n):
        out[i] = q[i] + x[i] if converged else q[i]
    return converged


@lean
def _newton(q: Array, largest: Array, free: bool, room: Room, out: Array) -> None:
    """Newton's steps from ``q``, whose pose is ``here`` and whose residual is ``e``."""
    n, size = q.shape[0], 0.0
    for i in range(n):
        room.x[i] = 0.0
    # The shortest of many solutions is sought once, in the second iteration: so what is found does
    # not hang on how many there are.
    least = 2 if equations.wide(n, free) else 1
    share, iterations, calm = 1.0, 0, False
    converged = newton.largest_of(room.e) <= SMALL_RESIDUAL
    while not converged and iterations < MOST_ITERATIONS:
        newton.columns(room.links, room.frames, room.here, room.J)
        if not equations.factor(room.J, room.here, room.tool, free, room.L):
            if iterations == 0:
                share, converged = 0.0, True
            break
        if iterations == 0:
            share = _first_steps(q, largest, free, room, out)
            size = newton.largest_of(room.step)
            calm = least == 1 and share == 1.0 and size <= CALM * newton.largest_of(room.x)
        else:
            size = _add_step(free, iterations == 1, room)
        iterations += 1
        converged = _moved(q, free, room, out) <= SMALL_RESIDUAL and iterations >= least
        repeats = 0
        while (calm or iterations > 1) and repeats < REPEATS and not converged:
            # more steps with the same matrix: each raises the order, for little
            repeats, before = repeats + 1, size
            size = _add_step(free, False, room)
            calm = size <= CALM * before
            converged = _moved(q, free, room, out) <= SMALL_RESIDUAL
        if converged or (iterations > 1 and size <= SMALL_STEP):
            _add_step(free, False, room)
            if repeats > 0 and not calm:
                _moved(q, free, room, out)
                _add_step(free, False, room)
            converged = True
        calm = False
    out[n + CONVERGED] = _take(q, room.x, largest, converged, out)
    out[n + ITERATIONS] = iterations
    out[n + SHARE] = share if out[n + CONVERGED] else 0.0


@lean
def _correct(q: Array, largest: Array, free: bool, room: Room, out: Array) -> None:
    """One point with settled models: ``out`` (n + 7), joints, then the report."""
    n, e = q.shape[0], room.e
    walk(q, room.taught_links, room.taught_root, room.turns, room.frames, room.goal)
    newton.at_tool(room.goal, room.taught_tool)
    k.swap_tool(room.goal, room.taught_tool, room.tool)
    newton.copy(room.goal, room.aim)
    _residual_at(q, free, room)
    out[n + TCP_SHIFT], out[n + TCP_ROTATION] = newton.length(e, 0), newton.length(e, 3)
    _newton(q, largest, free, room, out)
    if out[n + SHARE] < 1.0:
        newton.copy(room.goal, room.aim)
        _residual_at(out[:n], free, room)
    out[n + POSITION_ERROR], out[n + ROTATION_ERROR] = newton.length(e, 0), newton.length(e, 3)


@lean
def correct_point(
    q: Array, models: Array, s: float, largest: Array, free: bool, work: Array, out: Array
) -> None:
    """`correct_batch` for one point (n,)."""
    room = room_in(work, q.shape[0], free)
    settle(models, s, room)
    _correct(q, largest, free, room, out)


@lean
def correct_batch(
    q: Array, models: Array, s: Array, largest: Array, free: bool, work: Array, out: Array
) -> None:
    """Joints that put the actual tool where the reference tool is at ``q`` (m, n).

    ``s`` (m,) blends; ``largest`` (n,) bounds the joint shift; ``free``: the turn about the
    tool's z is free. ``out`` (m, n + 7): joints, then the report. See
    `joint_correction.JointCorrection`.
    """
    room = room_in(work, q.shape[1], free)
    for i in range(q.shape[0]):
        if i == 0 or s[i] != s[i - 1]:
            settle(models, s[i], room)
        _correct(q[i], largest, free, room, out[i])
