"""How far the tool may be off by now, and when that is too much: from the tracker, at any time."""

import math
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.descent import chi2_quantile
from robocal_ros.identification.solve import random_postures
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.reference import ColdSpots
from robocal_ros.thermal.tracking import DriftTracker

Array = NDArray[np.float64]


HORIZON_S = 24.0 * 3600.0
DUE_WITHIN_S = 1.0  # to which the time that is left is found


class AccuracyLevel(IntEnum):
    """Numbers of ``AccuracyState.msg``; 0 is never sent."""

    OK = 1
    DUE = 2
    DEGRADED = 3
    EXPIRED = 4
    FAULT = 5


@dataclass(frozen=True, eq=False)
class Work:
    """Where the tool is to be accurate.

    Attributes
    ----------
    q : (m, n) working poses, rad (prismatic: m); None: throughout the joint limits.
    tip : (3,) of the tool, flange, m; None: the first measured target.
    """

    q: Array | None = None
    tip: Array | None = None

    def rows(self, spots: ColdSpots) -> Array:
        """Displacement (m, 3, k) of the tip by the arm's parameters, base."""
        arm = spots.cell.arm
        q = random_postures(arm) if self.q is None else self.q
        tip = spots.cell.T_flange_target[0, :3, 3] if self.tip is None else self.tip
        return arm.parameter_jacobian(q, tip)[:, :3]


@dataclass(frozen=True)
class ToolError:
    """Expected error of the tool at all poses of the work, m.

    Attributes
    ----------
    rms_m : root mean square length.
    bound_m : 95 % of the errors are shorter.
    """

    rms_m: float
    bound_m: float

    @classmethod
    def of_square(cls, mean: float, variance: float) -> "ToolError":
        """From mean, m^2, and variance of the squared length.

        It is taken for a scaled chi-square of these two moments (Satterthwaite 1946).
        """
        rms_m = float(np.sqrt(mean))
        if variance <= 1e-12 * mean**2:  # a fixed length
            return cls(rms_m, rms_m)
        scale, freedom = variance / (2.0 * mean), 2.0 * mean**2 / variance
        return cls(rms_m, float(np.sqrt(scale * chi2_quantile(0.95, freedom))))


class AccuracyForecast:
    """Expected error of a model in force, from what the tracker knows.

    Parameters
    ----------
    in_force : an arm of the cold model's type.
    work : where the error is asked for.
    """

    def __init__(self, tracker: DriftTracker, in_force: SerialArm, work: Work) -> None:
        cold = tracker.spots.cell.arm
        self._tracker, self._work = tracker, work
        self._in_force = cold.parameters.read(in_force.mdh - cold.mdh)

    @cached_property
    def _rows(self) -> Array:
        return self._work.rows(self._tracker.spots)

    def drift_at(self, time_s: float) -> tuple[Array, Array]:
        """Expected drift (k,) since the cold visit and its covariance (k, k), SI."""
        return self._tracker.drift(time_s)

    def at(self, time_s: float) -> ToolError:
        """Expected error at a time of the tracker's.

        At one posture the squared length of a Gaussian error of mean m and covariance C has mean
        m'm + tr C and variance 4 m'Cm + 2 tr C^2; `ToolError.of_square` takes both over all
        postures. The scatter of one visit belongs to it, as large as that of a measured one.
        """
        drift, covariance = self.drift_at(time_s)
        rows = self._rows
        miss = rows @ (drift - self._in_force)
        C = rows @ covariance @ rows.transpose(0, 2, 1) + self._tracker.sigma_m**2 * np.eye(3)
        mean = np.einsum("pi,pi->p", miss, miss) + np.trace(C, axis1=1, axis2=2)
        variance = 4.0 * np.einsum("pi,pij,pj->p", miss, C, miss)
        variance += 2.0 * np.einsum("pij,pij->p", C, C)
        all_mean = float(mean.mean())
        all_variance = float(np.mean(variance + mean**2)) - all_mean**2
        return ToolError.of_square(all_mean, all_variance)

    def due_in_s(self, time_s: float, tolerance_m: float) -> float:
        """Time from ``time_s`` until the bound exceeds a tolerance: zero where it does already.

        At most a day, which stands for longer.
        """
        if self.at(time_s).bound_m > tolerance_m:
            return 0.0
        late, early = HORIZON_S, 0.0
        if self.at(time_s + late).bound_m <= tolerance_m:
            return late
        while late - early > DUE_WITHIN_S:
            middle = 0.5 * (early + late)
            if self.at(time_s + middle).bound_m > tolerance_m:
                late = middle
            else:
                early = middle
        return early


MOST_FREEDOM = 1e6  # more of it: as good as a fixed length
HALVINGS = 60


def offset_error(offset_m: float, sigma_m: float) -> ToolError:
    """Of a tip found so far away, with this standard deviation in each axis.

    Mean and variance of the squared length as in `AccuracyForecast.at`.
    """
    mean = offset_m**2 + 3.0 * sigma_m**2
    return ToolError.of_square(mean, 4.0 * offset_m**2 * sigma_m**2 + 6.0 * sigma_m**4)


def both_errors(drift: ToolError, tool: ToolError) -> ToolError:
    """Of both together, taken as independent: other sensors tell them, in other measurements.

    Their mean squares add. So do the variances of their squared lengths, with that of twice their
    product: as large as if both lay on one line, this way or that. An error that is wholly in both,
    on one line, stays below the bound in 83 % of cases.
    """
    (one, its), (other, others) = _square(drift), _square(tool)
    both = ToolError.of_square(one + other, its + others + 4.0 * one * other)
    return ToolError(float(np.hypot(drift.rms_m, tool.rms_m)), both.bound_m)


def _square(error: ToolError) -> tuple[float, float]:
    """Mean and variance of the squared length, of a scaled chi-square with the same bound.

    One degree of freedom at least: the squared length of a Gaussian error has no fewer.
    """
    if error.bound_m == 0.0:
        return 0.0, 0.0
    if error.rms_m == 0.0:
        return error.bound_m**2, 0.0
    ratio = error.bound_m / error.rms_m
    wanted = ratio * ratio  # infinite where ** would raise
    few, many = 0.0, float(np.log(MOST_FREEDOM))
    if wanted <= _over_mean(np.exp(many)):
        return error.bound_m**2, 0.0
    for _ in range(HALVINGS):
        middle = 0.5 * (few + many)
        few, many = (middle, many) if _over_mean(np.exp(middle)) > wanted else (few, middle)
    freedom = float(np.exp(many))
    mean = error.bound_m**2 / _over_mean(freedom)
    return mean, 2.0 * mean**2 / freedom


def _over_mean(freedom: float) -> float:
    """95 % quantile of a chi-square over its mean; falls with the degrees of freedom."""
    return chi2_quantile(0.95, freedom) / freedom


@dataclass(frozen=True)
class Accuracy:
    """What the line reads.

    Attributes
    ----------
    error : expected error of the tool; None where it is not known.
    due_in_s : time until a measurement is due; negative when overdue, 0 where nothing is known.
    """

    level: AccuracyLevel
    reason: str
    error: ToolError | None = None
    due_in_s: float = 0.0

    def document(self, tolerance_m: float) -> dict[str, Any]:
        """The fields of ``AccuracyState.msg``; -1 where the error is not known.

        A figure that is not finite makes it a FAULT: the line must not go on with what it read
        before.
        """
        error = self.error
        told_mm = (-1.0, -1.0) if error is None else (error.rms_m * 1e3, error.bound_m * 1e3)
        if not all(map(math.isfinite, (*told_mm, self.due_in_s))):
            words = "a figure of the accuracy is not finite, please report it"
            return Accuracy(AccuracyLevel.FAULT, words).document(tolerance_m)
        return {
            "state": int(self.level),
            "predicted_error_mm": told_mm[0],
            "bound_mm": told_mm[1],
            "tolerance_mm": tolerance_m * 1e3,
            "due_in_s": self.due_in_s,
            "reason": self.reason,
        }
