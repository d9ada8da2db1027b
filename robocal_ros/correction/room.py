"""Where the joint correction is worked out: its two models, and scratch numbers.

``work`` holds `work_size` numbers, so that a point allocates nothing; `settle` puts the models and
the constants of a correction there, once.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction import straight
from robocal_ros.correction import straight_kinematics as six
from robocal_ros.ground.compiled import lean
from robocal_ros.kinematics import newton
from robocal_ros.kinematics.kernels import turns_size

Array = NDArray[np.float64]

POSES, SQUARES, TWISTS = 6, 3, 5
STEEPNESS, PER_ERROR, IS_STRAIGHT, SETTINGS = 0, 1, 2, 3


class Workspace(NamedTuple):
    """Where a solution is worked out: parts of ``work``.

    Attributes
    ----------
    taught_links, links : (n, 9) joints of the reference and of the actual model.
    taught_root, taught_tool, root, tool : their (4, 4) ends, T_base_root and T_flange_tool.
    goal, here : (4, 4) where the tool must go, and where it is at the joints tried last. Such
        poses have the axes of the flange, their origin is the tool's.
    turns, frames : scratch of `walk`.
    J, there : (n, 6) Jacobian at the taught joints, and at those tried last.
    M, D, B : (6, 6) J J^T, the damping, and the matrix of a step.
    U : (3, 3) vectors of a part of M.
    e, y, step, spare, order : (6,) residual, multipliers, their step, and scratch.
    x : (n,) shift of the joints.
    settings : steepness and its rise, and whether `straight` serves; see `joint_correction` (3).
    constants, came, goes, late : of `straight` and `straight_damped`, for sixteen points.
    """

    taught_links: Array
    links: Array
    taught_root: Array
    taught_tool: Array
    root: Array
    tool: Array
    goal: Array
    here: Array
    turns: Array
    frames: Array
    J: Array
    there: Array
    M: Array
    U: Array
    D: Array
    B: Array
    e: Array
    y: Array
    step: Array
    spare: Array
    order: Array
    x: Array
    settings: Array
    constants: Array
    came: Array
    goes: Array
    late: Array


def work_size(n: int) -> int:
    """How many scratch numbers a solution for n joints needs."""
    many = six.CONSTANTS + straight.LANES * (six.N + straight.ROWS + 1)
    small = 16 * POSES + 24 * (n // 8 + 1) + 36 * SQUARES + 9 + 6 * TWISTS + SETTINGS
    return 18 * n + 18 * n + n + small + many


@lean
def room_in(work: Array, n: int) -> Workspace:
    """Divide ``work``."""
    links, at = work[: 18 * n].reshape(2, n, 9), 18 * n
    poses, at = work[at : at + 16 * POSES].reshape(POSES, 4, 4), at + 16 * POSES
    turns, at = work[at : at + turns_size(n)], at + turns_size(n)
    frames, at = work[at : at + 6 * n].reshape(n, 2, 3), at + 6 * n
    J, at = work[at : at + 12 * n].reshape(2, n, 6), at + 12 * n
    squares, at = work[at : at + 36 * SQUARES].reshape(SQUARES, 6, 6), at + 36 * SQUARES
    U, at = work[at : at + 9].reshape(3, 3), at + 9
    twists, at = work[at : at + 6 * TWISTS].reshape(TWISTS, 6), at + 6 * TWISTS
    x, at = work[at : at + n], at + n
    settings, at = work[at : at + SETTINGS], at + SETTINGS
    constants, at = work[at : at + six.CONSTANTS], at + six.CONSTANTS
    came, at = work[at : at + straight.LANES * six.N], at + straight.LANES * six.N
    goes, at = work[at : at + straight.LANES * straight.ROWS], at + straight.LANES * straight.ROWS
    return Workspace(
        links[0], links[1], poses[0], poses[1], poses[2], poses[3], poses[4], poses[5],
        turns, frames, J[0], J[1], squares[0], U, squares[1], squares[2],
        twists[0], twists[1], twists[2], twists[3], twists[4], x, settings,
        constants, came, goes, work[at : at + straight.LANES],
    )  # fmt: skip


@lean
def settle(
    models: Array, largest: Array, steepness: float, per_error: float, free: bool, room: Workspace
) -> None:
    """Put models (2, n + 2, 9), reference and actual, and the damping's settings into a room."""
    n = room.links.shape[0]
    newton.copy(models[0, :n], room.taught_links)
    newton.copy(models[1, :n], room.links)
    newton.pose(models[0, n], room.taught_root)
    newton.pose(models[0, n + 1], room.taught_tool)
    newton.pose(models[1, n], room.root)
    newton.pose(models[1, n + 1], room.tool)
    room.settings[STEEPNESS], room.settings[PER_ERROR] = steepness, per_error
    turning = not free and n == six.N
    for i in range(n):
        turning = turning and room.links[i, 8] < 0.5
    room.settings[IS_STRAIGHT] = 1.0 if turning else 0.0
    if not turning:
        return
    for i in range(six.N):
        room.constants[six.LARGEST + i] = largest[i]
    room.constants[six.DAMPING], room.constants[six.DAMPING + 1] = steepness, per_error
    taught, tool = room.taught_tool, room.tool
    six.constants(room.taught_links, room.taught_root, taught, taught, 0, room.constants)
    six.constants(room.links, room.root, tool, taught, six.ACTUAL, room.constants)
