# SPDX-License-Identifier: Apache-2.0
"""The simulated line laser: its points lie on what it looks at; what it cannot see is missing."""

from dataclasses import replace

import numpy as np
import pytest

from bench.hand_eye_cell import view
from robocal_ros.cell_sim.sensors import (
    ProfileSensor,
    Scene,
    ball_on_table,
    block,
    grooved_block,
    stairs,
    table,
)
from robocal_ros.ground import frames

DOWN = np.diag([1.0, -1.0, -1.0])
QUIET = ProfileSensor.exact()
WIDE = replace(QUIET, near_m=0.15, far_m=0.35)
RADIUS, CENTRE = 0.02, np.array([0.8, 0.1, 0.3])


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def looking(turns_deg, p_base, p_sensor) -> np.ndarray:
    return view(DOWN, np.radians(turns_deg), p_base, p_sensor)


def in_base(T: np.ndarray, profile: np.ndarray) -> np.ndarray:
    """Points (n, 3) of a profile without its gaps."""
    x, z = profile[np.isfinite(profile).all(axis=1)].T
    return (T @ np.array([x, 0 * x, z, np.ones_like(x)]))[:3].T


@pytest.mark.parametrize("y", [-0.013, 0.0, 0.009])
def test_points_lie_on_the_ball(y):
    T = looking([10, -20, 50], CENTRE, [0.004, y, 0.195 + np.sqrt(RADIUS**2 - y**2)])
    points = in_base(T, QUIET.shoot(T, ball_on_table(CENTRE, RADIUS), rng()))
    assert len(points) > 100
    assert np.linalg.norm(points - CENTRE, axis=1) == pytest.approx(RADIUS, abs=1e-12)


def test_noise_is_that_of_the_sensor():
    """Along z, on a level plate; of 1000 columns a standard deviation is known to 2 %."""
    sensor = ProfileSensor.exact(columns=1000, noise_m=3.7e-5)
    T = looking([0, 0, 30], [0.5, 0, 0], [0, 0, 0.2])
    z = sensor.shoot(T, Scene((table([0.5, 0, 0]),)), rng())[:, 1] - 0.2
    assert z.std() == pytest.approx(3.7e-5, rel=0.1)
    assert abs(z.mean()) < 4 * 3.7e-5 / np.sqrt(1000)


def test_the_columns_fill_the_fan():
    T = looking([0, 0, 0], [0.5, 0, 0], [0, 0, 0.2])
    x = QUIET.shoot(T, Scene((table([0.5, 0, 0]),)), rng())[:, 0]
    assert len(x) == 1280
    assert x[[0, -1]] == pytest.approx(0.2 * np.tan(QUIET.half_angle_rad) * np.array([-1, 1]))
    assert np.diff(x) == pytest.approx(np.full(1279, np.ptp(x) / 1279))


def test_nothing_outside_of_the_range_returns():
    T = looking([0, 0, 0], CENTRE, [0, 0.008, 0.215])
    near = QUIET.shoot(T, ball_on_table(CENTRE, RADIUS), rng())
    wide = WIDE.shoot(T, ball_on_table(CENTRE, RADIUS), rng())
    assert np.nanmax(near[:, 1]) <= 0.21
    assert np.nanmax(wide[:, 1]) == pytest.approx(0.215 + 0.08, abs=1e-9)  # the table
    nothing = QUIET.shoot(looking([0, 0, 0], CENTRE, [0, 0, 0.5]), Scene(()), rng())
    assert np.isnan(nothing).all()


def test_the_ball_hides_the_table_beneath_it():
    """From above, light that misses the ball meets the table beyond the ball's shadow."""
    T = looking([0, 0, 0], CENTRE, [0, 0, 0.22])
    profile = WIDE.shoot(T, ball_on_table(CENTRE, RADIUS), rng())
    on_table = profile[:, 1] > 0.29
    # the ray that just touches the ball: sine = R / distance
    slope = np.tan(np.arcsin(RADIUS / 0.22))
    assert np.abs(profile[on_table, 0]).min() == pytest.approx(0.30 * slope, abs=3e-4)


STEPS, RISE = 4, 0.01


def steps_at(turn_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Stairs from above, the sensor turned about their edges: points in base, sensor pose."""
    T = np.eye(4)
    amid = np.array([0.03, 0.02, 0.02])
    look = np.column_stack([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    pose = view(look, np.radians([0, turn_deg, 0]), amid, [0, 0, 0.25])
    scene = Scene((stairs(T, STEPS, 0.09, RISE, RISE),))
    return in_base(pose, WIDE.shoot(pose, scene, rng())), pose


def on_tread(points: np.ndarray) -> np.ndarray:
    step = np.floor(points[:, 1] / RISE)
    return np.abs(points[:, 2] - RISE * (step + 1)) < 1e-9


def on_riser(points: np.ndarray) -> np.ndarray:
    off = points[:, 1] - RISE * np.round(points[:, 1] / RISE)
    return np.abs(off) < 1e-9


def test_a_view_from_above_shows_treads_and_hides_risers():
    points, pose = steps_at(0.0)
    steep = pose[2, 3] - points[:, 2] > 5 * np.abs(points[:, 1] - pose[1, 3])
    assert on_tread(points[steep]).all()
    assert len(points) > 300


def test_a_slanted_view_shows_both():
    points, _ = steps_at(40.0)
    tread, riser = on_tread(points), on_riser(points)
    assert (tread | riser).all()
    assert tread.sum() > 50
    assert riser.sum() > 50
    for step in range(STEPS):
        assert np.any(tread & (np.floor(points[:, 1] / RISE) == step))


def test_a_view_from_behind_shows_no_riser():
    points, _ = steps_at(-40.0)
    assert not (on_riser(points) & (points[:, 1] < STEPS * RISE - 1e-6)).any()


def test_what_the_camera_cannot_see_is_missing():
    """A wall between camera and spot: light falls on the table, the camera looks at the wall."""
    T = looking([0, 0, 0], [0.5, 0, 0], [0, 0, 0.2])  # sensor y points to base -y
    scene = table([0.5, 0, 0])
    frame = frames.transform(np.eye(3), [0.45, -0.02, 0.05])
    wall = block(frame, 0.1, 0.005, 0.05)
    free = QUIET.shoot(T, Scene((scene,)), rng())
    hidden = QUIET.shoot(T, Scene((scene, wall)), rng())
    behind = QUIET.shoot(
        looking([0, 0, 180], [0.5, 0, 0], [0, 0, 0.2]), Scene((scene, wall)), rng()
    )
    assert np.isfinite(free).all()
    assert np.isfinite(behind).all()  # the camera now is on the other side
    # the ray from the spot to the camera climbs by 0.2 in 0.09: at y = -0.02 it is at 0.044
    assert np.isnan(hidden).all()


def test_a_flat_surface_fades():
    flat = np.degrees(QUIET.flattest_rad)
    for turn, seen in ((flat - 5.0, True), (flat + 5.0, False)):
        one = replace(QUIET, columns=3, half_angle_rad=1e-4)
        T = looking([0, turn, 0], [0.5, 0, 0], [0, 0, 0.2])
        assert np.isfinite(one.shoot(T, Scene((table([0.5, 0, 0]),)), rng())).any() == seen


def test_a_groove_has_its_depth():
    body = grooved_block(np.eye(4), 0.2, 0.05, 0.012, 0.005)
    look = np.column_stack([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    T = view(look, np.zeros(3), [0.1, 0, 0], [0, 0, 0.2])
    profile = QUIET.shoot(T, Scene((body,)), rng())
    assert np.nanmin(profile[:, 1]) == pytest.approx(0.195, abs=1e-12)
    assert np.nanmax(profile[:, 1]) == pytest.approx(0.2, abs=1e-4)
    inner = np.abs(profile[:, 0]) < 0.005
    z = 0.2 - np.abs(profile[inner, 0]) * 0.005 / 0.006
    assert profile[inner, 1] == pytest.approx(z, abs=1e-12)


def test_disturbances_are_as_frequent_as_asked():
    sensor = replace(QUIET, columns=20_000, spikes=0.05, dropouts=0.1, quantum_m=1e-5)
    T = looking([0, 0, 0], [0.5, 0, 0], [0, 0, 0.2])
    z = sensor.shoot(T, Scene((table([0.5, 0, 0]),)), rng())[:, 1]
    lost = np.isnan(z)
    assert lost.mean() == pytest.approx(0.1, abs=5 * np.sqrt(0.09 / 20_000))
    off = np.abs(z[~lost] - 0.2)
    assert np.mean(off > 1e-9) == pytest.approx(0.05, abs=5 * np.sqrt(0.0475 / 18_000) + 5e-4)
    assert off.max() <= sensor.spike_m + 0.5 * sensor.quantum_m  # spikes are rounded too
    assert z[~lost] / 1e-5 == pytest.approx(np.round(z[~lost] / 1e-5), abs=1e-6)


def test_gaps_are_runs_of_columns():
    sensor = replace(QUIET, gaps=2, gap_columns=40)
    T = looking([0, 0, 0], [0.5, 0, 0], [0, 0, 0.2])
    lost = np.isnan(sensor.shoot(T, Scene((table([0.5, 0, 0]),)), rng())[:, 1])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.view(np.int8), [0]])))
    runs = edges[1::2] - edges[::2]
    assert 1 <= len(runs) <= 2
    assert 40 <= runs.sum() <= 80


def test_a_mirrored_spot_is_seen_where_the_camera_believes_it():
    """Light on a table is mirrored to a wall, all within the laser plane: the ghosts are true."""
    slope = frames.transform(frames.exp_rotation([0, 0, np.pi / 2]), [0.55, -0.2, 0.0])
    wedge = stairs(slope, 1, 0.4, 0.04, 0.04)  # a cube: its front face is the wall
    T = looking([0, -45, 0], [0.57, 0, 0], [0, 0, 0.25])
    scene = Scene((table([0.5, 0, 0]), wedge))
    mirror = replace(WIDE, ghosts=1.0)
    direct, ghost = WIDE.shoot(T, scene, rng()), mirror.shoot(T, scene, rng())
    other = np.isfinite(ghost).all(axis=1) & ~(np.abs(ghost - direct) < 1e-9).all(axis=1)
    assert other.sum() > 20
    p = in_base(T, ghost[other])
    on_table, on_wall = np.abs(p[:, 2]) < 1e-9, np.abs(p[:, 0] - 0.55) < 1e-9
    assert (on_table | on_wall).all()


ROOF = block(np.eye(4), 0.2, 0.1, 0.1)
ON_ROOF = view(
    np.column_stack([[0.0, 1.0, 1.0], [np.sqrt(2.0), 0.0, 0.0], [0.0, 1.0, -1.0]]) / np.sqrt(2.0),
    np.zeros(3), [0.1, 0.0, 0.0], [0.0, 0.0, 0.2],
)  # fmt: skip


def above_the_roof(sensor: ProfileSensor) -> np.ndarray:
    """Places (n, 2) of a roof of 90 deg: x, and how far outside of it."""
    x, z = sensor.shoot(ON_ROOF, Scene((ROOF,)), rng()).T
    return np.column_stack([x, 0.2 + np.abs(x) - z])


def test_a_top_is_rounded_over_the_spot_and_nothing_else():
    """There the mean of |x| over the spot is told; beyond it what is."""
    x, outside = above_the_roof(ProfileSensor.exact(spot_m=1e-3)).T
    top, half = np.nanargmin(np.abs(x)), 6  # columns: half of the spot at 0.21 m
    mean = np.abs(x[top - half : top + half + 1]).mean()
    assert outside[top] == pytest.approx(np.abs(x[top]) - mean, rel=0.05)  # x is a mean, too
    assert mean > 2e-4
    assert np.nanmax(np.abs(outside[np.abs(x) > 0.6e-3])) < 1e-12


def test_horns_stand_beside_a_top():
    x, outside = above_the_roof(ProfileSensor.exact(spot_m=1e-3, horns=1.0)).T
    beside = (np.abs(x) > 0.4e-3) & (np.abs(x) < 1e-3)
    assert np.nanmax(outside[beside]) > 5e-5
    assert np.nanmax(np.abs(outside[np.abs(x) > 1.1e-3])) < 1e-12


def test_heights_are_of_a_frame_in_the_middle_of_the_range():
    sensor = ProfileSensor.exact(towards=True)
    T = looking([10, -20, 50], CENTRE, [0.004, 0.009, 0.195 + np.sqrt(RADIUS**2 - 0.009**2)])
    points = in_base(
        T @ sensor.T_light_sensor, sensor.shoot(T, ball_on_table(CENTRE, RADIUS), rng())
    )
    assert np.linalg.norm(points - CENTRE, axis=1) == pytest.approx(RADIUS, abs=1e-12)


def test_by_default_it_errs_as_real_ones_do():
    """A level plate: bent by 20 to 50 um, lost and speckled points, wrong ones at its ends."""
    T = looking([0, 0, 0], [0.5, 0, 0], [0, 0, 0.205])
    x, z = ProfileSensor().shoot(T, Scene((table([0.5, 0, 0]),)), rng()).T
    lost = np.isnan(z)
    assert lost.mean() == pytest.approx(0.02, abs=5 * np.sqrt(0.02 / 1280))
    off = z[~lost] + 0.005
    near = np.abs(off) < 2e-4
    assert 1280 * 0.02 > np.sum(~near) > 0
    bend = np.polyfit(x[~lost][near], off[near], 2)
    field = np.polyval(bend, x[~lost][near])
    assert 2e-5 < np.ptp(field) < 5e-5
    scatter = (off[near] - field).std()
    assert scatter == pytest.approx(ProfileSensor().noise_m, rel=0.15)
