"""Will planned poses do? Rank, expected error and better poses, before the robot moves.

The Fisher information of a pose is that of its predicted sighting: the Jacobian of the estimator at
the place where the target is expected, with the noise that sensor and robot are said to have.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.mount_fit import OPEN_M, open_directions
from robocal_ros.hand_eye.mount_problem import MountProblem, MountState, PoseNoise, TargetView
from robocal_ros.hand_eye.naming import joined
from robocal_ros.hand_eye.quality import expected_error_m, expected_errors_m
from robocal_ros.hand_eye.result import at_origin

Array = NDArray[np.float64]

VAGUE = 1.0  # m, rad: what is known without any measurement; an open direction has a large error
MOST_PROPOSED = 12
SPARE_POSES = 2  # beyond the fewest, so that one may be lost


@dataclass(frozen=True)
class SensorRange:
    """What a line-laser sensor sees: distances and width (m), points, noise along the beam (m)."""

    near_m: float = 0.19
    far_m: float = 0.21
    width_m: float = 0.06
    points: int = 1280
    noise_m: float = 3.7e-5

    @property
    def middle_m(self) -> float:
        """The distance to work at."""
        return 0.5 * (self.near_m + self.far_m)

    @property
    def pivot(self) -> Array:
        """The middle (3,) of its field, sensor frame, m."""
        return np.array([0.0, 0.0, self.middle_m])

    @property
    def field_points(self) -> Array:
        """Middle and corners (5, 3) of its field, sensor frame, m."""
        half = 0.5 * self.width_m
        corners = [[x, 0.0, z] for x in (-half, half) for z in (self.near_m, self.far_m)]
        return np.array([self.pivot, *corners])


class PlannedTarget(Protocol):
    """How a target would be seen, and from where it could be."""

    @property
    def fewest(self) -> int:
        """Poses without which nothing is solved."""

    def place(self, T_base_sensor: Array) -> Array:
        """Where it is expected, from sensor poses (m, 4, 4) that look at it."""

    def view(self, T_base_flange: Array, T_flange_sensor: Array, place: Array) -> TargetView:
        """Sightings to expect from flange poses (m, 4, 4); those with their pose's index."""

    def unseen(self, view: TargetView) -> dict[int, str]:
        """Poses from which it is out of view, and why."""

    def candidates(self, T_base_sensor: Array, place: Array) -> Array:
        """Sensor poses (n, 4, 4) that see it well, turned about those that are planned."""


@dataclass(frozen=True, eq=False)
class PlanReport:
    """What a plan is worth.

    Attributes
    ----------
    rank, unknowns : of the problem; a direction that stays open by 2 cm is not seen, even where
        rounding or a faint effect would tell something. unobservable : those of the sensor, in
        words.
    sigma : (6,) expected, sensor axes: m, rad; working_error_m: rms at the working distance.
    unseen : poses (by index) that do not see the target, with the reason.
    proposed : (n, 4, 4) flange poses to add, best first; proposed_error_m: with all of them, None
        where there is none.
    """

    rank: int
    unknowns: int
    unobservable: tuple[str, ...]
    sigma: Array | None
    working_error_m: float | None
    unseen: dict[int, str]
    proposed: Array
    proposed_error_m: float | None
    verdict: Verdict


def check_plan(
    target: PlannedTarget,
    T_base_flange: Array,
    T_flange_sensor: Array,
    sensor: SensorRange,
    noise: PoseNoise,
    limit_m: float,
) -> PlanReport:
    """Judge planned flange poses (m, 4, 4), with an approximate T_flange_sensor (4, 4).

    ``limit_m``: largest expected error (rms) of a point at the working distance.
    """
    place = target.place(T_base_flange @ T_flange_sensor)
    state = MountState(T_flange_sensor, (place,))
    whole = target.view(T_base_flange, T_flange_sensor, place)
    unseen = target.unseen(whole)
    rows = ~np.isin(whole.sightings.shot, list(unseen))
    seen = len(T_base_flange) - len(unseen)
    shown = _shown(whole.take(rows), state, noise, sensor)
    field = sensor.field_points - sensor.pivot
    error = None
    if shown.covariance is not None:
        error = expected_error_m(shown.covariance[:6, :6], field)
    verdict = _verdict(seen, target.fewest, shown.words, error, limit_m)
    proposed, better = np.empty((0, 4, 4)), None
    if not verdict.accept:
        known = shown.information, noise, sensor, limit_m
        proposed, better = _propose(target, T_base_flange, state, known, seen)
    return PlanReport(
        shown.rank,
        len(shown.information),
        tuple(shown.words),
        shown.sigma(sensor),
        error,
        unseen,
        proposed,
        better,
        verdict,
    )


@dataclass(frozen=True, eq=False)
class _Shown:
    """What sightings show: information (k, k), its inverse where there is one, open directions."""

    rank: int
    information: Array
    covariance: Array | None
    words: list[str]

    def sigma(self, sensor: SensorRange) -> Array | None:
        """Expected standard deviations (6,) at the sensor's origin."""
        if self.covariance is None:
            return None
        return np.sqrt(np.diag(at_origin(self.covariance[:6, :6], sensor.pivot)))


def _shown(view: TargetView, state: MountState, noise: PoseNoise, sensor: SensorRange) -> _Shown:
    k = 6 + len(view.model.names)
    if not view.sightings.names:
        return _Shown(0, np.zeros((k, k)), None, ["no pose sees the target"])
    problem = MountProblem((view,), noise, state, pivot=sensor.pivot)
    J = problem.linearise(state)[1].reshape(-1, k)
    information = J.T @ J + problem.prior()
    covariance = np.asarray(np.linalg.inv(information + VAGUE**-2 * np.eye(k)))
    size = np.ones(k)
    size[3:6] = sensor.middle_m
    rank = int(np.sum(np.linalg.eigvalsh(covariance * np.outer(size, size)) < OPEN_M**2))
    at_sensor = at_origin(covariance[:6, :6], sensor.pivot)
    words = open_directions(at_sensor, sensor.middle_m, view.sightings.T_base_flange)
    return _Shown(rank, information, None if words else covariance, words)


def _verdict(
    seen: int, fewest: int, words: Sequence[str], error: float | None, limit_m: float
) -> Verdict:
    open_ones = f"not determined: {joined(words)}" if words else ""
    if seen < fewest:
        few = f"{seen} poses see the target, at least {fewest} are needed"
        return Verdict(Code.TOO_FEW_SAMPLES, "; ".join(filter(None, (few, open_ones))))
    if words or error is None:
        return Verdict(Code.RANK_DEFICIENT, open_ones)
    figures = f"a point in the field of view is to be expected off by {error * 1e3:.3f} mm rms"
    if error > limit_m:
        return Verdict(
            Code.POSES_NOT_INFORMATIVE,
            f"{figures} (allowed {limit_m * 1e3:g} mm): add the proposed poses",
        )
    return Verdict(Code.ACCEPT, figures)


def _propose(
    target: PlannedTarget,
    T_base_flange: Array,
    state: MountState,
    known: tuple[Array, PoseNoise, SensorRange, float],
    seen: int,
) -> tuple[Array, float | None]:
    """Add, one by one, the candidate that lowers the expected error most, until they will do."""
    information, noise, sensor, limit_m = known
    X, place = state.T_flange_sensor, state.places[0]
    candidates = target.candidates(T_base_flange @ X, place)
    view = target.view(candidates @ frames.invert(X), X, place)
    problem = MountProblem((view,), noise, state, pivot=sensor.pivot)
    J = problem.linearise(state)[1]
    gain = np.zeros((len(candidates), *information.shape))
    gain[problem.poses] = np.swapaxes(J, 1, 2) @ J
    gain[list(target.unseen(view))] = 0.0
    total = information + VAGUE**-2 * np.eye(len(information))
    chosen: list[int] = []
    error = np.inf
    wanted = target.fewest + SPARE_POSES - seen
    while np.any(gain) and len(chosen) < MOST_PROPOSED:
        if error <= limit_m and len(chosen) >= wanted:
            break
        covariance = np.asarray(np.linalg.inv(total + gain)[:, :6, :6])
        errors = expected_errors_m(covariance, sensor.field_points - sensor.pivot)
        best = int(np.argmin(errors))
        error = float(errors[best])
        total = total + gain[best]
        gain[best] = 0.0  # once: the same pose again shows the same error again
        chosen.append(best)
    return candidates[chosen] @ frames.invert(X), error if chosen else None
