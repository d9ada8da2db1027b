"""Compiled inverse kinematics along a path of poses, with the rates of the joints."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.compiled import kernel
from robocal_ros.kinematics import newton
from robocal_ros.kinematics.kernels import turns_size, walk

Array = NDArray[np.float64]

MOST_ITERATIONS = 15
# A residual (m, rad) that is the rounding floor, and a step after which the next one is below it.
SMALL_RESIDUAL = 1e-12
SMALL_STEP = 1e-9

REACHED, SINGULAR, MISSED = range(3)


@kernel
def _reach(
    goal: Array, links: Array, poses: Array, turns: Array, frames: Array, J: Array, L: Array,
    near: Array, longest: float, q: Array,
) -> int:  # fmt: skip
    """Newton's steps in ``q`` from ``near`` to ``goal``; ``poses``: root, tool, pose at q."""
    n = q.shape[0]
    e, x, step = np.empty(6), np.zeros(n), np.empty(n)
    for i in range(n):
        q[i] = near[i]
    small = False
    for _ in range(MOST_ITERATIONS):
        walk(q, links, poses[0], turns, frames, poses[2])
        newton.at_tool(poses[2], poses[1])
        newton.columns(links, frames, poses[2], J)
        if not newton.factor(J, L):
            return SINGULAR
        if newton.residual(goal, poses[2], e) <= SMALL_RESIDUAL or small:
            return REACHED
        newton.solve(J, L, e, x, step)
        for i in range(n):
            x[i] += step[i]
            q[i] = near[i] + x[i]
        if not newton.largest_of(x) <= longest:
            return MISSED
        small = newton.largest_of(step) <= SMALL_STEP
    return MISSED


@kernel
def follow_batch(
    goals: Array,
    twist: Array,
    rate: Array,
    near: Array,
    links: Array,
    root_and_tool: Array,
    longest: float,
    q: Array,
    qd: Array,
    qdd: Array,
) -> tuple[int, int]:
    """Joints (m, n) at goals (m, 4, 4), each from the one before, and their rates.

    ``root_and_tool`` (2, 4, 4): T_base_root and where on the flange the goals are; ``twist`` and
    its derivative ``rate`` (m, 6) of the goals; ``longest``: no joint moves further from one goal
    to the next. Gives how many were reached and what became of the next.
    """
    n = links.shape[0]
    poses, frames = np.empty((3, 4, 4)), np.empty((n, 2, 3))
    turns = np.empty(turns_size(n))
    J, L, zero = np.empty((n, 6)), np.empty((n, n)), np.zeros(n)
    v, a = np.empty(6), np.empty(6)
    newton.copy(root_and_tool[0], poses[0])
    newton.copy(root_and_tool[1], poses[1])
    for i in range(goals.shape[0]):
        start = near if i == 0 else q[i - 1]
        outcome = _reach(goals[i], links, poses, turns, frames, J, L, start, longest, q[i])
        if outcome != REACHED:
            return i, outcome
        newton.solve(J, L, twist[i], zero, qd[i])
        newton.bias(links, frames, poses[2], qd[i], v, a)
        for r in range(6):
            a[r] = rate[i, r] - a[r]
        newton.solve(J, L, a, zero, qdd[i])
    return goals.shape[0], REACHED
