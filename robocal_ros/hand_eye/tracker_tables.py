"""Files of a hand-eye calibration by laser tracker: its points, and the sizes of its target.

The contract is written in docs/hand_eye_tracker.md.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from robocal_ros.ground.cells import Cells, read_cells, texts, write_cells
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import nearest, quoted, write_text
from robocal_ros.hand_eye.target_files import LARGEST_MM, SMALLEST_MM
from robocal_ros.hand_eye.tracker_data import FACES, Arc, TrackerData, TrackerTarget
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import Fields, read_fields
from robocal_ros.kinematics.tables import POSITION, TableLayout, joint_texts, read_layout

Array = NDArray[np.float64]

ARCS = ("arc_a", "arc_b")
SPHERE = "sphere"
ROLES = (*ARCS, SPHERE, *FACES)
BESIDE = ("sample", "stamp_s")  # for the user's own record
FARTHEST_MM = 1e3  # of the reflector from the flange's origin
KIND = "tracker"


@dataclass(frozen=True, eq=False)
class TrackerPoints:
    """Points of a laser tracker, m; see `TrackerData`."""

    arcs: tuple[Arc, Arc]
    sphere: Array
    faces: tuple[Array, Array]


def read_tracker_points(path: Path, arm: SerialArm) -> TrackerPoints:
    """Read the tracker's table; the joints of points that are not on an arc may be empty.

    Raises
    ------
    InputError
        With file, row and column, when the table is not as docs/hand_eye_tracker.md says.
    """
    found: list[TableLayout] = []
    table = read_cells(path, lambda header, file: found.append(_layout(header, arm, file)))
    layout = found[0]
    roles = np.array(table.words("role"))
    for index, role in enumerate(roles.tolist()):
        if role not in ROLES:
            message = f"{quoted(role)} is not one of {', '.join(ROLES)}{nearest(role, ROLES)}"
            table.fail(message, index, "role")
    missing = [role for role in ROLES if role not in roles]
    if missing:
        raise InputError(f"no point has the role {', '.join(missing)}", file=table.file)
    points = np.column_stack([table.numbers(name) for name in layout.position])
    points = points * layout.position_factor
    q = _joints(table, layout, np.isin(roles, ARCS))
    first, second = (Arc(role, q[roles == role], points[roles == role]) for role in ARCS)
    faces = (points[roles == FACES[0]], points[roles == FACES[1]])
    return TrackerPoints((first, second), points[roles == SPHERE], faces)


def _layout(header: list[str], arm: SerialArm, file: str) -> TableLayout:
    names = [name.strip() for name in header]
    if names.count("role") != 1:
        raise InputError(
            f"column role must be there once: it says what a point is of ({', '.join(ROLES)})",
            file=file,
            row=1,
        )
    layout = read_layout([name for name in names if name != "role"], arm, file)
    for name in layout.place:
        if name not in (*layout.joints, *layout.position, *BESIDE):
            raise InputError("unknown column", file=file, row=1, column=name)
    return layout


def _joints(table: Cells, layout: TableLayout, on_arc: NDArray[np.bool_]) -> Array:
    q = np.column_stack([table.numbers(name, gaps=True) for name in layout.joints])
    for joint, name in enumerate(layout.joints):
        empty = np.flatnonzero(on_arc & np.isnan(q[:, joint]))
        if len(empty):
            table.fail("the cell is empty; a point of an arc needs all joints", int(empty[0]), name)
    return q * layout.joint_factors


def write_tracker_points(path: Path, data: TrackerData) -> None:
    """Write the tracker's table in millimetres and degrees.

    Raises
    ------
    InputError
        When it cannot be written.
    """
    parts = [(arc.name, arc.points) for arc in data.arcs]
    parts += [(SPHERE, data.sphere), *zip(FACES, data.faces, strict=True)]
    columns = {"role": [role for role, points in parts for _ in points]}
    points = np.concatenate([points for _, points in parts])
    columns |= dict(zip(POSITION["mm"], map(texts, points.T * 1e3), strict=True))
    joints = joint_texts(np.concatenate([arc.q for arc in data.arcs]), data.arm)
    rest = [""] * (len(points) - sum(len(arc.q) for arc in data.arcs))
    write_cells(path, columns | {name: [*cells, *rest] for name, cells in joints.items()})


def read_tracker_target(path: Path) -> TrackerTarget:
    """Read the target file of a calibration by laser tracker.

    Raises
    ------
    InputError
        Naming file and key, when it is not as docs/hand_eye_tracker.md says.
    """
    top = read_fields(path, "target file")
    top.only("kind", "sphere_radius_mm", "reflector_radius_mm", "height_mm", "height_sigma_mm")
    top.choice("kind", (KIND,))
    target = TrackerTarget(_radius(top, "sphere_radius_mm"), _radius(top, "reflector_radius_mm"))
    if "height_mm" not in top.values:
        if "height_sigma_mm" in top.values:
            top.fail("is given without height_mm", "height_sigma_mm")
        return target
    height_mm = top.number("height_mm")
    if abs(height_mm) > FARTHEST_MM:
        top.fail(f"is {height_mm:g}; the reflector is on the flange: is it in µm?", "height_mm")
    sigma_mm = top.positive("height_sigma_mm", target.height_sigma_m * 1e3)
    return TrackerTarget(
        target.sphere_radius_m, target.reflector_radius_m, height_mm * 1e-3, sigma_mm * 1e-3
    )


def _radius(top: Fields, key: str) -> float:
    radius_mm = top.number(key)
    if not SMALLEST_MM <= radius_mm <= LARGEST_MM:
        top.fail(
            f"is {radius_mm:g}; it must be {SMALLEST_MM:g} to {LARGEST_MM:g}: is it off by a "
            "thousand?",
            key,
        )
    return radius_mm * 1e-3


def write_tracker_target(path: Path, target: TrackerTarget) -> None:
    """Write a target file.

    Raises
    ------
    InputError
        When it cannot be written.
    """
    document: dict[str, object] = {
        "kind": KIND,
        "sphere_radius_mm": target.sphere_radius_m * 1e3,
        "reflector_radius_mm": target.reflector_radius_m * 1e3,
    }
    if target.height_m is not None:
        document["height_mm"] = target.height_m * 1e3
        document["height_sigma_mm"] = target.height_sigma_m * 1e3
    write_text(path, yaml.safe_dump(document, sort_keys=False))
