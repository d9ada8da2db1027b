"""What a tracker needs, as a plain document, bit for bit."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from robocal_ros.thermal.heat import HeatGains
from robocal_ros.thermal.process import DriftProcess
from robocal_ros.thermal.process_learning import LearnedProcess


def process_document(learned: LearnedProcess) -> dict[str, Any]:
    """A learned (or default) process; SI."""
    process, gains = learned.process, learned.gains
    return {
        "covariance": process.covariance.tolist(),
        "approach_s": process.approach_s,
        "steady_s": process.steady_s,
        "sigma_m": learned.sigma_m,
        "gains": None
        if gains is None
        else {
            "mean": gains.mean.tolist(),
            "covariance": gains.covariance.tolist(),
            "lag_s": gains.lag_s,
        },
    }


def process_of(document: Mapping[str, Any]) -> LearnedProcess:
    """Read it back."""
    gains = document["gains"]
    return LearnedProcess(
        DriftProcess(
            np.array(document["covariance"]),
            approach_s=float(document["approach_s"]),
            steady_s=float(document["steady_s"]),
        ),
        float(document["sigma_m"]),
        None
        if gains is None
        else HeatGains(
            np.array(gains["mean"]), np.array(gains["covariance"]), float(gains["lag_s"])
        ),
    )
