"""The drift that one measuring cycle shows: maximum a posteriori, closed form.

Drifts are so small that the model is linear in them (0.1 mrad over 3 m: the second order is
30 nm). With y the displacement of the targets since the cold visit, ``y = A x + B s - b + v``:
x the parameters' drift, s the set-up's shift, b the cold visit's noise and v the warm one's.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import Observability, describe, observability
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.agreement import agreeing, left_out
from robocal_ros.thermal.process import SETUP_SIGMA_M
from robocal_ros.thermal.spots import ColdSpots
from robocal_ros.thermal.subset import subset_drift

Array = NDArray[np.float64]

FEWEST_POSES = 2


@dataclass(frozen=True, eq=False)
class CycleDrift:
    """A drift identified from one cycle.

    Attributes
    ----------
    drift, covariance : (k,) of the free parameters since the cold visit, and (k, k), SI.
    prior_covariance : (k, k) of the drift before the cycle; None where there was none.
    arm : the cold arm with the drift added.
    warm : the visits, those of one pose averaged; m of them.
    left_out : (m, 3) displacement at each sample less what all other samples say of it, m.
    left_out_sigma : (m,) rms length of the same that the covariances predict, m.
    rejected : (m,) samples that the others contradict.
    noise_m : rms standard deviation of a coordinate of the visits.
    seen, unobservable : what the data alone determine, and what not, in words.
    """

    drift: Array
    covariance: Array
    prior_covariance: Array | None
    arm: SerialArm
    warm: Measurements
    left_out: Array
    left_out_sigma: Array
    rejected: NDArray[np.bool_]
    noise_m: float
    seen: Observability
    unobservable: tuple[str, ...]


def identify_cycle(
    spots: ColdSpots,
    warm: Measurements,
    *,
    prior_covariance: Array,
    sigma_m: float,
    setup_sigma_m: float = SETUP_SIGMA_M,
) -> CycleDrift:
    """Identify all free parameters from one cycle.

    Visits of one pose are averaged first: they share the noise of its cold visit, and none may
    judge another.

    Parameters
    ----------
    prior_covariance : (k, k), SI, of the drift since the cold visit.
    sigma_m : standard deviation of one coordinate of one visit, of the cold ones and of warm
        ones without a sigma of their own.

    Raises
    ------
    InputError
        When a sample has no cold counterpart.
    TooFewSamplesError
        With fewer than two poses.
    """
    warm = spots.average(warm, sigma_m)
    if len(warm) < FEWEST_POSES:
        raise TooFewSamplesError("one pose cannot show a drift: measure at least five")
    spot, arm = spots.match(warm), spots.cell.arm
    y = spots.drift(warm).ravel()
    parameters, setup = spots.rows(warm.q, spots.target[spot])
    A, B = parameters.reshape(len(y), -1), setup.reshape(len(y), -1)
    variance = visit_variance(spots, spot, warm, sigma_m)
    R = np.diag(np.repeat(variance, 3)) + setup_sigma_m**2 * B @ B.T
    S = A @ prior_covariance @ A.T + R
    keep = agreeing(y, S, len(warm))
    rows = np.repeat(keep, 3)
    gain = np.linalg.solve(S[np.ix_(rows, rows)], A[rows] @ prior_covariance).T
    drift = gain @ y[rows]
    covariance = prior_covariance - gain @ A[rows] @ prior_covariance
    miss, spread = left_out(y, S, keep)
    chosen, seen = arm.parameters, observability(A[rows])
    words = (describe(column, chosen.names, chosen.to_display) for column in seen.null.T)
    return CycleDrift(
        drift=drift,
        covariance=0.5 * (covariance + covariance.T),
        prior_covariance=prior_covariance,
        arm=arm.with_mdh(chosen.add(arm.mdh, drift)),
        warm=warm,
        left_out=miss,
        left_out_sigma=spread,
        rejected=~keep,
        noise_m=float(np.sqrt(variance.mean())),
        seen=seen,
        unobservable=tuple(words),
    )


def require_parameters(arm: SerialArm, names: Sequence[str]) -> None:
    """Refuse names that are not free parameters of ``arm``.

    Raises
    ------
    InputError
        Naming the first of them, and those that there are.
    """
    unknown = [name for name in names if name not in arm.parameters.names]
    if unknown:
        raise InputError(
            f"unknown parameter '{unknown[0]}'; this model has {', '.join(arm.parameters.names)}"
        )


def identify_subset(
    spots: ColdSpots, warm: Measurements, names: Sequence[str], *, sigma_m: float
) -> CycleDrift:
    """Identify some parameters by least squares and hold the others (thesis eq. 3-8 to 3-10).

    Raises
    ------
    InputError
        When a name is unknown, or a sample has no cold counterpart.
    TooFewSamplesError, RankDeficientError
        When the poses cannot answer.
    """
    warm = spots.average(warm, sigma_m)
    spot, arm = spots.match(warm), spots.cell.arm
    require_parameters(arm, names)
    rows = spots.rows(warm.q, spots.target[spot])[0].reshape(3 * len(warm), -1)
    chosen = [i for i, name in enumerate(arm.parameters.names) if name in names]
    y = spots.drift(warm).ravel()
    fit = subset_drift(y[None], rows, chosen, arm.parameters.names)
    if len(y) < len(chosen) + 3:
        raise TooFewSamplesError(
            f"{len(warm)} poses give {len(y)} equations for {len(chosen)} parameters, and without "
            "any of them the others must still determine all: measure more"
        )
    variance = float(visit_variance(spots, spot, warm, sigma_m).mean())
    drift, covariance = np.zeros(rows.shape[1]), np.zeros((rows.shape[1],) * 2)
    drift[chosen] = fit.drift[0]
    covariance[np.ix_(chosen, chosen)] = variance * fit.inverse @ fit.inverse.T
    left, spread = _forecasts(y, fit.basis, variance)
    return CycleDrift(
        drift=drift,
        covariance=covariance,
        prior_covariance=None,
        arm=arm.with_mdh(arm.parameters.add(arm.mdh, drift)),
        warm=warm,
        left_out=left,
        left_out_sigma=spread,
        rejected=np.zeros(len(warm), dtype=np.bool_),
        noise_m=float(np.sqrt(variance)),
        seen=observability(rows[:, chosen]),
        unobservable=(),
    )


def _forecasts(y: Array, basis: Array, variance: float) -> tuple[Array, Array]:
    """Each pose less its forecast from the others (m, 3), and its rms length (m,); by leverage."""
    residual = (y - basis @ (basis.T @ y)).reshape(-1, 3)
    rows = basis.reshape(len(residual), 3, -1)
    own = np.linalg.inv(np.eye(3) - rows @ np.swapaxes(rows, 1, 2))
    spread = np.sqrt(variance * np.trace(own, axis1=1, axis2=2))
    return np.einsum("mij,mj->mi", own, residual), spread


def visit_variance(
    spots: ColdSpots, spot: NDArray[np.int64], warm: Measurements, sigma_m: float
) -> Array:
    """Variance (m,), m^2, of one coordinate of a displacement: warm and cold noise."""
    sigma = np.full(len(warm), sigma_m) if warm.sigma is None else warm.sigma
    return np.asarray(sigma**2 + sigma_m**2 / spots.visits[spot])
