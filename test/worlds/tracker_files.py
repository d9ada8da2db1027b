"""Files of a simulated calibration by laser tracker, in the folder `SCAN` and beside it."""

from pathlib import Path

import numpy as np
import yaml

from bench.laser_tracker import TrackerCell
from robocal_ros.hand_eye.files import SPHERE, write_pose_table, write_profile
from robocal_ros.hand_eye.targets import TrackerTarget
from robocal_ros.hand_eye.tracker_data import FACES, TrackerData
from robocal_ros.kinematics.tables import POSITION, joint_texts, texts, write_cells

SCAN = "scan"


def tracker_files(folder: Path, cell: TrackerCell) -> TrackerData:
    """What was measured, written: scan_poses.csv, tracker.csv, tracker_target.yaml, profiles."""
    data = cell.measure(np.random.default_rng(4))
    (folder / SCAN).mkdir()
    files = [f"{profile.name}.csv" for profile in data.profiles]
    for file, profile in zip(files, data.profiles, strict=True):
        write_profile(folder / SCAN / file, profile.points)
    write_pose_table(
        folder / "scan_poses.csv", data.arm.fk(data.q), files, joints=(data.arm, data.q)
    )
    write_tracker_points(folder / "tracker.csv", data)
    write_tracker_target(folder / "tracker_target.yaml", cell.sizes.target)
    return data


def write_tracker_points(path: Path, data: TrackerData) -> None:
    """Write the tracker's table in millimetres and degrees.

    Raises `InputError` when it cannot be written.
    """
    parts = [(arc.name, arc.points) for arc in data.arcs]
    parts += [(SPHERE, data.sphere), *zip(FACES, data.faces, strict=True)]
    columns = {"role": [role for role, points in parts for _ in points]}
    points = np.concatenate([points for _, points in parts])
    columns |= dict(zip(POSITION["mm"], map(texts, points.T * 1e3), strict=True))
    joints = joint_texts(np.concatenate([arc.q for arc in data.arcs]), data.arm)
    rest = [""] * (len(points) - sum(len(arc.q) for arc in data.arcs))
    write_cells(path, columns | {name: [*cells, *rest] for name, cells in joints.items()})


def write_tracker_target(path: Path, target: TrackerTarget) -> None:
    """Write a target file. Raises `InputError` when it cannot be written."""
    document: dict[str, str | float] = {
        "kind": "tracker",
        "sphere_radius_mm": target.sphere_radius_m * 1e3,
        "reflector_radius_mm": target.reflector_radius_m * 1e3,
    }
    if target.height_m is not None:
        document["height_mm"] = target.height_m * 1e3
        document["height_sigma_mm"] = target.height_sigma_m * 1e3
    path.write_text(yaml.safe_dump(document, sort_keys=False))
