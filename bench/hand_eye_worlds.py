# SPDX-License-Identifier: Apache-2.0
"""Simulated shots of a sphere, of stairs and of an edge; what the operator knows, what is true.

Whole profiles of a sensor and poses of a robot that err as real ones do (`ProfileSensor`,
`PoseRobot`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bench.hand_eye_bound import Least, Noise, Sight, circles, least, piercings
from bench.hand_eye_cell import (
    ArmRobot,
    HandEyeCell,
    PoseRobot,
    Robot,
    SimulatedShots,
    TrueStairs,
    WantedView,
    edge_block,
    edge_shots,
    sphere_shots,
    step_shots,
)
from bench.measured_runs import Q_NEAR
from robocal_ros.cell_sim.robot import Warmth
from robocal_ros.cell_sim.sensors import Scene, ball_on_table
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RobocalError
from robocal_ros.hand_eye.mount_problem import (
    CornerModel,
    LineModel,
    MountProblem,
    MountState,
    SphereModel,
    TargetView,
)
from robocal_ros.hand_eye.profiles import Profile, profile_of
from robocal_ros.hand_eye.result import HandEyeResult, HandEyeSettings, Method, PoseNoise, increment
from robocal_ros.hand_eye.solve import features, solve_task
from robocal_ros.hand_eye.stairs import task_of
from robocal_ros.hand_eye.targets import (
    LaserTarget,
    LineTarget,
    SphereTarget,
    Staircase,
)
from robocal_ros.hand_eye.tasks import HandEyeData, Task
from robocal_ros.kinematics.joint_errors import ShotJoints

Array = NDArray[np.float64]

RADIUS_M = 0.02
CENTRE = np.array([0.837, -0.059, 0.045])
T_BASE_USER = frames.transform(frames.exp_rotation([0.01, -0.02, -2.1]), [0.84, -0.02, 0.03])
LINE = LineTarget(T_BASE_USER[:3, 3], T_BASE_USER[:3, 0])
LINE_M = 0.2  # between the planes in which an unknown line's ends are counted
AIM_M = 2e-4
MACHINING_M = 1e-4 / 3.0
GAUGED_M = 5e-6  # of stairs that were measured
TAUGHT_M, TAUGHT_RAD = 5e-5, 5e-4  # told of a frame that is taught with an arm that errs
STAIRS = TrueStairs(T_BASE_USER)
STAIRCASE = Staircase(STAIRS.steps, STAIRS.length_m, STAIRS.height_m, STAIRS.depth_m)
SETTINGS = HandEyeSettings()
CELL = HandEyeCell()
X = CELL.T_flange_sensor


@dataclass(frozen=True, eq=False)
class Calibration:
    """Shots with what the operator knows of the target; z of the profiles is a height."""

    target: LaserTarget | None
    data: HandEyeData

    def task(self, classic: bool = False) -> Task:
        """The estimator's view of it."""
        return task_of(self.target, "edge", classic, towards=True)

    def solve(self, method: Method = "best") -> HandEyeResult:
        """The judged mount, as node and command find it."""
        return solve_task(self.task(method == "classic"), self.data, method, SETTINGS)


def data_of(shots: SimulatedShots, robot: Robot) -> HandEyeData:
    """As an operator of the robot has them."""
    names = tuple(f"shot {i + 1}" for i in range(len(shots.profiles)))
    profiles: list[Profile | RobocalError] = []
    for points, name in zip(shots.profiles, names, strict=True):
        try:
            profiles.append(profile_of(points, name))
        except RobocalError as error:
            profiles.append(error)
    marks = tuple(shots.marks) if any(shots.marks) else None
    joints = None
    if isinstance(robot, ArmRobot) and shots.q is not None:
        joints = ShotJoints(robot.nominal, shots.q)
    return HandEyeData(names, shots.T_base_flange, profiles, marks, joints)


def known_to(robot: Robot) -> Array:
    """What the robot takes for the base (4, 4): a target taught at the station is known there."""
    if not isinstance(robot, ArmRobot):
        return np.eye(4)
    there = robot.true.flange(Q_NEAR, Warmth.cold(robot.nominal.n))[0]
    return np.asarray(robot.nominal.fk(Q_NEAR) @ frames.invert(there))


def sphere_set(cell: HandEyeCell, rng: np.random.Generator, poses: int = 15) -> Calibration:
    """A sphere."""
    shots = sphere_shots(cell, CENTRE, RADIUS_M, poses, rng)
    return Calibration(SphereTarget(RADIUS_M), data_of(shots, cell.robot))


def edge_set(cell: HandEyeCell, rng: np.random.Generator, poses: int = 15) -> Calibration:
    """An edge, unknown."""
    return Calibration(None, data_of(edge_shots(cell, T_BASE_USER, poses, rng), cell.robot))


def known_edge_set(cell: HandEyeCell, rng: np.random.Generator, poses: int = 15) -> Calibration:
    """An edge, known."""
    T = known_to(cell.robot) @ T_BASE_USER
    shots = edge_shots(cell, T_BASE_USER, poses, rng)
    return Calibration(LineTarget(T[:3, 3], T[:3, 0]), data_of(shots, cell.robot))


def step_set(
    cell: HandEyeCell,
    rng: np.random.Generator,
    poses: int = 5,
    aim_m: float = AIM_M,
    machining_m: float = 0.0,
    told_m: float = MACHINING_M,
) -> Calibration:
    """Stairs; what is known of their corners is off by ``machining_m`` throughout."""
    shots = step_shots(cell, STAIRS, poses, rng, aim_m=aim_m)
    corners = told_corners(rng, machining_m)
    T = known_to(cell.robot) @ T_BASE_USER
    told = (TAUGHT_M, TAUGHT_RAD) if isinstance(cell.robot, ArmRobot) else (0.0, 0.0)
    target = STAIRCASE.target(
        T, corners=corners, sigma_m=told_m, user_sigma_m=told[0], user_sigma_rad=told[1]
    )
    return Calibration(target, data_of(shots, cell.robot))


@dataclass(frozen=True, eq=False)
class World:
    """A target, and true poses before it, from which it may be shot again.

    Attributes
    ----------
    place : the target's true place, as the estimator has it.
    wanted : views, at the poses where the robot stands.
    noise : of the robot, and of the eye.
    """

    target: LaserTarget | None
    place: Array
    scene: Scene
    wanted: tuple[WantedView, ...]
    robot: PoseRobot
    aim_m: float = 0.0

    @property
    def noise(self) -> Noise:
        """Of the robot's poses and of the eye."""
        return Noise(self.robot.position_m, self.robot.rotation_rad, self.aim_m)

    @property
    def true_T_base_flange(self) -> Array:
        """(m, 4, 4)."""
        light = np.array([view.T_base_light for view in self.wanted])
        return np.asarray(light @ frames.invert(CELL.T_flange_light))

    def shot(self, rng: np.random.Generator) -> Calibration:
        """Shots from these poses, which err anew."""
        cell = HandEyeCell(robot=self.robot)
        shots = cell.shoot(self.scene, self.wanted, len(self.wanted), rng)
        return Calibration(self.target, data_of(shots, self.robot))

    def least(self, made: Calibration, pivot: Array) -> tuple[Least, Array]:
        """The bound of what these shots show, and the estimator's own at the truth (6, 6)."""
        view = truly(features(made.task(), made.data).view)
        s, T = view.sightings, self.true_T_base_flange
        error = np.array(
            [increment(*pair, np.zeros(3)) for pair in zip(T, made.data.T_base_flange, strict=True)]
        )
        sight, unknowns = sight_of(view)
        c = sight.components
        found = least(
            sight, T[s.shot], s.pose, error[s.shot], X, pivot, unknowns,
            s.covariance[:, :c, :c], self.noise,
        )  # fmt: skip
        value = np.zeros_like(s.value)
        value[:, :c] = sight.see(T[s.shot] @ X, unknowns)
        if sight.aim is not None:
            value[:, 2] = 0.0  # the light is taken to lie on the marks
        exact = TargetView(view.model, type(s)(
            s.names, s.shot, s.pose, T[s.shot], value, s.covariance
        ))  # fmt: skip
        noise = PoseNoise(self.noise.pose_m, self.noise.pose_rad, self.aim_m)
        state = MountState(X, (self.place,))
        problem = MountProblem((exact,), noise, state, pivot=pivot)
        J = problem.linearise(state)[1].reshape(-1, len(problem.names))
        return found, np.asarray(np.linalg.inv(J.T @ J)[:6, :6])


def truly(view: TargetView) -> TargetView:
    """A view whose stairs are as they are, not as they are told."""
    if not isinstance(view.model, CornerModel):
        return view
    true = np.concatenate(list(STAIRCASE.marked_corners().values()))
    away = np.linalg.norm(view.model.corner_user[:, None] - true, axis=2)
    return replace(view, model=replace(view.model, corner_user=true[away.argmin(axis=1)]))


def sight_of(view: TargetView) -> tuple[Sight, Array]:
    """How the features of a view come about, and the true unknowns of the target (k,)."""
    model = view.model
    if isinstance(model, SphereModel):
        return Sight(lambda T, centre: circles(T, centre, RADIUS_M), 3, 3), CENTRE
    origin, along, aside = T_BASE_USER[:3, 3], T_BASE_USER[:3, 0], T_BASE_USER[:3, 1:3]
    if isinstance(model, LineModel):
        if model.known:
            return Sight(lambda T, _: piercings(T, origin, along)[0], 0, 2), np.zeros(0)

        def seen(T: Array, ends: Array) -> Array:
            first, last = origin + aside @ ends[:2], origin + LINE_M * along + aside @ ends[2:]
            return piercings(T, first, last - first)[0]

        return Sight(seen, 4, 2), np.zeros(4)
    if not isinstance(model, CornerModel):
        raise ValueError("no such target")
    base = model.corner_user @ T_BASE_USER[:3, :3].T + origin
    step = model.corner_user[:, 2] / STAIRS.height_m - 1.0
    aim = np.zeros((len(base), 3, 2))
    aim[:, 2, 0], aim[:, 2, 1] = 1.0, 2.0 * step / (STAIRS.steps - 1) - 1.0
    return Sight(lambda T, _: np.column_stack(piercings(T, base, along)), 0, 3, aim), np.zeros(0)


Draw = Callable[[np.random.Generator], World]


def _world(
    target: LaserTarget | None,
    place: Array,
    scene: Scene,
    shots: SimulatedShots,
    robot: PoseRobot,
    aim_m: float = 0.0,
) -> World:
    light = shots.true_T_base_flange @ CELL.T_flange_light
    wanted = tuple(WantedView(T, mark) for T, mark in zip(light, shots.marks, strict=True))
    return World(target, place, scene, wanted, robot, aim_m)


def sphere_world(
    rng: np.random.Generator, poses: int = 15, robot: PoseRobot | None = None
) -> World:
    """A ball."""
    shots = sphere_shots(CELL, CENTRE, RADIUS_M, poses, rng)
    scene = ball_on_table(CENTRE, RADIUS_M)
    return _world(SphereTarget(RADIUS_M), CENTRE, scene, shots, robot or PoseRobot())


def line_world(rng: np.random.Generator, known: bool, poses: int = 15) -> World:
    """A straight edge; an unknown one has four unknowns: where it cuts two planes."""
    shots = edge_shots(CELL, T_BASE_USER, poses, rng)
    place = np.stack([LINE.point_base, LINE.direction_base])
    scene = Scene((edge_block(T_BASE_USER),))
    return _world(LINE if known else None, place, scene, shots, PoseRobot())


def told_corners(rng: np.random.Generator, sigma_m: float) -> dict[str, Array]:
    """What is known of the stairs' corners: off by so much, the same in all shots."""
    return {
        mark: points + sigma_m * rng.standard_normal(points.shape)
        for mark, points in STAIRCASE.marked_corners().items()
    }


def step_world(rng: np.random.Generator, poses: int = 5, gauged_m: float = GAUGED_M) -> World:
    """Stairs that were measured, to ``gauged_m``."""
    shots = step_shots(CELL, STAIRS, poses, rng, aim_m=AIM_M)
    corners = told_corners(rng, gauged_m)
    target = STAIRCASE.target(T_BASE_USER, corners=corners, sigma_m=gauged_m)
    return _world(target, T_BASE_USER, Scene((STAIRS.body,)), shots, PoseRobot(), AIM_M)


def squared_error(result: HandEyeResult) -> float:
    """Squared error of a mount in units of its covariance: chi-square where that is true."""
    step = increment(result.T_flange_sensor, X, result.pivot)
    return float(step @ np.linalg.solve(result.covariance, step))
