"""The model between measuring cycles: a Kalman filter over the parameters' drift.

State: drift of the k parameters and its steady state, the gains of the motors' temperatures where
those are given, the error of each cold spot (the noise of the cold visit is in every later
comparison), and the set-up's six coordinates with their steady state. Absolute: the drift is
against the cold model, whatever is in force. A cycle that the process cannot explain is not
applied.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Judgement, Verdict
from robocal_ros.estimation.descent import chi2_quantile
from robocal_ros.estimation.estimation import describe, observability
from robocal_ros.ground.errors import Code, InputError, StaleError, TooFewSamplesError
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.documents import conclude
from robocal_ros.thermal.identification import (
    FEWEST_POSES,
    CycleDrift,
    FixedSphere,
    agreeing,
    possible_causes,
    step_words,
)
from robocal_ros.thermal.process import (
    PLAUSIBLE_WARMING_K,
    SOURCES,
    DriftProcess,
    Heat,
    HeatGains,
    joints_of,
    swing_k,
)
from robocal_ros.thermal.reference import ColdSpots

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


# ---- tracked cycle ------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TrackedCycle:
    """A cycle that the tracker took or refused.

    Attributes
    ----------
    found : the drift after the cycle; before it where the cycle was refused.
    judged : figures and verdict; each pose is forecast from all earlier cycles and the other poses.
    innovation : what the cycle brought against what was expected.
    """

    found: CycleDrift
    judged: Judgement
    innovation: Innovation


def track_cycle(
    tracker: DriftTracker,
    warm: Measurements,
    time_s: float,
    *,
    in_force: SerialArm,
    fixed: FixedSphere | None = None,
    doubt_s: float | None = None,
) -> TrackedCycle:
    """Update the tracker with a cycle and judge the model that follows from it.

    A cycle that the drift since the last one cannot explain, or during which a sphere that is
    fixed in the cell (``fixed``) moved, leaves the tracker as it was, and is refused as
    SENSOR_OR_ROBOT_MOVED with what it may be. ``doubt_s``: see `DriftTracker.take`.

    Raises
    ------
    InputError
        When a sample has no cold counterpart.
    TooFewSamplesError
        With fewer than two poses.
    StaleError
        When the cycle is older than the last one.
    """
    spots = tracker.spots
    warm = spots.average(warm, tracker.sigma_m)
    if len(warm) < FEWEST_POSES:
        raise TooFewSamplesError("one pose cannot show a drift: measure at least five")
    last = tracker.state
    innovation = tracker.take(warm, time_s, doubt_s)
    taken, tracker.state = tracker.state, last
    before = tracker.at(innovation.time_s)
    moved = not innovation.applied or (fixed is not None and fixed.moved)
    if not moved:
        tracker.state = taken
    miss, spread, drifts = _left_out(tracker, before, warm, innovation)
    found = _found(tracker, warm, time_s, innovation, miss, spread)
    arm = spots.cell.arm
    A = spots.rows(warm.q, spots.target[spots.match(warm)])[0]
    own = drifts - arm.parameters.read(in_force.mdh - arm.mdh)
    judged = conclude(
        found,
        spots,
        warm,
        in_force,
        current=np.linalg.norm(miss + np.einsum("mik,mk->mi", A, own), axis=1),
        after=np.linalg.norm(miss, axis=1),
        spread=spread,
        usable=innovation.kept,
    )
    if moved:
        judged = replace(judged, verdict=_refusal(tracker, warm, innovation, fixed))
    return TrackedCycle(found, judged, innovation)


def _found(
    tracker: DriftTracker,
    warm: Measurements,
    time_s: float,
    innovation: Innovation,
    miss: Array,
    spread: Array,
) -> CycleDrift:
    spots, k = tracker.spots, tracker.count
    arm, (drift, covariance) = spots.cell.arm, tracker.drift(time_s)
    kept = warm.take(innovation.kept)
    rows = spots.rows(kept.q, spots.target[spots.match(kept)])[0]
    seen = observability(rows.reshape(-1, k))
    chosen = arm.parameters
    sigma = np.full(len(warm), tracker.sigma_m) if warm.sigma is None else warm.sigma
    return CycleDrift(
        drift=drift,
        covariance=covariance,
        prior_covariance=tracker.expected_drift(),
        arm=arm.with_mdh(chosen.add(arm.mdh, drift)),
        warm=warm,
        left_out=miss,
        left_out_sigma=spread,
        rejected=~innovation.kept,
        noise_m=float(np.sqrt(np.mean(sigma**2))),
        seen=seen,
        unobservable=tuple(describe(c, chosen.names, chosen.to_display) for c in seen.null.T),
    )


def _left_out(
    tracker: DriftTracker, before: DriftState, warm: Measurements, innovation: Innovation
) -> tuple[Array, Array, Array]:
    """Error (m, 3) at each pose of what all else says, its rms length (m,), and drifts (m, k).

    All else: the earlier cycles and the other poses of this one that agree. Cold visit and set-up
    are estimated along, so that model in force and candidate differ by the drift alone.
    """
    _, H, _ = tracker.observation(warm, before.time_s)
    D = tracker.drift_rows(before.time_s)
    v, S, k, count = innovation.deviation, innovation.covariance, tracker.count, len(warm)
    forecast, PH = D @ before.mean, D @ before.covariance @ H.T
    kept = np.repeat(innovation.kept, 3)
    miss, spread, drifts = np.empty((count, 3)), np.empty(count), np.empty((count, k))
    for i in range(count):
        own, others = slice(3 * i, 3 * i + 3), kept.copy()
        others[own] = False
        across = S[others, own]
        gain = np.linalg.solve(S[np.ix_(others, others)], np.column_stack([v[others], across]))
        miss[i] = v[own] - across.T @ gain[:, 0]
        spread[i] = np.sqrt(np.trace(S[own, own] - across.T @ gain[:, 1:]))
        drifts[i] = forecast + PH[:, others] @ gain[:, 0]
    return miss, spread, drifts


def _refusal(
    tracker: DriftTracker, warm: Measurements, innovation: Innovation, fixed: FixedSphere | None
) -> Verdict:
    rms_mm, expected_mm = (
        1e3 * float(np.sqrt(3.0 * np.mean(square)))
        for square in (innovation.deviation**2, np.diag(innovation.covariance))
    )
    causes = possible_causes(tracker.spots, warm, innovation.deviation, innovation.covariance)
    return Verdict(
        Code.SENSOR_OR_ROBOT_MOVED,
        f"the measured positions are {rms_mm:.2f} mm rms off, where drift and noise explain "
        f"{expected_mm:.2f} mm; the model stays as it was; {step_words(causes, fixed)}",
    )


# ---- whether a parameter fluctuates about a level or drifts: tests of its autocorrelation -------


LEVEL = 0.05  # chance that white noise passes for a drift
LAGS = 7  # a drift shows in the first lags; with 7 the count's own chance is 4.4 %, next to LEVEL
BOUND = 1.96  # of a white series' autocorrelation, times the root of its length
FEWEST = 3 * LAGS


@dataclass(frozen=True, eq=False)
class Stationarity:
    """Tests of k series, each against white noise about a level.

    Attributes
    ----------
    autocorrelation : (LAGS, k) at lags 1 ... LAGS.
    bound : half width of the interval that holds 95 % of a white series' autocorrelations.
    outside : (k,) how many lags lie outside it; ``allowed`` of them is what chance allows.
    p_value : (k,) of Ljung and Box's test.
    """

    autocorrelation: Array
    bound: float
    outside: NDArray[np.int64]
    allowed: int
    p_value: Array

    @property
    def by_count(self) -> NDArray[np.bool_]:
        """(k,) stationary, because no more lags lie outside than chance allows."""
        return np.asarray(self.outside <= self.allowed)

    @property
    def by_ljung_box(self) -> NDArray[np.bool_]:
        """(k,) stationary, because white noise has such autocorrelations often enough."""
        return np.asarray(self.p_value >= LEVEL)


def stationarity(series: Array) -> Stationarity:
    """Test the columns of equally spaced series (t, k), in whatever unit.

    The lags of a white series are nearly independent and each is outside with chance 5 %, so
    that their number is binomial. Ljung and Box (1978) sum their squares instead, which is
    chi-square with as many degrees of freedom as there are lags. Either finds a white series
    drifting in about 5 % of cases (the count, being whole, in a little less).

    Raises
    ------
    TooFewSamplesError
        With fewer than 21 times.
    """
    from scipy.special import gammaincc

    n = len(series)
    if n < FEWEST:
        raise TooFewSamplesError(
            f"{n} cycles are too few to tell a drift from chance: at least {FEWEST}"
        )
    r = autocorrelation(series)
    bound = BOUND / float(np.sqrt(n))
    left = n - np.arange(1, LAGS + 1)
    squared = n * (n + 2.0) * np.sum(r**2 / left[:, None], axis=0)
    return Stationarity(
        autocorrelation=r,
        bound=bound,
        outside=np.sum(np.abs(r) > bound, axis=0),
        allowed=_allowed(),
        p_value=np.asarray(gammaincc(0.5 * LAGS, 0.5 * squared)),
    )


def autocorrelation(series: Array) -> Array:
    """Sample autocorrelation (LAGS, k) of the columns of (t, k); zero for a constant column."""
    x = series - series.mean(axis=0)
    power = np.sum(x**2, axis=0)
    power = np.where(power > 0.0, power, 1.0)
    return np.array([np.sum(x[lag:] * x[:-lag], axis=0) / power for lag in range(1, LAGS + 1)])


def _allowed() -> int:
    """Most lags outside that chance exceeds in no more than 5 % of white series."""
    from scipy.special import bdtrc

    return next(count for count in range(LAGS + 1) if bdtrc(count, LAGS, LEVEL) <= LEVEL)
