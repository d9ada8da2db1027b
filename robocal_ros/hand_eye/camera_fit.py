"""Maximum likelihood of a hand-eye calibration, with the noise of both sides."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import Estimate, solve
from robocal_ros.hand_eye.camera_model import PairProblem, PairState, linearised
from robocal_ros.hand_eye.camera_noise import (
    Evidence,
    Found,
    PairNoise,
    Parts,
    estimate,
    first_guess,
)
from robocal_ros.hand_eye.camera_start import robust_start
from robocal_ros.hand_eye.pose_pairs import Placement, PosePairs

Array = NDArray[np.float64]

_ROUNDS = 8  # of weights and noise in turn
_SAME = 1e-3  # m, and rad: levers change by parts in a thousand
_MANY = 30  # samples: so many bring the noise near to what all tell, in less time
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
        """(6,) as of `PairNoise`; nan where they are to be estimated."""
        unknown = float("nan")
        robot = unknown if self.robot_m is None else self.robot_m**2
        turn = unknown if self.robot_rad is None else self.robot_rad**2
        if own_covariance:
            scale = unknown if self.camera_scale is None else self.camera_scale**2 - 1.0
            return np.array([robot, turn, 0.0, 0.0, 0.0, scale])
        place, depth = unknown, unknown
        if self.camera_m is not None:
            place, depth = robot + self.camera_m**2, 0.0
        camera = unknown if self.camera_rad is None else self.camera_rad**2
        return np.array([place, turn, camera, camera, depth, 0.0])


@dataclass(frozen=True, eq=False)
class PairFit:
    """A solved calibration.

    Attributes
    ----------
    noise : of both sides, given or estimated.
    expected : (m, 6, 6) covariance of the samples' differences by the noise alone.
    settled : whether noise and placements agree in the end; where the noise is known they do.
    spread : (12 + s, 12 + s) what the covariance is larger by, because the noise was estimated.
    """

    pairs: PosePairs
    noise: PairNoise
    expected: Array
    estimate: Estimate[PairState]
    settled: bool
    spread: Array

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
        whole = self.estimate.covariance + self.spread
        if self.pairs.time_s is None:
            return whole
        return whole * correlation(self.estimate.residual[~self.rejected])

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
        As `robocal_ros.estimation.estimation.solve`.
    """
    known = (given or GivenNoise()).variances(pairs.covariance is not None)
    sound = robust_start(pairs) if sound is None else sound
    count = 0 if pairs.shared is None else len(pairs.shared.covariance)
    near = PairState(sound, np.zeros(count))
    far = None if start is None else PairState(start, np.zeros(count))
    return _NoiseSearch(pairs, known).run(near, far)


@dataclass(frozen=True, eq=False)
class _NoiseSearch:
    """Noise and placements in turn; ``known`` (6,) variances are nan where they are unknown."""

    pairs: PosePairs
    known: Array

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """(6,) variances to be estimated."""
        return np.isnan(self.known)

    @property
    def enough(self) -> bool:
        """Whether the samples can tell outliers and several variances."""
        return len(self.pairs) >= _ENOUGH_TO_DOUBT

    def run(self, near: PairState, far: PairState | None) -> PairFit:
        """The fit, from a state near the truth; placements from ``far`` where it is given."""
        told = None
        parts = Parts.of(self.pairs, near.at.X)
        seen = Evidence.of(self.pairs, parts, near)
        noise, keep = first_guess(seen.rows[:, :, -1], self.known)
        state = near if far is None else far
        if np.any(self.free) and self.enough:
            keep = keep if np.sum(keep) >= _ENOUGH_TO_DOUBT else np.ones_like(keep)
            told = self._first_noise(seen, near, keep, noise)
            noise = told.noise
            state = near.after(told.best) if far is None else far
        for _ in range(_ROUNDS):
            V, root = parts.covariances(noise)
            found = self._placed(state, root, noise)
            used, state = ~found.rejected, found.state
            settled = told is None or told.settled
            if told is None or (np.array_equal(used, keep) and _together(near.at, state.at)):
                break
            parts, near, keep = parts.moved(self.pairs, state.at.X), state, used
            seen = Evidence.of(self.pairs, parts, state).take(used)
            told = estimate(seen.with_common(self.pairs.shared, state.common), self.free, noise)
            settled = told.stayed
            if settled:
                break
            noise = told.noise
        k = len(found.names)
        spread = np.zeros((k, k)) if told is None else told.spread
        return PairFit(self.pairs, noise, V, found, settled, spread)

    def _first_noise(
        self, seen: Evidence, near: PairState, keep: NDArray[np.bool_], guess: PairNoise
    ) -> Found:
        """The likeliest noise by samples to keep (m,), first by some of them."""
        shared = self.pairs.shared
        if np.sum(keep) > _MANY:
            few = seen.take(_thinned(keep)).with_common(shared, near.common)
            guess = estimate(few, self.free, guess).noise
        return estimate(seen.take(keep).with_common(shared, near.common), self.free, guess)

    def _placed(self, state: PairState, root: Array, noise: PairNoise) -> Estimate[PairState]:
        """The most likely placements for one noise."""
        problem = PairProblem(self.pairs, root, noise.camera_scale)
        return solve(
            problem,
            state,
            prior_information=problem.prior_information,
            noise_known=self.enough or not np.any(self.free),
            robust=self.enough,
        )


def _together(a: Placement, b: Placement) -> bool:
    """Whether weights that follow from one placement do for the other."""
    away = max(float(np.abs(a.X - b.X).max()), float(np.abs(a.Z - b.Z).max()))
    return away < _SAME


def _thinned(keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """About 30 of many samples, spread evenly."""
    rows = np.flatnonzero(keep)
    few = np.zeros_like(keep)
    few[rows[np.linspace(0, len(rows) - 1, _MANY).astype(int)]] = True
    return few


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
