"""The model between measuring cycles: a Kalman filter over the parameters' drift.

State: drift of the k parameters and its steady state, the gains of the motors' temperatures where
those are given, the error of each cold spot (the noise of the cold visit is in every later
comparison), and the set-up's six coordinates with their steady state. Absolute: the drift is
against the cold model, whatever is in force. A cycle that the process cannot explain is not
applied.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.descent import chi2_quantile
from robocal_ros.ground.errors import InputError, StaleError
from robocal_ros.ground.samples import Measurements
from robocal_ros.thermal.agreement import agreeing
from robocal_ros.thermal.heat import SOURCES, Heat, HeatGains, joints_of, swing_k
from robocal_ros.thermal.priors import PLAUSIBLE_WARMING_K
from robocal_ros.thermal.process import DriftProcess
from robocal_ros.thermal.spots import ColdSpots

Array = NDArray[np.float64]

FALSE_ALARM = 0.001  # chance that a sound cycle is not applied
FEWEST_SHARE = 0.5  # of a cycle's samples that must agree
SETUP = 6
OUTLIER_M = 1e-3  # a sample that fits nothing lies anywhere within so much


@dataclass(frozen=True, eq=False)
class DriftState:
    """Mean (d,) and covariance (d, d) at a time, s."""

    time_s: float
    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Innovation:
    """What a cycle brought against what was expected.

    Attributes
    ----------
    time_s : at which the expectation was.
    squared, freedom : normalised square of the innovation, and its degrees of freedom.
    limit : the square above which a cycle is not applied.
    applied : whether it was.
    kept : (m,) samples that agree with the others.
    deviation, covariance : (3m,) measured less expected displacement, m, and (3m, 3m) what the
        tracker expected of it.
    log_likelihood : of all samples; those that do not fit lie anywhere within a millimetre.
    whitened : (freedom,) the innovation in units of its own spread: standard normal.
    """

    time_s: float
    squared: float
    freedom: int
    limit: float
    applied: bool
    kept: NDArray[np.bool_]
    deviation: Array
    covariance: Array
    log_likelihood: float
    whitened: Array


class DriftTracker:
    """Follows one robot from its cold reference on.

    Parameters
    ----------
    sigma_m : standard deviation of one coordinate of one visit (repeatability and sensor), of
        the cold visits and of warm ones that bring no covariance of their own.
    gains : of the motors' temperatures, which ``read_temperatures`` then brings; the process is
        what they leave. The cold visit is at ``time_s``.
    """

    def __init__(
        self,
        spots: ColdSpots,
        process: DriftProcess,
        sigma_m: float,
        time_s: float = 0.0,
        gains: HeatGains | None = None,
    ) -> None:
        self.spots, self.process, self.sigma_m = spots, process, sigma_m
        arm, self.count = spots.cell.arm, len(process.covariance)
        self._joint = joints_of(arm)
        self.heat = None if gains is None else Heat.cold(arm.n, time_s, gains.lag_s)
        k, cold = self.count, 3 * len(spots.visits)
        learned = 0 if gains is None else SOURCES * k
        self._gains = slice(2 * k, 2 * k + learned)
        self._setup = self._gains.stop + cold
        size = self._setup + 2 * SETUP
        mean, covariance = np.zeros(size), np.zeros((size, size))
        covariance[k : 2 * k, k : 2 * k] = process.covariance
        if gains is not None:
            mean[self._gains] = gains.mean
            covariance[self._gains, self._gains] = gains.covariance
        own = np.arange(self._gains.stop, self._setup)
        covariance[own, own] = np.repeat(sigma_m**2 / spots.visits, 3)
        own = np.arange(self._setup + SETUP, size)
        covariance[own, own] = process.setup_sigma_m**2
        self.state = DriftState(time_s, mean, covariance)

    @property
    def gains(self) -> HeatGains | None:
        """The temperatures' gains as known by now."""
        if self.heat is None:
            return None
        own, state = self._gains, self.state
        mean, covariance = state.mean[own].copy(), state.covariance[own, own].copy()
        return HeatGains(mean, covariance, self.heat.lag_s)

    def read_temperatures(self, temperature: Array, time_s: float) -> None:
        """Take motor temperatures (n,) above those at the cold visit, K; in order of time.

        Raises
        ------
        InputError
            When they are not one finite number per joint, come out of order, or have no gains.
        """
        if self.heat is None:
            raise InputError("this tracker has no gains for motor temperatures: learn them first")
        self.heat = self.heat.read(temperature, time_s)

    def at(self, time_s: float) -> DriftState:
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
        mean, P = state.mean.copy(), state.covariance.copy()
        process, setup = self.process, slice(self._setup, None)
        for part, (F, noise), variance in (
            (slice(2 * k), process.transition(step), process.covariance),
            (setup, process.setup_transition(step), process.setup_sigma_m**2 * np.eye(SETUP)),
        ):
            for rows in (mean[:, None], P, P.T):  # F P F^T by blocks: the rest of F is one
                before = rows[part].reshape(2, len(variance), -1)
                rows[part] = np.tensordot(F, before, 1).reshape(2 * len(variance), -1)
            P[part, part] += np.kron(noise, variance)
        return DriftState(time_s, mean, P)

    def drift(self, time_s: float) -> tuple[Array, Array]:
        """Parameters' drift (k,) since the cold reference and its covariance (k, k), SI.

        Where motor temperatures are in use, those after the last reading are held, with a doubt
        that grows.
        """
        state = self.at(time_s)
        rows = self.drift_rows(time_s)
        covariance = rows @ state.covariance @ rows.T + self._swing(time_s)
        return rows @ state.mean, covariance

    def _swing(self, time_s: float) -> Array:
        """Covariance (k, k) of what the motors may have done since they were last read.

        The links follow as if a motor had gone there at once: no course leaves them further off.
        """
        total, heat = np.zeros((self.count, self.count)), self.heat
        if heat is None:
            return total
        silent_s, gains = time_s - heat.time_s, self.state.mean[self._gains]
        for warm in swing_k(silent_s) * np.eye(len(heat.motor)):
            gone = Heat(0.0, warm, np.zeros_like(warm), heat.lag_s).held(silent_s)
            drift = gone.rows(self._joint) @ gains
            total += np.outer(drift, drift)
        return total

    def expected_drift(self) -> Array:
        """Covariance (k, k) of the drift that a shift may bring, SI: by all motors' warmth too."""
        total, gains, heat = self.process.covariance.copy(), self.gains, self.heat
        if gains is None or heat is None:
            return total
        for warm in PLAUSIBLE_WARMING_K * np.eye(len(heat.motor)):
            rows = Heat(0.0, warm, warm, heat.lag_s).rows(self._joint)
            drift = rows @ gains.mean
            total += np.outer(drift, drift) + rows @ gains.covariance @ rows.T
        return total

    def drift_rows(self, time_s: float) -> Array:
        """Drift (k, d) of the parameters by the state."""
        k = self.count
        rows = np.zeros((k, len(self.state.mean)))
        rows[:, :k] = np.eye(k)
        if self.heat is not None:
            rows[:, self._gains] = self.heat.held(time_s).rows(self._joint)
        return rows

    def take(self, cycle: Measurements, time_s: float, doubt_s: float | None = None) -> Innovation:
        """Update with a cycle, unless the process cannot explain it.

        ``doubt_s``: a cycle must fit with the doubt of this earlier time too, as after a step:
        waiting must not make it plausible.

        ``cycle.sigma`` (m,), where given, is each coordinate's noise.

        Raises
        ------
        InputError
            When a sample has no cold counterpart.
        StaleError
            When the cycle is older than the last one.
        """
        if doubt_s is not None and not (early := self._examine(cycle, doubt_s)[0]).applied:
            return early
        innovation, state = self._examine(cycle, time_s)
        self.state = self.state if state is None else state
        return innovation

    def _examine(self, cycle: Measurements, time_s: float) -> tuple[Innovation, DriftState | None]:
        """What a cycle brings, and the state after it; None where it is not applied."""
        state, after = self.at(time_s), None
        y, H, R = self.observation(cycle, time_s)
        deviation, expected = y - H @ state.mean, H @ state.covariance @ H.T + R
        keep = agreeing(deviation, expected, len(cycle))
        rows = np.repeat(keep, 3)
        v, PH, S = deviation[rows], state.covariance @ H[rows].T, expected[np.ix_(rows, rows)]
        root = np.linalg.cholesky(S)
        whitened = np.linalg.solve(root, v)
        squared = float(whitened @ whitened)
        limit = chi2_quantile(1.0 - FALSE_ALARM, len(v))
        applied = squared <= limit and np.mean(keep) >= FEWEST_SHARE
        if applied:
            gain = np.linalg.solve(S, PH.T).T
            P = state.covariance - gain @ PH.T
            after = DriftState(time_s, state.mean + gain @ v, 0.5 * (P + P.T))
        innovation = Innovation(
            time_s=time_s,
            squared=squared,
            freedom=len(v),
            limit=limit,
            applied=bool(applied),
            kept=keep,
            deviation=deviation,
            covariance=expected,
            log_likelihood=-0.5 * squared
            - float(np.log(np.sqrt(2.0 * np.pi) * np.diag(root)).sum())
            - 3.0 * float(np.sum(~keep)) * np.log(OUTLIER_M),
            whitened=whitened,
        )
        return innovation, after

    def observation(self, cycle: Measurements, time_s: float) -> tuple[Array, Array, Array]:
        """Drift of the spots (3m,), its rows (3m, d) in the state, and its noise (3m, 3m).

        Silent motors are part of the noise.
        """
        spots, m = self.spots, len(cycle)
        spot = spots.match(cycle)
        parameters, setup = spots.rows(cycle.q, spots.target[spot])
        H = np.zeros((m, 3, len(self.state.mean)))
        H[:] = parameters @ self.drift_rows(time_s)
        H[:, :, self._setup : self._setup + SETUP] = setup
        columns = self._gains.stop + 3 * spot[:, None] + np.arange(3)
        H[np.arange(m)[:, None], np.arange(3), columns] = -1.0
        sigma = np.full(m, self.sigma_m) if cycle.sigma is None else cycle.sigma
        A = parameters.reshape(3 * m, -1)
        noise = np.diag(np.repeat(sigma**2, 3)) + A @ self._swing(time_s) @ A.T
        return spots.drift(cycle).ravel(), H.reshape(3 * m, -1), noise
