# SPDX-License-Identifier: Apache-2.0
"""How a robot's parameters drift in time: the prior of the tracker."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Judgement, Verdict
from robocal_ros.estimation.estimation import chi2_quantile, describe, observability
from robocal_ros.ground.errors import Code, InputError, StaleError, TooFewSamplesError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.identification import (
    FEWEST_POSES,
    PLAUSIBLE_WARMING_K,
    CycleDrift,
    FixedSphere,
    agreeing,
    conclude,
    drift_prior,
    possible_causes,
    step_words,
)
from robocal_ros.thermal.reference import SETUP_SIGMA_M, ColdSpots

SETUP_APPROACH_S = 1800.0
APPROACH_S = 3600.0  # a link follows what heats it
STEADY_TIME_S = 8.0 * 3600.0  # what heats it changes with the work


@dataclass(frozen=True, eq=False)
class DriftProcess:
    """A drift that begins at zero and approaches a steady state, and a set-up never quite still.

    ``approach_s dx/dt = u - x`` for each parameter x; its steady state u is a first-order process
    that forgets what it was within ``steady_s``: work changes. The set-up (sensor, and sphere on
    the flange) does the same in its own small way: sensors warm up and stems expand, and neither
    may pass for a drift of the arm.

    ``covariance`` (k, k): of the parameters' steady state, SI.
    ``approach_s``, ``steady_s``: time constants; the first one is the shorter.
    ``setup_sigma_m``: standard deviation of the steady state of each of the set-up's six
    coordinates, which they approach within `SETUP_APPROACH_S`.

    Raises `InputError` when the steady state is forgotten before it is approached.
    """

    covariance: Array
    approach_s: float = APPROACH_S
    steady_s: float = STEADY_TIME_S
    setup_sigma_m: float = SETUP_SIGMA_M

    def __post_init__(self) -> None:
        if not 0.0 < max(self.approach_s, SETUP_APPROACH_S) < self.steady_s:
            raise InputError(
                f"approach within {self.approach_s:g} s (set-up: {SETUP_APPROACH_S:g} s) must "
                f"be shorter than the {self.steady_s:g} s after which the steady state is forgotten"
            )

    def transition(self, step_s: float, approach_s: float | None = None) -> tuple[Array, Array]:
        """Transition (2, 2) of a drift and its steady state, and its noise for variance 1.

        ``approach_s``: of another coordinate than the parameters.
        """
        approach_s, steady_s = self.approach_s if approach_s is None else approach_s, self.steady_s
        near, far = np.exp(-step_s / approach_s), np.exp(-step_s / steady_s)
        share = steady_s / (steady_s - approach_s)
        F = np.array([[near, share * (far - near)], [0.0, far]])
        reached = steady_s / (steady_s + approach_s)
        long_run = np.array([[reached, reached], [reached, 1.0]])
        return F, long_run - F @ long_run @ F.T


# What the motors' temperatures say of the drift. A motor and its gear move their own joint's
# parameters at once. The link that follows the joint lies between its motor and the next one, and
# follows both with a lag.

SOURCES = 3  # of each parameter: its joint's motor, the same lagged, the next motor lagged
SWING_K = 20.0  # where a temperature may go once it is no longer read
SWING_TIME_S = 3600.0


@dataclass(frozen=True, eq=False)
class Heat:
    """Motor temperatures above those at the cold visit, K: as last read, and lagged.

    ``time_s``: of the last reading. ``motor``, ``lagged``: (n,). ``lag_s``: time constant of the
    lag.
    """

    time_s: float
    motor: Array
    lagged: Array
    lag_s: float

    @classmethod
    def cold(cls, n: int, lag_s: float) -> "Heat":
        """At the cold visit, at time 0."""
        return cls(0.0, np.zeros(n), np.zeros(n), lag_s)

    def read(self, temperature: Array, time_s: float) -> "Heat":
        """After a reading (n,), the course since the last one taken as straight.

        Raises `InputError` when it is not one finite temperature for each joint, or older than the
        last.
        """
        given = np.asarray(temperature, dtype=np.float64)
        if given.shape != self.motor.shape or not np.all(np.isfinite(given)):
            raise InputError(
                f"motor temperatures must be {len(self.motor)} numbers, one per joint, not {given}"
            )
        step = time_s - self.time_s
        if not step >= 0.0:
            raise InputError(
                f"the motor temperatures of {time_s:.0f} s are older than the last ones: give "
                "them in order"
            )
        if step == 0.0:
            return replace(self, motor=given)
        fade, behind = np.exp(-step / self.lag_s), (given - self.motor) / step * self.lag_s
        lagged = given - behind + fade * (self.lagged - self.motor + behind)
        return Heat(time_s, given, lagged, self.lag_s)

    def held(self, time_s: float) -> "Heat":
        """At a later time, the motors as last read; an earlier one changes nothing."""
        return self if time_s <= self.time_s else self.read(self.motor, time_s)

    def array(self) -> Array:
        """Everything in one array (2 + 2n,), for keeping."""
        return np.concatenate([[self.time_s, self.lag_s], self.motor, self.lagged])

    @classmethod
    def of_array(cls, kept: Array) -> "Heat":
        """Read back what ``array`` gave."""
        motor, lagged = kept[2:].reshape(2, -1)
        return cls(float(kept[0]), motor, lagged, float(kept[1]))

    def rows(self, joint: NDArray[np.int64]) -> Array:
        """Drift (k, 3k) of parameters of these joints (k,) by the gains."""
        next_lagged = np.append(self.lagged[1:], 0.0)
        rows = np.zeros((len(joint), len(joint), SOURCES))
        own = np.arange(len(joint))
        rows[own, own] = np.column_stack([self.motor, self.lagged, next_lagged])[joint]
        return rows.reshape(len(joint), -1)


@dataclass(frozen=True, eq=False)
class HeatGains:
    """Change of each parameter per kelvin of each of its sources.

    ``mean``, ``covariance``: (3k,) and (3k, 3k), SI per K; parameter by parameter.
    ``lag_s``: how slowly links follow the motors.
    """

    mean: Array
    covariance: Array
    lag_s: float

    @classmethod
    def expected(cls, arm: SerialArm, lag_s: float, length: float, angle: float) -> "HeatGains":
        """Before any is learned: none, within the default drift per plausible warming.

        ``length``, ``angle``: what the gains of either kind are of that.
        """
        scale = np.where(arm.parameters.is_length, length, angle) / PLAUSIBLE_WARMING_K
        sigma = np.sqrt(np.diag(drift_prior(arm))) * scale
        variance = np.repeat(sigma**2, SOURCES) / SOURCES
        return cls(np.zeros(len(variance)), np.diag(variance), lag_s)


def joints_of(arm: SerialArm) -> NDArray[np.int64]:
    """Joint (k,), from 0, of each free parameter."""
    return np.array([joint for joint, _ in arm.parameters.index], dtype=np.int64)


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

    ``time_s``: at which the expectation was. ``squared``, ``freedom``: normalised square of the
    innovation, and its degrees of freedom. ``applied``: whether it was; not, where the square is
    above its limit. ``kept`` (m,): samples that agree with the others. ``deviation``,
    ``covariance``: (3m,) measured less expected displacement, m, and (3m, 3m) what the tracker
    expected of it. ``log_likelihood``: of all samples; those that do not fit lie anywhere within a
    millimetre. ``whitened`` (freedom,): the innovation in units of its own spread: standard normal.
    """

    time_s: float
    squared: float
    freedom: int
    applied: bool
    kept: NDArray[np.bool_]
    deviation: Array
    covariance: Array
    log_likelihood: float
    whitened: Array


class DriftTracker:
    """Follows one robot from its cold reference on.

    ``sigma_m``: standard deviation of one coordinate of one visit (repeatability and sensor), of
    the cold visits and of warm ones that bring no covariance of their own.
    ``gains``: of the motors' temperatures, which ``read_temperatures`` then brings; the process is
    what they leave. The cold visit is at time 0.
    """

    def __init__(
        self,
        spots: ColdSpots,
        process: DriftProcess,
        sigma_m: float,
        gains: HeatGains | None = None,
    ) -> None:
        self.spots, self.process, self.sigma_m = spots, process, sigma_m
        arm, self.count = spots.cell.arm, len(process.covariance)
        self._joint = joints_of(arm)
        self.heat = None if gains is None else Heat.cold(arm.n, gains.lag_s)
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
        self.state = DriftState(0.0, mean, covariance)

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

        Raises `InputError` when they are not one finite number per joint, come out of order, or
        have no gains.
        """
        if self.heat is None:
            raise InputError("this tracker has no gains for motor temperatures: learn them first")
        self.heat = self.heat.read(temperature, time_s)

    def at(self, time_s: float) -> DriftState:
        """The state at a later time, without new measurements.

        Raises `StaleError` when the time lies before the last cycle.
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
            (
                setup,
                process.transition(step, SETUP_APPROACH_S),
                process.setup_sigma_m**2 * np.eye(SETUP),
            ),
        ):
            size = 2 * len(variance)
            for rows in (mean[:, None], P, P.T):  # F P F^T by blocks: the rest of F is one
                rows[part] = (F @ rows[part].reshape(2, -1)).reshape(size, -1)
            both = noise[:, None, :, None] * variance[:, None, :]
            P[part, part] += both.reshape(size, size)
        return DriftState(time_s, mean, P)

    def drift(self, time_s: float) -> tuple[Array, Array]:
        """Parameters' drift (k,) since the cold reference and its covariance (k, k), SI.

        Where motor temperatures are in use, those after the last reading are held, with a doubt
        that grows.
        """
        state, k = self.at(time_s), self.count
        if self.heat is None:
            return state.mean[:k], state.covariance[:k, :k]
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
        swing_k = SWING_K * (1.0 - np.exp(-max(silent_s, 0.0) / SWING_TIME_S))
        for warm in swing_k * np.eye(len(heat.motor)):
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


@dataclass(frozen=True, eq=False)
class TrackedCycle:
    """A cycle that the tracker took or refused.

    ``found``: the drift after the cycle; before it where the cycle was refused. ``judged``: figures
    and verdict; each pose is forecast from all earlier cycles and the other poses. ``innovation``:
    what the cycle brought against what was expected.
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

    Raises `InputError` when a sample has no cold counterpart; `TooFewSamplesError` with fewer than
    two poses; `StaleError` when the cycle is older than the last one.
    """
    spots = tracker.spots
    warm = spots.average(warm, tracker.sigma_m)
    if len(spots.visited(warm.q)) < FEWEST_POSES:
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
        deviation, explained = innovation.deviation, innovation.covariance
        rms_mm, expected_mm = (
            1e3 * float(np.sqrt(3.0 * np.mean(square)))
            for square in (deviation**2, np.diag(explained))
        )
        causes = step_words(possible_causes(spots, warm, deviation, explained), fixed)
        refusal = Verdict(
            Code.SENSOR_OR_ROBOT_MOVED,
            f"the measured positions are {rms_mm:.2f} mm rms off, where drift and noise explain "
            f"{expected_mm:.2f} mm; the model stays as it was; {causes}",
        )
        judged = replace(judged, verdict=refusal)
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
    are estimated along, so that model in force and candidate differ by the drift alone. What
    silent motors did is in the error: noise to the tracker, it is in no model.
    """
    _, H, _ = tracker.observation(warm, before.time_s)
    D = tracker.drift_rows(before.time_s)
    v, S, k, count = innovation.deviation, innovation.covariance, tracker.count, len(warm)
    forecast, PH = D @ before.mean, D @ before.covariance @ H.T
    told = H @ before.covariance @ H.T
    kept, pose = np.repeat(innovation.kept, 3), tracker.spots.pose[tracker.spots.match(warm)]
    miss, spread, drifts = np.empty((count, 3)), np.empty(count), np.empty((count, k))
    for i in range(count):
        own, others = slice(3 * i, 3 * i + 3), kept & np.repeat(pose != pose[i], 3)
        model, across = told[others, own], S[others, own]
        gain = np.linalg.solve(S[np.ix_(others, others)], np.column_stack([v[others], model]))
        miss[i] = v[own] - model.T @ gain[:, 0]
        spread[i] = np.sqrt(np.trace(S[own, own] - (2.0 * across - model).T @ gain[:, 1:]))
        drifts[i] = forecast + PH[:, others] @ gain[:, 0]
    return miss, spread, drifts
