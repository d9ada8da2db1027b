# SPDX-License-Identifier: Apache-2.0
"""A drifting arm seen by a fixed sensor, by the estimators' own model: for tests of statistics."""

from dataclasses import replace

import numpy as np

from robocal_ros.cell_sim import kr150
from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell_model import CellModel
from robocal_ros.kinematics import SerialArm

SIGMA = 3e-5


def postures(count: int, seed: int = 0) -> np.ndarray:
    """That turn every joint, near one place."""
    middle = np.radians([5.0, -70.0, 115.0, 0.0, -60.0, 0.0])
    reach = np.radians([8.0, 10.0, 12.0, 120.0, 50.0, 150.0])
    return middle + reach * np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 6))


def cell_of(arm: SerialArm) -> CellModel:
    tool = frames.transform(np.eye(3), kr150.BALL)[None]
    return CellModel(arm, kr150.T_SENSOR_BASE, ("ball",), tool)


def visit(cell: CellModel, q: np.ndarray, rng: np.random.Generator | None = None) -> Measurements:
    p = cell.predict(q, np.zeros(len(q), dtype=np.int64))[:, :3, 3]
    if rng is not None:
        p = p + SIGMA * rng.standard_normal(p.shape)
    names = tuple(str(i) for i in range(len(q)))
    return Measurements(q=q, position=p, target=("ball",) * len(q), sample=names)


def drifted(cell: CellModel, drift: np.ndarray) -> CellModel:
    arm = cell.arm
    return replace(cell, arm=arm.with_mdh(arm.parameters.add(arm.mdh, drift)))
