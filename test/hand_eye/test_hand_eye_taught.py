"""What the taught frame of stairs owes to the poses."""

import numpy as np
import pytest
from hand_eye_sets import CELL, STAIRS, T_BASE_USER, data_of, stairs_target

from robocal_ros.cell_sim.hand_eye_cell import step_shots
from robocal_ros.ground import frames
from robocal_ros.hand_eye.mount_fit import fit_mount
from robocal_ros.hand_eye.solve import features, looked
from robocal_ros.hand_eye.staircase import StepTask

SHIFT_M = 2e-3


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_badly_taught_origin_shows_in_tilted_shots(axis):
    """Along the edges too: tilts about the laser line tell it from a shift of the sensor."""
    shots = step_shots(CELL, STAIRS, 12, np.random.default_rng(3))
    taught = T_BASE_USER @ frames.transform(np.eye(3), SHIFT_M * np.eye(3)[axis])
    target = stairs_target(taught, user_sigma_m=SHIFT_M, user_sigma_rad=1e-4)
    task, data = StepTask(target), data_of(shots)
    read = features(task, data)
    fit = fit_mount((read.view,), looked(task, data, read))
    off_m = (frames.invert(fit.state.places[0]) @ T_BASE_USER)[:3, 3]
    covariance = fit.covariance[6:9, 6:9]
    assert off_m @ np.linalg.solve(covariance, off_m) < 16.27  # chi-square of 3, once in 1000
    # At least 15 of 16 parts of what is then known of it are the poses', not the teacher's.
    assert np.sqrt(np.diag(covariance).max()) < SHIFT_M / 4.0
