"""Target files of a hand-eye calibration: YAML, in millimetres and degrees.

The contract is written in docs/hand_eye.md and, of a board, hand_eye_node.md.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.cells import Cells, read_cells, texts, write_cells
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import nearest, quoted, write_text
from robocal_ros.ground.frames import transform_document
from robocal_ros.hand_eye.board import FEWEST_CORNERS
from robocal_ros.hand_eye.targets import (
    MACHINING_M,
    BoardTarget,
    CornerKind,
    FirstStep,
    LineTarget,
    SphereTarget,
    Staircase,
    StepTarget,
)
from robocal_ros.hand_eye.tracker_data import FACES, Arc, TrackerData, TrackerTarget
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import Fields, read_fields, read_pose
from robocal_ros.kinematics.tables import POSITION, TableLayout, joint_texts, read_layout

Array = NDArray[np.float64]
Target = SphereTarget | StepTarget | LineTarget

KINDS = ("sphere", "step", "line", "board")
CORNERS: dict[str, CornerKind] = {"convex": "convex", "concave": "concave", "both": "both"}
FIRST: dict[str, FirstStep] = {"lowest": "lowest", "highest": "highest"}
SMALLEST_MM, LARGEST_MM = 1.0, 1000.0  # of a sphere's radius
FARTHEST_MM = 20e3  # of a target from the base
ROUNDING = 1e-3  # of the axes of a frame, from unit vectors at right angles
MOST_STEPS = 100
MOST_CORNERS = 100  # along a side of a board


def read_target(path: Path) -> Target | BoardTarget:
    """Read a target file.

    Raises
    ------
    InputError
        Naming file and key, when it is not as its contract says.
    """
    top = read_fields(path, "target file")
    kind = top.choice("kind", KINDS)
    if kind == "sphere":
        return _sphere(top)
    if kind == "board":
        return _board(top, path.parent)
    return _step(top) if kind == "step" else _line(top)


def _sphere(top: Fields) -> SphereTarget:
    top.only("kind", "radius_mm")
    radius_mm = top.number("radius_mm")
    if not SMALLEST_MM <= radius_mm <= LARGEST_MM:
        top.fail(
            f"is {radius_mm:g}; it must be {SMALLEST_MM:g} to {LARGEST_MM:g}: is it off by a "
            "thousand?",
            "radius_mm",
        )
    return SphereTarget(radius_mm * 1e-3)


def _board(top: Fields, folder: Path) -> BoardTarget:
    from robocal_ros.hand_eye.board import read_intrinsics

    top.only("kind", "columns", "rows", "square_mm", "intrinsics")
    columns, rows = (top.whole(key, FEWEST_CORNERS, MOST_CORNERS) for key in ("columns", "rows"))
    square_m = top.positive("square_mm") * 1e-3
    if "intrinsics" not in top.values:
        return BoardTarget(columns, rows, square_m)
    camera = read_intrinsics(folder / top.text("intrinsics"))
    size = np.array(camera.size, dtype=np.float64)
    return BoardTarget(columns, rows, square_m, camera.matrix, camera.distortion, size)


def _line(top: Fields) -> LineTarget:
    top.only("kind", "point_mm", "direction")
    point_mm = np.array(top.numbers("point_mm", 3))
    _check_near(top, "point_mm", point_mm)
    return LineTarget(point_mm * 1e-3, _direction(top, "direction"))


def _step(top: Fields) -> StepTarget:
    top.only(
        "kind", "T_base_user", "staircase", "corners_mm", "edge_user",
        "sigma_mm", "user_sigma_mm", "user_sigma_deg",
    )  # fmt: skip
    if ("staircase" in top.values) == ("corners_mm" in top.values):
        top.fail("must give either staircase, or corners_mm with edge_user")
    if "staircase" in top.values:
        if "edge_user" in top.values:
            top.fail("is x for a staircase: leave it out", "edge_user")
        staircase = _staircase(top.below("staircase"))
        corners, edge = staircase.marked_corners(), staircase.edge_user
    else:
        corners, edge = _corners(top.below("corners_mm")), _direction(top, "edge_user")
    return StepTarget(
        T_base_user=_frame(top.below("T_base_user")),
        corners=corners,
        edge_user=edge,
        sigma_m=top.positive("sigma_mm", MACHINING_M * 1e3) * 1e-3,
        user_sigma_m=_sigma(top, "user_sigma_mm") * 1e-3,
        user_sigma_rad=float(np.radians(_sigma(top, "user_sigma_deg"))),
    )


def _staircase(fields: Fields) -> Staircase:
    lengths = ("length_mm", "height_mm", "depth_mm")
    fields.only("steps", *lengths, "corners", "first")
    steps = fields.whole("steps", 1, MOST_STEPS)
    length, height, depth = (fields.positive(key) * 1e-3 for key in lengths)
    corners = CORNERS[fields.choice("corners", tuple(CORNERS), "convex")]
    if corners == "concave" and steps < 2:
        fields.fail("is 1; only between two steps there is a concave corner", "steps")
    first = FIRST[fields.choice("first", tuple(FIRST), "lowest")]
    return Staircase(steps, length, height, depth, corners, first)


def _corners(fields: Fields) -> dict[str, Array]:
    if not fields.values:
        fields.fail("must name at least one mark")
    corners = {}
    for mark, rows in fields.values.items():
        if not isinstance(mark, str) or not mark.strip():
            fields.fail("is no name of a mark: give a word", str(mark))
        if not isinstance(rows, list) or not rows:
            fields.fail("must be a list of corners [x, y, z]", mark)
        corners[mark] = 1e-3 * _points(rows, "corner", fields, mark)
    return corners


def _frame(fields: Fields) -> Array:
    """Transform (4, 4), m, of ``{xyz_mm, quat_xyzw or rpy_deg or rotation}``."""
    if "rotation" in fields.values:
        fields.only("xyz_mm", "rotation")
        T = frames.transform(_rotation(fields), np.array(fields.numbers("xyz_mm", 3)) * 1e-3)
    else:
        if not {"quat_xyzw", "rpy_deg"} & set(fields.values):
            fields.fail("needs an orientation: quat_xyzw, rpy_deg or rotation")
        T = read_pose(fields)
    _check_near(fields, "xyz_mm", T[:3, 3] * 1e3)
    return T


def _rotation(fields: Fields) -> Array:
    rows = fields.values["rotation"]
    if not isinstance(rows, list) or len(rows) != 3:
        fields.fail("must be a list of 3 rows of a matrix", "rotation")
    R = _points(rows, "row", fields, "rotation")
    error = float(np.abs(R.T @ R - np.eye(3)).max())
    if error > ROUNDING:
        fields.fail(
            f"has columns that are not unit vectors at right angles (off by {error:.3g})",
            "rotation",
        )
    if np.linalg.det(R) < 0.0:
        fields.fail("is left-handed: its third column must be first x second", "rotation")
    return frames.nearest_rotation(R)


def _points(rows: list[Any], name: str, fields: Fields, key: str) -> Array:
    """A list of points (n, 3); ``name`` is what one of them is called."""
    values = {f"{name} {i}": row for i, row in enumerate(rows, start=1)}
    numbered = Fields(values, fields.file, f"{fields.place}, {key}")
    return np.array([numbered.numbers(key, 3) for key in values])


def _direction(fields: Fields, key: str) -> Array:
    vector = np.array(fields.numbers(key, 3))
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        fields.fail("has no length", key)
    return vector / length


def _sigma(fields: Fields, key: str) -> float:
    value = fields.number(key)
    if value < 0.0:
        fields.fail(f"is {value:g}; it must not be below 0", key)
    return value


def _check_near(fields: Fields, key: str, point_mm: Array) -> None:
    distance = float(np.linalg.norm(point_mm))
    if distance > FARTHEST_MM:
        fields.fail(
            f"is {distance:.4g} mm from the base: is it a thousand times too far, in µm?", key
        )


def write_target(path: Path, target: Target) -> None:
    """Write a target file, corners in full; the file appears whole or not at all.

    Raises
    ------
    InputError
        When it cannot be written.
    """
    text = yaml.safe_dump(_document(target), sort_keys=False, default_flow_style=None, width=2**16)
    write_text(path, text)


def _document(target: Target) -> dict[str, Any]:
    if isinstance(target, SphereTarget):
        return {"kind": "sphere", "radius_mm": target.radius_m * 1e3}
    if isinstance(target, LineTarget):
        return {
            "kind": "line",
            "point_mm": (target.point_base * 1e3).tolist(),
            "direction": target.direction_base.tolist(),
        }
    return {
        "kind": "step",
        "T_base_user": transform_document(target.T_base_user),
        "corners_mm": {mark: (rows * 1e3).tolist() for mark, rows in target.corners.items()},
        "edge_user": target.edge_user.tolist(),
        "sigma_mm": target.sigma_m * 1e3,
        "user_sigma_mm": target.user_sigma_m * 1e3,
        "user_sigma_deg": float(np.degrees(target.user_sigma_rad)),
    }


# ---- tracker tables -----------------------------------------------------------------------------
#
# The contract is written in docs/hand_eye_tracker.md.


ARCS = ("arc_a", "arc_b")
SPHERE = "sphere"
ROLES = (*ARCS, SPHERE, *FACES)
BESIDE = ("sample", "stamp_s")  # for the user's own record
FARTHEST_REFLECTOR_MM = 1e3  # of the reflector from the flange's origin
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
    if abs(height_mm) > FARTHEST_REFLECTOR_MM:
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
