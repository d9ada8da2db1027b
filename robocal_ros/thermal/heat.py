"""What the motors' temperatures say of the drift: features, and gains to be learned.

A motor and its gear move their own joint's parameters at once. The link that follows the joint lies
between its motor and the next one, and follows both with a lag.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.priors import PLAUSIBLE_WARMING_K, drift_prior

Array = NDArray[np.float64]

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
