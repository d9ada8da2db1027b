# SPDX-License-Identifier: Apache-2.0
"""Make tables of a simulated drift: ``.venv/bin/python docs/examples/make_thermal.py out/thermal``.

Simulated, nothing was measured: a KR 150 in two shifts of 90 cycles, the true robot of
docs/simulation.md. Its sphere is measured in twenty poses, three times cold, then in every cycle.

- ``sensor.csv``: one cold visit, to place the sensor;
- ``cold.csv``, ``warm.csv``, ``check.csv``: the second shift; six poses measure in three of its
  cycles, the other fourteen judge;
- ``cold_before.csv``, ``warm_before.csv``, ``check_before.csv``: the shift before, all cycles.
"""

import csv
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # for the bench

from bench.measured_shifts import MEASURING, DriftRecord, drifting_cell, poses, record
from robocal_ros.cell_sim.kr150 import true_robot
from robocal_ros.kinematics.robots import load_robot

ROBOT, SEED = "kr150_r3100", 1
SHOWN = (5, 30, 89)
HEADER = ["pose", "cycle", "sample", *(f"q{i}_deg" for i in range(1, 7)), "x_mm", "y_mm", "z_mm"]

Array = NDArray[np.float64]


def write(path: Path, q: Array, position: Array, cycles: Iterable[int], own: Iterable[int]) -> None:
    """Write the visits of some poses in some cycles of (t, s, n) readings and positions."""
    own = list(own)
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(HEADER)
        for cycle in cycles:
            for pose in own:
                degrees = [f"{x:.6f}" for x in np.degrees(q[cycle, pose])]
                mm = [f"{x:.4f}" for x in position[cycle, pose] * 1e3]
                writer.writerow([f"p{pose}", f"c{cycle}", f"c{cycle}/p{pose}", *degrees, *mm])


def write_shift(folder: Path, shift: DriftRecord, cycles: Iterable[int], suffix: str = "") -> None:
    """Write the cold visit, the measuring poses and the others."""
    cycles, count = list(cycles), shift.q.shape[1]
    rounds, others = range(len(shift.cold)), [i for i in range(count) if i not in MEASURING]
    write(folder / f"cold{suffix}.csv", shift.cold_q, shift.cold, rounds, range(count))
    write(folder / f"warm{suffix}.csv", shift.q, shift.position, cycles, MEASURING)
    write(folder / f"check{suffix}.csv", shift.q, shift.position, cycles, others)


def main(folder: Path) -> None:
    """Simulate and write."""
    folder.mkdir(parents=True, exist_ok=True)
    shifts = np.random.default_rng([SEED, 1]).spawn(2)
    robot = true_robot(load_robot(ROBOT), np.random.default_rng(SEED))
    cell = drifting_cell(robot, poses("sphere"), poses("check"))
    before, after = (record(cell, plan, rng) for plan, rng in zip(cell.plans, shifts, strict=False))
    write(folder / "sensor.csv", before.cold_q, before.cold, [0], range(before.q.shape[1]))
    write_shift(folder, before, range(len(before.q)), "_before")
    write_shift(folder, after, SHOWN)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
