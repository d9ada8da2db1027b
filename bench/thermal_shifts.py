# SPDX-License-Identifier: Apache-2.0
"""Simulated shifts as the estimators see them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from bench.measured_shifts import MEASURING as MEASURING
from bench.measured_shifts import DriftingCell, DriftRecord, drifting_cell, poses
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.robot import Effects
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import CellModel
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.reference import ColdSpots, capture_reference

Array = NDArray[np.float64]

SEEDS = (1, 2, 3, 8, 13, 25, 26, 30, 33, 41)  # the first ten whose drift is as published
SIGMA_M = float(np.hypot(2e-5, 2e-5))
PARTS = 5  # between two cycles


@cache
def cell_of(seed: int, effects: Effects) -> DriftingCell:
    """One robot in its cell, its drift as published."""
    robot = kr150.true_robot(load_robot("kr150_r3100"), np.random.default_rng(seed), effects)
    return drifting_cell(robot, poses("sphere"), poses("check"))


@dataclass(frozen=True, eq=False)
class Measured:
    """A shift as the estimators see it: cold spots and cycles of the six measuring poses."""

    spots: ColdSpots
    cycles: list[Measurements]
    time_s: Array

    @classmethod
    def of(cls, arm: SerialArm, shift: DriftRecord, own: Sequence[int]) -> "Measured":
        """Take some of the poses; all cold ones place base and sphere."""
        rounds, count, _ = shift.cold_q.shape
        cold = visits(shift.cold_q.reshape(-1, arm.n), shift.cold.reshape(-1, 3), "cold")
        cell: CellModel = capture_reference(arm, cold).cell
        rows = np.add.outer(count * np.arange(rounds), list(own)).ravel()
        cycles = [
            visits(q[list(own)], p[list(own)], f"{i}")
            for i, (q, p) in enumerate(zip(shift.q, shift.position, strict=True))
        ]
        return cls(ColdSpots.of(cell, cold.take(rows)), cycles, shift.time_s)


def visits(q: Array, position: Array, name: str) -> Measurements:
    return Measurements(
        q=q,
        position=position,
        target=("ball",) * len(q),
        sample=tuple(f"{name}/{i}" for i in range(len(q))),
        sigma=np.full(len(q), SIGMA_M),
    )
