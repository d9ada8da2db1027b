"""Ready-made cells: the source's P-R-P arm, a six-axis arm, and shots of a sphere by the former."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.laser_tracker import FEWEST_LIT, Sizes, TrackerCell, true_flange
from robocal_ros.cell_sim.profile_targets import Ball, Scene
from robocal_ros.ground import frames
from robocal_ros.hand_eye.shots import Profile, profile_of
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.inverse import inverse

Array = NDArray[np.float64]

PRP_SENSOR = frames.transform(  # about as the source found it
    frames.exp_rotation(np.radians(89.87) * np.array([1.0, 0.0018, 0.0002])),
    [0.0571, 0.4474, 0.0493],
)
PRP_HEIGHT_M = 0.05643  # h0 + h1 of the source
PRP_STILL = np.array([0.2, 0.3, 0.05])


def prp_cell(arm: SerialArm, sizes: Sizes | None = None) -> TrackerCell:
    """The source's cell: a P-R-P arm, the sensor 90 deg about x, the reflector 56.43 mm high."""
    told = sizes or Sizes()
    told = replace(told, target=replace(told.target, height_m=PRP_HEIGHT_M))
    return TrackerCell(
        arm=arm,
        T_flange_sensor=PRP_SENSOR,
        reflector=np.array([0.04, PRP_HEIGHT_M, 0.06]),
        arcs=(
            one_joint(PRP_STILL, 1, np.radians(np.linspace(-40.0, 80.0, 25))),
            one_joint(PRP_STILL, 2, np.linspace(0.0, 0.25, 16)),
        ),
        scan=one_joint(PRP_STILL, 2, np.linspace(0.05, 0.18, 66)),
        sizes=told,
    )


def six_axis_cell(arm: SerialArm, q: Array, sizes: Sizes | None = None) -> TrackerCell:
    """A six-axis arm around joint values (6,): arcs of joints 5 and 6, a straight scan."""
    R = frames.rotation_from_rpy([0.05, -0.08, 0.6])
    X = frames.transform(R, [0.03, -0.06, 0.09])
    start = arm.fk(q)
    slide = np.linspace(-0.065, 0.065, 66)[:, None] * (start[:3, :3] @ R[:, 1])
    poses = frames.transform(start[:3, :3], start[:3, 3] + slide)
    turn = np.radians(np.linspace(-50.0, 50.0, 21))
    return TrackerCell(
        arm=arm,
        T_flange_sensor=X,
        reflector=np.array([0.09, 0.05, 0.04]),
        arcs=(one_joint(q, 4, q[4] + turn), one_joint(q, 5, q[5] + turn)),
        scan=inverse(arm, poses, q),
        sizes=sizes or Sizes(),
    )


def one_joint(q: Array, joint: int, values: Array) -> Array:
    """Joint values (n, dof) in which one joint takes ``values`` (n,) and the others stand still."""
    found = np.tile(q, (len(values), 1))
    found[:, joint] = values
    return found


def prp_sphere_shots(
    arm: SerialArm, rng: np.random.Generator, count: int = 15
) -> tuple[Array, list[Profile]]:
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
    q: list[Array] = []
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
