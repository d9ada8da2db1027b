"""Simulated shots of a sphere, of stairs and of an edge, with what the operator knows of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.hand_eye_cell import (
    ArmRobot,
    HandEyeCell,
    Robot,
    SimulatedShots,
    edge_shots,
    sphere_shots,
    step_shots,
)
from bench.hand_eye_worlds import (
    AIM_M,
    CENTRE,
    MACHINING_M,
    RADIUS_M,
    STAIRCASE,
    STAIRS,
    T_BASE_USER,
    calibrated,
)
from bench.measured_runs import Q_NEAR
from robocal_ros.cell_sim.robot import Warmth
from robocal_ros.estimation.edge import EdgeRule
from robocal_ros.ground import frames
from robocal_ros.hand_eye.mount_fit import MountFit
from robocal_ros.hand_eye.profiles import profile_of
from robocal_ros.hand_eye.result import HandEyeResult, HandEyeSettings
from robocal_ros.hand_eye.solve import solve_task
from robocal_ros.hand_eye.stairs import StepTask
from robocal_ros.hand_eye.targets import LineTarget, SphereTarget, StepTarget
from robocal_ros.hand_eye.tasks import HandEyeData, LineTask, SphereTask, Task

Array = NDArray[np.float64]

SETTINGS = HandEyeSettings()
EDGE = EdgeRule()
TAUGHT_M, TAUGHT_RAD = 5e-5, 5e-4  # told of a frame that is taught with an arm that errs


@dataclass(frozen=True, eq=False)
class Calibration:
    """Shots with what the operator knows of the target."""

    task: Task
    data: HandEyeData

    def solve(self) -> HandEyeResult:
        """The judged mount."""
        return solve_task(self.task, self.data, "best", SETTINGS)

    def both(self) -> tuple[MountFit, Array]:
        """The mount as it is found before it is judged, and (4, 4) by the classic method."""
        view = self.task.read(self.data).view
        fit = calibrated(self.task, view)
        return fit, self.task.classic(view, fit.state).T_flange_sensor


def data_of(shots: SimulatedShots) -> HandEyeData:
    """As an operator has them."""
    names = tuple(f"shot {i + 1}" for i in range(len(shots.profiles)))
    profiles = [profile_of(p, name) for p, name in zip(shots.profiles, names, strict=True)]
    return HandEyeData(
        names, shots.T_base_flange, profiles, tuple(shots.marks) if any(shots.marks) else None
    )


def known_to(robot: Robot) -> Array:
    """What the robot takes for the base (4, 4): a target taught at the station is known there."""
    if not isinstance(robot, ArmRobot):
        return np.eye(4)
    there = robot.true.flange(Q_NEAR, Warmth.cold(robot.nominal.n))[0]
    return np.asarray(robot.nominal.fk(Q_NEAR) @ frames.invert(there))


def sphere_set(cell: HandEyeCell, rng: np.random.Generator, poses: int = 15) -> Calibration:
    """A sphere."""
    shots = sphere_shots(cell, CENTRE, RADIUS_M, poses, rng)
    return Calibration(SphereTask(SphereTarget(RADIUS_M)), data_of(shots))


def edge_set(cell: HandEyeCell, rng: np.random.Generator, poses: int = 15) -> Calibration:
    """An edge, unknown."""
    return Calibration(LineTask(None, EDGE), data_of(edge_shots(cell, T_BASE_USER, poses, rng)))


def known_edge_set(cell: HandEyeCell, rng: np.random.Generator, poses: int = 15) -> Calibration:
    """An edge, known."""
    T = known_to(cell.robot) @ T_BASE_USER
    shots = edge_shots(cell, T_BASE_USER, poses, rng)
    return Calibration(LineTask(LineTarget(T[:3, 3], T[:3, 0]), EDGE), data_of(shots))


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
    corners = {
        mark: points + machining_m * rng.standard_normal(points.shape)
        for mark, points in STAIRCASE.marked_corners().items()
    }
    T = known_to(cell.robot) @ T_BASE_USER
    told = (TAUGHT_M, TAUGHT_RAD) if isinstance(cell.robot, ArmRobot) else (0.0, 0.0)
    target = StepTarget(
        T, corners, STAIRCASE.edge_user, told_m, user_sigma_m=told[0], user_sigma_rad=told[1]
    )
    return Calibration(StepTask(target), data_of(shots))
