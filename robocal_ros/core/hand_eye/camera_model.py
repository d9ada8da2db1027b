"""The model of a hand-eye calibration, as the estimators take it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.hand_eye.increments import moved
from robocal_ros.core.hand_eye.pose_pairs import Placement, PosePairs, differences, predicted

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


def linearised(pairs: PosePairs, state: PairState) -> tuple[Array, Array]:
    """Differences (m, 6), camera axes, m and rad, and their Jacobian (m, 6, 12 + s).

    Increments (v, w) of X along the camera's axes and of Z along the board's, then the errors
    common to all.
    """
    T = predicted(pairs, state.at)
    R, p = T[:, :3, :3], T[:, :3, 3]
    miss = differences(T, pairs)
    m, s = len(pairs), len(state.common)
    J = np.zeros((m, 6, 12 + s))
    turning = frames.left_jacobian_inverse(miss[:, 3:])
    J[:, :3, :3] = -np.eye(3)
    J[:, :3, 3:6] = frames.skew(p)
    J[:, 3:, 3:6] = -turning
    J[:, :3, 6:9] = R
    J[:, 3:, 9:12] = turning @ R
    if pairs.shared is not None:
        J[:, :, 12:] = -pairs.shared.sensitivity
        miss = miss - pairs.shared.sensitivity @ state.common
    return miss, J


@dataclass(frozen=True, eq=False)
class PairProblem:
    """`linearised`, whitened by the covariance (m, 6, 6) of each sample's differences."""

    pairs: PosePairs
    whitening: Array
    names: tuple[str, ...]
    common_scale: float
    scale_components: int = 6

    @classmethod
    def of(cls, pairs: PosePairs, covariance: Array, common_scale: float) -> "PairProblem":
        """With the inverse roots of the covariances; common errors so much larger than told."""
        count = 0 if pairs.shared is None else len(pairs.shared.covariance)
        names = (*NAMES, *(f"common_{i + 1}" for i in range(count)))
        return cls(pairs, np.linalg.inv(np.linalg.cholesky(covariance)), names, common_scale)

    def linearise(self, state: PairState) -> tuple[Array, Array]:
        """Whitened differences (m, 6) and their Jacobian."""
        miss, J = linearised(self.pairs, state)
        return (self.whitening @ miss[..., None])[..., 0], self.whitening @ J

    def retract(self, state: PairState, step: Array) -> PairState:
        """The state after a step (12 + s,)."""
        at = Placement(moved(state.at.X, step[:6]), moved(state.at.Z, step[6:12]))
        return PairState(at, state.common + step[12:])

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
