"""How many numbers are left to tell the noise when unknowns, also by a prior, took their share."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import TooFewSamplesError

Array = NDArray[np.float64]

MOST_ROUNDS = 50
CLOSE = 1e-12  # relative
SMALLEST_SHARE = 1e-9  # of the numbers, so that a fit that takes up all of them is no division by 0
TINY = 1e-200
ROUNDING = 1e-15
NO_MEAN = 2.0  # up to so many numbers a squared error over its reported variance (F) has no mean


@dataclass(frozen=True)
class Freedom:
    """What a fit under a prior leaves of N residuals, by the noise.

    A direction that the prior holds takes up nothing. With noise of the standard deviation s, data
    of the information W / s^2 and a prior P the fit takes up trace(W (W + s^2 P)^-1) of the
    numbers, of those that tell the noise trace(A (W + s^2 P)^-1) (MacKay, Bayesian interpolation,
    1992: the number of well-determined parameters).

    Attributes
    ----------
    count : N numbers tell the noise.
    told, data : (k,) diagonals of A and W in directions in which W + unit P is one.
    unit : a variance at which data and prior weigh alike.
    """

    count: int
    told: Array
    data: Array
    unit: float

    @classmethod
    def of(cls, count: int, told: Array, data: Array, prior: Array) -> "Freedom":
        """From A, W and P (k, k); what neither data nor prior determine takes up nothing."""
        pinned = float(np.trace(prior))
        unit = float(np.trace(data)) / pinned if pinned else 1.0
        whole = data + unit * prior
        size = 1.0 / np.sqrt(np.maximum(np.diag(whole), TINY))
        weight, axes = np.linalg.eigh(whole * np.outer(size, size))
        root = size[:, None] * axes / np.sqrt(np.maximum(weight, ROUNDING * weight[-1]))
        share, turn = np.linalg.eigh(root.T @ data @ root)
        V = root @ turn
        shown = np.clip(share, 0.0, 1.0) if pinned else np.ones(len(data))
        return cls(count, np.sum(V * (told @ V), axis=0), shown, unit)

    @classmethod
    def flat(cls, count: int, unknowns: int) -> "Freedom":
        """Without a prior, all numbers telling the noise: each unknown takes up one."""
        return cls(count, np.ones(unknowns), np.ones(unknowns), 1.0)

    def at(self, squared: float) -> float:
        """Numbers that are left with a variance of the noise."""
        return self.count - float(np.sum(self.told / (self.data + self._held(squared))))

    def scale(self, total: float) -> float:
        """Standard deviation s with s^2 = total / (numbers left at s^2).

        ``total``: sum of the squared residuals. The right side falls where s^2 grows, by a lower
        power: there is one solution. Newton's method in the logarithms, on log(s^2) less that of
        the right side, which has a slope between 1 and 2.
        """
        squared = max(total, TINY) / self.count
        for _ in range(MOST_ROUNDS if self.by_prior else 1):
            left = max(self.at(squared), SMALLEST_SHARE * self.count)
            held = self._held(squared)
            slope = 1.0 + float(np.sum(self.told * held / (self.data + held) ** 2)) / left
            step = float(np.log(max(total, TINY) / left / squared)) / slope
            squared *= float(np.exp(step))
            if abs(step) < CLOSE:
                break
        return float(np.sqrt(squared))

    @property
    def by_prior(self) -> bool:
        """Whether a prior holds anything."""
        return bool(np.any(self.data < 1.0))

    def _held(self, squared: float) -> Array:
        return (1.0 - self.data) * (squared / self.unit)


def require_told(left: float) -> None:
    """Refuse noise that too few numbers tell.

    Raises
    ------
    TooFewSamplesError
        With `NO_MEAN` numbers or fewer.
    """
    if left <= NO_MEAN:
        raise TooFewSamplesError(
            f"the unknowns take up what these samples tell: {NO_MEAN:.0f} numbers or fewer are "
            "left to find the noise from; measure more poses, or give each sample's sigma (column "
            "sigma_mm)"
        )
