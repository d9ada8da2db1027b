"""The robots of whole shifts: scaled to what was published, and chosen by it alone."""

import numpy as np
import pytest

from bench.thermal import SEEDS
from robocal_ros.cell_sim import thermal_shift
from robocal_ros.cell_sim.thermal_shift import UNCORRECTED, drifting_cell, poses
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.screening import share_within


@pytest.mark.parametrize("seed", [3, 7])
def test_a_robot_counts_where_six_lengths_do_as_published(seed):
    robot = thermal_shift.true_robot(load_robot("kr150_r3100"), np.random.default_rng(seed))
    cell = drifting_cell(robot, poses("sphere"), poses("check"))
    assert cell.as_published == (seed in SEEDS)
    # Scaled at every sixth cycle of 90: the others may differ by a cycle's share on either side.
    for plan in cell.plans:
        assert share_within(cell.truth(plan)) == pytest.approx(UNCORRECTED, abs=2.0 / 90.0)
