"""Errors of a tool over a shift, and what they come to."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import summarise

Array = NDArray[np.float64]

TOLERANCE_MM = 0.1


@dataclass(frozen=True, eq=False)
class ShiftErrors:
    """True errors of a simulated tool at check poses over a shift, against the cold robot.

    Attributes
    ----------
    hours : (c,) time of each cycle since the start of the shift.
    accepted : of each cycle: whether its model came into force.
    before, after : (c, m, 3) error at the check poses after each cycle, m, without and with
        correction.
    held : (c, m, 3) with the correction that was in force just before the cycle: at its oldest.
    """

    hours: Array
    accepted: Sequence[bool]
    before: Array
    after: Array
    held: Array


def figures_of(error: Array) -> dict[str, float]:
    """Mean, rms, p95, max of the distances, mm, and the share of directions in tolerance.

    ``error`` is (..., 3), m; a direction is one coordinate at one pose.
    """
    found = summarise(error.reshape(-1, 3))
    within = np.abs(error) * 1e3 < TOLERANCE_MM
    return {
        "mean_mm": found.mean_m * 1e3,
        "rms_mm": found.rms_m * 1e3,
        "p95_mm": found.p95_m * 1e3,
        "max_mm": found.max_m * 1e3,
        "share_within_tolerance": float(np.mean(within)),
        "n": found.n,
    }
