# SPDX-License-Identifier: Apache-2.0
"""The shift of base and tool frame that serves a robot's working poses best.

Where no program is to be touched, two frames of the controller still move every point: its base,
or work object, and its tool. Shifted by X_b and X_t, six numbers each, the controller goes with
the point that it takes joints q for to the joints q' with

    T_nominal(q') T_flange_tool X_t = X_b T_nominal(q) T_flange_tool,                       (1)

and the robot as identified stands with its tool at T_actual(q') T_flange_tool, where it should be
at T_reference(q) T_flange_tool. What is left is made least in squares over the poses, the turn
counted as the way of a point some way off the tool's (the lever). Where the poses hardly tell base
from tool, as with one constant orientation, both would be large and opposite: a shift of 10 mm
weighs as an error of 0.05 mm.
"""

from dataclasses import dataclass

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.ground.frames import Array, Mask
from robocal_ros.programs.postures import CorrectionModels, reach

LEVER_M = 0.1
HELD = 0.05 / 10.0
TURN_M = 1.0  # a turn of a frame counts as the way of a point so far off
ROUNDS = 4
PARTS = ("base", "tool")


@dataclass(frozen=True, eq=False)
class FrameShift:
    """How two frames move, and what that leaves.

    ``T_base_shift`` (4, 4): goes before every base frame, T_base_shift T_base_frame.
    ``T_tool_shift`` (4, 4): goes behind the tool of the poses, T_flange_tool T_tool_shift; before
    any other in the flange's axes, T_flange_tool T_tool_shift T_flange_tool^-1 T_flange_other.
    ``before``, ``after`` (m, 6): twists [m; rad] in base axes from where the tool stands, with the
    frames as they were and as shifted, to where it should.
    """

    T_base_shift: Array
    T_tool_shift: Array
    before: Array
    after: Array


def best_shift(
    models: CorrectionModels,
    q: Array,
    T_flange_tool: Array,
    *,
    parts: tuple[str, ...] = PARTS,
    weight: Array | None = None,
    lever_m: float = LEVER_M,
) -> FrameShift:
    """The shift that serves working poses q (m, n) best, by Gauss-Newton steps.

    ``parts``: which frames may move. ``weight`` (m,): of each pose; all alike without.

    Raises `LimitError` where a pose cannot be shifted, as the arm is singular there.
    """
    wanted = models.reference.fk(q) @ T_flange_tool
    pivot = np.mean(wanted[:, :3, 3], axis=0)
    rows = _rows(models.nominal.fk(q) @ T_flange_tool, pivot)
    free = np.repeat([part in parts for part in PARTS], 6)
    scale = np.tile(np.repeat([1.0, 1.0 / TURN_M], 3), 2)
    root = np.repeat(np.sqrt(np.ones(len(q)) if weight is None else weight), 6)
    root = root * np.tile(np.repeat([1.0, lever_m], 3), len(q))
    A = np.vstack([(root[:, None] * rows * scale)[:, free], HELD * np.eye(int(free.sum()))])
    x = np.zeros(12)
    before = after = _missed(models, q, T_flange_tool, np.eye(4), np.eye(4))
    for _ in range(ROUNDS):
        b = np.concatenate([root * after.ravel(), -HELD * (x / scale)[free]])
        step = np.zeros(12)
        step[free] = np.linalg.lstsq(A, b, rcond=None)[0]
        x = x + step * scale
        shifts = _shift(x[:6], pivot), _shift(x[6:], np.zeros(3))
        after = _missed(models, q, T_flange_tool, *shifts)
    return FrameShift(*shifts, before, after)


def given_shift(
    models: CorrectionModels,
    q: Array,
    T_flange_tool: Array,
    T_base_shift: Array,
    T_tool_shift: Array,
) -> FrameShift:
    """What a shift does that was found before, perhaps for another model.

    Raises `LimitError` as `best_shift`.
    """
    before = _missed(models, q, T_flange_tool, np.eye(4), np.eye(4))
    after = _missed(models, q, T_flange_tool, T_base_shift, T_tool_shift)
    return FrameShift(T_base_shift, T_tool_shift, before, after)


def shifted_joints(
    models: CorrectionModels,
    q: Array,
    T_flange_tool: Array,
    T_base_shift: Array,
    T_tool_shift: Array,
) -> tuple[Array, Mask]:
    """Joints q' (m, n) of equation (1), and where there are any."""
    there = models.nominal.fk(q) @ T_flange_tool
    goal = T_base_shift @ there @ frames.invert(T_flange_tool @ T_tool_shift)
    return reach(models.nominal, goal, q)


def _missed(
    models: CorrectionModels,
    q: Array,
    T_flange_tool: Array,
    T_base_shift: Array,
    T_tool_shift: Array,
) -> Array:
    """Twists (m, 6) from where the tool stands to where it should."""
    moved, found = shifted_joints(models, q, T_flange_tool, T_base_shift, T_tool_shift)
    if not np.all(found):
        at = int(np.argmin(found)) + 1
        raise LimitError(f"pose {at} of {len(q)} is singular, or out of reach: leave it out")
    wanted, here = models.reference.fk(q) @ T_flange_tool, models.actual.fk(moved) @ T_flange_tool
    turn = frames.log_rotation(wanted[:, :3, :3] @ np.swapaxes(here[:, :3, :3], 1, 2))
    return np.hstack([wanted[:, :3, 3] - here[:, :3, 3], turn])


def _rows(T: Array, pivot: Array) -> Array:
    """How the tool at T (m, 4, 4) moves with both shifts: (6 m, 12), lengths before turns."""
    R = T[:, :3, :3]
    rows = np.zeros((len(T), 6, 12))
    rows[:, :3, :3] = np.eye(3)
    rows[:, :3, 3:6] = -frames.skew(T[:, :3, 3] - pivot)
    rows[:, 3:, 3:6] = np.eye(3)
    rows[:, :3, 6:9] = -R
    rows[:, 3:, 9:] = -R
    return rows.reshape(-1, 12)


def _shift(x: Array, pivot: Array) -> Array:
    """A shift by (v, w) (6,), w about a point."""
    R = frames.exp_rotation(x[3:])
    return frames.transform(R, x[:3] + pivot - R @ pivot)
