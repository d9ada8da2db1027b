"""How a robot's parameters drift in time: the prior of the tracker."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import FEWEST_GROUPS
from robocal_ros.estimation.descent import chi2_quantile
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.identification import SETUP_SIGMA_M, visit_variance
from robocal_ros.thermal.reference import ColdReference, ColdSpots

Array = NDArray[np.float64]

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

    Attributes
    ----------
    covariance : (k, k) of the parameters' steady state, SI.
    approach_s, steady_s : time constants; the first one is the shorter.
    setup_sigma_m, setup_approach_s : standard deviation of the steady state of each of the
        set-up's six coordinates, and how fast they approach it.

    Raises
    ------
    InputError
        When the steady state is forgotten before it is approached.
    """

    covariance: Array
    approach_s: float = APPROACH_S
    steady_s: float = STEADY_TIME_S
    setup_sigma_m: float = SETUP_SIGMA_M
    setup_approach_s: float = SETUP_APPROACH_S

    def __post_init__(self) -> None:
        if not 0.0 < max(self.approach_s, self.setup_approach_s) < self.steady_s:
            raise InputError(
                f"approach within {self.approach_s:g} s (set-up: {self.setup_approach_s:g} s) must "
                f"be shorter than the {self.steady_s:g} s after which the steady state is forgotten"
            )

    def transition(self, step_s: float) -> tuple[Array, Array]:
        """Transition (2, 2) of a drift and its steady state, and its noise for variance 1."""
        return _transition(step_s, self.approach_s, self.steady_s)

    def setup_transition(self, step_s: float) -> tuple[Array, Array]:
        """The same of a coordinate of the set-up."""
        return _transition(step_s, self.setup_approach_s, self.steady_s)


def _transition(step_s: float, approach_s: float, steady_s: float) -> tuple[Array, Array]:
    near, far = np.exp(-step_s / approach_s), np.exp(-step_s / steady_s)
    share = steady_s / (steady_s - approach_s)
    F = np.array([[near, share * (far - near)], [0.0, far]])
    reached = steady_s / (steady_s + approach_s)
    long_run = np.array([[reached, reached], [reached, 1.0]])
    return F, long_run - F @ long_run @ F.T


# ---- how far parameters may lie from the nominal ones -------------------------------------------


EXPANSION_PER_K = 12e-6  # steel and cast iron; aluminium links drift up to twice as much
PLAUSIBLE_WARMING_K = 20.0
SMALLEST_LENGTH_M = 0.2  # a joint whose nominal length is zero still has a housing that grows
DRIFT_ANGLE_RAD = float(np.radians(0.005))
DEFAULT_WEIGHT = 10.0  # the default prior counts as so many identified drifts


def drift_prior(arm: SerialArm) -> Array:
    """Covariance (k, k), SI, of the free parameters' thermal drift before it is learned.

    Lengths: link length times expansion coefficient times plausible warming; angles: a fixed
    small value.
    """
    length = np.maximum(np.abs(arm.parameters.read(arm.mdh)), SMALLEST_LENGTH_M)
    grown = length * EXPANSION_PER_K * PLAUSIBLE_WARMING_K
    return np.diag(np.where(arm.parameters.is_length, grown, DRIFT_ANGLE_RAD) ** 2)


def learned_prior(default: Array, drifts: Array, covariances: Array) -> Array:
    """Covariance (k, k) of the drift from identified ones.

    Parameters
    ----------
    default : (k, k) prior to start from.
    drifts, covariances : (n, k) identified drifts against the cold reference and their
        (n, k, k) covariances.

    One expectation-maximisation step of a zero-mean Gaussian's covariance with the default as
    its inverse-Wishart prior: the second moment of each drift is its square plus its covariance,
    so that what the measurements never showed keeps its default.
    """
    moments = np.einsum("ni,nj->ij", drifts, drifts) + covariances.sum(axis=0)
    return np.asarray((DEFAULT_WEIGHT * default + moments) / (DEFAULT_WEIGHT + len(drifts)))


# ---- what the motors' temperatures say of the drift: features, and gains to be learned ----------
#
# A motor and its gear move their own joint's parameters at once. The link that follows the joint
# lies between its motor and the next one, and follows both with a lag.


SOURCES = 3  # of each parameter: its joint's motor, the same lagged, the next motor lagged
SWING_K = 20.0  # where a temperature may go once it is no longer read
SWING_TIME_S = 3600.0


@dataclass(frozen=True, eq=False)
class Heat:
    """Motor temperatures above those at the cold visit, K: as last read, and lagged.

    Attributes
    ----------
    time_s : of the last reading.
    motor, lagged : (n,).
    lag_s : time constant of the lag.
    """

    time_s: float
    motor: Array
    lagged: Array
    lag_s: float

    @classmethod
    def cold(cls, n: int, time_s: float, lag_s: float) -> "Heat":
        """At the cold visit."""
        return cls(time_s, np.zeros(n), np.zeros(n), lag_s)

    def read(self, temperature: Array, time_s: float) -> "Heat":
        """After a reading (n,), the course since the last one taken as straight.

        Raises
        ------
        InputError
            When it is not one finite temperature for each joint, or older than the last.
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


def swing_k(silent_s: float) -> float:
    """Standard deviation, K, of a motor's temperature so long after it was read."""
    return float(SWING_K * (1.0 - np.exp(-max(silent_s, 0.0) / SWING_TIME_S)))


@dataclass(frozen=True, eq=False)
class HeatGains:
    """Change of each parameter per kelvin of each of its sources.

    Attributes
    ----------
    mean, covariance : (3k,) and (3k, 3k), SI per K; parameter by parameter.
    lag_s : how slowly links follow the motors.
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


# ---- warmth -------------------------------------------------------------------------------------
#
# At the poses of a cold reference the arm's static errors are known and cancel. What is left is
# compared with either answer: first as if sensor and target stood still, then, where neither
# answer explains it so, with both moved anywhere, which takes more or better poses to tell.


# Noise makes the wrong answer so much likelier in one case of as many (Wald 1945).
LIKELIER = 1000.0
MOST_LEFT = 0.25  # share of the drift that an answer may leave, to be missing in all later models
FALSE_ALARM = 0.001  # chance that a set-up that stands still looks moved


@dataclass(frozen=True)
class DriftShare:
    """How much of a drift is in a visit: 0 for the cold robot, 1 for one as warm as the drift.

    Attributes
    ----------
    share, sigma : its estimate and standard deviation; infinite where the visit shows nothing.
    """

    share: float = 0.5
    sigma: float = math.inf

    @property
    def told(self) -> bool:
        """Whether the visit tells one answer from the other.

        The chi-squares of the two fits differ by (1 - 2 share) / sigma^2, which is twice the
        logarithm of their likelihoods' ratio.
        """
        return abs(1.0 - 2.0 * self.share) >= 2.0 * math.log(LIKELIER) * self.sigma**2

    @property
    def between(self) -> bool:
        """Whether neither answer is near: the robot warms up or cools down."""
        return MOST_LEFT < self.share < 1.0 - MOST_LEFT

    @property
    def warm(self) -> bool:
        """Whether the drift fits better than the cold robot."""
        return self.share > 0.5


def drift_size_m(visit: ColdReference, warm: SerialArm) -> float:
    """Rms of one coordinate, m, by which a drift moves the targets at a visit's poses."""
    moved = replace(visit.cell, arm=warm).residual(visit.data) - visit.cell.residual(visit.data)
    return float(np.sqrt(np.mean(moved**2)))


def drift_share(
    reference: ColdReference, visit: ColdReference, warm: SerialArm, sigma_m: float
) -> DriftShare:
    """Tell how much of the drift from ``visit``'s arm to ``warm`` a visit shows.

    Parameters
    ----------
    reference : the one in force, for the static errors at its poses; other poses tell nothing.
    visit : the new visit, placed with the cold arm.
    warm : the arm with the drift.
    sigma_m : standard deviation of one coordinate of one visit.
    """
    spots, cold = reference.spots, visit.cell.arm
    again = spots.common(visit.used)
    again = again.take(~np.isin(again.sample, visit.spots.rejected))
    if len(spots.visited(again.q)) < FEWEST_GROUPS:
        return DriftShare()
    still, explained = _compared(spots, again, cold, warm, sigma_m, moved=False)
    if explained:
        return still
    T = reference.cell.T_frame_base @ frames.invert(visit.cell.T_frame_base)
    seen = replace(again, position=again.position @ T[:3, :3].T + T[:3, 3])
    return _compared(spots, seen, cold, warm, sigma_m, moved=True)[0]


def _compared(
    spots: ColdSpots,
    again: Measurements,
    cold: SerialArm,
    warm: SerialArm,
    sigma_m: float,
    *,
    moved: bool,
) -> tuple[DriftShare, bool]:
    """The share, and whether the better answer leaves no more than noise.

    Least squares over the set-up: sensor and target held to their usual wander, or free in
    position and turn. A fit that is worse than the noise widens sigma by as much.
    """
    again = spots.average(again, sigma_m)
    spot, parameters = spots.match(again), spots.cell.arm.parameters
    rows, setup = spots.rows(again.q, spots.target[spot])
    known = parameters.read(cold.mdh - spots.cell.arm.mdh)
    pair = [rows @ parameters.read(warm.mdh - cold.mdh), spots.drift(again) - rows @ known]
    if moved:
        turn = -frames.skew(again.position - again.position.mean(axis=0))
        setup = np.concatenate([setup, turn], axis=2)
    sigma = np.repeat(np.sqrt(visit_variance(spots, spot, again, sigma_m)), 3)[:, None]
    G = setup.reshape(len(sigma), -1) / sigma
    both = np.column_stack([one.ravel() for one in pair]) / sigma
    if not moved:
        held = np.eye(G.shape[1]) / SETUP_SIGMA_M
        G, both = np.vstack([G, held]), np.vstack([both, np.zeros((len(held), 2))])
    solved, _, rank, _ = np.linalg.lstsq(G, both, rcond=None)
    drift, shown = (both - G @ solved).T
    square, freedom = float(drift @ drift), len(G) - int(rank)
    if freedom < 1 or square <= 0.0:
        return DriftShare(), False
    chi2 = min(float(shown @ shown), float(np.sum((shown - drift) ** 2)))
    sigma_share = float(np.sqrt(max(1.0, chi2 / freedom) / square))
    explained = chi2 <= chi2_quantile(1.0 - FALSE_ALARM, freedom)
    return DriftShare(float(drift @ shown) / square, sigma_share), explained
