# SPDX-License-Identifier: Apache-2.0
"""The simulated tracker cell: what it measures is what stands there, with the noise it is given."""

import numpy as np
import pytest

from bench.laser_tracker import (
    FEWEST_LIT,
    PRP_SENSOR,
    PRP_STILL,
    TrackerCell,
    prp_cell,
    six_axis_cell,
    true_flange,
)
from bench.measured_runs import Q_NEAR
from robocal_ros.cell_sim.sensors import Ball, Scene
from robocal_ros.ground import frames
from robocal_ros.hand_eye.profiles import Profile, profile_of
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot

pytestmark = pytest.mark.filterwarnings("ignore:.*joint limits not given")


def prp_sphere_shots(
    arm: SerialArm, rng: np.random.Generator, count: int = 15
) -> tuple[np.ndarray, list[Profile]]:
    """One sphere shot from ``count`` poses of the P-R-P arm, as the source's comparison does.

    Its axes of slide 1 and of joint 2 are parallel, so the flange never tilts: where the sensor
    sits along them cannot be seen.

    Returns
    -------
    T_base_flange : (count, 4, 4) by the noisy joint readings, m.
    profiles : of the sphere.
    """
    cell = prp_cell(arm)
    radius = cell.sizes.target.sphere_radius_m
    middle = true_flange(arm, PRP_STILL[None])[0] @ PRP_SENSOR
    scene = Scene((Ball((middle @ [0.0, 0.0, 0.2, 1.0])[:3], radius),))
    q: list[np.ndarray] = []
    profiles: list[Profile] = []
    while len(q) < count:
        joints = PRP_STILL + rng.uniform(-1.0, 1.0, 3) * [0.008, np.radians(6.0), 0.02]
        xz = cell.sensor.shoot(true_flange(arm, joints[None])[0] @ PRP_SENSOR, scene, rng)
        if np.sum(np.isfinite(xz[:, 0])) > FEWEST_LIT:
            q.append(joints)
            profiles.append(profile_of(xz, f"s{len(q):02d}"))
    noise = cell.sizes.noise
    sigma = np.where(arm.prismatic, noise.joint_m, noise.joint_rad)
    return arm.fk(np.array(q) + sigma * rng.standard_normal((count, 3))), profiles


@pytest.fixture(scope="module", params=["prp", "ur10"])
def cell(request) -> TrackerCell:
    if request.param == "prp":
        return prp_cell(load_robot("p1r2p3"))
    return six_axis_cell(load_robot("ur10"), Q_NEAR)


def test_the_true_robot_is_the_estimators_without_its_code(cell):
    q = cell.scan[::20]
    assert np.allclose(true_flange(cell.arm, q), cell.arm.fk(q), atol=1e-12)


def test_profiles_lie_on_the_cube_and_the_sphere(cell):
    """Every point is on one of three surfaces, and every surface has its share."""
    T = true_flange(cell.arm, cell.exact.q) @ cell.T_flange_sensor
    points = np.concatenate(
        [
            np.insert(p.points, 1, 0.0, axis=1) @ pose[:3, :3].T + pose[:3, 3]
            for p, pose in zip(cell.exact.profiles, T, strict=True)
        ]
    )
    local = (points - cell.T_base_cube[:3, 3]) @ cell.T_base_cube[:3, :3]
    ball = np.linalg.norm(points - cell.centre, axis=1) - cell.sizes.target.sphere_radius_m
    off = np.abs(np.column_stack([local[:, 2], local[:, 1], ball]))
    assert off.min(axis=1).max() < 1e-9
    assert np.all(np.bincount(off.argmin(axis=1), minlength=3) > 0.1 * len(points))


def test_the_reflector_touches_the_faces_and_rides_on_the_flange(cell):
    T = frames.invert(cell.T_tracker_base)
    radius = cell.sizes.target.reflector_radius_m
    for points, axis, sign in zip(cell.exact.faces, (2, 1), (1.0, -1.0), strict=True):
        base = points @ T[:3, :3].T + T[:3, 3]
        local = (base - cell.T_base_cube[:3, 3]) @ cell.T_base_cube[:3, :3]
        assert np.allclose(local[:, axis], sign * radius, atol=1e-12)
    for arc in cell.exact.arcs:
        base = arc.points @ T[:3, :3].T + T[:3, 3]
        flange = frames.invert(true_flange(cell.arm, arc.q))
        local = (flange[:, :3, :3] @ base[..., None])[..., 0] + flange[:, :3, 3]
        assert np.allclose(local, cell.reflector, atol=1e-12)


def test_noise_is_as_large_as_it_is_told(cell):
    """Each within 5 standard errors of a standard deviation."""
    exact = cell.exact
    rng = np.random.default_rng(1)
    runs = [cell.measure(rng) for _ in range(30)]
    noise = cell.sizes.noise
    tracker = np.array([run.arcs[0].points - exact.arcs[0].points for run in runs])
    z = np.concatenate([run.profiles[5].points - exact.profiles[5].points for run in runs])
    q = np.array([run.arcs[0].q - exact.arcs[0].q for run in runs])
    joint = int(np.argmax(np.ptp(exact.arcs[0].q, axis=0)))
    cases = [
        (tracker, noise.tracker_m),
        (z[:, 1], cell.sensor.noise_m),
        (q[..., joint], noise.joint_rad),
    ]
    for found, sigma in cases:
        assert abs(found.std() / sigma - 1.0) < 5.0 / np.sqrt(2.0 * found.size)
    assert not np.any(z[:, 0])
    assert not np.any(np.delete(q, joint, axis=-1))


def test_shots_of_a_sphere_by_an_arm_that_never_tilts():
    arm = load_robot("p1r2p3")
    T, profiles = prp_sphere_shots(arm, np.random.default_rng(2))
    assert len(T) == len(profiles) == 15
    up = T[:, :3, :3] @ [0.0, 1.0, 0.0]  # the flange's y is along the axis of joint 2
    assert np.allclose(up, [0.0, 0.0, 1.0], atol=1e-12)
