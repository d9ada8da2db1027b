"""How a robot's parameters drift in time: the prior of the tracker."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError

Array = NDArray[np.float64]

SETUP_SIGMA_M = 1e-5
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
