# SPDX-License-Identifier: Apache-2.0
"""Tables of a simulated thermal drift: cold and warm visits of named poses."""

import csv
from pathlib import Path

import numpy as np
from drift_cell import postures

from robocal_ros.cell_sim import kr150
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.identification import drift_prior

ROBOT = "kr150_r3100"
SIGMA = 2e-5
JUDGES = ("c15", "c16", "c17", "c18", "c19")
HEADER = ["pose", "cycle", "sample", *(f"q{i}_deg" for i in range(1, 7)), "x_mm", "y_mm", "z_mm"]


def nominal() -> SerialArm:
    return load_robot(ROBOT)


def built() -> SerialArm:
    """The cold robot, off its nominal model by tenths of a millimetre."""
    arm, rng = nominal(), np.random.default_rng(3)
    size = np.where(arm.parameters.is_length, 2e-4, np.radians(0.01))
    return arm.with_mdh(arm.parameters.add(arm.mdh, size * rng.standard_normal(len(size))))


def drifted(share: float) -> SerialArm:
    arm = built()
    drift = np.sqrt(np.diag(drift_prior(arm))) * np.random.default_rng(4).standard_normal(24)
    return arm.with_mdh(arm.parameters.add(arm.mdh, share * drift))


def visits(
    path: Path, cycles: dict[str, SerialArm], poses: dict[str, np.ndarray], seed: int = 0
) -> Path:
    """Write one row for each pose and cycle."""
    rng = np.random.default_rng(seed)
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(HEADER)
        for cycle, arm in cycles.items():
            for pose, taught in poses.items():
                q = taught + 2e-5 * rng.standard_normal(6)
                T = kr150.T_SENSOR_BASE @ arm.fk(q)
                p = T[:3, :3] @ kr150.BALL + T[:3, 3] + SIGMA * rng.standard_normal(3)
                writer.writerow(
                    [pose, cycle, f"{cycle}/{pose}"]
                    + [f"{x:.7f}" for x in np.degrees(q)]
                    + [f"{x:.5f}" for x in p * 1e3]
                )
    return path


def fixed_tables(folder: Path) -> None:
    """sensor poses, cold, warm (two cycles of six poses), check, and a history of twelve cycles."""
    q = postures(20)
    measuring = {f"p{i}": q[i] for i in range(6)}
    unseen = {f"c{i}": q[i] for i in range(6, 20)}
    cold = {f"cold{i}": built() for i in range(3)}
    warm = {"early": drifted(1.0), "late": drifted(2.0)}
    visits(folder / "sensor.csv", {"set-up": built()}, measuring | unseen)
    visits(folder / "cold.csv", cold, measuring | unseen, 1)
    visits(folder / "warm.csv", warm, measuring, 2)
    visits(folder / "check.csv", warm, unseen, 3)
    history = {f"{i}": drifted(0.15 * i) for i in range(12)}
    visits(folder / "history.csv", history, measuring, 4)
    shift = {f"{i}": drifted(2.0 - 2.0 * 0.9**i) for i in range(30)}
    told = {name: q for name, q in (measuring | unseen).items() if name not in JUDGES}
    visits(folder / "shift.csv", shift, told, 5)
    visits(folder / "judges.csv", shift, {name: unseen[name] for name in JUDGES}, 6)


def session(path: Path, count: int, seed: int) -> Path:
    """A measuring robot's table: sphere centres in the sensor on the flange."""
    rng, arm = np.random.default_rng(seed), built()
    X = frames.transform(frames.exp_rotation([0.1, -0.4, 0.8]), [0.08, -0.05, 0.22])
    centres = {"a": np.array([1.6, 0.2, 0.6]), "b": np.array([1.2, -0.8, 0.9])}
    reach = np.radians([60.0, 25.0, 30.0, 150.0, 60.0, 170.0])
    q = np.radians([0, -70, 110, 0, -40, 0]) + reach * rng.uniform(-1.0, 1.0, (count, 6))
    T = frames.invert(arm.fk(q) @ X)
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["target", *HEADER[3:]])
        for i in range(count):
            name = "ab"[i % 2]
            p = T[i, :3, :3] @ centres[name] + T[i, :3, 3] + SIGMA * rng.standard_normal(3)
            degrees = [f"{x:.7f}" for x in np.degrees(q[i])]
            writer.writerow([name, *degrees, *(f"{x:.5f}" for x in p * 1e3)])
    return path
