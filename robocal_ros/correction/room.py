"""Where the joint correction is worked out: scratch numbers, and the models at a blend.

``models`` (4, n + 2, 9) are the packed reference and actual model, each at the start and at the
end of a blend. ``work`` is scratch of `work_size` numbers, so that a point allocates nothing.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import lean
from robocal_ros.core.kinematics import newton
from robocal_ros.core.kinematics.kernels import turns_size
from robocal_ros.correction import equations, straight
from robocal_ros.correction import kernels as k
from robocal_ros.correction import straight_kinematics as six

Array = NDArray[np.float64]


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
    constants, came, goes : of `straight`, for sixteen points.
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
    constants: Array
    came: Array
    goes: Array


def work_size(n: int) -> int:
    """How many scratch numbers a solution for n joints needs."""
    poses, turns = 18 * (n + 2) + 7 * 16, 24 * (n // 8 + 1)
    many = six.CONSTANTS + straight.LANES * (six.N + straight.ROWS)
    return poses + turns + 6 * n + 6 * n + max(n, 6) ** 2 + 18 + 2 * n + many


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
    joints, at = work[at : at + 2 * n].reshape(2, n), at + 2 * n
    constants, at = work[at : at + six.CONSTANTS], at + six.CONSTANTS
    came, at = work[at : at + straight.LANES * six.N], at + straight.LANES * six.N
    return Room(
        taught, actual, taught[:n], actual[:n], poses[0], poses[1], poses[2], poses[3], poses[4],
        poses[5], poses[6], turns, frames, J, L, twists[0], twists[1], twists[2],
        joints[0], joints[1], constants, came, work[at : at + straight.LANES * straight.ROWS],
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
