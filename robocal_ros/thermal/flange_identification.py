"""Identification of a measuring robot, and its judgement on measurements not used to solve."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation import estimation
from robocal_ros.estimation.assessment import (
    Judgement,
    gross,
    hold_out,
    judge,
    pose_groups,
    summarise,
    too_narrow,
)
from robocal_ros.estimation.estimation import describe
from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.priors import default_prior, fitted_prior
from robocal_ros.identification.solve import random_postures
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.flange_sensor import (
    FlangeSensorProblem,
    MeasuringRobot,
    hand_eye_start,
    in_sessions,
)

Array = NDArray[np.float64]


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

    def workspace_change(self) -> float:
        """Rms displacement, m, of the same point by the identified parameters."""
        chosen = self.nominal.parameters
        moved = self._workspace_rows() @ chosen.read(self.cell.arm.mdh - self.nominal.mdh)
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
    arm: SerialArm, data: Measurements, *, geometry: bool = True, robust: bool = True
) -> FlangeSensorIdentification:
    """Solve hand-eye pose and centres, and with ``geometry`` all model parameters.

    The parameters have building tolerances as prior, scaled to what the data show
    (``priors.fitted_prior``).

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When the data cannot answer.
    """
    start = hand_eye_start(arm, data)
    sigma = np.ones(len(data)) if data.sigma is None else data.sigma
    problem = FlangeSensorProblem(arm, data, start.spheres, geometry, sigma)

    def solve(state: MeasuringRobot, variance: Array | None) -> estimation.Estimate[MeasuringRobot]:
        prior = None
        if variance is not None:
            prior = np.zeros((len(problem.names),) * 2)
            prior[: len(variance), : len(variance)] = np.diag(1.0 / variance)
        return estimation.solve(
            problem,
            state,
            prior_information=prior,
            noise_known=data.sigma is not None,
            robust=robust,
        )

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
    The nominal model, with a hand-eye pose of its own, is the one in force.
    """

    identification: FlangeSensorIdentification


def identify_and_judge_flange_sensor(
    arm: SerialArm,
    sessions: Sequence[Measurements],
    check: Measurements | None = None,
    *,
    share: float = 0.5,
    seed: int = 0,
) -> JudgedFlangeSensor:
    """Identify from sessions and judge on ``check``, in which only the centres are refitted.

    Without ``check`` a ``share`` of the poses of the sessions is held out.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When the data cannot answer.
    """
    train = in_sessions(sessions)
    if check is None:
        held = hold_out(pose_groups(train.q), share, seed)
        train, check = train.take(~held), train.take(held)
    result = identify_flange_sensor(arm, train)
    plain = identify_flange_sensor(arm, train, geometry=False)
    before = np.linalg.norm(plain.cell.scatter(check), axis=1)
    after = np.linalg.norm(result.cell.scatter(check), axis=1)
    sound = ~gross(before, after)
    model = float(result.predicted_variance(check).mean())
    noise = result.noise_m if check.sigma is None else float(np.sqrt(np.mean(check.sigma**2)))
    plain_error = summarise(before[sound])
    doubt = _doubt(result, plain_error.rms_m)
    return JudgedFlangeSensor(
        identification=result,
        nominal=plain_error,
        current=plain_error,
        candidate=summarise(after[sound]),
        predicted_rms_m=float(np.sqrt(model)),
        predicted_total_rms_m=float(np.sqrt(model + 3.0 * noise**2)),
        workspace_rms_m=result.workspace_rms(),
        held_out_rejected=tuple(check.sample[i] for i in np.flatnonzero(~sound)),
        verdict=judge(before[sound], after[sound], pose_groups(check.q)[sound], doubt),
    )


def _doubt(result: FlangeSensorIdentification, current_rms_m: float) -> str:
    """Say why the poses do not carry over to other ones; empty when they do."""
    remedy = "look at the spheres from more sides, and turn every joint"
    error, change = result.workspace_rms(), result.workspace_change()
    return result.estimate.creeping or too_narrow(error, change, current_rms_m, remedy)
