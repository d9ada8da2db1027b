"""What drift to expect: from the links' lengths, or learned from the robot's own history."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]

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
