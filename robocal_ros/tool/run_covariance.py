"""How well a run knows its tool: covariances of the unknowns (k, k), and of the tool (5, 5)."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.descent import SOUND_FIT, chi2_quantile
from robocal_ros.estimation.estimation import Estimate
from robocal_ros.tool.crossed_model import RunProblem, ToolState, across

Array = NDArray[np.float64]


def widened(problem: RunProblem, found: Estimate[ToolState]) -> Estimate[ToolState]:
    """With a covariance for shifts, or what was held, that are larger than their sigmas explain.

    For edges that are, `solve` has widened it: here they count with the scatter that it found.
    """
    away = problem.deviation(found.state)
    misfit = float(np.sum((found.residual / found.scale) ** 2) + away @ problem.prior @ away)
    free = len(found.residual) - problem.undetermined
    if free <= 0 or misfit <= chi2_quantile(SOUND_FIT, free):
        return found
    return replace(found, covariance=misfit / free * found.covariance)


def of_laser(problem: RunProblem, found: Estimate[ToolState]) -> Array:
    """Part of the covariance C that the errors of the laser's points make: C P C, P their prior."""
    points = [i for i, name in enumerate(found.names) if name.startswith("laser_")]
    by_point = found.covariance[:, points]
    return np.asarray(by_point @ problem.prior[np.ix_(points, points)] @ by_point.T)


def tool_covariance(covariance: Array, axis: Array, R_flange_tool: Array) -> Array:
    """(5, 5) of the tip and of the tilts along the tool's x and y."""
    turn = np.eye(5)
    turn[3:, 3:] = R_flange_tool[:, :2].T @ across(axis)
    return np.asarray(turn @ covariance[:5, :5] @ turn.T)
