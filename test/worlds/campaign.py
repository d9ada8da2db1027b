# SPDX-License-Identifier: Apache-2.0
"""A simulated measuring campaign: a KR 150 as built, a point on its flange, tables of it."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.kinematics.tables import write_measurements

ROBOT = "kr150_r3100"
NOISE_M = 5e-5
POINTS = {"ball": (0.10, 0.05, 0.20), "peg": (-0.15, 0.02, 0.10)}


R_FRAME_BASE = frames.exp_rotation(np.array([0.3, -0.2, 1.0]))


def true_arm(seed: int = 0) -> SerialArm:
    """The robot as built: off its nominal model by tenths of a millimetre."""
    nominal = load_robot(ROBOT)
    size = np.where(nominal.parameters.is_length, 3e-4, np.radians(0.02))
    change = size * np.random.default_rng(seed).normal(size=len(size))
    return nominal.with_mdh(nominal.parameters.add(nominal.mdh, change))


def postures(arm: SerialArm, count: int, seed: int) -> np.ndarray:
    low, high = np.maximum(arm.lower, -1.7), np.minimum(arm.upper, 1.7)
    return np.random.default_rng(seed).uniform(low, high, (count, arm.n))


def measured(
    count: int,
    seed: int = 1,
    *,
    arm: SerialArm | None = None,
    q: np.ndarray | None = None,
    targets: tuple[str, ...] = ("ball",),
    place: tuple[float, float, float] = (2.0, 1.0, -0.5),
) -> Measurements:
    """Measurements of the true robot by a device at ``place``; the targets take turns."""
    arm = arm or true_arm()
    q = postures(arm, count, seed) if q is None else q
    rng = np.random.default_rng(seed + 1000)
    names = tuple(targets[i % len(targets)] for i in range(count))
    points = np.array([[*POINTS[name], 1.0] for name in names])
    T_frame_base = frames.transform(R_FRAME_BASE, place)
    flange = T_frame_base @ arm.fk(q)
    position = np.einsum("mij,mj->mi", flange, points)[:, :3]
    return Measurements(
        q=q,
        position=position + NOISE_M * rng.normal(size=position.shape),
        target=names,
        sample=tuple(f"{seed}-{i}" for i in range(count)),
    )


def table(path: Path, data: Measurements) -> Path:
    write_measurements(path, data, load_robot(ROBOT))
    return path


def with_rotations(data: Measurements, arm: SerialArm) -> Measurements:
    return replace(data, rotation=R_FRAME_BASE @ arm.fk(data.q)[:, :3, :3])


def edited(path: Path, column: str, change) -> Path:
    """The same table with each cell of a column changed, beside the old one."""
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:
        row[column] = change(row[column])
    new = path.with_name(f"edited_{path.name}")
    with new.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return new


def renamed(path: Path, **columns: str) -> Path:
    """The same table with columns of other names."""
    header, rest = path.read_text().split("\n", 1)
    names = [columns.get(name, name) for name in header.split(",")]
    new = path.with_name(f"renamed_{path.name}")
    new.write_text(",".join(names) + "\n" + rest)
    return new
