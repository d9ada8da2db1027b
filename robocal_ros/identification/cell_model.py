# SPDX-License-Identifier: Apache-2.0
"""A robot, where it stands in the measuring frame, and the targets on its flange: its model.

Its unknowns, how predictions depend on them, and a closed-form start.
"""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, TooFewSamplesError
from robocal_ros.ground.frames import Array, Index, Mask
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm

Part = Literal["base", "tool", "geometry"]


@dataclass(frozen=True)
class CellModel:
    """A measured robot: ``T_frame_target = T_frame_base T_base_flange(q) T_flange_target``.

    Attributes
    ----------
    arm : the arm with its model parameters.
    T_frame_base : (4, 4) robot base in the measuring frame.
    targets, T_flange_target : names and (t, 4, 4) poses of the targets on the flange.
    """

    arm: SerialArm
    T_frame_base: Array
    targets: tuple[str, ...]
    T_flange_target: Array

    @cached_property
    def T_frame_root(self) -> Array:
        """The first joint's frame (4, 4) in the measuring frame."""
        return self.T_frame_base @ self.arm.T_base_root

    def predict(self, q: Array, target: Index) -> Array:
        """T_frame_target (m, 4, 4) at joint vectors (m, n), ``target`` (m,) by index."""
        from robocal_ros.kinematics import kernels

        T = np.empty((len(q), 4, 4))
        kernels.fk_batch(self.arm.turned(q), self.arm.links, self.T_frame_root, T)
        return np.asarray(T @ self.T_flange_target[target])

    def residual(self, data: Measurements) -> Array:
        """Predicted minus measured position (m, 3), m, in the measuring frame."""
        T = self.predict(data.q, data.target_index(self.targets))
        return np.asarray(T[:, :3, 3] - data.position)


@dataclass(frozen=True)
class UnknownLayout:
    """Which increments are unknown, and their columns.

    Order: the model parameters ``slots`` (n, 5), six of the base from ``base`` (translation of
    the root, turn about it, measuring axes), then per target from ``tool`` (t,) three of
    position and, with orientation, three of turn (flange axes). -1 where held.
    """

    names: tuple[str, ...]
    slots: Index
    base: int
    tool: Index
    tool_size: int

    @cached_property
    def to_display(self) -> Array:
        """Factors (k,) from SI to the unit in each name."""
        return np.array([1e3 if name.endswith("_mm") else np.degrees(1.0) for name in self.names])

    @cached_property
    def geometry(self) -> tuple[Index, Index, Index]:
        """Joint, parameter column and place in the increment of each free model parameter."""
        joint, column = np.nonzero(self.slots >= 0)
        return joint, column, self.slots[joint, column]

    @property
    def tool_places(self) -> Index:
        """Places (3 t,) of the targets' positions in the increment; none where they are held."""
        return (self.tool[self.tool >= 0][:, None] + np.arange(3)).ravel()

    def columns(self, parts: Collection[Part]) -> Mask:
        """Which of the unknowns (k,) belong to base or tool, where these are among the parts."""
        mask = np.zeros(len(self.names), dtype=np.bool_)
        if "base" in parts and self.base >= 0:
            mask[self.base : self.base + 6] = True
        if "tool" in parts and self.tool[0] >= 0:
            mask[self.tool[0] :] = True
        return mask

    def jacobian(self, state: CellModel, q: Array, target: Index) -> tuple[Array, Array]:
        """T_frame_target (m, 4, 4) and its twist [v; w] by the unknowns (m, tool_size, k)."""
        from robocal_ros.kinematics import kernels

        T = np.empty((len(q), 4, 4))
        J = np.zeros((len(q), self.tool_size, len(self.names)))
        arm = state.arm
        kernels.parameter_batch(
            arm.turned(q), arm.links, state.T_frame_root, state.T_flange_target, target,
            self.slots, self.base, self.tool, T, J,
        )  # fmt: skip
        return T, J

    def retract(self, state: CellModel, step: Array) -> CellModel:
        """Move a cell model by an increment (k,)."""
        arm, T_frame_base, tools = state.arm, state.T_frame_base, state.T_flange_target
        joint, column, place = self.geometry
        if len(place):
            mdh = arm.mdh.copy()
            mdh[joint, column] += step[place]
            arm = arm.with_mdh(mdh)
        if self.base >= 0:
            shift, turn = step[self.base : self.base + 3], step[self.base + 3 : self.base + 6]
            root = state.T_frame_root
            moved = frames.transform(frames.exp_rotation(turn) @ root[:3, :3], root[:3, 3] + shift)
            T_frame_base = moved @ frames.invert(arm.T_base_root)
        if self.tool[0] >= 0:
            tools = tools.copy()
            block = step[self.tool[0] :].reshape(len(self.tool), self.tool_size)
            tools[:, :3, 3] += block[:, :3]
            if self.tool_size == 6:
                tools[:, :3, :3] = frames.exp_rotation(block[:, 3:]) @ tools[:, :3, :3]
        return CellModel(arm, T_frame_base, state.targets, tools)


_BASE = ("base_x_mm", "base_y_mm", "base_z_mm", "base_rx_deg", "base_ry_deg", "base_rz_deg")
_AXES = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")


def make_layout(
    arm: SerialArm,
    targets: tuple[str, ...],
    *,
    geometry: tuple[str, ...],
    base: bool,
    tool: bool,
    orientation: bool,
) -> UnknownLayout:
    """Lay out the unknowns: the model parameters of these names, the base, the targets."""
    chosen = arm.parameters.subset(geometry)
    size = 6 if orientation else 3
    first_tool = len(chosen) + (6 if base else 0)
    names = chosen.names + (_BASE if base else ())
    if tool:
        names += tuple(f"{target}_{axis}" for target in targets for axis in _AXES[:size])
    columns = np.arange(len(targets), dtype=np.int64) * size + first_tool
    return UnknownLayout(
        names=names,
        slots=chosen.slots(arm.n),
        base=len(chosen) if base else -1,
        tool=columns if tool else np.full(len(targets), -1, dtype=np.int64),
        tool_size=size,
    )


@dataclass(frozen=True)
class CellProblem:
    """Residuals of measurements against a cell model, for ``estimation.solve``.

    Attributes
    ----------
    sigma : (m,) of each position coordinate, m (ones where unknown).
    lever_m : length, m, by which a turn in rad counts as a position error; 0: positions only.
    prior_arm : mean of the prior: its parameters, and its tool as every target's place.
    """

    layout: UnknownLayout
    data: Measurements
    targets: tuple[str, ...]
    sigma: Array
    lever_m: float
    prior_arm: SerialArm

    @property
    def names(self) -> tuple[str, ...]:
        """Names (k) of the increments."""
        return self.layout.names

    @property
    def scale_components(self) -> int:
        """Positions tell the noise; orientations are weighted against them by ``lever_m``."""
        return 3

    @cached_property
    def _target(self) -> Index:
        return self.data.target_index(self.targets)

    @cached_property
    def _q(self) -> Array:
        return np.ascontiguousarray(self.data.q, dtype=np.float64)

    def linearise(self, state: CellModel) -> tuple[Array, Array]:
        """Whitened residual (m, c) and Jacobian (m, c, k), c = 3 or 6."""
        T, J = self.layout.jacobian(state, self._q, self._target)
        residual = T[:, :3, 3] - self.data.position
        if self.data.rotation is not None and self.layout.tool_size == 6:
            turn = frames.log_rotation(T[:, :3, :3] @ np.swapaxes(self.data.rotation, 1, 2))
            J[:, 3:] = self.lever_m * (frames.left_jacobian_inverse(turn) @ J[:, 3:])
            residual = np.hstack([residual, self.lever_m * turn])
        J /= self.sigma[:, None, None]
        return residual / self.sigma[:, None], J

    def retract(self, state: CellModel, step: Array) -> CellModel:
        """Move the cell model by an increment (k,)."""
        return self.layout.retract(state, step)

    def deviation(self, state: CellModel) -> Array:
        """Distance (k,) of parameters and targets' places from the prior's mean; else zeros."""
        away = np.zeros(len(self.names))
        joint, column, place = self.layout.geometry
        away[place] = state.arm.mdh[joint, column] - self.prior_arm.mdh[joint, column]
        if self.layout.tool[0] >= 0:
            point = state.T_flange_target[:, :3, 3] - self.prior_arm.T_flange_tool[:3, 3]
            away[self.layout.tool_places] = point.ravel()
        return away


# ---- closed-form start of base and targets, from the nominal arm --------------------------------


_SMALLEST_SPREAD = 1e-6  # of the largest singular value: below it a direction is not seen
ADVICE = "turn the flange about a second axis between the samples, or give base or target as known"
# A target sits within some decimetres of the flange. Where poses hardly turn the flange they tell
# base and targets in combination only: then each target is held about the arm's tool so far.
TARGET_REACH_M = 0.5
TYPICAL_ERROR_M = 1e-3  # of a nominal arm
WEAK_TARGET_M = 0.05  # known worse than this by data that err so, a target is held
_HELD_WEIGHT = TYPICAL_ERROR_M / TARGET_REACH_M
_TURNS = 100  # of placing base and targets one after the other


def linear_start(
    arm: SerialArm,
    data: Measurements,
    *,
    base: bool = False,
    tool: bool = False,
    known: CellModel | None = None,
    hold: bool = False,
) -> CellModel:
    """Solve base and targets linearly with the arm's present parameters.

    ``R^T p = p_base + c - R_flange p_target`` is linear in R^T (nine numbers), c and p_target;
    the rotation is then projected to SO(3). What is not solved for is as in ``known``, else the
    base is where the measuring frame is and targets are the arm's tool. ``hold``: poses that hardly
    turn the flange are no error, targets are held near the arm's tool.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When the samples cannot give them.
    """
    targets = data.targets if tool or known is None else known.targets
    index = data.target_index(targets)
    T_base_flange = arm.fk(data.q)
    tools = np.broadcast_to(arm.T_flange_tool, (len(targets), 4, 4)).copy()
    T_frame_base = np.eye(4)
    if known is not None:
        T_frame_base = known.T_frame_base
        if not tool:
            tools = known.T_flange_target
    if base and tool:
        T_frame_base, points = place_base_and_points(
            T_base_flange,
            data.position,
            index,
            len(targets),
            arm.T_flange_tool[:3, 3] if hold else None,
        )
        tools[:, :3, 3] = points
    elif base:
        T_frame_base = _aligned(carried(T_base_flange, tools[index, :3, 3]), data.position)
    elif tool:
        tools[:, :3, 3] = _points(T_frame_base @ T_base_flange, data.position, index, len(targets))
    if tool and data.rotation is not None:
        relative = np.swapaxes(T_frame_base[:3, :3] @ T_base_flange[:, :3, :3], 1, 2)
        for t in range(len(targets)):
            mean = (relative @ data.rotation)[index == t].mean(axis=0)
            tools[t, :3, :3] = frames.nearest_rotation(mean)
    return CellModel(arm, T_frame_base, targets, tools)


def place_base_and_points(
    T_base_flange: Array, measured: Array, index: NDArray[np.int64], count: int, held: Array | None
) -> tuple[Array, Array]:
    """T_frame_base (4, 4) and ``count`` points on the flange (count, 3).

    Where poses hardly turn it the points are near ``held`` (3,), if that is given.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        As `linear_start`.
    """
    m = len(measured)
    unknowns = 12 + 3 * count
    if 3 * m < unknowns:
        raise TooFewSamplesError(
            f"{m} samples cannot place base and {count} target(s): at least "
            f"{-(-unknowns // 3)} are needed"
        )
    centre = measured.mean(axis=0)
    size = max(float(np.abs(measured - centre).max()), 1e-9)
    A = np.zeros((m + count, 3, unknowns))
    for axis in range(3):
        A[:m, axis, 3 * axis : 3 * axis + 3] = (measured - centre) / size
        A[:m, axis, 9 + axis] = 1.0
    for t in range(count):
        A[:m][index == t, :, 12 + 3 * t : 15 + 3 * t] = -T_base_flange[index == t, :3, :3]
        A[m + t, :, 12 + 3 * t : 15 + 3 * t] = _HELD_WEIGHT * np.eye(3)
    near = np.zeros(3) if held is None else held
    wanted = np.vstack([T_base_flange[:, :3, 3], np.tile(_HELD_WEIGHT * near, (count, 1))])
    rows, wanted = A.reshape(-1, unknowns), wanted.ravel()
    s = np.linalg.svd(rows[: 3 * m], compute_uv=False)
    if held is None and s[-1] < _SMALLEST_SPREAD * s[0]:
        rank = int(np.sum(s >= _SMALLEST_SPREAD * s[0]))
        raise RankDeficientError(
            f"base and targets together: rank {rank} of {unknowns}; {ADVICE}", (ADVICE,)
        )
    if held is None or s[-1] > TYPICAL_ERROR_M / WEAK_TARGET_M:
        rows, wanted = rows[: 3 * m], wanted[: 3 * m]
    x = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    linear: Array = np.asarray(x[12:].reshape(count, 3), dtype=np.float64)
    R_linear: Array = frames.nearest_rotation(x[:9].reshape(3, 3)).T
    found = [(R_linear, linear)]
    if len(rows) > 3 * m:  # of one plane the third axis is but the product of the others
        try:
            found.append(_placed_in_turn(T_base_flange, measured, index, np.tile(near, (count, 1))))
        except RankDeficientError as line:
            raise RankDeficientError(f"{line}; {ADVICE}", line.directions) from line
    error, best = np.inf, None
    for R, points in found:
        in_base = carried(T_base_flange, points[index])
        T_frame_base = frames.transform(R, centre - R @ in_base.mean(axis=0))
        off = carried(T_frame_base[None], in_base) - measured
        if best is None or np.sum(off**2) < error:
            error, best = float(np.sum(off**2)), (T_frame_base, points)
    assert best is not None
    return best


def _placed_in_turn(
    T_base_flange: Array, measured: Array, index: NDArray[np.int64], points: Array
) -> tuple[Array, Array]:
    """R_frame_base and points, one after the other: where the linear form has no single answer."""
    for _ in range(_TURNS):
        T_frame_base = _aligned(carried(T_base_flange, points[index]), measured)
        last, points = points, _points(T_frame_base @ T_base_flange, measured, index, len(points))
        if np.max(np.abs(points - last)) < TYPICAL_ERROR_M:
            break
    return T_frame_base[:3, :3], points


def carried(T: Array, points: Array) -> Array:
    """Points (m, 3) carried by transforms (m, 4, 4)."""
    return np.asarray((T[:, :3, :3] @ points[..., None])[..., 0] + T[:, :3, 3])


def _points(T: Array, measured: Array, index: NDArray[np.int64], count: int) -> Array:
    """Mean places (count, 3) on the flange, at poses T (m, 4, 4), of measured points (m, 3)."""
    p = carried(frames.invert(T), measured)
    return np.stack([p[index == t].mean(axis=0) for t in range(count)])


def _aligned(points: Array, measured: Array) -> Array:
    """Rigid transform (4, 4) that carries points (m, 3) onto measured ones (Kabsch)."""
    if len(points) < 3:
        raise TooFewSamplesError(f"{len(points)} samples cannot place the base: 3 are needed")
    p, y = points - points.mean(axis=0), measured - measured.mean(axis=0)
    s = np.linalg.svd(p, compute_uv=False)
    if s[1] < _SMALLEST_SPREAD * np.linalg.norm(points):
        raise RankDeficientError(
            "the points lie on one line and leave the base free to turn about it",
            ("base turns about the line of points: move off the line",),
        )
    R = frames.nearest_rotation(y.T @ p)
    return frames.transform(R, measured.mean(axis=0) - R @ points.mean(axis=0))
