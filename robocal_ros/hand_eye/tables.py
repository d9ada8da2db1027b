"""Tables of a hand-eye calibration: a shot in each row, and the profiles that they name.

The contract is written in docs/hand_eye.md.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.cells import Cells, read_cells, texts, write_cells
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.ground.files import quoted, read_bytes
from robocal_ros.hand_eye.shots import Profile, profile_of
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.tables import (
    POSITION,
    QUATERNION,
    TableLayout,
    check_plain,
    flange_unit_fault,
    joint_texts,
    read_pose_columns,
    read_rotations,
    read_samples,
    read_stamps,
    require_different,
    stamp_texts,
)

Array = NDArray[np.float64]

PROFILE = ("x_mm", "z_mm")
FILE_COLUMNS = ("profile", "image")


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Shots: where the flange stood, and the file that each of them gave.

    Attributes
    ----------
    names : (m,) of the shots; where the table gives none the file's name, or the row's number.
    T_base_flange : (m, 4, 4), m.
    files : (m,) relative to the folder of the shots; none where no such column was asked for.
    q : (m, n) joint readings, rad (prismatic: m); None without them, or where no arm is known.
    stamp_ns : (m,); None without a column.
    mark : (m,) of the target, through which the laser plane was laid; None without a column.
    path, rows, column : the table's file, the row of each shot there, the column of ``files``.
    named : whether the table has a column ``sample``.
    """

    names: tuple[str, ...]
    T_base_flange: Array
    files: tuple[str, ...]
    q: Array | None
    stamp_ns: NDArray[np.int64] | None
    mark: tuple[str, ...] | None
    path: str
    rows: tuple[int, ...]
    column: str
    named: bool = False

    def __len__(self) -> int:
        return len(self.names)

    def fail(self, index: int, message: str) -> NoReturn:
        """Refuse the file of a shot.

        Raises
        ------
        InputError
            Always.
        """
        raise InputError(message, file=self.path, row=self.rows[index], column=self.column)

    def files_in(self, folder: Path) -> list[Path]:
        """Paths (m,) of the files.

        Raises
        ------
        InputError
            At the first that does not exist.
        """
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

    Raises
    ------
    InputError
        With file, row and column, when the table is not as its contract says.
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
    q = None
    if layout.joints:
        q = np.column_stack([table.numbers(name) for name in layout.joints])
        q = q * layout.joint_factors
    return PoseTable(
        names=read_samples(table, files or tuple(map(str, table.rows))),
        T_base_flange=_poses(table, layout, arm, q),
        files=files,
        q=q,
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


def _poses(table: Cells, layout: TableLayout, arm: SerialArm | None, q: Array | None) -> Array:
    if layout.orientation is None:
        if arm is None or q is None:
            raise ValueError("a layout without poses has joints")
        return arm.fk(q)
    position = np.column_stack([table.numbers(name) for name in layout.position])
    position *= layout.position_factor
    _check_unit(table, layout.position, position)
    return frames.transform(read_rotations(table, layout.orientation), position)


def _check_unit(table: Cells, columns: Sequence[str], position: Array) -> None:
    unit = "mm" if columns == POSITION["mm"] else "m"
    if (fault := flange_unit_fault(position, unit)) is not None:
        index, words = fault
        table.fail(words, index, columns[int(np.argmax(np.abs(position[index])))])


def read_profile(path: Path, name: str) -> Profile:
    """Read a profile; rows without a return (an empty cell, or nan) are left out.

    Raises
    ------
    InputError
        With file, row and column, when it is no table of ``x_mm`` and ``z_mm``, or is in another
        unit.
    TooFewSamplesError
        When nearly nothing was seen.
    """
    lines = [line for line in read_bytes(path, "profile").splitlines() if line.strip()]
    if len(lines) < 2:
        raise TooFewSamplesError(f"profile {name} is empty ({path})")
    table = read_cells(path, lambda header, file: check_plain(header, file, PROFILE))
    points = 1e-3 * np.column_stack([table.numbers(column, gaps=True) for column in PROFILE])
    try:
        return profile_of(points, name)
    except InputError as error:
        raise InputError(str(error), file=str(path)) from error


def read_profiles(folder: Path, table: PoseTable) -> list[Profile | TooFewSamplesError]:
    """Profiles (m,) of the shots; for one that shows next to nothing the reason.

    Raises
    ------
    InputError
        When a file is missing (all are looked for first), or is no profile.
    """
    profiles: list[Profile | TooFewSamplesError] = []
    for path, name in zip(table.files_in(folder), table.names, strict=True):
        try:
            profiles.append(read_profile(path, name))
        except TooFewSamplesError as error:
            profiles.append(error)
    return profiles


def write_profile(path: Path, points: Array) -> None:
    """Write a profile (n, 2), m; what is not-a-number becomes an empty cell.

    Raises
    ------
    InputError
        When it cannot be written.
    """
    seen = np.all(np.isfinite(points), axis=1)
    columns = {}
    for axis, column in enumerate(PROFILE):
        cells = zip(texts(points[:, axis] * 1e3), seen, strict=True)
        columns[column] = [cell if there else "" for cell, there in cells]
    write_cells(path, columns)


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
    """Write a table of shots in millimetres and quaternions, ``joints`` (q (m, n)) beside them.

    Raises
    ------
    InputError
        When it cannot be written.
    """
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


def write_shots(
    path: Path, folder: Path, T_base_flange: Array, profiles: Mapping[str, Array], **more: Any
) -> None:
    """Write a table of shots and, into ``folder``, the profile of each by the name of its shot.

    ``more`` as in `write_pose_table`.

    Raises
    ------
    InputError
        When one of them cannot be written.
    """
    files = [f"{name}.csv" for name in profiles]
    for file, points in zip(files, profiles.values(), strict=True):
        write_profile(folder / file, points)
    write_pose_table(path, T_base_flange, files, names=tuple(profiles), **more)
