# SPDX-License-Identifier: Apache-2.0
"""Files of a hand-eye calibration, written: shots and profiles, targets, a laser tracker's points.

What the commands read, made for bench, bags and tests; what cannot be written raises `InputError`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from robocal_ros.ground.files import write_text
from robocal_ros.ground.frames import Document, transform_document
from robocal_ros.hand_eye.files import PROFILE, write_pose_table
from robocal_ros.hand_eye.targets import (
    FACES,
    KIND_OF,
    SPHERE,
    LaserTarget,
    LineTarget,
    SphereTarget,
    TrackerTarget,
)
from robocal_ros.hand_eye.tracker_data import TrackerData
from robocal_ros.kinematics.tables import POSITION, joint_texts, texts, write_cells

Array = NDArray[np.float64]


def write_profile(path: Path, points: Array) -> None:
    """Write a profile (n, 2), m; what is not-a-number becomes an empty cell."""
    seen = np.all(np.isfinite(points), axis=1)
    columns = {}
    for axis, column in enumerate(PROFILE):
        cells = zip(texts(points[:, axis] * 1e3), seen, strict=True)
        columns[column] = [cell if there else "" for cell, there in cells]
    write_cells(path, columns)


def write_shots(
    path: Path, folder: Path, T_base_flange: Array, profiles: Mapping[str, Array], **more: Any
) -> None:
    """Write a table of shots and, into ``folder``, the profile of each by the name of its shot.

    ``more`` as in `write_pose_table`.
    """
    files = [f"{name}.csv" for name in profiles]
    for file, points in zip(files, profiles.values(), strict=True):
        write_profile(folder / file, points)
    write_pose_table(path, T_base_flange, files, names=tuple(profiles), **more)


def write_target(path: Path, target: LaserTarget) -> None:
    """Write a target file, corners in full; the file appears whole or not at all."""
    document: Document = {"kind": KIND_OF[type(target)]}
    if isinstance(target, SphereTarget):
        document["radius_mm"] = target.radius_m * 1e3
    elif isinstance(target, LineTarget):
        document["point_mm"] = (target.point_base * 1e3).tolist()
        document["direction"] = target.direction_base.tolist()
    else:
        marks = target.corners.items()
        document |= {
            "T_base_user": transform_document(target.T_base_user),
            "corners_mm": {mark: (rows * 1e3).tolist() for mark, rows in marks},
            "edge_user": target.edge_user.tolist(),
            "sigma_mm": target.sigma_m * 1e3,
            "user_sigma_mm": target.user_sigma_m * 1e3,
            "user_sigma_deg": float(np.degrees(target.user_sigma_rad)),
        }
        if target.convex is not None:
            document["convex"] = [bool(one) for one in target.convex]
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=2**16)
    write_text(path, text)


def write_tracker_points(path: Path, data: TrackerData) -> None:
    """Write the tracker's table in millimetres and degrees."""
    parts = [(arc.name, arc.points) for arc in data.arcs]
    parts += [(SPHERE, data.sphere), *zip(FACES, data.faces, strict=True)]
    columns = {"role": [role for role, points in parts for _ in points]}
    points = np.concatenate([points for _, points in parts])
    columns |= dict(zip(POSITION["mm"], map(texts, points.T * 1e3), strict=True))
    joints = joint_texts(np.concatenate([arc.q for arc in data.arcs]), data.arm)
    rest = [""] * (len(points) - sum(len(arc.q) for arc in data.arcs))
    write_cells(path, columns | {name: [*cells, *rest] for name, cells in joints.items()})


def write_tracker_target(path: Path, target: TrackerTarget) -> None:
    """Write a target file."""
    document: Document = {
        "kind": "tracker",
        "sphere_radius_mm": target.sphere_radius_m * 1e3,
        "reflector_radius_mm": target.reflector_radius_m * 1e3,
    }
    if target.height_m is not None:
        document["height_mm"] = target.height_m * 1e3
        document["height_sigma_mm"] = target.height_sigma_m * 1e3
    write_text(path, yaml.safe_dump(document, sort_keys=False))
