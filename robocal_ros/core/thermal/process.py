"""How a robot's parameters drift in time: the prior of the tracker."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SETUP_SIGMA_M = 1e-5
SETUP_TIME_S = 1800.0
APPROACH_S = 3600.0  # a link follows what heats it
STEADY_TIME_S = 8.0 * 3600.0  # what heats it changes with the work


@dataclass(frozen=True, eq=False)
class DriftProcess:
    """A drift that begins at zero and approaches a steady state, and a set-up never quite still.

    ``approach_s dx/dt = u - x`` for each parameter x; its steady state u is a first-order process
    that forgets what it was within ``steady_s``: work changes. The set-up (sensor, and sphere on
    the flange) wanders by its own small amount: sensors warm up and stems expand, and neither may
    pass for a drift of the arm.

    Attributes
    ----------
    covariance : (k, k) of the parameters' steady state, SI.
    approach_s, steady_s : time constants; they must differ.
    setup_sigma_m, setup_time_s : standard deviation of each of the set-up's six coordinates, and
        its correlation time.
    stretch : by how much the standard deviations that follow are too small: no more than what
        earlier shifts happened to show is in the covariance.
    """

    covariance: Array
    approach_s: float = APPROACH_S
    steady_s: float = STEADY_TIME_S
    setup_sigma_m: float = SETUP_SIGMA_M
    setup_time_s: float = SETUP_TIME_S
    stretch: float = 1.0

    def transition(self, step_s: float) -> tuple[Array, Array]:
        """Transition (2, 2) of a drift and its steady state, and its noise for variance 1."""
        near, far = np.exp(-step_s / self.approach_s), np.exp(-step_s / self.steady_s)
        share = self.steady_s / (self.steady_s - self.approach_s)
        F = np.array([[near, share * (far - near)], [0.0, far]])
        return F, self.stationary - F @ self.stationary @ F.T

    @property
    def stationary(self) -> Array:
        """Covariance (2, 2) of a drift and its steady state in the long run, for variance 1."""
        reached = self.steady_s / (self.steady_s + self.approach_s)
        return np.array([[reached, reached], [reached, 1.0]])

    def setup_fade(self, step_s: float) -> float:
        """What is left of the set-up's deviation after a step."""
        return float(np.exp(-step_s / self.setup_time_s))
