# SPDX-License-Identifier: Apache-2.0
"""What of one wrong shot is left to see once the unknowns have taken up what they can.

Baarda 1968, "A testing procedure for use in geodetic networks": a test of one in a thousand finds
an error with a chance of 80 % where what is left of it is 4.13 times the noise.
"""

from dataclasses import replace

import numpy as np
from hand_eye_sets import CELL, CENTRE, RADIUS_M, T_BASE_USER, data_of, line_task, sphere_task

from bench.hand_eye_cell import edge_shots, sphere_shots
from robocal_ros.hand_eye.mount_fit import fit_mount
from robocal_ros.hand_eye.mount_problem import MountProblem, TargetView
from robocal_ros.hand_eye.solve import features, looked

FOUND = 4.13  # times the noise
SHIFT_M, STEP_M = 2e-3, 1e-5
SHOTS = 12


def left_to_see(task, data) -> np.ndarray:
    """(m, 3) of a shift of each shot's pose along each axis of the base, over the noise."""
    read = features(task, data)
    near, _ = looked(task, data, read)
    fit = fit_mount((read.view,), near)
    (view,) = fit.views
    problem = MountProblem(fit.views, fit.noise, fit.state)
    residual, J = problem.linearise(fit.state)
    J = J.reshape(-1, J.shape[2])
    taken_up = J @ np.linalg.pinv(J.T @ J + problem.prior()) @ J.T
    found = np.zeros((len(fit.names), 3))
    for shot, axis in np.ndindex(found.shape):
        T = view.sightings.T_base_flange.copy()
        T[shot, axis, 3] += STEP_M
        moved = TargetView(view.model, replace(view.sightings, T_base_flange=T))
        away, _ = MountProblem((moved,), fit.noise, fit.state).linearise(fit.state)
        column = (away - residual).ravel() * (SHIFT_M / STEP_M)
        found[shot, axis] = np.sqrt(column @ column - column @ taken_up @ column)
    return found


def test_a_sphere_shows_each_and_an_unknown_edge_does_not():
    """A fixed centre is seen from every pose; an unknown edge slides along itself."""
    rng = np.random.default_rng(5)
    ball = left_to_see(sphere_task(), data_of(sphere_shots(CELL, CENTRE, RADIUS_M, SHOTS, rng)))
    edge = left_to_see(line_task(), data_of(edge_shots(CELL, T_BASE_USER, SHOTS, rng)))
    assert ball.min() > 2.0 * FOUND
    assert edge.min() < FOUND < np.median(edge)
