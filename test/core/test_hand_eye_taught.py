"""What the taught frame of stairs owes to the poses."""

import numpy as np
import pytest
from hand_eye_sets import CELL, STAIRS, T_BASE_USER, data_of, stairs_target

from robocal_ros.core import frames
from robocal_ros.core.hand_eye.quality import HandEyeSettings
from robocal_ros.core.hand_eye.solve import solve_step
from robocal_ros.sim.hand_eye_sets import step_shots

SHIFT_M = 2e-3


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_badly_taught_origin_shows_in_tilted_shots(axis):
    """Along the edges too: tilts about the laser line tell it from a shift of the sensor."""
    shots = step_shots(CELL, STAIRS, 12, np.random.default_rng(3))
    taught = T_BASE_USER @ frames.transform(np.eye(3), SHIFT_M * np.eye(3)[axis])
    target = stairs_target(taught, user_sigma_m=SHIFT_M, user_sigma_rad=1e-4)
    found = solve_step(data_of(shots), target, "best", HandEyeSettings())
    assert found.place is not None
    off_m = np.abs((found.place - T_BASE_USER)[:3, 3])
    assert np.all(off_m < 0.4 * SHIFT_M)  # what is left is the robot, not the teaching
