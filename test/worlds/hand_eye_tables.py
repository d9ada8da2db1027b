# SPDX-License-Identifier: Apache-2.0
"""Tables of a simulated line laser before a sphere, stairs, an edge and a groove."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.hand_eye_cell import (
    HandEyeCell,
    SimulatedShots,
    TrueStairs,
    edge_shots,
    groove_shots,
    sphere_shots,
    step_shots,
)
from bench.hand_eye_files import write_shots, write_target
from robocal_ros.ground import frames
from robocal_ros.hand_eye.targets import (
    LaserTarget,
    LineTarget,
    SphereTarget,
    Staircase,
    StepTarget,
)

Array = NDArray[np.float64]

CELL = HandEyeCell()
ROBOT_M = CELL.robot.position_m
TRUE = CELL.T_flange_sensor
RADIUS_M = 0.02
CENTRE = np.array([0.837, -0.059, 0.045])
T_BASE_USER = frames.transform(frames.exp_rotation([0.01, -0.02, -2.1]), [0.84, -0.02, 0.03])
STAIRS = TrueStairs(T_BASE_USER)
SHOTS, CHECKS = 20, 4


def known_stairs() -> StepTarget:
    """The stairs as they stand: taught without an error."""
    same = Staircase(STAIRS.steps, STAIRS.length_m, STAIRS.height_m, STAIRS.depth_m)
    return same.target(T_BASE_USER)


def shots_of(kind: str, count: int = SHOTS + CHECKS, seed: int = 0) -> SimulatedShots:
    """Shots of a target."""
    rng = np.random.default_rng(seed)
    if kind == "sphere":
        return sphere_shots(CELL, CENTRE, RADIUS_M, count, rng)
    if kind == "step":
        return step_shots(CELL, STAIRS, count, rng)
    return (groove_shots if kind == "groove" else edge_shots)(CELL, T_BASE_USER, count, rng)


def target_of(kind: str) -> LaserTarget:
    """What is known of a target."""
    if kind == "sphere":
        return SphereTarget(RADIUS_M)
    return known_stairs() if kind == "step" else LineTarget(T_BASE_USER[:3, 3], T_BASE_USER[:3, 0])


def write_part(
    folder: Path,
    table: str,
    shots: SimulatedShots,
    rows: Sequence[int],
    T_base_flange: Array | None = None,
    **more: Any,
) -> Path:
    """Write some shots as a table, with these poses in place of the reported ones.

    ``more`` as in `write_shots`.
    """
    path = folder / f"{table}.csv"
    profiles = folder / "profiles"
    profiles.mkdir(parents=True, exist_ok=True)
    poses = shots.T_base_flange[list(rows)] if T_base_flange is None else T_base_flange
    if any(shots.marks):
        more["mark"] = [shots.marks[row] for row in rows]
    seen = {f"s{row + 1}": shots.profiles[row] for row in rows}
    write_shots(path, profiles, poses, seen, **more)
    return path


def hand_eye_tables(folder: Path, kind: str) -> Path:
    """Shots that solve, shots that judge, and what is known of the target."""
    shots = shots_of(kind)
    write_part(folder, "poses", shots, range(SHOTS))
    write_part(folder, "check", shots, range(SHOTS, SHOTS + CHECKS))
    write_target(folder / "target.yaml", target_of(kind))
    return folder
