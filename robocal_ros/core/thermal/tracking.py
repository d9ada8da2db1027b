"""The model between measuring cycles: a Kalman filter over the parameters' drift.

State: drift of the k parameters and its rate, the error of each cold spot (the noise of the cold
visit is in every later comparison), and the set-up's six coordinates. Absolute: the drift is
against the cold model, whatever is in force. A cycle that the process cannot explain is not
applied.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.descent import chi2_quantile
from robocal_ros.core.errors import StaleError
from robocal_ros.core.samples import Measurements
from robocal_ros.core.thermal.agreement import agreeing
from robocal_ros.core.thermal.process import DriftProcess
from robocal_ros.core.thermal.spots import ColdSpots

Array = NDArray[np.float64]

FALSE_ALARM = 0.001  # chance that a sound cycle is not applied
FEWEST_SHARE = 0.5  # of a cycle's samples that must agree
SETUP = 6


@dataclass(frozen=True, eq=False)
class TrackerState:
    """Mean (d,) and covariance (d, d) at a time, s."""

    time_s: float
    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Innovation:
    """What a cycle brought against what was expected.

    Attributes
    ----------
    squared, freedom : normalised square of the innovation, and its degrees of freedom.
    limit : the square above which a cycle is not applied.
    applied : whether it was.
    kept : (m,) samples that agree with the others.
    deviation, covariance : (3m,) measured less expected displacement, m, and (3m, 3m) what the
        tracker expected of it.
    """

    squared: float
    freedom: int
    limit: float
    applied: bool
    kept: NDArray[np.bool_]
    deviation: Array
    covariance: Array


class DriftTracker:
    """Follows one robot from its cold reference on.

    Parameters
    ----------
    sigma_m : standard deviation of one coordinate of one visit (repeatability and sensor), of
        the cold visits and of warm ones that bring no covariance of their own.
    """

    def __init__(
        self, spots: ColdSpots, process: DriftProcess, sigma_m: float, time_s: float = 0.0
    ) -> None:
        self.spots, self.process, self.sigma_m = spots, process, sigma_m
        self.count = len(process.covariance)
        k, cold = self.count, 3 * len(spots.visits)
        size = 2 * k + cold + SETUP
        covariance = np.zeros((size, size))
        rate = np.sqrt(3.0) / process.time_s
        covariance[k : 2 * k, k : 2 * k] = rate**2 * process.covariance
        own = np.arange(2 * k, 2 * k + cold)
        covariance[own, own] = np.repeat(sigma_m**2 / spots.visits, 3)
        self.state = TrackerState(time_s, np.zeros(size), covariance)

    def at(self, time_s: float) -> TrackerState:
        """The state at a later time, without new measurements.

        Raises
        ------
        StaleError
            When the time lies before the last cycle.
        """
        state, k = self.state, self.count
        step = time_s - state.time_s
        if step < 0.0:
            raise StaleError(
                f"the time {time_s:.0f} s lies {-step:.0f} s before the last cycle: cycles are "
                "taken in order"
            )
        if step == 0.0:
            return state
        (f, g), noise = self.process.transition(step)
        fade = self.process.setup_fade(step)
        mean, P = state.mean.copy(), state.covariance.copy()
        drift, rate = mean[:k].copy(), mean[k : 2 * k].copy()
        mean[:k], mean[k : 2 * k] = f[0] * drift + f[1] * rate, g[0] * drift + g[1] * rate
        for rows in (P, P.T):  # F P F^T, block by block: the rest of F is the unit matrix
            drift, rate = rows[:k].copy(), rows[k : 2 * k].copy()
            rows[:k], rows[k : 2 * k] = f[0] * drift + f[1] * rate, g[0] * drift + g[1] * rate
            rows[-SETUP:] *= fade
        P[: 2 * k, : 2 * k] += np.kron(noise, self.process.covariance)
        own = np.arange(len(P) - SETUP, len(P))
        P[own, own] += self.process.setup_sigma_m**2 * (1.0 - fade**2)
        mean[-SETUP:] *= fade
        return TrackerState(time_s, mean, P)

    def drift(self, time_s: float) -> tuple[Array, Array]:
        """Parameters' drift (k,) since the cold reference and its covariance (k, k), SI."""
        state, k = self.at(time_s), self.count
        return state.mean[:k], state.covariance[:k, :k]

    def take(self, cycle: Measurements, time_s: float) -> Innovation:
        """Update with a cycle, unless the process cannot explain it.

        ``cycle.sigma`` (m,), where given, is each coordinate's noise.

        Raises
        ------
        InputError
            When a sample has no cold counterpart.
        StaleError
            When the cycle is older than the last one.
        """
        state = self.at(time_s)
        y, H, R = self.observation(cycle)
        deviation, expected = y - H @ state.mean, H @ state.covariance @ H.T + R
        keep = agreeing(deviation, expected, len(cycle))
        rows = np.repeat(keep, 3)
        v, PH, S = deviation[rows], state.covariance @ H[rows].T, expected[np.ix_(rows, rows)]
        squared = float(v @ np.linalg.solve(S, v))
        limit = chi2_quantile(1.0 - FALSE_ALARM, len(v))
        applied = squared <= limit and np.mean(keep) >= FEWEST_SHARE
        if applied:
            gain = np.linalg.solve(S, PH.T).T
            P = state.covariance - gain @ PH.T
            self.state = TrackerState(time_s, state.mean + gain @ v, 0.5 * (P + P.T))
        return Innovation(
            squared=squared,
            freedom=len(v),
            limit=limit,
            applied=bool(applied),
            kept=keep,
            deviation=deviation,
            covariance=expected,
        )

    def observation(self, cycle: Measurements) -> tuple[Array, Array, Array]:
        """Drift of the spots (3m,), its rows (3m, d) in the state, and its noise (3m, 3m)."""
        spots, k, m = self.spots, self.count, len(cycle)
        spot = spots.match(cycle)
        parameters, setup = spots.rows(cycle.q, spots.target[spot])
        H = np.zeros((m, 3, len(self.state.mean)))
        H[:, :, :k], H[:, :, -SETUP:] = parameters, setup
        columns = 2 * k + 3 * spot[:, None] + np.arange(3)
        H[np.arange(m)[:, None], np.arange(3), columns] = -1.0
        sigma = np.full(m, self.sigma_m) if cycle.sigma is None else cycle.sigma
        return spots.drift(cycle).ravel(), H.reshape(3 * m, -1), np.diag(np.repeat(sigma**2, 3))
