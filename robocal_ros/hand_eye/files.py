# SPDX-License-Identifier: Apache-2.0
"""Files of a hand-eye calibration: tables of shots and profiles, of a laser tracker, and mounts.

The contracts are written in docs/hand_eye.md and docs/hand_eye_tracker.md. A mount is what
``robocal hand-eye`` prints, or a rough place by hand,

    T_flange_sensor: {xyz_mm: [60, -40, 110], rpy_deg: [0, 0, 45]}

in YAML or JSON, with ``quat_xyzw`` or ``rpy_deg`` (about the fixed x, y, z).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Literal, NoReturn
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError, TooFewSamplesError
from robocal_ros.ground.files import nearest, quoted, read_bytes
from robocal_ros.ground.frames import Array, fixed, urdf_joint, urdf_origin
from robocal_ros.hand_eye.boards import Image, decode_image
from robocal_ros.hand_eye.linearity import SensorLinearity
from robocal_ros.hand_eye.profiles import (
    CLOUDS,
    DEFAULT,
    Profile,
    SensorDescription,
    columns_profile,
    file_profile,
)
from robocal_ros.hand_eye.targets import ARCS, FACES, ROLES, SPHERE
from robocal_ros.hand_eye.tracker_data import Arc
from robocal_ros.history.history_records import why_void
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_errors import ShotJoints
from robocal_ros.kinematics.robots import read_fields, read_pose
from robocal_ros.kinematics.tables import (
    POSITION,
    QUATERNION,
    Cells,
    TableLayout,
    check_plain,
    flange_unit_fault,
    joint_texts,
    read_cells,
    read_layout,
    read_pose_columns,
    read_rotations,
    read_samples,
    read_stamps,
    require_different,
    stamp_texts,
    texts,
    write_cells,
)

Parent = Literal["flange", "base"]
Format = Literal["urdf", "xacro", "yaml", "static-transform"]

PROFILE = ("x_mm", "z_mm")
FILE_COLUMNS = ("profile", "image")
BESIDE = ("sample", "stamp_s")  # for the user's own record
FARTHEST_M = {"flange": 3.0, "base": 20.0}  # of a sensor from its parent


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Shots: where the flange stood, and the file that each of them gave.

    ``names`` (m,) of the shots; where the table gives none the file's name, or the row's number.
    ``T_base_flange`` (m, 4, 4), m.
    ``files`` (m,) relative to the folder of the shots; none where no such column was asked for.
    ``joints``: that were read; None without them, or where no arm is known.
    ``stamp_ns`` (m,); None without a column.
    ``mark`` (m,) of the target, through which the laser plane was laid; None without a column.
    ``path``, ``rows``, ``column``: the table's file, the row of each shot there, the column of
    ``files``.
    ``named``: whether the table has a column ``sample``.
    """

    names: tuple[str, ...]
    T_base_flange: Array
    files: tuple[str, ...]
    joints: ShotJoints | None
    stamp_ns: NDArray[np.int64] | None
    mark: tuple[str, ...] | None
    path: str
    rows: tuple[int, ...]
    column: str
    named: bool = False

    def __len__(self) -> int:
        return len(self.names)

    def fail(self, index: int, message: str) -> NoReturn:
        """Refuse the file of a shot. Always raises `InputError`."""
        raise InputError(message, file=self.path, row=self.rows[index], column=self.column)

    def files_in(self, folder: Path) -> list[Path]:
        """Paths (m,) of the files. Raises `InputError` at the first that does not exist."""
        if not folder.is_dir():
            raise InputError("no such folder", file=str(folder))
        paths = [folder / file for file in self.files]
        for index, path in enumerate(paths):
            if not path.is_file():
                self.fail(index, f"there is no file {quoted(self.files[index])} in {folder}")
        return paths


def read_pose_table(
    path: Path, arm: SerialArm | None = None, file_column: str | None = "profile"
) -> PoseTable:
    """Read the table of shots; without ``file_column`` one of poses alone.

    Without flange poses they are those of ``arm`` at its joint readings. Joint readings beside
    poses are kept where ``arm`` is known.

    Raises `InputError`, with file, row and column, when the table is not as its contract says.
    """
    found: list[TableLayout] = []
    words = ("sample", "stamp_s", "mark", *((file_column,) if file_column else FILE_COLUMNS))

    def check(header: list[str], file: str) -> None:
        found.append(read_pose_columns(header, arm, file, words))
        if file_column and file_column not in found[0].place:
            raise InputError(
                f"column {file_column} is missing: it names each shot's file", file=file, row=1
            )

    table = read_cells(path, check)
    layout = found[0]
    files = _files(table, file_column) if file_column else ()
    T_base_flange, q = _poses(table, layout, arm)
    return PoseTable(
        names=read_samples(table, files or tuple(map(str, table.rows))),
        T_base_flange=T_base_flange,
        files=files,
        joints=None if q is None or arm is None else ShotJoints(arm, q),
        stamp_ns=read_stamps(table) if "stamp_s" in layout.place else None,
        mark=table.words("mark") or None,
        path=table.file,
        rows=table.rows,
        column=file_column or "",
        named="sample" in table.columns,
    )


def _files(table: Cells, column: str) -> tuple[str, ...]:
    files = table.words(column)
    for index, file in enumerate(files):
        path = PurePath(file)
        if path.is_absolute() or ".." in path.parts or not file.isprintable():
            table.fail(
                f"{quoted(file)} is not inside the folder of the shots: give a path in it",
                index,
                column,
            )
    require_different(table, column)
    return files


def _poses(table: Cells, layout: TableLayout, arm: SerialArm | None) -> tuple[Array, Array | None]:
    """Where the flange was (m, 4, 4), m, and the joints (m, n); None where the table has none."""
    q = None
    if layout.joints:
        q = np.column_stack([table.numbers(name) for name in layout.joints]) * layout.joint_factors
    if layout.orientation is None:
        if arm is None or q is None:
            raise ValueError("a layout without poses has joints")
        return arm.fk(q), q
    columns = layout.position
    position = np.column_stack([table.numbers(name) for name in columns])
    position *= layout.position_factor
    fault = flange_unit_fault(position, "mm" if columns == POSITION["mm"] else "m")
    if fault is not None:
        index, words = fault
        table.fail(words, index, columns[int(np.argmax(np.abs(position[index])))])
    return frames.transform(read_rotations(table, layout.orientation), position), q


@dataclass(frozen=True, eq=False)
class ScannedPoints:
    """Marked points that the sensor saw: ``point`` (m,) names, ``points`` (m, 2) x and z, m.

    ``T_base_flange`` (m, 4, 4): where the flange was.
    """

    point: tuple[str, ...]
    points: Array
    T_base_flange: Array


SCANNED = ("point", "sensor_x_mm", "sensor_z_mm")


def read_scanned_points(path: Path, arm: SerialArm | None = None) -> ScannedPoints:
    """Read a table of marked points, each row a pose and where the sensor saw the point then.

    Raises `InputError` as `read_pose_table`.
    """
    found: list[TableLayout] = []

    def check(header: list[str], file: str) -> None:
        found.append(read_pose_columns(header, arm, file, ("sample", "stamp_s", *SCANNED)))
        if missing := [name for name in SCANNED if name not in found[0].place]:
            raise InputError(f"column {', '.join(missing)} is missing", file=file, row=1)

    table = read_cells(path, check)
    points = 1e-3 * np.column_stack([table.numbers(name) for name in SCANNED[1:]])
    return ScannedPoints(table.words("point"), points, _poses(table, found[0], arm)[0])


def read_touched_points(path: Path) -> dict[str, Array]:
    """Places (3,) in base, m, of touched points by name."""
    columns = ("point", *POSITION["mm"])
    table = read_cells(path, lambda header, file: check_plain(header, file, columns))
    require_different(table, "point")
    places = 1e-3 * np.column_stack([table.numbers(name) for name in columns[1:]])
    return dict(zip(table.words("point"), places, strict=True))


def read_profile(path: Path, name: str, sensor: SensorDescription = DEFAULT) -> Profile:
    """Read a profile; rows without a return (an empty cell, or nan) are left out.

    Raises `InputError`, with file, row and column, when it is no table of ``x_mm`` and ``z_mm``, or
    is in another unit; as `file_profile` where the sensor tells other columns, and for clouds;
    `TooFewSamplesError` when nearly nothing was seen.
    """
    if sensor.tells_columns or path.suffix.lower() in CLOUDS:
        return file_profile(path, sensor, name)
    lines = [line for line in read_bytes(path, "profile").splitlines() if line.strip()]
    if len(lines) < 2:
        raise TooFewSamplesError(f"profile {name} is empty ({path})")
    table = read_cells(path, lambda header, file: check_plain(header, file, PROFILE))
    x, z = (table.numbers(column, gaps=True) for column in PROFILE)
    try:
        return columns_profile({"x": x, "z": z}, 0, sensor, 1e-3, name)
    except InputError as error:
        raise InputError(str(error), file=str(path)) from error


def read_profiles(
    folder: Path, table: PoseTable, sensor: SensorDescription = DEFAULT
) -> list[Profile | TooFewSamplesError]:
    """Profiles (m,) of the shots; for one that shows next to nothing the reason."""
    profiles: list[Profile | TooFewSamplesError] = []
    for path, name in zip(table.files_in(folder), table.names, strict=True):
        try:
            profiles.append(read_profile(path, name, sensor))
        except TooFewSamplesError as error:
            profiles.append(error)
    return profiles


def write_pose_table(
    path: Path,
    T_base_flange: Array,
    files: Sequence[str] | None = None,
    *,
    file_column: str = "profile",
    names: Sequence[str] | None = None,
    joints: tuple[SerialArm, Array] | None = None,
    stamp_ns: NDArray[np.int64] | None = None,
    mark: Sequence[str] | None = None,
) -> None:
    """Write a table of shots in millimetres and quaternions, ``joints`` (q (m, n)) beside them."""
    columns: dict[str, list[str]] = {}
    if names is not None:
        columns["sample"] = list(names)
    if files is not None:
        columns[file_column] = list(files)
    if mark is not None:
        columns["mark"] = list(mark)
    if stamp_ns is not None:
        columns["stamp_s"] = stamp_texts(stamp_ns)
    if joints is not None:
        columns |= joint_texts(joints[1], joints[0])
    columns |= dict(zip(POSITION["mm"], map(texts, T_base_flange[:, :3, 3].T * 1e3), strict=True))
    columns |= dict(zip(QUATERNION, map(texts, frames.quat_xyzw(T_base_flange).T), strict=True))
    write_cells(path, columns)


def read_tracker_points(
    path: Path, arm: SerialArm
) -> tuple[tuple[Arc, Arc], Array, tuple[Array, Array]]:
    """Arcs, points of the sphere and of both faces, m, of `TrackerData`, from the tracker's table.

    The joints of points that are not on an arc may be empty.

    Raises `InputError`, with file, row and column, when the table is not as
    docs/hand_eye_tracker.md says.
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
    return (first, second), points[roles == SPHERE], faces


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


@dataclass(frozen=True, eq=False)
class SensorMount:
    """Where a sensor sits: ``T_parent_sensor`` (4, 4), m, on the flange or beside the robot.

    ``linearity``: of a line laser, where it was found with that.
    """

    parent: Parent
    T_parent_sensor: Array
    linearity: SensorLinearity | None = None


def read_mount(path: Path, *, accepted: bool = False) -> SensorMount:
    """Read a sensor's place.

    ``accepted``: refuse a result whose verdict does not accept it, or that is void
    (`why_void`).

    Raises `InputError`, naming file and key, when the place is missing, given twice or no pose.
    """
    top = read_fields(path, "mount file")
    if "document" in top.values:  # as the history shows it
        if accepted and (words := why_void(top.values)):
            top.fail(words, "calibration")
        top = top.below("document")
    if "error" in top.values:
        top.fail("tells why no sensor was placed: calibrate again", "error")
    if accepted and "verdict" in top.values:
        verdict = top.below("verdict")
        accept, code = verdict.values.get("accept"), verdict.text("code")
        if accept is not True or code != Code.ACCEPT.name:
            words = f"has accept {str(accept).lower()} and code {code}: this place was not accepted"
            top.fail(words, "verdict")
    found = [parent for parent in FARTHEST_M if f"T_{parent}_sensor" in top.values]
    if len(found) != 1:
        top.fail("must give the sensor's place: either T_flange_sensor or T_base_sensor")
    parent: Parent = "base" if found[0] == "base" else "flange"
    fields = top.below(f"T_{parent}_sensor")
    if not {"quat_xyzw", "rpy_deg"} & set(fields.values):
        fields.fail("needs an orientation: quat_xyzw or rpy_deg")
    T = read_pose(fields)
    far_m = float(np.linalg.norm(T[:3, 3]))
    if far_m > FARTHEST_M[parent]:
        fields.fail(f"is {far_m:.4g} m away: is it a thousand times too far?", "xyz_mm")
    linearity = None
    if top.values.get("linearity") is not None:
        try:
            linearity = SensorLinearity.of_document(top.values["linearity"])
        except (KeyError, TypeError, ValueError):
            top.fail("is no linearity as results have it", "linearity")
    return SensorMount(parent, T, linearity)


def read_flange_mount(path: Path) -> SensorMount:
    """Read the place of a sensor on the flange.

    Raises `InputError` as `read_mount`, and for a sensor that does not sit on the flange.
    """
    mount = read_mount(path)
    if mount.parent != "flange":
        raise InputError(
            f"T_{mount.parent}_sensor is of a sensor beside the robot; a line laser sits on the "
            "flange: give T_flange_sensor",
            file=str(path),
        )
    return mount


def exported(T_parent_sensor: Array, parent: str, child: str, format: Format) -> str:
    """Text of a sensor's pose (4, 4), m, below its parent, with 1e-4 mm and 1e-6 deg.

    ``xacro``: properties, so that another calibration changes two lines only; ``yaml``: the fields
    of a geometry_msgs/TransformStamped; ``static-transform``: the command that publishes it.

    Raises `InputError` when a frame's name is empty or needs quoting.
    """
    for name in (parent, child):
        if not name or quoteattr(name) != f'"{name}"' or any(c in name for c in " :#{}\n"):
            raise InputError(f"'{name}' is no name of a frame: letters, digits, _ and / are")
    xyz, rpy = urdf_origin(T_parent_sensor)
    if format == "urdf":
        return urdf_joint(parent, child, xyz, rpy)
    if format == "xacro":
        name = "".join(c if c.isalnum() else "_" for c in child)
        return (
            f'<xacro:property name="{name}_xyz" value="{xyz}"/>\n'
            f'<xacro:property name="{name}_rpy" value="{rpy}"/>\n'
            + urdf_joint(parent, child, f"${{{name}_xyz}}", f"${{{name}_rpy}}")
        )
    x, y, z = fixed(T_parent_sensor[:3, 3], 7)
    qx, qy, qz, qw = fixed(frames.quat_xyzw(T_parent_sensor), 10)
    if format == "yaml":
        return (
            f"header: {{frame_id: {parent}}}\n"
            f"child_frame_id: {child}\n"
            "transform:\n"
            f"  translation: {{x: {x}, y: {y}, z: {z}}}\n"
            f"  rotation: {{x: {qx}, y: {qy}, z: {qz}, w: {qw}}}"
        )
    return (
        f"ros2 run tf2_ros static_transform_publisher --x {x} --y {y} --z {z} "
        f"--qx {qx} --qy {qy} --qz {qz} --qw {qw} --frame-id {parent} --child-frame-id {child}"
    )


def read_images(folder: Path, table: PoseTable) -> tuple[list[tuple[str, Image]], dict[str, str]]:
    """Named grey images of the shots that a table names, and why any of them cannot be read."""
    images, rejected = [], {}
    for path, name in zip(table.files_in(folder), table.names, strict=True):
        try:
            images.append((name, decode_image(read_bytes(path, "image"), path.name)))
        except InputError as error:
            rejected[name] = str(error)
    return images, rejected
