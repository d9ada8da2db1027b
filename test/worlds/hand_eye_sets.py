"""Simulated shots of hand-eye targets as the estimators take them, and how far an answer is off."""

import numpy as np

from bench.hand_eye_cell import HandEyeCell, PoseRobot, SimulatedShots, TrueStairs
from robocal_ros.cell_sim.sensors import ProfileSensor
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RobocalError
from robocal_ros.hand_eye.profiles import profile_of
from robocal_ros.hand_eye.result import HandEyeResult, increment
from robocal_ros.hand_eye.targets import LineTarget, SphereTarget, Staircase, StepTarget
from robocal_ros.hand_eye.tasks import HandEyeData

POSE_M = 1e-4 / np.sqrt(3.0)  # along each axis: 0.1 mm in space
# As real sensors are: bent by some 20 um, with wrong points where what is seen ends, and outliers.
SENSOR = ProfileSensor(
    noise_m=1.5e-5, linearity_m=(2e-5, -1e-5, 2e-5), ends=2, spikes=0.003, dropouts=0.02
)
REAL_CELL = HandEyeCell(sensor=SENSOR, robot=PoseRobot(POSE_M))
CELL = HandEyeCell(robot=PoseRobot(POSE_M))
CENTRE, RADIUS_M = np.array([0.9, 0.1, 0.3]), 0.02
T_BASE_USER = frames.transform(frames.exp_rotation([0.0, 0.0, 0.3]), [0.9, 0.1, 0.3])
STAIRS = TrueStairs(T_BASE_USER)
SPHERE = SphereTarget(RADIUS_M)
LINE = LineTarget(T_BASE_USER[:3, 3], T_BASE_USER[:3, 0])
FAR_OFF = 22.46  # chi-square of 6 numbers, exceeded once in 1000


def stairs_target(T_base_user=T_BASE_USER, **known):
    drawn = Staircase(STAIRS.steps, STAIRS.length_m, STAIRS.height_m, STAIRS.depth_m)
    return StepTarget(T_base_user, drawn.marked_corners(), drawn.edge_user, **known)


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
