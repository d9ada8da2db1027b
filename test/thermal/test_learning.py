"""A prior learned from a robot's own cycles, against the truth."""

import numpy as np
from drift_cell import SIGMA, cell_of, drifted, postures, visit

from robocal_ros.cell_sim import kr150
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.accuracy import learn_drift
from robocal_ros.thermal.identification import drift_prior, identify_cycle
from robocal_ros.thermal.reference import ColdSpots


def test_a_learned_prior_does_better_than_the_default():
    """A robot drifts along a pattern of its own; 40 cycles teach, 160 others judge at unseen poses.

    One-sided: without any true gain a mean beyond three standard errors has a chance of 1e-3.
    """
    arm, rng = load_robot("kr150_r3100"), np.random.default_rng(0)
    cell, q, default = cell_of(arm), postures(6), drift_prior(arm)
    rows = arm.parameter_jacobian(postures(30, 9), kr150.BALL)[:, :3]
    pattern = np.sqrt(np.diag(default)) * rng.standard_normal(len(default))

    def cycle() -> tuple[np.ndarray, ColdSpots, list]:
        drift = rng.standard_normal() * pattern
        spots = ColdSpots.of(cell, visit(cell, q, rng))
        return drift, spots, [visit(drifted(cell, drift), q, rng)]

    taught = [cycle()[1:] for _ in range(40)]
    learned = learn_drift(taught, sigma_m=SIGMA).covariance
    gain = []
    for drift, spots, (warm,) in (cycle() for _ in range(160)):
        by_default, by_learned = (
            rows @ (identify_cycle(spots, warm, prior_covariance=p, sigma_m=SIGMA).drift - drift)
            for p in (default, learned)
        )
        gain.append(np.mean(by_default**2) - np.mean(by_learned**2))
    assert np.mean(gain) > 3.0 * np.std(gain, ddof=1) / np.sqrt(len(gain))
