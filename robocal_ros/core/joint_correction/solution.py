"""Compiled solution of the joint correction: one point, or a trajectory.

``models`` (4, n + 2, 9) are the packed reference and actual model, each at the start and at the
end of a blend. ``work`` is scratch of `work_size` numbers, so that a point allocates nothing.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import kernel
from robocal_ros.core.joint_correction import equations
from robocal_ros.core.joint_correction import kernels as k
from robocal_ros.core.kinematics import newton
from robocal_ros.core.kinematics.kernels import walk

Array = NDArray[np.float64]

MOST_ITERATIONS = 10
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


def work_size(n: int) -> int:
    """How many scratch numbers a solution for n joints needs."""
    return 18 * (n + 2) + 15 * n + 96 + 6 + 6 * n + max(n, 6) ** 2 + 4 * max(n, 6)


@kernel
def _models(work: Array, n: int) -> tuple[Array, Array, Array, int]:
    """Places of the blended reference and actual model and of the joints' frames in ``work``."""
    m = 9 * (n + 2)
    reference, actual = work[:m].reshape(n + 2, 9), work[m : 2 * m].reshape(n + 2, 9)
    return reference, actual, work[2 * m : 2 * m + 15 * n].reshape(n, 5, 3), 2 * m + 15 * n


@kernel
def _aim(
    q: Array,
    reference: Array,
    actual: Array,
    frames: Array,
    root: Array,
    tool: Array,
    spare: Array,
    goal: Array,
) -> None:
    """Where the actual flange's axes and the tool's origin must go; ``root`` and ``tool`` too."""
    n = q.shape[0]
    newton.pose(reference[n], root)
    walk(q, reference[:n], root, frames, goal)
    newton.pose(reference[n + 1], spare)
    newton.at_tool(goal, spare)
    newton.pose(actual[n + 1], tool)
    k.swap_tool(goal, spare, tool)
    newton.pose(actual[n], root)


@kernel
def _residual_at(
    q: Array, x: Array, links: Array, ends: Array, free: bool, frames: Array, out: Array, e: Array
) -> float:
    """Residual of the pose at q + x, which goes to ``out``; ``ends`` as in `_newton`."""
    for i in range(q.shape[0]):
        out[i] = q[i] + x[i]
    walk(out[: q.shape[0]], links, ends[0], frames, ends[3])
    newton.at_tool(ends[3], ends[1])
    return equations.residual(ends[2], ends[3], ends[1], free, e)


@kernel
def _first_steps(
    q: Array, links: Array, ends: Array, largest: Array, free: bool, frames: Array, J: Array,
    L: Array, steps: Array, out: Array, e: Array,
) -> float:  # fmt: skip
    """Newton's step and a second one with the same matrix, shortened near a singularity.

    ``steps[0]`` receives the shift. The goal becomes the pose that lies the returned share of the
    way. The second step tells how far the first may be trusted: towards the edge of the reach
    (where sigma x + kappa x^2 / 2 = e has a solution while the second step is at most a quarter
    of the first, in its direction), and where the arm bends too much for Newton's method.
    """
    n = q.shape[0]
    x, step = steps[0, :n], steps[1, :n]
    equations.step(J, L, e, x, free, False, steps[3, :6], step)
    share = k.share(step, largest)
    for r in range(6):
        steps[2, r] = e[r]
    start = ends[4]
    newton.copy(ends[3], start)
    if share < 1.0:
        k.part_of_the_way(start, steps[2, :6], share, ends[2])
    for i in range(n):
        x[i] = share * step[i]
    _residual_at(q, x, links, ends, free, frames, out, e)
    equations.step(J, L, e, x, free, False, steps[3, :6], step)
    length, second, along = 1e-300, 0.0, 0.0
    for i in range(n):
        length += x[i] * x[i]
        second += step[i] * step[i]
        along += x[i] * step[i]
    trust = min(1.0, AHEAD * length / max(along, 1e-300))
    trust = min(trust, BESIDE * np.sqrt(length / max(second, 1e-300)))
    if trust < 1.0:
        share *= trust
        k.part_of_the_way(start, steps[2, :6], share, ends[2])
    for i in range(n):
        x[i] = trust * x[i] + trust * trust * step[i]
    return share


@kernel
def _add_step(
    J: Array, L: Array, e: Array, free: bool, shorten: bool, steps: Array, x: Array
) -> float:
    """One step with a factored matrix; returns its largest component."""
    step = steps[1, : x.shape[0]]
    equations.step(J, L, e, x, free, shorten, steps[3, :6], step)
    for i in range(x.shape[0]):
        x[i] += step[i]
    return newton.largest_of(step)


@kernel
def _take(q: Array, x: Array, largest: Array, converged: bool, out: Array) -> bool:
    """Joints ``q + x``; where that is no solution within reach, the point stays as it came."""
    n = q.shape[0]
    for i in range(n):
        converged = converged and abs(x[i]) <= MOST_OVER * largest[i]
    for i in range(n):
        out[i] = q[i] + x[i] if converged else q[i]
    return converged


@kernel
def _newton(
    q: Array, links: Array, ends: Array, largest: Array, free: bool, frames: Array, J: Array,
    L: Array, steps: Array, out: Array, e: Array,
) -> None:  # fmt: skip
    """Newton's steps from ``q``.

    ``ends``: root, tool, goal, the pose at q (with its residual ``e``), and a spare pose.
    """
    n = q.shape[0]
    x, size = steps[0, :n], 0.0
    for i in range(n):
        x[i] = 0.0
    # The shortest of many solutions is sought once, in the second iteration: so what is found does
    # not hang on how many there are.
    least = 2 if equations.wide(n, free) else 1
    share, iterations = 1.0, 0
    converged = newton.largest_of(e) <= SMALL_RESIDUAL
    while not converged and iterations < MOST_ITERATIONS:
        newton.columns(links, frames, ends[3], J)
        if not equations.factor(J, ends[3], ends[1], free, L):
            if iterations == 0:
                share, converged = 0.0, True
            break
        if iterations == 0:
            share = _first_steps(q, links, ends, largest, free, frames, J, L, steps, out, e)
        else:
            size = _add_step(J, L, e, free, iterations == 1, steps, x)
        iterations += 1
        converged = _residual_at(q, x, links, ends, free, frames, out, e) <= SMALL_RESIDUAL
        converged = converged and iterations >= least
        if iterations > 1 and not converged:
            # a second step with the same matrix: third order for little more
            size = _add_step(J, L, e, free, False, steps, x)
            converged = _residual_at(q, x, links, ends, free, frames, out, e) <= SMALL_RESIDUAL
        if converged or (iterations > 1 and size <= SMALL_STEP):
            _add_step(J, L, e, free, False, steps, x)
            converged = True
    out[n + CONVERGED] = _take(q, x, largest, converged, out)
    out[n + ITERATIONS] = iterations
    out[n + SHARE] = share if out[n + CONVERGED] else 0.0


@kernel
def correct_point(
    q: Array, models: Array, s: float, largest: Array, free: bool, work: Array, out: Array
) -> None:
    """Joints that put the actual tool where the reference tool is at ``q``.

    ``largest`` (n,) bounds the joint shift; ``free``: the turn about the tool's z is free.
    ``out`` (n + 7): joints, then the report. See `joint_correction.JointCorrection`.
    """
    n = q.shape[0]
    reference, actual, frames, at = _models(work, n)
    ends = work[at : at + 96].reshape(6, 4, 4)
    goal, here = ends[5], ends[3]
    at += 96
    e, J = work[at : at + 6], work[at + 6 : at + 6 + 6 * n].reshape(n, 6)
    at += 6 + 6 * n
    size = 6 if equations.wide(n, free) else n
    L, at = work[at : at + size * size].reshape(size, size), at + size * size
    steps = work[at : at + 4 * max(n, 6)].reshape(4, max(n, 6))
    k.blend(models[0], models[1], s, reference)
    k.blend(models[2], models[3], s, actual)
    links = actual[:n]
    _aim(q, reference, actual, frames, ends[0], ends[1], ends[4], goal)
    walk(q, links, ends[0], frames, here)
    newton.at_tool(here, ends[1])
    equations.residual(goal, here, ends[1], free, e)
    out[n + TCP_SHIFT], out[n + TCP_ROTATION] = newton.length(e, 0), newton.length(e, 3)
    newton.copy(goal, ends[2])
    _newton(q, links, ends, largest, free, frames, J, L, steps, out, e)
    if out[n + SHARE] < 1.0:
        walk(out[:n], links, ends[0], frames, here)
        newton.at_tool(here, ends[1])
        equations.residual(goal, here, ends[1], free, e)
    out[n + POSITION_ERROR], out[n + ROTATION_ERROR] = newton.length(e, 0), newton.length(e, 3)


@kernel
def correct_batch(
    q: Array, models: Array, s: Array, largest: Array, free: bool, work: Array, out: Array
) -> None:
    """`correct_point` for (m, n) joints at blends (m,)."""
    for i in range(q.shape[0]):
        correct_point(q[i], models, s[i], largest, free, work, out[i])
