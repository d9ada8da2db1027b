"""What drift to expect of one robot, learned from cycles that it has measured."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import TooFewSamplesError
from robocal_ros.ground.samples import Measurements
from robocal_ros.thermal.identification import identify_cycle
from robocal_ros.thermal.priors import drift_prior, learned_prior
from robocal_ros.thermal.spots import ColdSpots

Array = NDArray[np.float64]

FEWEST_CYCLES = 10


@dataclass(frozen=True, eq=False)
class LearnedDrift:
    """Expected drift.

    Attributes
    ----------
    covariance : (k, k) of the free parameters' drift since the cold visit, SI.
    cycles : how many cycles it was learned from.
    """

    covariance: Array
    cycles: int


def learn_drift(
    histories: Sequence[tuple[ColdSpots, Sequence[Measurements]]], *, sigma_m: float
) -> LearnedDrift:
    """Learn from cold visits and the cycles that followed each, all of one robot.

    Each cycle is identified with the default prior; ``priors.learned_prior`` weighs what the
    cycles show against it. What no cycle can show keeps its default.

    Raises
    ------
    InputError
        When a cycle does not belong to its cold visit.
    TooFewSamplesError
        With fewer than ten cycles.
    """
    total = sum(len(cycles) for _, cycles in histories)
    if total < FEWEST_CYCLES:
        raise TooFewSamplesError(
            f"{total} cycles show too little of what drift to expect: at least {FEWEST_CYCLES}"
        )
    default = drift_prior(histories[0][0].cell.arm)
    found = [
        identify_cycle(spots, cycle, prior_covariance=default, sigma_m=sigma_m)
        for spots, cycles in histories
        for cycle in cycles
    ]
    drifts = np.array([one.drift for one in found])
    covariances = np.array([one.covariance for one in found])
    return LearnedDrift(learned_prior(default, drifts, covariances), total)
