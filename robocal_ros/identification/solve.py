"""A robot, where it stands in the measuring frame, and the targets on its flange: its model.

Base, targets and model parameters from measurements: least squares or maximum a posteriori.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation import estimation
from robocal_ros.estimation.descent import require_told
from robocal_ros.estimation.estimation import describe, observability
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, TooFewSamplesError
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


# ---- closed-form start of base and targets, from the nominal arm --------------------------------


_SMALLEST_SPREAD = 1e-6  # of the largest singular value: below it a direction is not seen
_ADVICE = "turn the flange about a second axis between the samples, or give base or target as known"


def linear_start(
    arm: SerialArm, data: Measurements, *, base: bool = False, tool: bool = False
) -> CellModel:
    """Solve base and targets linearly with the arm's present parameters.

    ``R^T p = p_base + c - R_flange p_target`` is linear in R^T (nine numbers), c and p_target;
    the rotation is then projected to SO(3).

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When the samples cannot give them.
    """
    targets = data.targets
    index = data.target_index(targets)
    T_base_flange = arm.fk(data.q)
    tools = np.broadcast_to(arm.T_flange_tool, (len(targets), 4, 4)).copy()
    T_frame_base = np.eye(4)
    if base and tool:
        T_frame_base, points = _base_and_points(T_base_flange, data.position, index, len(targets))
        tools[:, :3, 3] = points
    elif base:
        T = T_base_flange @ tools[index]
        T_frame_base = _aligned(T[:, :3, 3], data.position)
    elif tool:
        homogeneous = np.hstack([data.position, np.ones((len(data), 1))])
        p = (frames.invert(T_base_flange) @ homogeneous[..., None])[:, :3, 0]
        for t in range(len(targets)):
            tools[t, :3, 3] = p[index == t].mean(axis=0)
    if tool and data.rotation is not None:
        relative = np.swapaxes(T_frame_base[:3, :3] @ T_base_flange[:, :3, :3], 1, 2)
        for t in range(len(targets)):
            mean = (relative @ data.rotation)[index == t].mean(axis=0)
            tools[t, :3, :3] = frames.nearest_rotation(mean)
    return CellModel(arm, T_frame_base, targets, tools)


def _base_and_points(
    T_base_flange: Array, measured: Array, index: NDArray[np.int64], count: int
) -> tuple[Array, Array]:
    m = len(measured)
    unknowns = 12 + 3 * count
    if 3 * m < unknowns:
        raise TooFewSamplesError(
            f"{m} samples cannot place base and {count} target(s): at least "
            f"{-(-unknowns // 3)} are needed"
        )
    centre = measured.mean(axis=0)
    size = max(float(np.abs(measured - centre).max()), 1e-9)
    A = np.zeros((m, 3, unknowns))
    for axis in range(3):
        A[:, axis, 3 * axis : 3 * axis + 3] = (measured - centre) / size
        A[:, axis, 9 + axis] = 1.0
    for t in range(count):
        A[index == t, :, 12 + 3 * t : 15 + 3 * t] = -T_base_flange[index == t, :3, :3]
    rows = A.reshape(3 * m, unknowns)
    x, _, _, s = np.linalg.lstsq(rows, T_base_flange[:, :3, 3].ravel(), rcond=None)
    if s[-1] < _SMALLEST_SPREAD * s[0]:
        rank = int(np.sum(s >= _SMALLEST_SPREAD * s[0]))
        raise RankDeficientError(
            f"base and targets together: rank {rank} of {unknowns}; {_ADVICE}", (_ADVICE,)
        )
    R_base_frame = frames.nearest_rotation(x[:9].reshape(3, 3))
    points = x[12:].reshape(count, 3)
    in_base = T_base_flange[:, :3, 3] + np.einsum(
        "mij,mj->mi", T_base_flange[:, :3, :3], points[index]
    )
    R = R_base_frame.T
    return frames.transform(R, centre - R @ in_base.mean(axis=0)), np.asarray(points)


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


# ---- how far parameters may lie from the nominal ones -------------------------------------------


# Spread of a new robot's parameters about the nominal ones: machining and mastering tolerances.
TOLERANCE_LENGTH_M = 3e-3
TOLERANCE_ANGLE_RAD = float(np.radians(0.5))
SMALLEST_SCALE = 0.02
_ROUNDS = 60


def default_prior(arm: SerialArm) -> Array:
    """Variances (k,) of the free parameters of an arm as built."""
    return np.where(arm.parameters.is_length, TOLERANCE_LENGTH_M, TOLERANCE_ANGLE_RAD) ** 2


def fitted_prior(arm: SerialArm, found: Array, covariance: Array) -> Array:
    """Variances (k,) of the free parameters, scaled to what the data show of this robot.

    One scale for the lengths and one for the angles maximise the likelihood of the data with the
    parameters integrated out (empirical Bayes), by expectation-maximisation. Few data then
    neither drown in a prior that is too narrow nor turn noise into millimetres elsewhere.

    Parameters
    ----------
    found, covariance : (k,) deviations from the nominal parameters and their (k, k) covariance,
        as identified with ``default_prior``.
    """
    prior, lengths = default_prior(arm), arm.parameters.is_length
    unit = np.sqrt(prior)  # everything below in units of the tolerances
    total = np.linalg.inv(covariance / np.outer(unit, unit))
    data, pull = total - np.eye(len(unit)), total @ (found / unit)
    scale = np.ones(len(unit))
    for _ in range(_ROUNDS):
        posterior = np.linalg.inv(data + np.diag(1.0 / scale))
        second_moment = (posterior @ pull) ** 2 + np.diag(posterior)
        for group in (lengths, ~lengths):
            if np.any(group):
                scale[group] = max(float(second_moment[group].mean()), SMALLEST_SCALE**2)
    return np.asarray(prior * scale)


# ---- least squares, maximum a posteriori --------------------------------------------------------


Part = Literal["base", "tool", "geometry"]
Method = Literal["map", "lsq"]

_STILL_RAD = float(np.radians(5.0))
_STILL_M = 0.01
_ORIENTATION_SHARE = 0.25
_SHORTEST_LEVER_M = 0.02
_LEVER_ROUNDS = 4


@dataclass(frozen=True)
class Identification:
    """An identified cell model with its uncertainty.

    Attributes
    ----------
    nominal : the arm that was started from.
    cell : the identified model, base and targets.
    held : model parameters kept at their start because base or targets (or other parameters)
        have the same effect on every measurement.
    unobservable : directions, in words, that the data leave to the prior or to ``held``.
    prior_covariance : (g, g), SI, of the model parameters before the data, or None.
    noise_m : standard deviation of a measured coordinate, as given or as found.
    lever_m : length by which a turn in rad counted as a position error.
    """

    nominal: SerialArm
    cell: CellModel
    layout: UnknownLayout
    method: Method
    estimate: estimation.Estimate[CellModel]
    held: tuple[str, ...]
    prior_covariance: Array | None
    unobservable: tuple[str, ...]
    rejected: tuple[str, ...]
    noise_m: float
    lever_m: float

    def sigma(self) -> dict[str, float]:
        """Standard deviation, SI, of each unknown by name."""
        spread = np.sqrt(np.diag(self.estimate.covariance))
        return dict(zip(self.layout.names, spread.tolist(), strict=True))

    def predicted_variance(
        self, q: Array, target: NDArray[np.int64], without: Collection[Part] = ()
    ) -> Array:
        """Covariance (m, 3, 3), m^2, of the predicted target positions.

        ``without``: parts whose share is projected out because they are solved anew elsewhere.
        """
        J = self._jacobian(q, target, without)
        return np.asarray(J @ self.estimate.covariance @ np.swapaxes(J, 1, 2))

    def workspace_rms(self, covariance: Array) -> float:
        """Rms target position error, m, over postures throughout the joint limits.

        ``covariance`` is of the unknowns, or of the leading ones (the model parameters). What
        another base or target would explain does not count: it belongs to the set-up.
        """
        rows = self._workspace_rows()[..., : len(covariance)]
        return float(np.sqrt(np.mean(np.einsum("mik,kl,mil->m", rows, covariance, rows))))

    def workspace_change(self, arm: SerialArm) -> float:
        """Rms target displacement, m, over the same postures from ``arm``'s model to this one."""
        joint, column, place = self.layout.geometry
        change = (self.cell.arm.mdh - arm.mdh)[joint, column]
        moved = self._workspace_rows()[..., place] @ change
        return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))

    def _workspace_rows(self) -> Array:
        """Position rows (t * 60, 3, k) of each target at the same random postures."""
        q = random_postures(self.nominal)
        targets = np.repeat(np.arange(len(self.cell.targets))[:, None], len(q), axis=1)
        return np.vstack([self._jacobian(q, target, ("base", "tool")) for target in targets])

    def _jacobian(self, q: Array, target: NDArray[np.int64], without: Collection[Part]) -> Array:
        """Position rows (m, 3, k); what ``without`` could explain over all of them is removed."""
        _, J = self.layout.jacobian(self.cell, np.ascontiguousarray(q), target)
        rows = J[:, :3].reshape(-1, J.shape[2])
        own = rows[:, self._columns(without)]
        if own.shape[1]:
            rows = rows - own @ np.linalg.lstsq(own, rows, rcond=None)[0]
        return np.asarray(rows.reshape(len(q), 3, -1))

    def _columns(self, parts: Collection[Part]) -> NDArray[np.bool_]:
        """Mask (k,) of the unknowns that belong to base or tool."""
        mask = np.zeros(len(self.layout.names), dtype=np.bool_)
        if "base" in parts and self.layout.base >= 0:
            mask[self.layout.base : self.layout.base + 6] = True
        if "tool" in parts and self.layout.tool[0] >= 0:
            mask[self.layout.tool[0] :] = True
        return mask


def identify(
    arm: SerialArm,
    data: Measurements,
    *,
    fit: Collection[Part] = ("base", "tool", "geometry"),
    method: Method = "map",
    prior_covariance: Array | None = None,
    start: CellModel | None = None,
    robust: bool = True,
) -> Identification:
    """Identify the parts named in ``fit``.

    Parameters
    ----------
    arm : nominal arm; the mean of the prior.
    data : m samples of one or several targets; poses when ``data.rotation`` is given.
    method : ``map`` keeps every free parameter, with a Gaussian prior about the nominal one;
        ``lsq`` has no prior and holds parameters whose effect base or targets have too.
    prior_covariance : (k, k) of the arm's free parameters, SI; default: building tolerances,
        scaled to what the data show (`fitted_prior`).
    start : known base and targets; where a part of them is not in ``fit`` it is held there.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When the data cannot answer; the message names the missing motion.
    """
    parts = frozenset(fit)
    base, tool = "base" in parts, "tool" in parts
    initial = linear_start(arm, data, base=base, tool=tool) if start is None else start
    names = arm.parameters.names if "geometry" in parts else ()
    orientation = data.rotation is not None

    def layout_of(geometry: tuple[str, ...]) -> UnknownLayout:
        return make_layout(
            arm, initial.targets, geometry=geometry, base=base, tool=tool, orientation=orientation
        )

    complete = layout_of(names)
    held = _redundant(complete, initial, arm, len(names)) if method == "lsq" else ()
    layout = layout_of(tuple(n for n in names if n not in held)) if held else complete
    by_prior = method == "map" and bool(names)
    covariance = prior_covariance if by_prior else None
    if by_prior and covariance is None:
        covariance = np.diag(default_prior(arm))
    try:
        estimate, lever = _solve(arm, data, layout, initial, covariance, robust)
        if by_prior and prior_covariance is None:
            count, found = len(names), arm.parameters.read(estimate.state.arm.mdh - arm.mdh)
            variances = fitted_prior(arm, found, estimate.covariance[:count, :count])
            covariance = np.diag(variances)
            estimate, lever = _solve(arm, data, layout, estimate.state, covariance, robust)
    except RankDeficientError as error:
        still = still_joints(arm, data)
        raise RankDeficientError(
            f"{error}; {still}" if still else f"{error}", error.directions
        ) from error
    result = _report(arm, data, estimate, layout, complete, method, held, lever)
    return replace(result, prior_covariance=covariance)


def _solve(
    arm: SerialArm,
    data: Measurements,
    layout: UnknownLayout,
    initial: CellModel,
    prior_covariance: Array | None,
    robust: bool,
) -> tuple[estimation.Estimate[CellModel], float]:
    """Solve; orientations settle what positions leave open and weigh little beside them.

    Unmodelled bending and eccentricity shift and tilt the flange together, so orientations add
    less than their fine noise suggests: a turn counts as a quarter of what it moves over the
    target's own distance, and less where orientations scatter more than that.
    """
    sigma = np.ones(len(data)) if data.sigma is None else data.sigma
    reach = float(np.linalg.norm(initial.T_flange_target[:, :3, 3], axis=1).mean())
    most = max(_ORIENTATION_SHARE * reach, _SHORTEST_LEVER_M)
    prior = None
    if prior_covariance is not None:
        count = len(prior_covariance)
        prior = np.zeros((len(layout.names), len(layout.names)))
        prior[:count, :count] = np.linalg.inv(prior_covariance)
    lever = most
    if data.rotation is not None:
        unit = CellProblem(layout, data, initial.targets, sigma, 1.0, arm.mdh)
        lever = _lever(unit.linearise(initial)[0] * sigma[:, None], 1.0, most)
    state = initial
    for _ in range(_LEVER_ROUNDS):
        problem = CellProblem(layout, data, initial.targets, sigma, lever, arm.mdh)
        estimate = estimation.solve(
            problem,
            state,
            prior_information=prior,
            noise_known=data.sigma is not None,
            robust=robust,
        )
        if data.rotation is None:
            break
        used = (estimate.residual * sigma[:, None])[~estimate.rejected]
        state, settled = estimate.state, _lever(used, lever, most)
        if abs(settled / lever - 1.0) < 0.1:
            break
        lever = settled
    return estimate, lever


def _lever(residual: Array, lever: float, most: float) -> float:
    """Length, m, by which a turn counts: ``most``, or the scatters' ratio where that is less."""
    position = np.median(np.linalg.norm(residual[:, :3], axis=1))
    turn = np.median(np.linalg.norm(residual[:, 3:], axis=1)) / lever
    return float(min(most, max(position, 1e-9) / max(turn, 1e-9)))


def random_postures(arm: SerialArm, count: int = 60) -> Array:
    """The same postures (count, n) at every call, throughout the joint limits."""
    rng = np.random.default_rng(0)
    span = np.where(arm.prismatic, 0.5, np.pi)
    lower = np.where(np.isfinite(arm.lower), arm.lower, -span)
    upper = np.where(np.isfinite(arm.upper), arm.upper, span)
    return np.asarray(rng.uniform(lower, upper, (count, arm.n)))


def _redundant(
    layout: UnknownLayout, cell: CellModel, arm: SerialArm, count: int
) -> tuple[str, ...]:
    """Model parameters whose effect base, targets or earlier parameters have at every posture."""
    q = random_postures(arm)
    target = np.repeat(np.arange(len(cell.targets)), len(q))
    J = layout.jacobian(cell, np.tile(q, (len(cell.targets), 1)), target)[1]
    J = J.reshape(-1, len(layout.names))
    order = [*range(count, J.shape[1]), *range(count)]
    length = np.linalg.norm(J[:, order], axis=0)
    J = J[:, order] / np.where(length > 0.0, length, 1.0)
    dependent = np.abs(np.diag(np.linalg.qr(J, mode="r"))) < 1e-9
    return tuple(layout.names[i] for i, d in zip(order, dependent, strict=True) if d)


def still_joints(arm: SerialArm, data: Measurements) -> str:
    """Name the joints that the data do not turn by 5 deg (or move by 1 cm); empty if none."""
    span = np.ptp(data.q, axis=0)
    still = [
        f"{name} moves only {s * 1e3:.2g} mm"
        if slides
        else f"{name} moves only {np.degrees(s):.2g} deg"
        for name, s, slides in zip(arm.joint_names, span, arm.prismatic, strict=True)
        if s < (_STILL_M if slides else _STILL_RAD)
    ]
    return f"in these data {', '.join(still)}: move it" if still else ""


def _report(
    arm: SerialArm,
    data: Measurements,
    estimate: estimation.Estimate[CellModel],
    layout: UnknownLayout,
    complete: UnknownLayout,
    method: Method,
    held: tuple[str, ...],
    lever: float,
) -> Identification:
    if data.sigma is None:
        require_told(estimate.freedom)
    seen = estimate.observability
    if held:
        sigma = np.ones(len(data)) if data.sigma is None else data.sigma
        problem = CellProblem(complete, data, estimate.state.targets, sigma, lever, arm.mdh)
        _, J = problem.linearise(estimate.state)
        seen = observability(J[~estimate.rejected].reshape(-1, J.shape[2]))
    words = tuple(describe(column, complete.names, complete.to_display) for column in seen.null.T)
    known = data.sigma
    return Identification(
        nominal=arm,
        cell=estimate.state,
        layout=layout,
        method=method,
        estimate=estimate,
        held=held,
        prior_covariance=None,
        unobservable=words,
        rejected=tuple(data.sample[i] for i in np.flatnonzero(estimate.rejected)),
        noise_m=estimate.scale * (1.0 if known is None else float(np.sqrt(np.mean(known**2)))),
        lever_m=lever,
    )
