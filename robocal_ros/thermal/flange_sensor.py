# SPDX-License-Identifier: Apache-2.0
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

from robocal_ros.estimation import estimation
from robocal_ros.estimation.assessment import (
    LARGEST_RMS_M,
    Judgement,
    gross,
    hold_out,
    judge,
    judged_errors_document,
    pose_groups,
    summarise,
    too_narrow,
    verdict_document,
)
from robocal_ros.estimation.estimation import describe
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    InputError,
    RankDeficientError,
    ResidualError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array, Document, transform_document
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell_model import CellModel
from robocal_ros.identification.solve import default_prior, fitted_prior
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import model_document, parameters_document, random_postures
from robocal_ros.thermal.reference import ColdReference, SpheresInCell

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

    ``T_flange_sensor`` (4, 4). ``spheres``, ``centres``: names and (s, 3) centres in base, m.
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
        arm.turned(q), arm.links, arm.T_base_root, tools, each, slots, -1, none, T, J
    )
    return J


def hand_eye_start(arm: SerialArm, data: Measurements) -> MeasuringRobot:
    """Hand-eye pose and centres in closed form with the arm's present parameters.

    ``R_i (R_X p_i + t_X) - c = -t_i`` is linear in R_X (nine numbers), t_X and the centres.

    Raises `TooFewSamplesError` or `RankDeficientError` when the poses cannot give them.
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


@dataclass(frozen=True)
class FlangeSensorIdentification:
    """An identified measuring robot with its uncertainty.

    ``unobservable``: directions, in words, that the data leave to the prior. ``noise_m``: standard
    deviation of a measured coordinate, as given or as found.
    """

    nominal: SerialArm
    cell: MeasuringRobot
    problem: FlangeSensorProblem
    estimate: estimation.Estimate[MeasuringRobot]
    unobservable: tuple[str, ...]
    rejected: tuple[str, ...]
    noise_m: float

    def workspace_rms(self) -> float:
        """Rms error, m, of a point seen in the middle of the sensor's field.

        Over postures throughout the joint limits; what another base or mounting would explain
        does not count.
        """
        rows, count = self._workspace_rows(), self.problem.count
        spread = self.estimate.covariance[:count, :count]
        return float(np.sqrt(np.mean(np.einsum("mik,kl,mil->m", rows, spread, rows))))

    def workspace_change(self, arm: SerialArm) -> float:
        """Rms displacement, m, of the same point from ``arm``'s parameters to the identified."""
        chosen = self.nominal.parameters
        moved = self._workspace_rows() @ chosen.read(self.cell.arm.mdh - arm.mdh)
        return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))

    def _workspace_rows(self) -> Array:
        """Rows (m, 3, k) of the parameters, without what base and mounting explain."""
        seen = self.problem.data.position.mean(axis=0)
        X = self.cell.T_flange_sensor
        p_flange = X[:3, :3] @ seen + X[:3, 3]
        q = random_postures(self.nominal)
        arm = self.cell.arm
        T = arm.fk(q)
        rows = arm.parameter_jacobian(q, p_flange)[:, :3]
        lever = T[:, :3, :3] @ p_flange + T[:, :3, 3]
        base = np.concatenate([np.tile(np.eye(3), (len(q), 1, 1)), -frames.skew(lever)], axis=2)
        mounting = np.concatenate([T[:, :3, :3], -T[:, :3, :3] @ frames.skew(p_flange)], axis=2)
        own = np.concatenate([base, mounting], axis=2).reshape(-1, 12)
        flat = rows.reshape(len(own), -1)
        left = flat - own @ np.linalg.lstsq(own, flat, rcond=None)[0]
        return np.asarray(left.reshape(rows.shape))

    def predicted_variance(self, data: Measurements) -> Array:
        """Predicted variance (m,) of the distance from each sphere's mean, m^2, without noise."""
        problem = replace(self.problem, data=data, spheres=data.targets, sigma=np.ones(len(data)))
        index = data.target_index(data.targets)
        centres = self.cell.means(data)
        _, J = problem.linearise(replace(self.cell, spheres=data.targets, centres=centres))
        k = problem.count + 6
        rows = J[:, :, :k]
        for i in range(len(data.targets)):  # the centres are refitted: a common shift is not seen
            rows[index == i] -= rows[index == i].mean(axis=0)
        spread = self.estimate.covariance[:k, :k]
        return np.asarray(np.einsum("mik,kl,mil->m", rows, spread, rows))


def identify_flange_sensor(
    arm: SerialArm, data: Measurements, *, geometry: bool = True
) -> FlangeSensorIdentification:
    """Solve hand-eye pose and centres, and with ``geometry`` all model parameters.

    The parameters have building tolerances as prior, scaled to what the data show
    (`fitted_prior`).
    """
    start = hand_eye_start(arm, data)
    sigma = np.ones(len(data)) if data.sigma is None else data.sigma
    problem = FlangeSensorProblem(arm, data, start.spheres, geometry, sigma)

    def solve(state: MeasuringRobot, variance: Array | None) -> estimation.Estimate[MeasuringRobot]:
        prior = None
        if variance is not None:
            prior = np.zeros((len(problem.names),) * 2)
            prior[: len(variance), : len(variance)] = np.diag(1.0 / variance)
        given = data.sigma is not None
        return estimation.solve(problem, state, prior_information=prior, noise_known=given)

    if geometry:
        count = problem.count
        first = solve(start, default_prior(arm))
        found = arm.parameters.read(first.state.arm.mdh - arm.mdh)
        estimate = solve(first.state, fitted_prior(arm, found, first.covariance[:count, :count]))
    else:
        estimate = solve(start, None)
    known = 1.0 if data.sigma is None else float(np.sqrt(np.mean(data.sigma**2)))
    return FlangeSensorIdentification(
        nominal=arm,
        cell=estimate.state,
        problem=problem,
        estimate=estimate,
        unobservable=tuple(
            describe(direction, problem.names, problem.to_display)
            for direction in estimate.observability.null.T
        ),
        rejected=tuple(data.sample[i] for i in np.flatnonzero(estimate.rejected)),
        noise_m=estimate.scale * known,
    )


@dataclass(frozen=True)
class JudgedFlangeSensor(Judgement):
    """An identified measuring robot with its judgement.

    Errors are distances of each measured centre, in base, from its sphere's mean over the session.
    Each model has a hand-eye pose of its own, from the same sessions.
    """

    identification: FlangeSensorIdentification


def identify_and_judge_flange_sensor(
    arm: SerialArm,
    sessions: Sequence[Measurements],
    check: Measurements | None = None,
    *,
    share: float = 0.5,
    seed: int = 0,
    in_force: SerialArm | None = None,
) -> JudgedFlangeSensor:
    """Identify from sessions and judge on ``check``, in which only the centres are refitted.

    Without ``check`` a ``share`` of the poses of the sessions is held out.
    ``in_force``: arm with the parameters in force, default the nominal ``arm``.
    """
    train = in_sessions(sessions)
    if check is None:
        held = hold_out(pose_groups(train.q), share, seed)
        train, check = train.take(~held), train.take(held)
    result = identify_flange_sensor(arm, train)
    plain = identify_flange_sensor(arm, train, geometry=False)
    was = plain if in_force is None else identify_flange_sensor(in_force, train, geometry=False)
    before = np.linalg.norm(was.cell.scatter(check), axis=1)
    after = np.linalg.norm(result.cell.scatter(check), axis=1)
    sound = ~gross(before, after)
    model = float(result.predicted_variance(check).mean())
    noise = result.noise_m
    if check.sigma is not None:  # as much above what is stated as where it was solved from
        noise = max(1.0, result.estimate.scale) * float(np.sqrt(np.mean(check.sigma**2)))
    current = summarise(before[sound])
    workspace_rms_m = result.workspace_rms()
    change_m = result.workspace_change(in_force or arm)
    remedy = "look at the spheres from more sides, and turn every joint"
    doubt = result.estimate.creeping or too_narrow(workspace_rms_m, change_m, current.rms_m, remedy)
    return JudgedFlangeSensor(
        identification=result,
        nominal=summarise(plain.cell.scatter(check)[sound]),
        current=current,
        candidate=summarise(after[sound]),
        predicted_rms_m=float(np.sqrt(model)),
        predicted_total_rms_m=float(np.sqrt(model + 3.0 * noise**2)),
        workspace_rms_m=workspace_rms_m,
        held_out_rejected=tuple(check.sample[i] for i in np.flatnonzero(~sound)),
        verdict=judge(before[sound], after[sound], pose_groups(check.q)[sound], doubt),
    )


def flange_sensor_document(judged: JudgedFlangeSensor) -> Document:
    """A measuring robot in the form of ``identify``, with hand-eye pose and spheres."""
    result = judged.identification
    problem, seen = result.problem, result.estimate.observability
    sigma = dict(
        zip(problem.names, np.sqrt(np.diag(result.estimate.covariance)).tolist(), strict=True)
    )
    return {
        "robot": result.nominal.name,
        "model_hash": result.nominal.model_hash,
        "method": "map",
        **judged_errors_document(judged),
        "parameters": parameters_document(result.nominal, result.cell.arm, sigma),
        "T_flange_sensor": transform_document(result.cell.T_flange_sensor),
        "spheres": {
            name: {"xyz_mm": (centre * 1e3).tolist()}
            for name, centre in zip(result.cell.spheres, result.cell.centres, strict=True)
        },
        "noise_mm": result.noise_m * 1e3,
        "samples": len(result.problem.data),
        "rank": seen.rank,
        "unknowns": len(problem.names),
        "condition": seen.condition,
        "unobservable": list(result.unobservable),
        "held": [],
        "rejected": list(result.rejected),
        "held_out_rejected": list(judged.held_out_rejected),
        "converged": result.estimate.converged,
        "verdict": verdict_document(judged.verdict),
    }


def flange_sensor_model(found: FlangeSensorIdentification) -> Document:
    """``model_document`` of the identified arm, with its parameters' covariance (SI)."""
    count = found.problem.count
    return model_document(found.cell.arm) | {
        "parameters": list(found.problem.names[:count]),
        "covariance": found.estimate.covariance[:count, :count].tolist(),
    }


def capture_on_flange(arm: SerialArm, data: Measurements, frame: str = "") -> ColdReference:
    """Place sensor and spheres from a cold visit with the cold model ``arm``: its reference.

    ``frame``: the sensor's.
    Each pose's static error stays with the point of the flange that saw the sphere, and cancels
    when the pose is visited again.

    Raises `TooFewSamplesError` or `RankDeficientError` when the visit cannot place them;
    `ResidualError` when it misses the arm by more than 5 mm rms.
    """
    found = identify_flange_sensor(arm, data, geometry=False)
    robot = found.cell
    rms_m = summarise(robot.scatter(data.take(~np.isin(data.sample, found.rejected)))).rms_m
    if rms_m > LARGEST_RMS_M:
        raise ResidualError(
            f"the cold visit misses the model by {rms_m * 1e3:.1f} mm rms, more than any robot's "
            f"static error ({LARGEST_RMS_M * 1e3:.0f} mm): check robot file, units, joint signs, "
            "whether the sensor is on the flange, and the spheres' names"
        )
    index = data.target_index(robot.spheres)
    _, first, spot = np.unique(
        pose_groups(data.q) * len(robot.spheres) + index, return_index=True, return_inverse=True
    )
    mean = np.zeros((len(first), len(data)))
    mean[spot, np.arange(len(data))] = 1.0 / np.bincount(spot)[spot]
    places = frames.transform(np.eye(3), np.zeros(3))[None].repeat(len(first), axis=0)
    places[:, :3, 3] = mean @ frames.apply(robot.T_flange_sensor, data.position)
    sphere = tuple(data.target[i] for i in first)
    cell = CellModel(
        arm, np.eye(4), tuple(f"{name}@{i}" for i, name in enumerate(sphere, 1)), places
    )
    spheres = SpheresInCell(
        robot.T_flange_sensor, sphere, robot.centres[index[first]], mean @ data.q, frame
    )
    placed = spheres.placed(cell, data)
    return ColdReference(cell, placed, found.rejected, spheres=spheres)
