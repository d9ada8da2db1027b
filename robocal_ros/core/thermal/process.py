"""How a robot's parameters drift in time: the prior of the tracker."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SETUP_SIGMA_M = 1e-5
SETUP_TIME_S = 1800.0
DRIFT_TIME_S = 4.0 * 3600.0


@dataclass(frozen=True, eq=False)
class DriftProcess:
    """A smooth random drift that begins at zero, and a set-up that is never quite still.

    The parameters follow a Gaussian process with Matern-3/2 correlation in time: what a body does
    that is heated at a rate which changes. As a state it is the drift and its rate (Hartikainen
    and Sarkka 2010). The set-up (sensor, and sphere on the flange) wanders by its own small
    amount: sensors warm up and stems expand, and neither may pass for a drift of the arm.

    Attributes
    ----------
    covariance : (k, k) of the parameters' drift in the long run, SI.
    time_s : correlation time of the drift.
    setup_sigma_m, setup_time_s : standard deviation of each of the set-up's six coordinates, and
        its correlation time.
    """

    covariance: Array
    time_s: float = DRIFT_TIME_S
    setup_sigma_m: float = SETUP_SIGMA_M
    setup_time_s: float = SETUP_TIME_S

    def transition(self, step_s: float) -> tuple[Array, Array]:
        """Transition (2, 2) of a drift and its rate over a step, and its noise for variance 1."""
        rate = np.sqrt(3.0) / self.time_s
        fade = np.exp(-rate * step_s)
        F = fade * np.array(
            [[1.0 + rate * step_s, step_s], [-(rate**2) * step_s, 1.0 - rate * step_s]]
        )
        steady = np.diag([1.0, rate**2])
        return F, steady - F @ steady @ F.T

    def setup_fade(self, step_s: float) -> float:
        """What is left of the set-up's deviation after a step."""
        return float(np.exp(-step_s / self.setup_time_s))
