# SPDX-License-Identifier: Apache-2.0
"""Poses that joints with backlash reach from the other side than when the robot was cold."""

from dataclasses import replace

import numpy as np
import pytest

from bench.measured_shifts import MEASURING, poses
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.robot import Effects, Warmth
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.proposing import other_sides
from robocal_ros.thermal.reference import (
    capture_reference,
    reference_document,
    reference_of,
    visit_variance,
)

CYCLE = poses("sphere")[list(MEASURING)]
SIGMA_M = float(np.hypot(2e-5, 2e-5))  # sensor and repeatability
EFFECTS = replace(Effects.modelled(), gears=True)
COLD = Warmth.cold(6)


class Cell:
    """A robot with gears, which stays cold."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        self.nominal = load_robot("kr150_r3100")
        self.robot = kr150.true_robot(self.nominal, self.rng, EFFECTS)
        self.sensor = kr150.sphere_sensor(EFFECTS)

    def visited(self, side):
        """A visit of the cycle's poses, which each joint reaches from a side (6, n)."""
        behind = self.robot.gears.behind(side)
        T = self.robot.flange(CYCLE, COLD, self.rng, behind)
        seen = np.array([self.sensor.measure(one, 0.0, 0.0, self.rng) for one in T])
        names = tuple(f"{self.rng.integers(2**60)}" for _ in CYCLE)
        return Measurements(CYCLE, seen, ("ball",) * len(CYCLE), names, side=side)


def joined(*rounds):
    names = tuple(f"{i}/{name}" for i, data in enumerate(rounds) for name in data.sample)
    q, position, side = (
        np.vstack([getattr(data, part) for data in rounds]) for part in ("q", "position", "side")
    )
    return Measurements(q, position, ("ball",) * len(q), names, side=side)


@pytest.fixture(scope="module")
def squares():
    """Squared displacements over their variances, with and without what is known of the sides."""
    found = []
    for seed in range(40):
        cell = Cell(seed)
        side = np.where(cell.rng.random(CYCLE.shape) < 0.5, -1.0, 1.0)
        reference = capture_reference(cell.nominal, joined(*[cell.visited(side) for _ in range(3)]))
        warm = cell.visited(np.where(cell.rng.random(CYCLE.shape) < 0.5, -side, side))
        for known in (warm, replace(warm, side=None), cell.visited(side)):
            spots = reference.spots
            data = spots.average(known, SIGMA_M)
            variance = visit_variance(spots, spots.match(data), data, SIGMA_M)
            found.append(np.mean(spots.drift(data) ** 2, axis=1) / variance)
    return np.array(found).reshape(40, 3, len(CYCLE))


def test_the_noise_of_a_comparison_holds_backlash(squares):
    """Half of the joints come from the other side; 40 robots, 720 numbers, few of them alike."""
    known, unknown, same = squares.mean(axis=(0, 2))
    assert 0.8 < known < 1.2
    assert unknown > 2.0  # of a robot as real ones are
    assert 0.85 < same < 1.15  # from the same side it cancels, nothing is added


def test_the_poses_and_joints_are_named():
    cell = Cell(1)
    side = np.ones(CYCLE.shape)
    reference = capture_reference(cell.nominal, joined(*[cell.visited(side) for _ in range(3)]))
    assert other_sides(reference.spots, cell.visited(side)) == ""
    turned = side.copy()
    turned[0, [1, 3]] = -1.0
    turned[4, 1] = 0.0  # not known
    words = other_sides(reference.spots, cell.visited(turned))
    assert "joint_a2, joint_a4 at pose 1, where" in words
    # Rounds of the cold robot that differ among themselves are named, too.
    mixed = joined(cell.visited(turned), cell.visited(side), cell.visited(side))
    assert "joint_a2, joint_a4 at pose 1, where" in other_sides(
        capture_reference(cell.nominal, mixed).spots, mixed
    )


def test_a_reference_keeps_the_sides():
    cell = Cell(2)
    reference = capture_reference(cell.nominal, cell.visited(np.ones(CYCLE.shape)))
    document = reference_document(reference)
    back = reference_of(document, cell.nominal)
    np.testing.assert_array_equal(back.spots.side, reference.spots.side)
    older = reference_of({k: v for k, v in document.items() if k != "side"}, cell.nominal)
    assert older.spots.side is None
    assert other_sides(older.spots, cell.visited(-np.ones(CYCLE.shape))) == ""
