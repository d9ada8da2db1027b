"""Maximum likelihood of a hand-eye calibration, with the noise of both sides."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.estimation import Estimate, solve
from robocal_ros.core.hand_eye.camera_model import PairProblem, PairState, linearised
from robocal_ros.core.hand_eye.camera_noise import (
    Evidence,
    PairNoise,
    covariances,
    estimate,
    first_guess,
)
from robocal_ros.core.hand_eye.camera_start import robust_start
from robocal_ros.core.hand_eye.pose_pairs import Placement, PosePairs

Array = NDArray[np.float64]

_ROUNDS = 8  # of weights and noise in turn
_SETTLED = 0.02  # of a standard deviation
_ENOUGH_TO_DOUBT = 6  # samples: fewer tell neither outliers nor several variances


@dataclass(frozen=True)
class GivenNoise:
    """What is known of the noise, standard deviations per axis; None is estimated.

    Attributes
    ----------
    camera_m, camera_rad : of board poses without a covariance of their own.
    camera_scale : factor of the sigmas in the covariance that board poses have: 1 to trust it. What
        is told of corners alone knows nothing of a lens or a board that are not as assumed.
    """

    robot_m: float | None = None
    robot_rad: float | None = None
    camera_m: float | None = None
    camera_rad: float | None = None
    camera_scale: float | None = None

    def variances(self, own_covariance: bool) -> Array:
        """(3,) as of `PairNoise`; nan where they are to be estimated."""
        unknown = float("nan")
        robot = unknown if self.robot_m is None else self.robot_m**2
        turn = unknown if self.robot_rad is None else self.robot_rad**2
        if own_covariance:
            scale = unknown if self.camera_scale is None else self.camera_scale**2 - 1.0
            return np.array([robot, turn, scale])
        place = unknown if self.camera_m is None else robot + self.camera_m**2
        return np.array([place, turn, unknown if self.camera_rad is None else self.camera_rad**2])


@dataclass(frozen=True, eq=False)
class PairFit:
    """A solved calibration.

    Attributes
    ----------
    noise : of both sides, given or estimated.
    expected : (m, 6, 6) covariance of the samples' differences by the noise alone.
    settled : whether noise and placements agree in the end; where the noise is known they do.
    """

    pairs: PosePairs
    noise: PairNoise
    expected: Array
    estimate: Estimate[PairState]
    settled: bool

    @property
    def at(self) -> Placement:
        """Where camera and board are."""
        return self.estimate.state.at

    @cached_property
    def _linearised(self) -> tuple[Array, Array]:
        return linearised(self.pairs, self.estimate.state)

    @property
    def differences(self) -> Array:
        """Differences (m, 6) of all samples, camera axes, m and rad."""
        return self._linearised[0]

    @property
    def jacobian(self) -> Array:
        """Their Jacobian (m, 6, 12 + s)."""
        return self._linearised[1]

    @property
    def covariance(self) -> Array:
        """Covariance (12, 12) of the increments (v, w) of X, camera axes, and of Z, board axes.

        Of a stream it is widened, because neighbours share their errors.
        """
        return self.whole_covariance[:12, :12]

    @property
    def whole_covariance(self) -> Array:
        """The same with the common errors (12 + s, 12 + s)."""
        if self.pairs.time_s is None:
            return self.estimate.covariance
        return self.estimate.covariance * correlation(self.estimate.residual[~self.rejected])

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """(m,) samples that were not used."""
        return self.estimate.rejected


def fit_pairs(
    pairs: PosePairs, given: GivenNoise | None = None, start: Placement | None = None,
    sound: Placement | None = None,
) -> PairFit:  # fmt: skip
    """Find the most likely placements, reject what does not fit, estimate the unknown noise.

    ``start``: where the search begins; default ``sound``. ``sound``: a placement near the truth,
    from which the noise is guessed; default `robust_start`.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        As `robocal_ros.core.estimation.solve`.
    """
    known = (given or GivenNoise()).variances(pairs.covariance is not None)
    free = np.isnan(known)
    sound = robust_start(pairs) if sound is None else sound
    count = 0 if pairs.shared is None else len(pairs.shared.covariance)
    state = PairState(start or sound, np.zeros(count))
    enough = len(pairs) >= _ENOUGH_TO_DOUBT
    noise = first_guess(pairs, sound, known)
    X = sound.X  # not of a start that may be far off: weights follow from it
    for _ in range(_ROUNDS):
        V = covariances(pairs, X, noise)
        scale = 1.0 if pairs.covariance is None else noise.camera_scale
        problem = PairProblem.of(pairs, V, scale)
        found = solve(
            problem,
            state,
            prior_information=problem.prior_information,
            noise_known=enough or not np.any(free),
            robust=enough,
        )
        before, settled, state, X = noise, True, found.state, found.state.at.X
        if np.any(free) and enough:
            miss, J = linearised(pairs, state)
            keep = ~found.rejected
            used = pairs if np.all(keep) else pairs.take(keep)
            seen = Evidence.of(used, X, miss[keep], J[keep], state.common)
            noise, settled = estimate(seen, free, noise)
        settled = settled and _same(before, noise)
        if settled:
            break
    return PairFit(pairs, noise, V, found, settled)


def _same(before: PairNoise, after: PairNoise) -> bool:
    old, new = np.sqrt(before.variances), np.sqrt(after.variances)
    return bool(np.all(np.abs(new - old) <= _SETTLED * np.maximum(old, new)))


def correlation(residual: Array) -> float:
    """How many neighbours in a stream (n, c) count as one: 1 + 2 sum of autocorrelations.

    Summed up to the first pair of lags that is not positive (Geyer 1992).
    """
    r = residual - residual.mean(axis=0)
    n = len(r)
    power = np.abs(np.fft.rfft(r, 2 * n, axis=0)) ** 2
    lagged = np.fft.irfft(power.sum(axis=1))[:n]
    if lagged[0] <= 0.0:
        return 1.0
    rho = lagged / lagged[0]
    pairs = rho[0 : n - n % 2 : 2] + rho[1 : n + n % 2 : 2][: n // 2]
    until = int(np.argmax(pairs <= 0.0)) if np.any(pairs <= 0.0) else len(pairs)
    return max(float(2.0 * pairs[:until].sum() - 1.0), 1.0)
