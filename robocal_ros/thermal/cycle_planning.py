"""Poses for a measuring cycle of one cell, and how much better they are than others."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.identification.cell import CellModel
from robocal_ros.identification.solve import random_postures
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.pose_planning import (
    Design,
    PosePlan,
    SensorField,
    candidate_poses,
    plan_poses,
)

Array = NDArray[np.float64]

POSES = 6
CANDIDATES = 1000
COLD_VISITS = 3


@dataclass(frozen=True, eq=False)
class PlannedCycle:
    """Planned poses beside a user's own.

    Attributes
    ----------
    own_rms_m : predicted error of the tool after a cycle of the user's own poses; None without.
    candidates, working : how many poses there were to choose from, and to judge at.
    """

    plan: PosePlan
    own_rms_m: float | None
    candidates: int
    working: int


def plan_cycle(
    arm: SerialArm,
    T_sensor_base: Array,
    sphere_in_flange: Array,
    field: SensorField,
    *,
    prior: Array,
    sigma_m: float,
    count: int = POSES,
    candidates: int = CANDIDATES,
    working: Array | None = None,
    own: Array | None = None,
    seed: int = 0,
) -> PlannedCycle:
    """Plan ``count`` poses for a sensor that stands at ``T_sensor_base`` (4, 4).

    Parameters
    ----------
    sphere_in_flange : (3,), m.
    prior : (k, k) covariance of the expected drift, SI; ``sigma_m`` of one visit's coordinate.
    working : (w, n) poses where the tool must be right; None: all over the joint limits.
    own : (o, n) measuring poses to compare with, or None.

    Raises
    ------
    LimitError, TooFewSamplesError
        When the sphere cannot be brought into the field often enough.
    """
    tool = frames.transform(np.eye(3), sphere_in_flange)[None]
    cell = CellModel(arm, T_sensor_base, ("sphere",), tool)
    rng = np.random.default_rng(seed)
    found = candidate_poses(cell, field, candidates, rng)
    where = random_postures(arm) if working is None else working
    every = found if own is None else np.vstack([found, own])
    point = arm.T_flange_tool[:3, 3]
    design = Design.of(cell, every, where, point, prior, sigma_m, COLD_VISITS)
    plan = plan_poses(design.of_first(len(found)), found, count, rng)
    theirs = list(range(len(found), len(every)))
    return PlannedCycle(plan, design.error(theirs) if theirs else None, len(found), len(where))
