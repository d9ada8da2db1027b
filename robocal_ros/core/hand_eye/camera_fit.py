"""Maximum likelihood of a hand-eye calibration, with the noise of both sides."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.estimation import Estimate, solve
from robocal_ros.core.hand_eye.camera_model import PairProblem, PairState, linearised
from robocal_ros.core.hand_eye.camera_noise import (
    PairNoise,
    components,
    covariances,
    estimate,
    first_guess,
)
from robocal_ros.core.hand_eye.camera_start import robust_start
from robocal_ros.core.hand_eye.pose_pairs import Placement, PosePairs, differences, predicted

Array = NDArray[np.float64]

_ROUNDS = 8  # of weights and noise in turn
_SETTLED = 0.02  # of a standard deviation
_ENOUGH_TO_DOUBT = 6  # samples: fewer tell neither outliers nor several variances


@dataclass(frozen=True)
class GivenNoise:
    """What is known of the noise, standard deviations per axis; None is estimated."""

    robot_m: float | None = None
    robot_rad: float | None = None
    camera_m: float | None = None
    camera_rad: float | None = None


@dataclass(frozen=True, eq=False)
class PairFit:
    """A solved calibration.

    Attributes
    ----------
    at : the placement; ``covariance`` (12, 12) of the increments (v, w) of X along the camera's
        axes and of Z along the board's.
    differences : (m, 6) of all samples, camera axes, m and rad; ``expected`` (m, 6, 6) their
        covariance by the noise alone.
    """

    pairs: PosePairs
    at: Placement
    noise: PairNoise
    differences: Array
    jacobian: Array
    expected: Array
    estimate: Estimate[PairState]

    @property
    def covariance(self) -> Array:
        """Of both placements."""
        return self.estimate.covariance[:12, :12]

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """(m,) samples that were not used."""
        return self.estimate.rejected


def fit_pairs(
    pairs: PosePairs, given: GivenNoise | None = None, start: Placement | None = None
) -> PairFit:
    """Find the most likely placements, reject what does not fit, estimate the unknown noise.

    ``start``: where the search begins; default `robust_start`.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        As `robocal_ros.core.estimation.solve`.
    """
    known, free = _split(pairs, given or GivenNoise())
    sound = robust_start(pairs)
    count = 0 if pairs.shared is None else len(pairs.shared.covariance)
    state = PairState(start or sound, np.zeros(count))
    noise = first_guess(differences(predicted(pairs, sound), pairs), free, known)
    for _ in range(_ROUNDS):
        V = covariances(pairs, state.at.X, noise)
        problem = PairProblem.of(pairs, V)
        found = solve(
            problem,
            state,
            prior_information=problem.prior_information,
            noise_known=not np.any(free),
            robust=len(pairs) >= _ENOUGH_TO_DOUBT,
        )
        before, state = noise, found.state
        miss, J = linearised(pairs, state)
        keep = ~found.rejected
        if np.any(free) and int(keep.sum()) >= _ENOUGH_TO_DOUBT:
            parts = components(pairs, state.at.X)[:, keep]
            rest = covariances(pairs, state.at.X, PairNoise(0.0, 0.0))[keep]
            noise = estimate(miss[keep], J[keep], parts, rest, free, noise)
        if _same(before, noise):
            break
    return PairFit(pairs, state.at, noise, miss, J, V, found)


def _split(pairs: PosePairs, given: GivenNoise) -> tuple[PairNoise, NDArray[np.bool_]]:
    """What is known, and which of the three variances are to be estimated."""
    camera_known = pairs.covariance is not None
    known = PairNoise(
        given.robot_m or 0.0, given.robot_rad or 0.0, given.camera_m or 0.0, given.camera_rad or 0.0
    )
    free = [
        given.robot_m is None or (given.camera_m is None and not camera_known),
        given.robot_rad is None,
        given.camera_rad is None and not camera_known,
    ]
    return known, np.array(free)


def _same(before: PairNoise, after: PairNoise) -> bool:
    old, new = np.sqrt(before.variances), np.sqrt(after.variances)
    return bool(np.all(np.abs(new - old) <= _SETTLED * np.maximum(old, new)))
