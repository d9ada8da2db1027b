"""What samples of one Gaussian say of each other: forecasts of each from all others, closed form.

With ``y ~ N(0, S)`` the error of forecasting part i from the rest is ``(S^-1)_ii^-1 (S^-1 y)_i``,
and its covariance is ``(S^-1)_ii^-1`` (Rasmussen and Williams 2006, section 5.4.2).
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.descent import chi2_quantile

Array = NDArray[np.float64]

FALSE_SAMPLE = 0.001  # chance that a sound cycle loses a sample


def agreeing(y: Array, S: Array, count: int) -> NDArray[np.bool_]:
    """Which of ``count`` samples of three coordinates fit what all others say of them.

    The worst is left out until all fit. ``y`` (3 count,), ``S`` (3 count, 3 count).
    """
    keep = np.ones(count, dtype=np.bool_)
    limit = chi2_quantile(1.0 - FALSE_SAMPLE / count, 3)
    while np.sum(keep) > 1:
        rows = np.repeat(keep, 3)
        pull, own = _parts(y[rows], S[np.ix_(rows, rows)])
        squared = np.einsum("mi,mi->m", pull, np.linalg.solve(own, pull[..., None])[..., 0])
        worst = int(np.argmax(squared))
        if squared[worst] <= limit:
            break
        keep[np.flatnonzero(keep)[worst]] = False
    return keep


def left_out(y: Array, S: Array, keep: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Error (m, 3) at each sample of the forecast from the others, and its rms length (m,)."""
    rows, count = np.repeat(keep, 3), len(keep)
    error, spread = np.empty((count, 3)), np.empty(count)
    pull, own = _parts(y[rows], S[np.ix_(rows, rows)])
    covariance = np.linalg.inv(own)
    error[keep] = (covariance @ pull[..., None])[..., 0]
    spread[keep] = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    if not np.all(keep):  # those left out are forecast from all that are kept
        gain = np.linalg.solve(S[np.ix_(rows, rows)], S[np.ix_(rows, ~rows)]).T
        error[~keep] = (y[~rows] - gain @ y[rows]).reshape(-1, 3)
        rest = S[np.ix_(~rows, ~rows)] - gain @ S[np.ix_(rows, ~rows)]
        spread[~keep] = np.sqrt(np.diag(rest).reshape(-1, 3).sum(axis=1))
    return error, spread


def _parts(y: Array, S: Array) -> tuple[Array, Array]:
    """Parts (m, 3) of S^-1 y and diagonal blocks (m, 3, 3) of S^-1."""
    inverse = np.linalg.inv(S)
    count = len(y) // 3
    blocks = inverse.reshape(count, 3, count, 3)
    each = np.arange(count)
    return np.asarray((inverse @ y).reshape(count, 3)), np.asarray(blocks[each, :, each])
