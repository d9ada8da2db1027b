"""Whether a parameter fluctuates about a level or drifts: tests of its autocorrelation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import TooFewSamplesError

Array = NDArray[np.float64]

LEVEL = 0.05  # chance that white noise passes for a drift
LAGS = 7  # a drift shows in the first lags; with 7 the count's own chance is 4.4 %, next to LEVEL
BOUND = 1.96  # of a white series' autocorrelation, times the root of its length
FEWEST = 3 * LAGS


@dataclass(frozen=True, eq=False)
class Stationarity:
    """Tests of k series, each against white noise about a level.

    Attributes
    ----------
    autocorrelation : (LAGS, k) at lags 1 ... LAGS.
    bound : half width of the interval that holds 95 % of a white series' autocorrelations.
    outside : (k,) how many lags lie outside it; ``allowed`` of them is what chance allows.
    p_value : (k,) of Ljung and Box's test.
    """

    autocorrelation: Array
    bound: float
    outside: NDArray[np.int64]
    allowed: int
    p_value: Array

    @property
    def by_count(self) -> NDArray[np.bool_]:
        """(k,) stationary, because no more lags lie outside than chance allows."""
        return np.asarray(self.outside <= self.allowed)

    @property
    def by_ljung_box(self) -> NDArray[np.bool_]:
        """(k,) stationary, because white noise has such autocorrelations often enough."""
        return np.asarray(self.p_value >= LEVEL)


def stationarity(series: Array) -> Stationarity:
    """Test the columns of equally spaced series (t, k), in whatever unit.

    The lags of a white series are nearly independent and each is outside with chance 5 %, so
    that their number is binomial. Ljung and Box (1978) sum their squares instead, which is
    chi-square with as many degrees of freedom as there are lags. Either finds a white series
    drifting in about 5 % of cases (the count, being whole, in a little less).

    Raises
    ------
    TooFewSamplesError
        With fewer than 21 times.
    """
    from scipy.special import gammaincc

    n = len(series)
    if n < FEWEST:
        raise TooFewSamplesError(
            f"{n} cycles are too few to tell a drift from chance: at least {FEWEST}"
        )
    r = autocorrelation(series)
    bound = BOUND / float(np.sqrt(n))
    left = n - np.arange(1, LAGS + 1)
    squared = n * (n + 2.0) * np.sum(r**2 / left[:, None], axis=0)
    return Stationarity(
        autocorrelation=r,
        bound=bound,
        outside=np.sum(np.abs(r) > bound, axis=0),
        allowed=_allowed(),
        p_value=np.asarray(gammaincc(0.5 * LAGS, 0.5 * squared)),
    )


def autocorrelation(series: Array) -> Array:
    """Sample autocorrelation (LAGS, k) of the columns of (t, k); zero for a constant column."""
    x = series - series.mean(axis=0)
    power = np.sum(x**2, axis=0)
    power = np.where(power > 0.0, power, 1.0)
    return np.array([np.sum(x[lag:] * x[:-lag], axis=0) / power for lag in range(1, LAGS + 1)])


def _allowed() -> int:
    """Most lags outside that chance exceeds in no more than 5 % of white series."""
    from scipy.special import bdtrc

    return next(count for count in range(LAGS + 1) if bdtrc(count, LAGS, LEVEL) <= LEVEL)
