# SPDX-License-Identifier: Apache-2.0
"""Simulated shots of hand-eye targets as the estimators take them, and how far an answer is off."""

import numpy as np

from bench.hand_eye_cell import HandEyeCell, SimulatedShots, TrueStairs
from robocal_ros.estimation.edge import CornerRule, EdgeRule, Kind
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RobocalError
from robocal_ros.hand_eye.profiles import profile_of
from robocal_ros.hand_eye.result import HandEyeResult, increment
from robocal_ros.hand_eye.stairs import StepTask
from robocal_ros.hand_eye.targets import LineTarget, SphereTarget, Staircase, StepTarget
from robocal_ros.hand_eye.tasks import HandEyeData, LineTask, SphereTask

CELL = HandEyeCell()
POSE_M, POSE_RAD = CELL.robot.position_m, CELL.robot.rotation_rad
CENTRE, RADIUS_M = np.array([0.9, 0.1, 0.3]), 0.02
T_BASE_USER = frames.transform(frames.exp_rotation([0.0, 0.0, 0.3]), [0.9, 0.1, 0.3])
STAIRS = TrueStairs(T_BASE_USER)
SPHERE = SphereTarget(RADIUS_M)
LINE = LineTarget(T_BASE_USER[:3, 3], T_BASE_USER[:3, 0])
FAR_OFF = 22.46  # chi-square of 6 numbers, exceeded once in 1000


def stairs_target(T_base_user=T_BASE_USER, stairs=STAIRS, corners="convex", **known):
    """As a target file's ``staircase`` tells it."""
    drawn = Staircase(stairs.steps, stairs.length_m, stairs.height_m, stairs.depth_m, corners)
    return drawn.target(T_base_user, **known)


def sphere_task(target: SphereTarget = SPHERE) -> SphereTask:
    """As the simulated sensor tells profiles: z is a height."""
    return SphereTask(target, towards=True)


def step_task(target: StepTarget | None = None) -> StepTask:
    return StepTask(target or stairs_target(), CornerRule(towards=True))


def line_task(target: LineTarget | None = None, kind: Kind = "edge") -> LineTask:
    return LineTask(target, EdgeRule(towards=True, kind=kind))


def data_of(shots: SimulatedShots) -> HandEyeData:
    names = tuple(f"p{i + 1}" for i in range(len(shots.profiles)))
    profiles = []
    for name, points in zip(names, shots.profiles, strict=True):
        try:
            profiles.append(profile_of(points, name))
        except RobocalError as error:
            profiles.append(error)
    marks = tuple(shots.marks) if all(shots.marks) else None
    return HandEyeData(names, shots.T_base_flange, profiles, marks)


def chi_square(result: HandEyeResult, T_flange_sensor) -> float:
    """Squared distance from the truth in standard deviations; 6 on average."""
    off = increment(result.T_flange_sensor, T_flange_sensor, result.pivot)
    return float(off @ np.linalg.solve(result.covariance, off))
