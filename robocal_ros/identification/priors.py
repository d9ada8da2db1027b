"""How far a robot's parameters may lie from the nominal ones: tolerances, and what data say."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]

# Spread of a new robot's parameters about the nominal ones: machining and mastering tolerances.
TOLERANCE_LENGTH_M = 3e-3
TOLERANCE_ANGLE_RAD = float(np.radians(0.5))
SMALLEST_SCALE = 0.02
_ROUNDS = 60


def default_prior(arm: SerialArm) -> Array:
    """Variances (k,) of the free parameters of an arm as built."""
    return np.where(arm.parameters.is_length, TOLERANCE_LENGTH_M, TOLERANCE_ANGLE_RAD) ** 2


def fitted_prior(arm: SerialArm, found: Array, covariance: Array) -> Array:
    """Variances (k,) of the free parameters, scaled to what the data show of this robot.

    One scale for the lengths and one for the angles maximise the likelihood of the data with the
    parameters integrated out (empirical Bayes), by expectation-maximisation. Few data then
    neither drown in a prior that is too narrow nor turn noise into millimetres elsewhere.

    Parameters
    ----------
    found, covariance : (k,) deviations from the nominal parameters and their (k, k) covariance,
        as identified with ``default_prior``.
    """
    prior, lengths = default_prior(arm), arm.parameters.is_length
    unit = np.sqrt(prior)  # everything below in units of the tolerances
    total = np.linalg.inv(covariance / np.outer(unit, unit))
    data, pull = total - np.eye(len(unit)), total @ (found / unit)
    scale = np.ones(len(unit))
    for _ in range(_ROUNDS):
        posterior = np.linalg.inv(data + np.diag(1.0 / scale))
        second_moment = (posterior @ pull) ** 2 + np.diag(posterior)
        for group in (lengths, ~lengths):
            if np.any(group):
                scale[group] = max(float(second_moment[group].mean()), SMALLEST_SCALE**2)
    return np.asarray(prior * scale)
