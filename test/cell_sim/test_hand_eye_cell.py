# SPDX-License-Identifier: Apache-2.0
"""Simulated hand-eye sets: they show the target where it truly is, and report poses that err."""

from dataclasses import replace

import numpy as np
import pytest

from bench.hand_eye_cell import (
    ArmRobot,
    HandEyeCell,
    PoseRobot,
    SimulatedShots,
    TrueStairs,
    edge_shots,
    groove_shots,
    sphere_shots,
    step_shots,
    taught,
)
from robocal_ros.cell_sim.cell import rigid_robot
from robocal_ros.cell_sim.sensors import ProfileSensor
from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.kinematics.robots import load_robot

QUIET = ProfileSensor.exact()
CENTRE, RADIUS = np.array([0.75, -0.1, 0.15]), 0.02
T_BASE_USER = frames.transform(frames.exp_rotation([0.02, -0.03, 0.4]), [0.75, -0.1, 0.1])
STAIRS = TrueStairs(T_BASE_USER)


def rng() -> np.random.Generator:
    return np.random.default_rng(8)


def points(cell: HandEyeCell, shots: SimulatedShots, i: int) -> np.ndarray:
    """Points (n, 3) of a shot, base, by the true pose."""
    x, z = shots.profiles[i][np.isfinite(shots.profiles[i]).all(axis=1)].T
    p = np.array([x, 0 * x, z, np.ones_like(x)])
    return (shots.true_T_base_flange[i] @ cell.T_flange_sensor @ p)[:3].T


@pytest.mark.parametrize("sensor", [QUIET, replace(QUIET, near_m=0.15, far_m=0.35)])
@pytest.mark.parametrize("signs", [(-1, 1), (1,)])
def test_the_ball_is_cut_off_its_centre(sensor, signs):
    cell = HandEyeCell(sensor=sensor)
    shots = sphere_shots(cell, CENTRE, RADIUS, 20, rng(), signs)
    T_sensor_base = frames.invert(shots.true_T_base_flange @ cell.T_flange_sensor)
    y = (T_sensor_base @ [*CENTRE, 1.0])[:, 1] / RADIUS
    assert np.sign(y).tolist() == [signs[i % len(signs)] for i in range(20)]
    assert np.abs(y).min() >= 0.4 - 1e-9
    assert np.abs(y).max() <= 0.7 + 1e-9
    for i in range(20):
        distance = np.linalg.norm(points(cell, shots, i) - CENTRE, axis=1)
        ball = np.abs(distance - RADIUS) < 1e-9
        assert ball.sum() >= 50


def test_views_are_turned_as_far_as_asked():
    cell = HandEyeCell(sensor=QUIET, tilt_rad=0.2, roll_rad=0.1)
    shots = sphere_shots(cell, CENTRE, RADIUS, 60, rng())
    down = -(shots.true_T_base_flange @ cell.T_flange_sensor)[:, 2, 2]
    tilt = np.arccos(down)
    assert 0.15 < tilt.max() <= np.hypot(0.2, 0.2)


@pytest.mark.long
def test_reported_poses_scatter_as_told():
    """60 poses, 180 numbers: a standard deviation is known to 5.3 %."""
    cell = HandEyeCell(sensor=QUIET, robot=PoseRobot(1e-4, 1e-3))
    shots = sphere_shots(cell, CENTRE, RADIUS, 60, rng())
    off = shots.T_base_flange[:, :3, 3] - shots.true_T_base_flange[:, :3, 3]
    turned = frames.log_rotation(
        np.swapaxes(shots.true_T_base_flange[:, :3, :3], 1, 2) @ shots.T_base_flange[:, :3, :3]
    )
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1e-4, rel=0.2)
    assert np.sqrt(np.mean(turned**2)) == pytest.approx(1e-3, rel=0.2)
    assert shots.q is None


def edges_seen(cell: HandEyeCell, shots: SimulatedShots, i: int) -> np.ndarray:
    """Where (k, 3) the true edges of the stairs pierce a shot's laser plane, user frame."""
    T = frames.invert(T_BASE_USER) @ shots.true_T_base_flange[i] @ cell.T_flange_sensor
    k = np.arange(5)
    start = np.column_stack([0.0 * k, 0.01 * k, 0.01 * (k + 1)])
    normal, origin = T[:3, 1], T[:3, 3]
    x = (origin - start) @ normal / normal[0]
    return start + x[:, None] * [1.0, 0.0, 0.0]


@pytest.mark.parametrize("level", [False, True])
def test_the_light_lies_on_the_marks(level):
    cell = HandEyeCell(sensor=QUIET)
    shots = step_shots(cell, STAIRS, 10, rng(), aim_m=1e-4, level=level)
    assert list(shots.marks) == ["near", "far"] * 5
    for i, mark in enumerate(shots.marks):
        x = edges_seen(cell, shots, i)[:, 0] - {"near": 0.03, "far": 0.06}[mark]
        # aimed at with 0.1 mm, and turned by as much over half the stairs: five sigma, slanted
        assert np.abs(x).max() < 5 * 1e-4 * np.hypot(1.0, 1.0) / np.cos(cell.tilt_rad)
        user = (frames.invert(T_BASE_USER) @ np.insert(points(cell, shots, i), 3, 1.0, axis=1).T).T
        step = np.clip(np.floor(user[:, 1] / 0.01 + 1e-7), 0, 4)
        tread = np.abs(user[:, 2] - 0.01 * (step + 1)) < 1e-9
        riser = np.abs(user[:, 1] - 0.01 * np.round(user[:, 1] / 0.01)) < 1e-9
        assert (tread | riser).all()
        assert {0, 1, 2, 3, 4} <= set(step[tread].astype(int))
        # a profile that goes upstairs
        assert np.corrcoef(np.arange(len(user)), user[:, 1])[0, 1] > 0.99


@pytest.mark.parametrize("make", [edge_shots, groove_shots])
def test_the_line_is_in_every_profile(make):
    cell = HandEyeCell(sensor=QUIET)
    shots = make(cell, T_BASE_USER, 20, rng())
    near = []
    for i in range(20):
        p = points(cell, shots, i) - T_BASE_USER[:3, 3]
        along = T_BASE_USER[:3, 0]
        near.append(np.linalg.norm(p - np.outer(p @ along, along), axis=1).min())
    # columns are 0.1 mm apart; the camera may not look into the groove or around the edge
    assert np.mean(np.array(near) < 3e-4) >= 0.8


def test_a_robot_with_joints_reports_its_nominal_poses():
    arm = load_robot("ur10")
    true = replace(rigid_robot(arm, 3e-4, rng()), repeatability=0.0)
    q_near = np.radians([-30.0, -100.0, -110.0, -60.0, 90.0, 20.0])
    cell = HandEyeCell(sensor=QUIET, robot=ArmRobot(true, q_near), roll_rad=0.5)
    shots = sphere_shots(cell, CENTRE, RADIUS, 8, rng())
    assert shots.T_base_flange == pytest.approx(arm.fk(shots.q), abs=1e-12)
    off = np.linalg.norm((shots.T_base_flange - shots.true_T_base_flange)[:, :3, 3], axis=1)
    assert 1e-4 < off.mean() < 5e-3
    # the operator sees where the light is: the plane is off the ball's centre as wanted
    y = (frames.invert(shots.true_T_base_flange @ cell.T_flange_sensor) @ [*CENTRE, 1.0])[:, 1]
    assert np.abs(y).min() >= 0.4 * RADIUS - 2e-5
    assert np.abs(y).max() <= 0.7 * RADIUS + 2e-5
    with pytest.raises(LimitError, match="in reach"):
        sphere_shots(cell, [5.0, 0.0, 0.0], RADIUS, 2, rng())


def test_a_taught_frame_errs_as_told():
    draw = rng()
    T = np.array([taught(T_BASE_USER, 1e-4, 1e-3, draw) for _ in range(300)])
    off = np.sqrt(np.mean((T[:, :3, 3] - T_BASE_USER[:3, 3]) ** 2))
    turned = frames.log_rotation(T_BASE_USER[:3, :3].T @ T[:, :3, :3])
    assert off == pytest.approx(1e-4, rel=0.12)  # 900 numbers: 2.4 % of one sigma
    assert np.sqrt(np.mean(turned**2)) == pytest.approx(1e-3, rel=0.12)
