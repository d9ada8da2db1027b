"""A robot, where it stands in the measuring frame, and the targets on its flange."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]
Index = NDArray[np.int64]


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
        kernels.fk_batch(np.ascontiguousarray(q), self.arm.links, self.T_frame_root, T)
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

    def jacobian(self, state: CellModel, q: Array, target: Index) -> tuple[Array, Array]:
        """T_frame_target (m, 4, 4) and its twist [v; w] by the unknowns (m, tool_size, k)."""
        from robocal_ros.kinematics import kernels

        T = np.empty((len(q), 4, 4))
        J = np.zeros((len(q), self.tool_size, len(self.names)))
        arm = state.arm
        kernels.parameter_batch(
            q, arm.links, state.T_frame_root, state.T_flange_target, target,
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
    prior_mdh : (n, 5) mean of the model parameters' prior.
    """

    layout: UnknownLayout
    data: Measurements
    targets: tuple[str, ...]
    sigma: Array
    lever_m: float
    prior_mdh: Array

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
        """Model parameters' distance (k,) from the prior's mean; base and targets have none."""
        away = np.zeros(len(self.names))
        joint, column, place = self.layout.geometry
        away[place] = state.arm.mdh[joint, column] - self.prior_mdh[joint, column]
        return away
