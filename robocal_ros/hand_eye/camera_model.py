"""The model of a hand-eye calibration, as the estimators take it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocal_ros.hand_eye.camera_kernels import advance, differentiate, whiten
from robocal_ros.hand_eye.pose_pairs import Placement, PosePairs, differences, plain, predicted

Array = NDArray[np.float64]

_AXES = ("x", "y", "z")
NAMES = (
    *(f"camera_{axis}" for axis in _AXES),
    *(f"camera_turn_{axis}" for axis in _AXES),
    *(f"board_{axis}" for axis in _AXES),
    *(f"board_turn_{axis}" for axis in _AXES),
)


@dataclass(frozen=True, eq=False)
class PairState:
    """A placement, and the errors (s,) common to all board poses."""

    at: Placement
    common: Array

    def after(self, step: Array) -> "PairState":
        """The state after increments (12 + s,), as of `linearised`."""
        X, Z = np.empty((4, 4)), np.empty((4, 4))
        advance(plain(self.at.X), step[:6], X)
        advance(plain(self.at.Z), step[6:12], Z)
        return PairState(Placement(X, Z), self.common + step[12:])


def linearised(pairs: PosePairs, state: PairState) -> tuple[Array, Array]:
    """Differences (m, 6), camera axes, m and rad, and their Jacobian (m, 6, 12 + s).

    Increments (v, w) of X along the camera's axes and of Z along the board's, then the errors
    common to all.
    """
    T = predicted(pairs, state.at)
    miss = differences(T, pairs)
    J = np.zeros((len(pairs), 6, 12 + len(state.common)))
    differentiate(T, miss, J)
    if pairs.shared is not None:
        J[:, :, 12:] = -pairs.shared.sensitivity
        miss = miss - pairs.shared.sensitivity @ state.common
    return miss, J


@dataclass(frozen=True, eq=False)
class PairProblem:
    """`linearised`, whitened by the lower roots (m, 6, 6) of the differences' covariances.

    ``common_scale``: by how much common errors are larger than told.
    """

    pairs: PosePairs
    root: Array
    common_scale: float
    scale_components: int = 6

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the unknowns."""
        count = 0 if self.pairs.shared is None else len(self.pairs.shared.covariance)
        return (*NAMES, *(f"common_{i + 1}" for i in range(count)))

    def linearise(self, state: PairState) -> tuple[Array, Array]:
        """Whitened differences (m, 6) and their Jacobian."""
        miss, J = linearised(self.pairs, state)
        white = miss[:, :, None]
        whiten(self.root, white)
        whiten(self.root, J)
        return miss, J

    def retract(self, state: PairState, step: Array) -> PairState:
        """The state after a step (12 + s,)."""
        return state.after(step)

    def deviation(self, state: PairState) -> Array:
        """Of the common errors from their mean, zero."""
        return np.concatenate([np.zeros(12), state.common])

    @property
    def prior_information(self) -> Array | None:
        """Flat but for the common errors."""
        shared = self.pairs.shared
        if shared is None:
            return None
        information = np.zeros((len(self.names), len(self.names)))
        information[12:, 12:] = np.linalg.inv(shared.covariance * self.common_scale**2)
        return information
