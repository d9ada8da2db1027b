"""Where poses look for a sphere of unknown place."""

import numpy as np
import pytest
from hand_eye_sets import CELL, CENTRE, RADIUS_M
from scipy.optimize import minimize

from robocal_ros.cell_sim.hand_eye_cell import sphere_shots
from robocal_ros.hand_eye.planning import BEHIND, OFF_EQUATOR, SensorRange, looked_at

SENSOR = SensorRange(width_m=0.09)


def misfit(centre, T_base_sensor):
    """Of a centre (3,) with Cauchy's loss, one pose after the other."""
    off = OFF_EQUATOR * RADIUS_M
    allowed = [0.045, RADIUS_M - off, 0.01 + RADIUS_M]
    total = 0.0
    for T in T_base_sensor:
        s = T[:3, :3].T @ (centre - T[:3, 3])
        wanted = [0.0, np.copysign(off, s[1]), 0.2 + BEHIND * RADIUS_M]
        total += np.log1p(np.sum(((s - wanted) / allowed) ** 2))
    return total


@pytest.mark.parametrize("strays", [0, 3])
@pytest.mark.parametrize("seed", range(3))
def test_the_centre_is_the_most_likely_one(seed, strays):
    shots = sphere_shots(CELL, CENTRE, RADIUS_M, 12, np.random.default_rng(seed))
    T = shots.true_T_base_flange @ CELL.T_flange_sensor
    T[12 - strays :, :3, 3] += 0.3
    centres, misfits = looked_at(T, RADIUS_M, SENSOR)
    best = np.argmin(misfits)
    least = minimize(misfit, CENTRE, (T,), method="Nelder-Mead", options={"xatol": 1e-7})
    assert misfits[best] == pytest.approx(least.fun, rel=1e-6)
    assert np.linalg.norm(centres[best] - least.x) < 1e-5  # both ends stop at 1e-6 or finer


def test_poses_that_look_alike_leave_both_sides_possible():
    """Without a turn the sphere may be before the laser planes or behind them."""
    sides = looked_at(np.tile(np.eye(4), (3, 1, 1)), RADIUS_M, SENSOR)
    y = np.sort(sides[0][:, 1])
    assert np.allclose(np.abs(y), OFF_EQUATOR * RADIUS_M, atol=1e-6)
    assert y[0] < 0.0 < y[-1]
    assert np.allclose(sides[1], 0.0, atol=1e-6)
