# SPDX-License-Identifier: Apache-2.0
"""A prior and a process learned from a robot's own shifts: what was put in is found again."""

from dataclasses import replace

import numpy as np
import pytest
from drift_cell import SIGMA, cell_of, drifted, postures, visit

from robocal_ros.cell_sim import kr150
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.accuracy import (
    EarlierShift,
    learn_drift,
    learn_gains,
    learn_process,
    visit_noise,
)
from robocal_ros.thermal.identification import drift_prior, identify_cycle
from robocal_ros.thermal.reference import ColdSpots
from robocal_ros.thermal.tracking import DriftProcess


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
    learned = learn_drift(taught, sigma_m=SIGMA)
    gain = []
    for drift, spots, (warm,) in (cycle() for _ in range(160)):
        by_default, by_learned = (
            rows @ (identify_cycle(spots, warm, prior_covariance=p, sigma_m=SIGMA).drift - drift)
            for p in (default, learned)
        )
        gain.append(np.mean(by_default**2) - np.mean(by_learned**2))
    assert np.mean(gain) > 3.0 * np.std(gain, ddof=1) / np.sqrt(len(gain))


PERIOD_S, CYCLES = 300.0, 40


def gains_of(arm: SerialArm, rng: np.random.Generator) -> np.ndarray:
    """Change (k,) of each parameter per kelvin of its joint."""
    return 0.05 * np.sqrt(np.diag(drift_prior(arm))) * rng.standard_normal(len(arm.parameters))


def shift_of(
    arm: SerialArm, gains: np.ndarray, rng: np.random.Generator, outliers: float = 0.0
) -> EarlierShift:
    """Joints that warm up by their own duty, parameters that follow them at once."""
    cell, q = cell_of(arm), postures(8)
    rise = 20.0 * rng.uniform(0.2, 1.0, arm.n)
    time_s = PERIOD_S * np.arange(1, CYCLES + 1)
    motor = rise * (1.0 - np.exp(-time_s[:, None] / 2400.0))
    joint = [index for index, _ in arm.parameters.index]
    cycles = []
    for row in motor:
        warm = visit(drifted(cell, gains * row[joint]), q, rng)
        wrong = rng.random(len(q)) < outliers
        warm.position[wrong] += 1e-3 * rng.standard_normal((int(wrong.sum()), 3))
        cycles.append(warm)
    return EarlierShift(ColdSpots.of(cell, visit(cell, q, rng)), cycles, time_s, motor)


@pytest.mark.parametrize("outliers", [0.0, 0.02])
def test_the_noise_of_a_visit_is_found_whatever_drifts(arm, outliers):
    rng = np.random.default_rng(1)
    shifts = [shift_of(arm, gains_of(arm, rng), rng, outliers) for _ in range(2)]
    # 2 x 38 x 8 x 3 second differences, correlated over three: a standard error of about 2.5 %;
    # of outliers some are small enough to stay
    assert visit_noise(shifts) == pytest.approx(SIGMA, rel=0.1)


def test_what_is_learned_tracks_a_further_shift(arm):
    """With the learned process closer than with the default one; with temperatures closer yet."""
    default, sums = DriftProcess(drift_prior(arm)), np.zeros(3)
    inside = []
    rows = arm.parameter_jacobian(postures(20, 9), np.array([0.0, 0.0, 0.3]))[:, :3]
    for seed in range(3):
        rng = np.random.default_rng([2, seed])
        gains = gains_of(arm, rng)
        shifts = [shift_of(arm, gains, rng) for _ in range(2)]
        learned, warm = learn_process(shifts), learn_gains(shifts)
        assert warm.gains is not None
        shift = shift_of(arm, gains, rng)
        joint = [index for index, _ in arm.parameters.index]
        trackers = [
            one.tracker(shift.spots) for one in (replace(learned, process=default), learned, warm)
        ]
        for cycle, motor, at_s in zip(shift.cycles, shift.temperature, shift.time_s, strict=True):
            trackers[2].read_temperatures(motor, at_s)
            for i, tracker in enumerate(trackers):
                tracker.take(cycle, at_s)
                mean, covariance = tracker.drift(at_s)
                miss = rows @ (mean - gains * motor[joint])
                sums[i] += np.sum(miss**2)
                spread = np.sqrt(np.einsum("cik,kl,cil->ci", rows, covariance, rows))
                if i == 2:
                    inside.append(np.mean(np.abs(miss) <= 1.96 * spread))
    assert sums[2] < sums[1] < sums[0]
    assert np.mean(inside) > 0.8  # three robots: their errors hang together


def test_a_cycle_without_the_poses_that_judge_teaches_by_its_own(arm):
    """Every second of fourteen poses judges a shift; a cycle cut short may have none of them."""
    cell, q, rng = cell_of(arm), postures(14), np.random.default_rng(5)
    cycles = [visit(cell, part, rng) for part in (q[1:7:2], *[q] * 10)]
    time_s = PERIOD_S * np.arange(1.0, len(cycles) + 1)
    shift = EarlierShift(ColdSpots.of(cell, visit(cell, q, rng)), cycles, time_s)
    assert learn_process([shift]).sigma_m == pytest.approx(SIGMA, rel=0.25)


def test_what_cannot_teach_is_refused(arm):
    rng = np.random.default_rng(3)
    shift = shift_of(arm, gains_of(arm, rng), rng)
    short = replace(shift, cycles=shift.cycles[:5], time_s=shift.time_s[:5])
    with pytest.raises(TooFewSamplesError, match="no shift has 10 cycles"):
        learn_process([short])
    with pytest.raises(InputError, match="teaches no gains"):
        learn_gains([shift, replace(shift, temperature=None)])
