# SPDX-License-Identifier: Apache-2.0
"""What a point of a measuring robot is worth: told from the cold visit, judged at other poses."""

import numpy as np
import pytest
from shift import NOISE_M, MeasuringShift, built, looking

from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.flange_sensor import capture_on_flange

NOMINAL = load_robot("kr150_r3100")
ROBOTS, UNSEEN = 12, 30


def seen(arm, q, seed) -> Measurements:
    shift, rng = MeasuringShift(NOMINAL.joint_names), np.random.default_rng(seed)
    rows = [
        (joints, name, point + NOISE_M * rng.normal(size=3))
        for joints in q
        for name, point in shift.seen(arm, joints, "").items()
    ]
    joints, names, points = zip(*rows, strict=True)
    samples = tuple(f"s{i}" for i in range(len(rows)))
    return Measurements(np.array(joints), np.array(points), target=names, sample=samples)


@pytest.mark.parametrize("poses", [8, 20])
def test_static_errors_at_unseen_poses_are_as_told(poses):
    """Over robots that err otherwise: their rms error is within a quarter of what is told."""
    off, told = [], []
    for seed in range(ROBOTS):
        arm = built(NOMINAL, seed)
        reference = capture_on_flange(NOMINAL, seen(arm, looking(poses, seed + 3), seed), "f")
        spheres = reference.spheres
        fresh = seen(arm, looking(UNSEEN, 100 + seed), seed + 50)
        centres = dict(zip(spheres.sphere, spheres.centre, strict=True))
        places = frames.apply(NOMINAL.fk(fresh.q) @ spheres.T_flange_sensor, fresh.position)
        miss = places - np.array([centres[name] for name in fresh.target])
        off.append(np.mean(np.sum(miss**2, axis=1)))
        told.append(reference.static_error_m**2)
    assert 0.8 < np.sqrt(np.mean(off) / np.mean(told)) < 1.25
