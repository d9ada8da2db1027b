"""Simulated sightings of a sphere, of stairs and of an edge, without profiles: quick to draw.

Poses come from the simulated cell, features from the geometry of `bench.hand_eye_bound`, with the
noise that points of a line laser leave in them.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bench.hand_eye_bound import (
    Noise,
    Sight,
    circle_covariance,
    circles,
    corner_covariance,
    least_covariance,
    piercings,
)
from bench.hand_eye_cell import (
    HandEyeCell,
    PoseRobot,
    TrueStairs,
    edge_shots,
    sphere_shots,
    step_shots,
)
from robocal_ros.cell_sim.sensors import ProfileSensor, Scene
from robocal_ros.estimation.edge import EdgeRule
from robocal_ros.ground import frames
from robocal_ros.hand_eye.mount_fit import MountFit, fit_mount, require_seen
from robocal_ros.hand_eye.mount_problem import (
    Index,
    LineModel,
    MountProblem,
    MountState,
    Sightings,
    SphereModel,
    TargetModel,
    TargetView,
    pivot_of,
)
from robocal_ros.hand_eye.result import PoseNoise, increment
from robocal_ros.hand_eye.solve import look
from robocal_ros.hand_eye.stairs import StepTask
from robocal_ros.hand_eye.targets import LineTarget, SphereTarget, Staircase, StepTarget
from robocal_ros.hand_eye.tasks import LineTask, SphereTask, Task

Array = NDArray[np.float64]

RADIUS_M = 0.02
CENTRE = np.array([0.837, -0.059, 0.045])
T_BASE_USER = frames.transform(frames.exp_rotation([0.01, -0.02, -2.1]), [0.84, -0.02, 0.03])
LINE_M = 0.2  # between the planes in which an unknown line's ends are counted
POINT_M = 3.7e-5  # of a profile point
PITCH_M = 2.0 * 0.2 * float(np.tan(np.radians(14.0))) / 1280.0  # between profile points
FLANK_M = 8e-3  # of a surface beside an edge
AIM_M = 2e-4
MACHINING_M = 1e-4 / 3.0
NOISE = Noise(5e-5, 5e-5)
AIMED = replace(NOISE, aim_m=AIM_M)
STAIRS = TrueStairs(T_BASE_USER)
STAIRCASE = Staircase(STAIRS.steps, STAIRS.length_m, STAIRS.height_m, STAIRS.depth_m)


class Blind(ProfileSensor):
    """A sensor of the same range that is spared the work of taking profiles."""

    def shoot(self, T_base_sensor: Array, scene: Scene, rng: np.random.Generator) -> Array:
        """Nothing."""
        return np.empty((0, 2))


BLIND = HandEyeCell(sensor=Blind(), robot=PoseRobot(0.0, 0.0))
X = BLIND.T_flange_sensor


@dataclass(frozen=True, eq=False)
class World:
    """A target and true poses before it.

    Attributes
    ----------
    model, place : as the estimator has them, the place the true one.
    sight, unknowns : the same for the bench's own geometry.
    T_base_flange : (m, 4, 4) true pose of each feature; ``pose`` (m,): which belong together.
    covariance : (m, 3, 3) of the features.
    """

    task: Task
    model: TargetModel
    place: Array
    sight: Sight
    unknowns: Array
    T_base_flange: Array
    pose: Index
    covariance: Array
    noise: Noise
    exact: TargetView = field(init=False)

    def __post_init__(self) -> None:
        value = np.zeros((len(self.pose), 3))
        value[:, : self.sight.components] = self.seen
        if self.sight.aim is not None:
            value[:, 2] = 0.0  # the light is taken to lie on the marks
        object.__setattr__(self, "exact", self._view(self.T_base_flange, value))

    @property
    def seen(self) -> Array:
        """Features (m, c) without error."""
        return self.sight.see(self.T_base_flange @ X, self.unknowns)

    @property
    def pivot(self) -> Array:
        """Middle (3,) of what is seen, sensor frame."""
        value = self.exact.sightings.value
        return np.array([value[:, 0].mean(), 0.0, value[:, 1].mean()])

    def measured(self, rng: np.random.Generator) -> TargetView:
        """With errors of robot and sensor."""
        m, c = len(self.pose), self.sight.components
        root = np.linalg.cholesky(self.covariance[:, :c, :c])
        value = self.exact.sightings.value.copy()
        value[:, :c] += (root @ rng.standard_normal((m, c, 1)))[:, :, 0]
        count = int(self.pose.max()) + 1
        turn = frames.exp_rotation(self.noise.pose_rad * rng.standard_normal((count, 3)))
        away = self.noise.pose_m * rng.standard_normal((count, 3))
        error = frames.transform(turn, away)[self.pose]
        return self._view(self.T_base_flange @ error, value)

    def bound(self) -> Array:
        """Cramer-Rao (6, 6) about the pivot, by the bench's own geometry."""
        c = self.sight.components
        return least_covariance(
            self.sight, self.T_base_flange, self.pose, X, self.pivot, self.unknowns,
            self.covariance[:, :c, :c], self.noise,
        )  # fmt: skip

    def own_bound(self) -> Array:
        """The same by the estimator's Jacobian at the truth."""
        noise = PoseNoise(self.noise.pose_m, self.noise.pose_rad, self.noise.aim_m)
        state = MountState(X, (self.place,))
        problem = MountProblem((self.exact,), noise, state, pivot=self.pivot)
        J = problem.linearise(state)[1].reshape(-1, len(problem.names))
        return np.asarray(np.linalg.inv(J.T @ J)[:6, :6])

    def _view(self, T_base_flange: Array, value: Array) -> TargetView:
        names = tuple(f"{self.task.kind} {i + 1}" for i in range(len(self.pose)))
        sightings = Sightings(names, self.pose, self.pose, T_base_flange, value, self.covariance)
        return TargetView(self.model, sightings)


def sphere_world(rng: np.random.Generator, noise: Noise = NOISE, poses: int = 15) -> World:
    """Circles on a sphere."""
    T = sphere_shots(BLIND, CENTRE, RADIUS_M, poses, rng).true_T_base_flange

    def see(T_base_sensor: Array, centre: Array) -> Array:
        return circles(T_base_sensor, centre, RADIUS_M)

    covariance = [circle_covariance(r, POINT_M, PITCH_M) for r in see(T @ X, CENTRE)[:, 2]]
    return World(
        SphereTask(SphereTarget(RADIUS_M)), SphereModel(RADIUS_M), CENTRE, Sight(see, 3, 3),
        CENTRE, T, np.arange(poses), np.array(covariance), noise,
    )  # fmt: skip


def line_world(
    rng: np.random.Generator, known: bool, noise: Noise = NOISE, poses: int = 15
) -> World:
    """Points of a straight edge; an unknown one has four unknowns: where it cuts two planes."""
    T = edge_shots(BLIND, T_BASE_USER, poses, rng).true_T_base_flange
    origin, along, aside = T_BASE_USER[:3, 3], T_BASE_USER[:3, 0], T_BASE_USER[:3, 1:3]

    def see(T_base_sensor: Array, ends: Array) -> Array:
        if known:
            return piercings(T_base_sensor, origin, along)[0]
        first, last = origin + aside @ ends[:2], origin + LINE_M * along + aside @ ends[2:]
        return piercings(T_base_sensor, first, last - first)[0]

    unknowns = 0 if known else 4
    target = LineTarget(origin, along) if known else None
    return World(
        LineTask(target, EdgeRule()), LineModel(known), np.stack([origin, along]),
        Sight(see, unknowns, 2), np.zeros(unknowns), T, np.arange(poses),
        _corners(rng, poses), noise,
    )  # fmt: skip


def step_world(rng: np.random.Generator, noise: Noise = AIMED, poses: int = 5) -> World:
    """Corners of stairs; in every profile each has a machining error of its own."""
    shots = step_shots(BLIND, STAIRS, poses, rng, aim_m=noise.aim_m)
    marks, steps = STAIRCASE.marked_corners(), STAIRS.steps
    user = np.concatenate([marks[mark] for mark in shots.marks])
    base = user @ T_BASE_USER[:3, :3].T + T_BASE_USER[:3, 3]
    pose = np.repeat(np.arange(poses), steps)

    def see(T_base_sensor: Array, nothing: Array) -> Array:
        xz, far = piercings(T_base_sensor, base, T_BASE_USER[:3, 0])
        return np.column_stack([xz, far])

    covariance = _corners(rng, poses)[pose]
    covariance[:, 2, 2] = 0.0
    aim = np.zeros((len(base), 3, 2))
    aim[:, 2, 0], aim[:, 2, 1] = 1.0, np.tile(np.linspace(-1.0, 1.0, steps), poses)
    task = StepTask(StepTarget(T_BASE_USER, marks, STAIRCASE.edge_user))
    return World(
        task, task.model(user), T_BASE_USER, Sight(see, 0, 3, aim), np.zeros(0),
        shots.true_T_base_flange[pose], pose, covariance + MACHINING_M**2 * np.eye(3), noise,
    )  # fmt: skip


def _corners(rng: np.random.Generator, poses: int) -> Array:
    """Covariances (poses, 3, 3) of (x, z) of corners that are turned in the laser plane."""
    covariance = np.tile(np.eye(3), (poses, 1, 1))
    for one, turn in zip(
        covariance, rng.uniform(-BLIND.tilt_rad, BLIND.tilt_rad, poses), strict=True
    ):
        one[:2, :2] = corner_covariance(turn, FLANK_M, POINT_M, PITCH_M)
    return covariance


def calibrated(task: Task, view: TargetView) -> MountFit:
    """As the solver does it with the features of profiles; no noise is told."""
    fit = fit_mount((view,), look(task, view)[0])
    require_seen(fit)
    return fit


def squared_error(fit: MountFit) -> float:
    """Squared error of a mount in units of its covariance: chi-square where that is true."""
    step = increment(fit.state.T_flange_sensor, X, pivot_of(fit.views))
    return float(step @ np.linalg.solve(fit.covariance[:6, :6], step))
