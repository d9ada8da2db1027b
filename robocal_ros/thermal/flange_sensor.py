"""A measuring robot: the sensor rides on the flange and sees spheres that are fixed in the cell.

``c = T_base_flange(q) T_flange_sensor p_sensor`` is the same at every pose of one sphere. Geometry,
hand-eye pose and all centres are unknowns of one problem; that each centre stays where it is is
the only information, so that a move of the whole cell is not seen (d1 and theta1), and the last
joint is seen only together with the sensor's mounting.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RankDeficientError, TooFewSamplesError
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_HAND_EYE = (
    "sensor_x_mm",
    "sensor_y_mm",
    "sensor_z_mm",
    "sensor_rx_deg",
    "sensor_ry_deg",
    "sensor_rz_deg",
)
_AXES = ("x_mm", "y_mm", "z_mm")
_SMALLEST_SPREAD = 1e-6


@dataclass(frozen=True)
class MeasuringRobot:
    """An arm with a sensor, and the spheres that it sees.

    Attributes
    ----------
    T_flange_sensor : (4, 4).
    spheres, centres : names and (s, 3) centres in base, m.
    """

    arm: SerialArm
    T_flange_sensor: Array
    spheres: tuple[str, ...]
    centres: Array

    def in_base(self, data: Measurements) -> Array:
        """Measured centres (m, 3) carried to the base, m."""
        T = self.arm.fk(data.q) @ self.T_flange_sensor
        return frames.apply(T, data.position)

    def scatter(self, data: Measurements) -> Array:
        """Measured centres less the mean of their sphere (m, 3), m: the centres are refitted."""
        means = self.means(data)
        return np.asarray(self.in_base(data) - means[data.target_index(data.targets)])

    def means(self, data: Measurements) -> Array:
        """Mean (s, 3) in base, m, of the measured centres of each of the data's spheres."""
        index, points = data.target_index(data.targets), self.in_base(data)
        sums = np.stack([np.bincount(index, points[:, i]) for i in range(3)], axis=1)
        return np.asarray(sums / np.bincount(index)[:, None])


def in_sessions(sessions: Sequence[Measurements]) -> Measurements:
    """All measurements as one; a sphere may have moved between sessions, so each has its own.

    The target becomes ``<sphere>@<session, from 1>`` where there are several.
    """
    if len(sessions) == 1:
        return sessions[0]
    sigmas = [data.sigma for data in sessions]
    known = [sigma for sigma in sigmas if sigma is not None]
    if known and len(known) < len(sessions):
        raise InputError("sigma is given in some sessions and not in others: give it in all")
    return Measurements(
        q=np.vstack([data.q for data in sessions]),
        position=np.vstack([data.position for data in sessions]),
        target=tuple(f"{t}@{i}" for i, data in enumerate(sessions, 1) for t in data.target),
        sample=tuple(f"{s}@{i}" for i, data in enumerate(sessions, 1) for s in data.sample),
        sigma=np.concatenate(known) if known else None,
    )


@dataclass(frozen=True)
class FlangeSensorProblem:
    """Residuals in base axes, for ``estimation.solve``.

    Unknowns: the model parameters ``chosen``, six of the hand-eye pose (shift and turn in flange
    axes), three of each sphere. ``sigma`` (m,): of each coordinate (ones where unknown).
    """

    arm: SerialArm
    data: Measurements
    spheres: tuple[str, ...]
    geometry: bool
    sigma: Array

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names (k) of the increments."""
        own = self.arm.parameters.names if self.geometry else ()
        return own + _HAND_EYE + tuple(f"{s}_{axis}" for s in self.spheres for axis in _AXES)

    @cached_property
    def to_display(self) -> Array:
        """Factors (k,) from SI to the unit in each name."""
        return np.array([1e3 if name.endswith("_mm") else np.degrees(1.0) for name in self.names])

    @property
    def scale_components(self) -> int:
        """All three coordinates tell the noise."""
        return 3

    @property
    def count(self) -> int:
        """Number of model parameters."""
        return len(self.arm.parameters) if self.geometry else 0

    def linearise(self, state: MeasuringRobot) -> tuple[Array, Array]:
        """Whitened residual (m, 3) and Jacobian (m, 3, k)."""
        data, g = self.data, self.count
        index = data.target_index(self.spheres)
        centre = state.centres[index]
        residual = state.in_base(data) - centre
        # The Jacobian is taken at the centre, not at the measured point. They differ by the
        # residual r, and r . (w x r) = 0: the gradient is the same, and what a move of the cell
        # leaves unseen stays unseen to the last digit in spite of the noise.
        T = state.arm.fk(data.q)
        R = T[:, :3, :3]
        p_flange = np.einsum("mji,mj->mi", R, centre - T[:, :3, 3])
        J = np.zeros((len(data), 3, len(self.names)))
        if g:
            J[:, :, :g] = _point_jacobian(state.arm, data.q, p_flange)
        J[:, :, g : g + 3] = R
        J[:, :, g + 3 : g + 6] = -R @ frames.skew(p_flange - state.T_flange_sensor[:3, 3])
        columns = g + 6 + 3 * index[:, None] + np.arange(3)
        J[np.arange(len(data))[:, None], np.arange(3), columns] = -1.0
        return residual / self.sigma[:, None], J / self.sigma[:, None, None]

    def retract(self, state: MeasuringRobot, step: Array) -> MeasuringRobot:
        """Move the state by an increment (k,)."""
        g, arm = self.count, state.arm
        if g:
            arm = arm.with_mdh(arm.parameters.add(arm.mdh, step[:g]))
        X = state.T_flange_sensor
        turned = frames.exp_rotation(step[g + 3 : g + 6]) @ X[:3, :3]
        moved = frames.transform(turned, X[:3, 3] + step[g : g + 3])
        return MeasuringRobot(
            arm, moved, self.spheres, state.centres + step[g + 6 :].reshape(-1, 3)
        )

    def deviation(self, state: MeasuringRobot) -> Array:
        """Model parameters' distance (k,) from the nominal ones; the rest has no prior."""
        away = np.zeros(len(self.names))
        if self.count:
            away[: self.count] = self.arm.parameters.read(state.arm.mdh - self.arm.mdh)
        return away


def _point_jacobian(arm: SerialArm, q: Array, p_flange: Array) -> Array:
    """Velocity (m, 3, k) in base, by the model parameters, of points (m, 3) of the flange."""
    from robocal_ros.kinematics import kernels

    m = len(q)
    T, J = np.empty((m, 4, 4)), np.zeros((m, 3, len(arm.parameters)))
    tools = frames.transform(np.eye(3), p_flange)
    none, each = np.full(m, -1, dtype=np.int64), np.arange(m, dtype=np.int64)
    slots = arm.parameters.slots(arm.n)
    kernels.parameter_batch(
        np.ascontiguousarray(q), arm.links, arm.T_base_root, tools, each, slots, -1, none, T, J
    )
    return J


def hand_eye_start(arm: SerialArm, data: Measurements) -> MeasuringRobot:
    """Hand-eye pose and centres in closed form with the arm's present parameters.

    ``R_i (R_X p_i + t_X) - c = -t_i`` is linear in R_X (nine numbers), t_X and the centres.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When the poses cannot give them.
    """
    spheres, T = data.targets, arm.fk(data.q)
    index, m = data.target_index(spheres), len(data)
    unknowns = 12 + 3 * len(spheres)
    if 3 * m < unknowns:
        raise TooFewSamplesError(
            f"{m} measurements cannot place the sensor and {len(spheres)} sphere(s): at least "
            f"{-(-unknowns // 3)} are needed"
        )
    A = np.zeros((m, 3, unknowns))
    for column in range(3):
        A[:, :, 3 * column : 3 * column + 3] = T[:, :3, :3] * data.position[:, None, column, None]
    A[:, :, 9:12] = T[:, :3, :3]
    columns = 12 + 3 * index[:, None] + np.arange(3)
    A[np.arange(m)[:, None], np.arange(3), columns] = -1.0
    x, _, _, s = np.linalg.lstsq(A.reshape(3 * m, -1), -T[:, :3, 3].ravel(), rcond=None)
    if s[-1] < _SMALLEST_SPREAD * s[0]:
        rank = int(np.sum(s >= _SMALLEST_SPREAD * s[0]))
        advice = "look at a sphere with the flange turned about two axes and from several places"
        raise RankDeficientError(
            f"sensor and spheres together: rank {rank} of {unknowns}; {advice}", (advice,)
        )
    R = frames.nearest_rotation(x[:9].reshape(3, 3).T)
    start = MeasuringRobot(arm, frames.transform(R, x[9:12]), spheres, np.zeros((len(spheres), 3)))
    return replace(start, centres=start.means(data))
