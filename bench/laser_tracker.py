# SPDX-License-Identifier: Apache-2.0
"""A simulated laser tracker, and a cell in which it measures a robot, a cube and a sphere.

The robot's truth is a product of elementary motions, and the sensor's a cast of rays, so that a
mistake in the estimator cannot hide.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.robot import turn
from robocal_ros.cell_sim.sensors import Ball, ProfileSensor, ScannedBody, Scene, block
from robocal_ros.ground import frames
from robocal_ros.hand_eye.profiles import profile_of
from robocal_ros.hand_eye.targets import TrackerTarget
from robocal_ros.hand_eye.tracker_data import Arc, TrackerData, TrackerNoise
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import inverse

Array = NDArray[np.float64]

T_TRACKER_BASE = frames.transform(
    frames.rotation_from_rpy([0.03, -0.05, 2.4]), [3.0, 1.7, -0.8]
)  # 3.5 m away, as in the source
CUBE_M = 0.08
FEWEST_LIT = 60  # points of a profile that is kept
GRID = np.linspace(-0.3, 0.3, 3) * CUBE_M  # where the reflector touches a face


def shift(axis: int, length: Array) -> Array:
    """Translations (m, 4, 4) along a coordinate axis, m."""
    T = np.tile(np.eye(4), (len(length), 1, 1))
    T[:, axis, 3] = length
    return T


def true_flange(arm: SerialArm, q: Array) -> Array:
    """T_base_flange (m, 4, 4) at joint values (m, dof); only the numbers are the arm's."""
    T = np.broadcast_to(np.array(arm.T_base_root), (len(q), 4, 4))
    for i, (d, theta, a, alpha, beta) in enumerate(np.array(arm.mdh)):
        moved, still = arm.sign[i] * q[:, i], np.zeros(len(q))
        along, about = (moved, still) if arm.prismatic[i] else (still, moved)
        T = T @ shift(2, d + along) @ turn(2, theta + about)
        T = T @ shift(0, np.array([a])) @ turn(0, np.array([alpha])) @ turn(1, np.array([beta]))
    return np.asarray(T)


class TrueArm(Protocol):
    """What tells where a flange truly is."""

    def fk(self, q: Array) -> Array:
        """Flange poses (m, 4, 4) at readings (m, n)."""


@dataclass(frozen=True)
class Sizes:
    """Sizes and noise that the estimator is told."""

    target: TrackerTarget = field(default_factory=lambda: TrackerTarget(0.01905, 0.01905))
    noise: TrackerNoise = field(default_factory=TrackerNoise)


@dataclass(frozen=True, eq=False)
class TrackerCell:
    """What stands where, and what is done.

    Attributes
    ----------
    T_flange_sensor : the truth that is looked for.
    reflector : (3,) of the tracked ball in the flange, m.
    arcs : joint values (n, dof) of the two paths; ``scan`` (m, dof) of the profiles.
    edge_rad : angle in the sensor's x-y plane from its y to the edge between both faces;
        ``lean_rad`` turns the cube about that edge.
    sensor : that of the source, without the form of real ones: its method has no model of it.
    around : whatever else the sensor may see.
    true : the arm as it is; None: as it is told, by elementary motions.
    """

    arm: SerialArm
    T_flange_sensor: Array
    reflector: Array
    arcs: tuple[Array, Array]
    scan: Array
    sizes: Sizes = field(default_factory=Sizes)
    T_tracker_base: Array = field(default_factory=lambda: T_TRACKER_BASE.copy())
    sensor: ProfileSensor = field(default_factory=lambda: ProfileSensor.exact(noise_m=3.7e-5))
    edge_rad: float = float(np.radians(40.0))
    lean_rad: float = float(np.radians(7.0))
    around: tuple[ScannedBody, ...] = ()
    true: TrueArm | None = None

    def flange(self, q: Array) -> Array:
        """True T_base_flange (m, 4, 4) at joint values (m, dof)."""
        return true_flange(self.arm, q) if self.true is None else self.true.fk(q)

    @property
    def T_base_view(self) -> Array:
        """Pose (4, 4) in which the sensor stands in the middle of its scan."""
        q = self.scan.mean(axis=0, keepdims=True)
        return np.asarray(self.flange(q)[0] @ self.T_flange_sensor)

    @cached_property
    def T_base_cube(self) -> Array:
        """Pose (4, 4) of the cube: x along its upper edge, y and -z along the faces that meet."""
        c, s = np.cos(self.edge_rad), np.sin(self.edge_rad)
        edge = np.array([s, c, 0.0])
        across = np.cross(edge, [0.0, 0.0, 1.0])
        toward = frames.exp_rotation(self.lean_rad * edge) @ np.array([0.0, 0.0, 1.0])
        side = frames.exp_rotation(self.lean_rad * edge) @ across
        y, z = (toward + side) / np.sqrt(2.0), (side - toward) / np.sqrt(2.0)
        place = np.array([0.0, -0.028, 0.193]) - 0.5 * CUBE_M * edge
        return np.asarray(self.T_base_view @ frames.transform(np.column_stack([edge, y, z]), place))

    @cached_property
    def centre(self) -> Array:
        """Centre (3,) of the sphere, base, m."""
        radius = self.sizes.target.sphere_radius_m
        return np.asarray((self.T_base_view @ [0.004, 0.042, 0.192 + radius, 1.0])[:3])

    @property
    def scene(self) -> Scene:
        """The cube and the sphere, and what is around."""
        ball = Ball(self.centre, self.sizes.target.sphere_radius_m)
        return Scene((block(self.T_base_cube, CUBE_M, CUBE_M, CUBE_M), ball, *self.around))

    @cached_property
    def exact(self) -> TrackerData:
        """Everything without noise."""
        still = replace(self.sensor, noise_m=0.0)
        rng = np.random.default_rng(0)
        T = self.flange(self.scan) @ self.T_flange_sensor
        shots = [still.shoot(pose, self.scene, rng) for pose in T]
        lit = [i for i, xz in enumerate(shots) if np.sum(np.isfinite(xz[:, 0])) >= FEWEST_LIT]
        names = ("arc_a", "arc_b")
        arcs = [
            Arc(name, q, self._seen(T_flange[:, :3, :3] @ self.reflector + T_flange[:, :3, 3]))
            for name, q in zip(names, self.arcs, strict=True)
            for T_flange in [self.flange(q)]
        ]
        # Centres (9, 3) of the reflector while it touches the face z = 0, and y = 0; base.
        a, b = (0.5 * CUBE_M + grid.ravel() for grid in np.meshgrid(GRID, GRID))
        off = np.full(len(a), self.sizes.target.reflector_radius_m)
        R, t = self.T_base_cube[:3, :3], self.T_base_cube[:3, 3]
        first = np.column_stack([a, b, off]) @ R.T + t
        second = np.column_stack([a, -off, -b]) @ R.T + t
        return TrackerData(
            arm=self.arm,
            arcs=(arcs[0], arcs[1]),
            sphere=self._seen(np.tile(self.centre, (3, 1))),
            faces=(self._seen(first), self._seen(second)),
            q=self.scan[lit],
            profiles=[profile_of(shots[i], f"p{i + 1:03d}") for i in lit],
        )

    def measure(self, rng: np.random.Generator) -> TrackerData:
        """Everything with noise; what the joints show misses what they truly do."""
        exact = self.exact
        first, second = (self._noisy(points, rng) for points in exact.faces)
        arcs = [
            Arc(arc.name, self._readings(arc.q, rng), self._noisy(arc.points, rng))
            for arc in exact.arcs
        ]
        profiles = [
            replace(p, points=p.points + np.array([0.0, self.sensor.noise_m])
                    * rng.standard_normal((len(p.points), 1)))
            for p in exact.profiles
        ]  # fmt: skip
        return replace(
            exact,
            arcs=(arcs[0], arcs[1]),
            sphere=self._noisy(exact.sphere, rng),
            faces=(first, second),
            q=self._readings(exact.q, rng),
            profiles=profiles,
        )

    def told(self, rng: np.random.Generator) -> TrackerTarget:
        """The target as its user measured it: the reflector's height has an error."""
        target = self.sizes.target
        if target.height_m is None:
            return target
        error_m = target.height_sigma_m * float(rng.standard_normal())
        return replace(target, height_m=target.height_m + error_m)

    def _seen(self, points: Array) -> Array:
        T = self.T_tracker_base
        return np.asarray(points @ T[:3, :3].T + T[:3, 3])

    def _noisy(self, points: Array, rng: np.random.Generator) -> Array:
        return points + self.sizes.noise.tracker_m * rng.standard_normal(points.shape)

    def _readings(self, q: Array, rng: np.random.Generator) -> Array:
        """Readings (n, dof): those of the joints that move miss the truth, the others' do not."""
        noise = self.sizes.noise
        sigma = np.where(self.arm.prismatic, noise.joint_m, noise.joint_rad)
        moves = np.ptp(q, axis=0) > 0.0
        return q + np.where(moves, sigma, 0.0) * rng.standard_normal(q.shape)


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
