"""Compiled solution of the joint correction: one point, or a trajectory.

Most points of six joints are solved by `straight`; the others, and all other arms, here.
``models`` and ``work``: see `room`.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import lean
from robocal_ros.core.kinematics import newton
from robocal_ros.core.kinematics.kernels import walk
from robocal_ros.correction import equations, straight
from robocal_ros.correction import kernels as k
from robocal_ros.correction import straight_kinematics as six
from robocal_ros.correction.room import Room, room_in, settle

Array = NDArray[np.float64]

MOST_ITERATIONS = 10
# How often a step is repeated with the same matrix, from the second one on.
REPEATS = 3
# A step that is at most this share of the one before, with the same matrix: what follows is too.
CALM = 2e-3
# A residual (m, rad) below which one more step with the last matrix reaches the rounding floor.
SMALL_RESIDUAL = 1e-12
# A step (rad, m) that shrinks below the rounding floor by the next one with the same matrix.
FLOOR = 1e-13
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
def _finish(q: Array, free: bool, room: Room, out: Array) -> None:
    """Steps with the last matrix down to the rounding floor."""
    repeats, size = 0, _add_step(free, False, room)
    while size > FLOOR and repeats < REPEATS:
        _moved(q, free, room, out)
        repeats, size = repeats + 1, _add_step(free, False, room)


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
            _finish(q, free, room, out)
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
def _is_straight(largest: Array, free: bool, room: Room) -> bool:
    """Whether the settled models are for `straight`; its constants then."""
    n = room.links.shape[0]
    if free or n != six.N:
        return False
    turning = True
    for i in range(n):
        turning &= room.links[i, 8] < 0.5
        room.constants[six.LARGEST + i] = largest[i]
    taught, tool = room.taught_tool, room.tool
    six.constants(room.taught_links, room.taught_root, taught, taught, 0, room.constants)
    six.constants(room.links, room.root, tool, taught, six.ACTUAL, room.constants)
    return turning


@lean
def _put(q: Array, lane: int, lanes: int, room: Room) -> None:
    """A point becomes one of those that `straight` solves."""
    for i in range(six.N):
        room.came[i * lanes + lane] = q[i]


@lean
def _take_over(room: Room, lane: int, lanes: int, out: Array) -> bool:
    """A point of `straight`, with its report; False where it must be solved here."""
    goes, n = room.goes, six.N
    for i in range(n):
        out[i] = goes[i * lanes + lane]
    out[n + POSITION_ERROR] = goes[straight.POSITION_LEFT * lanes + lane]
    out[n + ROTATION_ERROR] = goes[straight.ROTATION_LEFT * lanes + lane]
    out[n + ITERATIONS], out[n + SHARE] = straight.ITERATIONS, 1.0
    out[n + CONVERGED] = goes[straight.FINE * lanes + lane]
    out[n + TCP_SHIFT] = goes[straight.TCP_SHIFT * lanes + lane]
    out[n + TCP_ROTATION] = goes[straight.TCP_ROTATION * lanes + lane]
    return bool(out[n + CONVERGED] > 0.5)


@lean
def _straight_one(q: Array, room: Room, out: Array) -> bool:
    _put(q, 0, 1, room)
    straight.correct_one(room.constants, room.came, room.goes)
    return _take_over(room, 0, 1, out)


@lean
def _alike(s: Array) -> bool:
    """Whether points can be solved at once: as many as there are lanes, with one blend."""
    same = s.shape[0] == straight.LANES
    for i in range(s.shape[0]):
        same &= s[i] == s[0]
    return bool(same)


@lean
def correct_point(
    q: Array, models: Array, s: float, largest: Array, free: bool, work: Array, out: Array
) -> None:
    """`correct_batch` for one point (n,)."""
    room = room_in(work, q.shape[0], free)
    settle(models, s, room)
    if not (_is_straight(largest, free, room) and _straight_one(q, room, out)):
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
    room, first, is_straight = room_in(work, q.shape[1], free), 0, False
    while first < q.shape[0]:
        if first == 0 or s[first] != s[first - 1]:
            settle(models, s[first], room)
            is_straight = _is_straight(largest, free, room)
        lanes = straight.LANES if _alike(s[first : first + straight.LANES]) else 1
        if is_straight and lanes > 1:
            for lane in range(lanes):
                _put(q[first + lane], lane, lanes, room)
            straight.correct_lanes(room.constants, room.came, room.goes)
        for lane in range(lanes):
            i = first + lane
            if is_straight and lanes > 1:
                solved = _take_over(room, lane, lanes, out[i])
            else:
                solved = is_straight and _straight_one(q[i], room, out[i])
            if not solved:
                _correct(q[i], largest, free, room, out[i])
        first += lanes
