"""What planned poses would say about a sensor's place, before the robot is moved."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.errors import InputError
from robocal_ros.core.hand_eye.target_documents import target_of
from robocal_ros.core.hand_eye.targets import LineTarget, SphereTarget, StepTarget
from robocal_ros.sessions.hand_eye_config import HandEyeConfig
from robocal_ros.sessions.hand_eye_data import DataSet

if TYPE_CHECKING:
    from robocal_ros.core.hand_eye.planning import PlannedTarget, PlanReport, SensorRange

Array = NDArray[np.float64]

ROBOT_SIGMA_M = 5e-5  # of a reported pose in each axis, where it is not given


def judged_plan(
    data: DataSet,
    T_base_flange: Array,
    marks: Sequence[str],
    T_flange_sensor: Array,
    sensor: "SensorRange",
    config: HandEyeConfig,
) -> "PlanReport":
    """Judge planned flange poses (m, 4, 4) with a rough T_flange_sensor (4, 4).

    ``marks``: of a step target the mark (m) of each pose; without any its first one.

    Raises
    ------
    InputError
        For a target whose plans cannot be judged, and for marks that it does not have.
    """
    from robocal_ros.core.hand_eye.mount_problem import PoseNoise
    from robocal_ros.core.hand_eye.planning import check_plan

    noise = PoseNoise(config.robot_sigma_m or ROBOT_SIGMA_M, config.robot_sigma_rad or 0.0)
    if marks and len(marks) != len(T_base_flange):
        raise InputError(f"{len(marks)} marks for {len(T_base_flange)} poses: give each its own")
    for mark in marks:
        data.require_mark(mark)
    target = _planned(data, marks, sensor)
    return check_plan(target, T_base_flange, T_flange_sensor, sensor, noise, config.limit_m)


def _planned(data: DataSet, marks: Sequence[str], sensor: "SensorRange") -> "PlannedTarget":
    from robocal_ros.core.hand_eye.planned_targets import PlannedLine, PlannedSphere, PlannedStep

    target = target_of(data.target)
    if isinstance(target, SphereTarget):
        return PlannedSphere(target.radius_m, sensor)
    if isinstance(target, StepTarget):
        return PlannedStep(target, sensor, tuple(marks) or None)
    if isinstance(target, LineTarget):
        return PlannedLine(sensor, np.stack([target.point_base, target.direction_base]))
    if data.kind == "line":
        return PlannedLine(sensor)
    raise InputError(f"plans are judged for a line laser's targets, not for a {data.kind}")
