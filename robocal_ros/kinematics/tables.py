# SPDX-License-Identifier: Apache-2.0
"""Measurements as CSV tables, each complaint with its file, row and column: see docs/files.md."""

import csv
import io
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import nearest, quoted, read_text, shortened, write_text
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import DEFAULT_TARGET, Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import QUATERNION_TOLERANCE

LARGEST = 1e9  # in any unit: beyond it squares lose what is left of a measurement
DIGITS = ".12g"  # 1e-9 mm in a metre, and no trailing noise of binary fractions


@dataclass(frozen=True)
class Cells:
    """A table.

    ``rows``: number of each row in the file (the header is row 1).
    ``columns``: cells of each column.
    """

    file: str
    rows: tuple[int, ...]
    columns: Mapping[str, tuple[str, ...]]

    def fail(self, message: str, index: int, column: str) -> NoReturn:
        """Refuse the cell of a row, by its place among ``rows``.

        Raises `InputError` always.
        """
        raise InputError(message, file=self.file, row=self.rows[index], column=column)

    def numbers(self, name: str, *, gaps: bool = False) -> Array:
        """A column of finite numbers (m,).

        With ``gaps`` a cell that is empty or says nan is not-a-number.

        Raises `InputError` at the first cell that is none.
        """
        cells = self.columns[name]
        if gaps:
            cells = tuple(cell.strip() or "nan" for cell in cells)
        try:
            values = np.array([float(cell) for cell in cells])
        except ValueError:
            self.fail_at_text(name, float, gaps=gaps)
        if "_" in "".join(cells):  # Python reads 1_000 as a thousand; a table must not mean that
            index = next(i for i, cell in enumerate(cells) if "_" in cell)
            self.fail(f"{quoted(cells[index])} is not a number", index, name)
        for wrong, words in (
            (np.isinf(values) if gaps else ~np.isfinite(values), "is not a finite number"),
            (np.abs(values) > LARGEST, "is no measurement"),
        ):
            if np.any(wrong):
                index = int(np.argmax(wrong))
                self.fail(f"{quoted(cells[index])} {words}", index, name)
        return values

    def words(self, name: str) -> tuple[str, ...]:
        """A column of texts (m,), none of them empty; nothing where there is no such column.

        Raises `InputError` at the first empty cell.
        """
        words = tuple(cell.strip() for cell in self.columns.get(name, ()))
        if "" in words:
            self.fail("the cell is empty", words.index(""), name)
        return words

    def fail_at_text(
        self, name: str, convert: Callable[[str], object], *, gaps: bool = False
    ) -> NoReturn:
        """Refuse the first cell that ``convert`` refuses, with ``gaps`` the first such text.

        Raises `InputError` always.
        """
        for index, cell in enumerate(self.columns[name]):
            try:
                convert(cell.strip() or ("nan" if gaps else ""))
            except (ValueError, InvalidOperation):
                text = cell.strip()
                if not text:
                    self.fail("the cell is empty", index, name)
                comma = text.count(",") == 1 and text.replace(",", "").lstrip("+-").isdigit()
                hint = "; the decimal mark must be a point" if comma else ""
                self.fail(f"{quoted(text)} is not a number{hint}", index, name)
        raise AssertionError(f"every cell of {name} is a number")


def read_cells(path: Path, check: Callable[[list[str], str], None], separator: str = ",") -> Cells:
    """Read a table; ``check`` refuses a header (its names, and the file's).

    Raises `InputError` when it is no table, has no rows, or rows that are longer or shorter than
    the header.
    """
    file = str(path)
    stream = io.StringIO(read_text(path, "table"), newline="")
    reader = csv.reader(stream, strict=True, delimiter=separator)
    rows, numbers = [], []
    try:
        header = next(reader)
        check(header, file)
        for number, row in enumerate(reader, start=2):
            if len(row) > 1 or "".join(row).strip():  # no blank line
                rows.append(row)
                numbers.append(number)
    except csv.Error as error:
        raise InputError(f"not a CSV table: {error}", file=file, row=reader.line_num) from error
    if not rows:
        raise InputError("the table has a header but no measurements", file=file)
    for number, row in zip(numbers, rows, strict=True):
        if len(row) != len(header):
            message = f"{len(row)} cells, but the header has {len(header)} columns"
            if len(row) > len(header):
                message += "; is the decimal mark a comma? It must be a point"
            raise InputError(message, file=file, row=number)
    names = [name.strip() for name in header]
    columns = zip(*rows, strict=True)
    return Cells(file, tuple(numbers), dict(zip(names, columns, strict=True)))


def read_published(path: Path, columns: Sequence[str], separator: str = ",") -> Cells:
    """Read the ``columns`` of a table that others made, which may have more.

    Between semicolons the decimal mark is a comma, as spreadsheets write it; it is made a point.

    Raises `InputError` as `read_cells`, and for a column that is missing.
    """

    def check(header: list[str], file: str) -> None:
        missing = [name for name in columns if name not in map(str.strip, header)]
        if missing:
            _fail(f"column {', '.join(missing)} is missing: this is not the published file", file)

    table = read_cells(path, check, separator)
    if separator != ";":
        return table
    points = {name: tuple(cell.replace(",", ".") for cell in table.columns[name])
              for name in columns}  # fmt: skip
    return Cells(table.file, table.rows, points)


def texts(values: Array) -> list[str]:
    """Numbers as cells."""
    return [format(value, DIGITS) for value in values.tolist()]


def write_cells(path: Path, columns: Mapping[str, Sequence[str]]) -> None:
    """Write a table by its columns; the file appears whole or not at all.

    Raises `InputError` when it cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_text(path, text.getvalue())


# ---- columns of a measurement table: names, units, and what is missing or unknown ---------------
#
# The contract is written in docs/files.md.


ANGLE_UNITS = {"deg": float(np.pi / 180.0), "rad": 1.0}
LENGTH_UNITS = {"mm": 1e-3, "m": 1.0}
POSITION = {unit: tuple(f"{axis}_{unit}" for axis in "xyz") for unit in LENGTH_UNITS}
EULER = ("rx_deg", "ry_deg", "rz_deg")
ROTATION_VECTOR = ("rvx_rad", "rvy_rad", "rvz_rad")
QUATERNION = ("qx", "qy", "qz", "qw")
FANUC = ("w_deg", "p_deg", "r_deg")
ORIENTATIONS = (EULER, ROTATION_VECTOR, FANUC, QUATERNION)
_POSES = tuple(name for group in (*POSITION.values(), *ORIENTATIONS) for name in group)
NUMBERS = ("stamp_s", "sigma_mm")
WORDS = ("target", "sample", "pose", "cycle")
JOINT = re.compile(r"q[1-9][0-9]?_(deg|rad|mm|m)")
SEPARATORS = {";": "semicolons", "\t": "tabs"}
_NO_POSE = (
    "where the flange was is missing: add x_mm, y_mm, z_mm and qx, qy, qz, qw (or another "
    "orientation), or the joints q1_deg …"
)
_NO_ARM = "the table has joints but no flange poses: name the robot, whose model tells the poses"


@dataclass(frozen=True)
class TableLayout:
    """Where each quantity stands in a row, and the factors to SI.

    ``joints`` and ``position`` hold column names; ``orientation`` is one of ``ORIENTATIONS`` or
    None; ``place`` maps every column's name to its index.
    """

    place: Mapping[str, int]
    joints: tuple[str, ...]
    joint_factors: Array
    position: tuple[str, ...]
    position_factor: float
    orientation: tuple[str, ...] | None

    @property
    def numeric(self) -> tuple[str, ...]:
        """Names of the columns that hold plain numbers, without the time stamp."""
        sigma = ("sigma_mm",) if "sigma_mm" in self.place else ()
        return (*self.joints, *self.position, *(self.orientation or ()), *sigma)


def joint_units(arm: SerialArm, joint: int) -> Mapping[str, float]:
    """Units that a joint's column may have, with their factors to SI."""
    return LENGTH_UNITS if arm.prismatic[joint] else ANGLE_UNITS


def read_layout(header: Sequence[str], arm: SerialArm, file: str) -> TableLayout:
    """Understand a header.

    Raises `InputError` for an unknown, missing, doubled or nameless column, and for mixed units.
    """
    place = _measured_places(header, arm, file)
    joints, factors = _joint_columns(place, arm, file)
    position, factor = _position_columns(place, file)
    return TableLayout(place, joints, factors, position, factor, orientation_columns(place, file))


def _measured_places(header: Sequence[str], arm: SerialArm, file: str) -> Mapping[str, int]:
    """Index of each column of a measurement table."""
    names = _names(header, file)
    _check_known(names, (*_of_joints(arm), *_POSES, *NUMBERS, *WORDS), file, arm)
    return {name: i for i, name in enumerate(names)}


def read_joint_columns(
    header: Sequence[str], arm: SerialArm, file: str
) -> tuple[tuple[str, ...], Array]:
    """Understand a header of stamps and joint readings: the joints' columns, their factors to SI.

    Raises `InputError` as `read_layout`.
    """
    names = _names(header, file)
    _check_known(names, ("stamp_s", *_of_joints(arm)), file, arm)
    if "stamp_s" not in names:
        _fail("column stamp_s is missing", file)
    return _joint_columns({name: i for i, name in enumerate(names)}, arm, file)


def read_pose_columns(
    header: Sequence[str], arm: SerialArm | None, file: str, words: Sequence[str]
) -> TableLayout:
    """Understand a header of flange poses, of joint readings, or of both, and ``words``.

    Without ``arm`` columns of joints are known by their form alone, and are left out of the layout.

    Raises `InputError` as `read_layout`; for a position without an orientation, and when neither
    pose nor joints are there.
    """
    names = _names(header, file)
    joints = [name for name in names if JOINT.fullmatch(name)]
    own = joints if arm is None else _of_joints(arm)
    _check_known(names, [*words, *_POSES, *own], file, arm)
    place = {name: i for i, name in enumerate(names)}
    columns: tuple[str, ...] = ()
    factors = np.zeros(0)
    if arm is not None and joints:
        columns, factors = _joint_columns(place, arm, file)
    orientation = orientation_columns(place, file)
    if orientation is None and not any(n in place for group in POSITION.values() for n in group):
        if not columns:
            _fail(_NO_ARM if joints else _NO_POSE, file)
        return TableLayout(place, columns, factors, (), 1.0, None)
    position, factor = _position_columns(place, file)
    if orientation is None:
        ways = "; or ".join(", ".join(group) for group in ORIENTATIONS)
        _fail(f"the flange's orientation is missing: add {ways}", file)
    return TableLayout(place, columns, factors, position, factor, orientation)


def check_plain(
    header: Sequence[str], file: str, required: Sequence[str], optional: Sequence[str] = ()
) -> None:
    """Refuse a header of plain columns.

    Raises `InputError` for an unknown, missing, doubled or nameless column.
    """
    names = _names(header, file)
    _check_known(names, (*required, *optional), file)
    missing = [name for name in required if name not in names]
    if missing:
        _fail(f"column {', '.join(missing)} is missing", file)


def _fail(message: str, file: str, column: str | None = None) -> NoReturn:
    raise InputError(
        message, file=file, row=1, column=None if column is None else shortened(column)
    )


def _of_joints(arm: SerialArm) -> list[str]:
    return [f"q{i + 1}_{unit}" for i in range(arm.n) for unit in joint_units(arm, i)]


def _names(header: Sequence[str], file: str) -> list[str]:
    names = [name.strip() for name in header]
    for sign, called in SEPARATORS.items():
        if len(names) == 1 and sign in names[0]:
            _fail(
                f"columns are separated by {called}; separate them by commas, with a point as "
                f"the decimal mark",
                file,
            )
    return names


def _check_known(
    names: list[str], known: Sequence[str], file: str, arm: SerialArm | None = None
) -> None:
    for number, name in enumerate(names, start=1):
        if not name:
            _fail(f"column {number} has no name", file)
        if names.index(name) != number - 1:
            _fail("this column appears twice", file, name)
        if name not in known:
            why = "" if arm is None else _why_unknown(name, arm)
            _fail(f"unknown column{why or nearest(name, known)}", file, name)


def _why_unknown(name: str, arm: SerialArm) -> str:
    """Words for a joint's column that is not of this arm or not of its kind; else none."""
    number = name.removeprefix("q").partition("_")[0]
    if not (name.startswith("q") and number.isdigit()):
        return ""
    if not 1 <= int(number) <= arm.n:
        return f": {arm.name} has {arm.n} joints, q1 to q{arm.n}"
    choices = " or ".join(f"q{number}_{known}" for known in joint_units(arm, int(number) - 1))
    kind = "prismatic" if arm.prismatic[int(number) - 1] else "revolute"
    return f": joint {number} of {arm.name} is {kind}, its column is {choices}"


def _joint_columns(
    place: Mapping[str, int], arm: SerialArm, file: str
) -> tuple[tuple[str, ...], Array]:
    columns, factors = [], []
    first: dict[bool, str] = {}
    for joint in range(arm.n):
        units = joint_units(arm, joint)
        found = [unit for unit in units if f"q{joint + 1}_{unit}" in place]
        if not found:
            choices = " or ".join(f"q{joint + 1}_{unit}" for unit in units)
            _fail(f"column {choices} is missing ({arm.name} has {arm.n} joints)", file)
        column = f"q{joint + 1}_{found[0]}"
        if len(found) > 1:
            _fail(f"joint {joint + 1} also has the column q{joint + 1}_{found[1]}", file, column)
        before = first.setdefault(bool(arm.prismatic[joint]), column)
        if before.partition("_")[2] != found[0]:
            _fail(f"mixed units: {before} and {column}; use one for all", file, column)
        columns.append(column)
        factors.append(units[found[0]])
    return tuple(columns), np.array(factors)


def _position_columns(place: Mapping[str, int], file: str) -> tuple[tuple[str, ...], float]:
    present = [name for names in POSITION.values() for name in names if name in place]
    units = {name.partition("_")[2] for name in present}
    if len(units) > 1:
        _fail(f"mixed units: {' and '.join(present)}; use one for all", file, present[-1])
    unit = units.pop() if units else "mm"
    missing = [name for name in POSITION[unit] if name not in place]
    if missing:
        also = "" if present else " (or x_m, y_m, z_m)"
        _fail(f"column {', '.join(missing)} is missing{also}", file)
    return POSITION[unit], LENGTH_UNITS[unit]


def orientation_columns(place: Collection[str], file: str) -> tuple[str, ...] | None:
    """The columns of one of ``ORIENTATIONS`` that a header has; None without any.

    Raises `InputError` when it has several, or one in part.
    """
    begun = [names for names in ORIENTATIONS if any(name in place for name in names)]
    if not begun:
        return None
    if len(begun) > 1:
        ways = " and ".join(", ".join(names) for names in begun)
        _fail(f"orientation is given in more than one way: {ways}", file)
    missing = [name for name in begun[0] if name not in place]
    if missing:
        whole = ", ".join(begun[0])
        _fail(f"column {', '.join(missing)} is missing (orientation takes {whole})", file)
    return begun[0]


# ---- measurements as CSV tables; the contract is written in docs/files.md ------------------------


LARGEST_STAMP_S = 9_000_000_000
SMALLEST_SIGMA_MM = 1e-9


def read_measurements(path: str | Path, arm: SerialArm) -> Measurements:
    """Read a table of joint readings and measured positions or poses for ``arm``.

    The whole file is accepted or none of it.

    Returns
    -------
    Measurements
        In SI. ``target`` is "tool" and ``sample`` the row's number (the header is row 1) where
        the file has no such column.

    Raises
    ------
    InputError
        With file, row and column, when anything in the file is not as docs/files.md says.
    """
    return measurements_of(*read_table(Path(path), arm), arm)


def measurements_of(table: Cells, layout: TableLayout, arm: SerialArm) -> Measurements:
    """Measurements in a table that was read."""
    numbers = np.column_stack([table.numbers(name) for name in layout.numeric])
    n = arm.n
    rest = numbers[:, n + 3 :]
    return Measurements(
        q=numbers[:, :n] * layout.joint_factors,
        position=numbers[:, n : n + 3] * layout.position_factor,
        target=table.words("target") or (DEFAULT_TARGET,) * len(numbers),
        sample=read_samples(table, tuple(map(str, table.rows))),
        rotation=None if layout.orientation is None else read_rotations(table, layout.orientation),
        sigma=_sigma(table, rest[:, -1]) if "sigma_mm" in layout.place else None,
        stamp_ns=read_stamps(table) if "stamp_s" in layout.place else None,
    )


def beyond_limits(data: Measurements, arm: SerialArm) -> tuple[str, ...]:
    """Warnings in words, one per joint whose readings lie beyond the arm's limits."""
    found = []
    for joint, name in enumerate(arm.joint_names):
        q = data.q[:, joint]
        low, high = arm.lower[joint], arm.upper[joint]
        outside = np.flatnonzero((q < low) | (q > high))
        if not len(outside):
            continue
        worst = outside[np.argmax(np.maximum(low - q[outside], q[outside] - high))]
        factor, unit = (1e3, "mm") if arm.prismatic[joint] else (180.0 / np.pi, "deg")
        found.append(
            f"joint {joint + 1} ({name}): {len(outside)} of {len(q)} readings beyond "
            f"{low * factor:g} … {high * factor:g} {unit}, farthest {q[worst] * factor:g} {unit} "
            f"in sample {data.sample[worst]}"
        )
    return tuple(found)


def write_measurements(path: str | Path, data: Measurements, arm: SerialArm) -> None:
    """Write a table in degrees and millimetres, orientation as a quaternion.

    Reading it back gives the same values to 12 digits. The file appears whole or not at all.
    """
    columns: dict[str, list[str]] = {"sample": list(data.sample), "target": list(data.target)}
    if data.stamp_ns is not None:
        columns["stamp_s"] = stamp_texts(data.stamp_ns)
    columns |= joint_texts(data.q, arm)
    for axis, name in enumerate(("x_mm", "y_mm", "z_mm")):
        columns[name] = texts(data.position[:, axis] * 1e3)
    if data.rotation is not None:
        for axis, values in enumerate(frames.quat_xyzw(data.rotation).T):
            columns[QUATERNION[axis]] = texts(values)
    if data.sigma is not None:
        columns["sigma_mm"] = texts(data.sigma * 1e3)
    write_cells(Path(path), columns)


def stamp_texts(stamp_ns: NDArray[np.int64]) -> list[str]:
    """Cells of ``stamp_s``."""
    return [f"{Decimal(stamp).scaleb(-9):.9f}" for stamp in stamp_ns.tolist()]


def joint_texts(q: Array, arm: SerialArm) -> dict[str, list[str]]:
    """Columns of joint readings (m, n), in degrees and millimetres."""
    columns = {}
    for joint in range(arm.n):
        name, factor = ("mm", 1e3) if arm.prismatic[joint] else ("deg", 180.0 / np.pi)
        columns[f"q{joint + 1}_{name}"] = texts(q[:, joint] * factor)
    return columns


def read_joints(path: Path, arm: SerialArm) -> Array:
    """Joints (m, n) of a table of poses, measured or not: a measurement table, or its joints alone.

    Raises `InputError` as `read_measurements`, of the header and the joints.
    """
    found: list[tuple[tuple[str, ...], Array]] = []

    def check(header: list[str], file: str) -> None:
        found.append(_joint_columns(_measured_places(header, arm, file), arm, file))

    table = read_cells(path, check)
    columns, factors = found[0]
    return np.column_stack([table.numbers(name) for name in columns]) * factors


def read_table(path: Path, arm: SerialArm) -> tuple[Cells, TableLayout]:
    """Cells of a table of measurements, and where its columns are."""
    found: list[TableLayout] = []
    table = read_cells(path, lambda header, file: found.append(read_layout(header, arm, file)))
    return table, found[0]


def read_samples(table: Cells, otherwise: tuple[str, ...]) -> tuple[str, ...]:
    """Names (m,) of the column ``sample``, all different; ``otherwise`` where there is none.

    Raises `InputError` at the first name that is there already.
    """
    require_different(table, "sample")
    return table.words("sample") or otherwise


def require_different(table: Cells, column: str) -> None:
    """Refuse a word that a column has twice.

    Raises `InputError` at the first word that is there already.
    """
    first: dict[str, int] = {}
    for index, name in enumerate(table.words(column)):
        if first.setdefault(name, index) != index:
            row = table.rows[first[name]]
            table.fail(f"{column} {quoted(name)} is already in row {row}", index, column)


def _sigma(table: Cells, sigma_mm: Array) -> Array:
    bad = np.flatnonzero(sigma_mm < SMALLEST_SIGMA_MM)
    if len(bad):
        index = int(bad[0])
        table.fail(f"{sigma_mm[index]:g} is no standard deviation", index, "sigma_mm")
    return sigma_mm * 1e-3


def read_rotations(table: Cells, kind: tuple[str, ...]) -> Array:
    """Orientations (m, 3, 3) from columns of one of ``ORIENTATIONS``.

    Raises `InputError` when a quaternion is not of unit length.
    """
    values = np.column_stack([table.numbers(name) for name in kind])
    if kind == ROTATION_VECTOR:
        return frames.exp_rotation(values)
    if kind in (EULER, FANUC):
        turns = np.radians(values)[:, :, None] * np.eye(3)
        Rx, Ry, Rz = np.moveaxis(frames.exp_rotation(turns), 1, 0)
        # about x, then the new y, then the new z; of FANUC about the fixed x (W), y (P), z (R)
        return np.asarray(Rx @ Ry @ Rz if kind == EULER else Rz @ Ry @ Rx)
    length = np.linalg.norm(values, axis=1)
    bad = np.flatnonzero(np.abs(length - 1.0) > QUATERNION_TOLERANCE)
    if len(bad):
        index = int(bad[0])
        table.fail(f"the quaternion has length {length[index]:.6g}, not 1", index, "qw")
    return frames.transform_from_quat(np.zeros(3), values)[:, :3, :3]


def read_stamps(table: Cells) -> NDArray[np.int64]:
    """Nanoseconds (m,) of ``stamp_s``, without the rounding that seconds since 1970 suffer.

    Raises `InputError` at the first cell that is no time.
    """
    stamps = []
    try:
        seconds = [Decimal(cell.strip()) for cell in table.columns["stamp_s"]]
    except InvalidOperation:
        table.fail_at_text("stamp_s", Decimal)
    for index, value in enumerate(seconds):
        if not value.is_finite():
            table.fail(f"{quoted(value)} is not a finite number", index, "stamp_s")
        if abs(value) > LARGEST_STAMP_S:
            table.fail(
                f"{quoted(value)} is beyond any date; the unit is the second", index, "stamp_s"
            )
        stamps.append(int(value.scaleb(9).to_integral_value()))
    return np.array(stamps, dtype=np.int64)


# ---- flange poses and joint values that are a unit apart from what they should be ---------------


FARTHEST_M = 20.0  # no arm's flange is farther from its base
NEAREST_M = 0.01  # nor do all poses of one lie so near to it
MOST_TURNS = 4.0  # of a joint: what is beyond is no angle in rad


def flange_unit_fault(position: Array, unit: str = "m") -> tuple[int, str] | None:
    """The flange position (index) of many (m, 3), m, that cannot be one, and why; None without.

    ``unit``: m or mm, in which they were given.
    """
    distance = np.linalg.norm(position, axis=1)
    index = int(np.argmax(distance))
    if distance[index] > FARTHEST_M:
        why = ": mm where m are expected?" if unit == "m" else "?"
        return index, (
            f"the flange is {distance[index]:.4g} m from the base: is it a thousand times too "
            f"far{why}"
        )
    if distance[index] < NEAREST_M:
        why = ", m where mm are expected?" if unit == "mm" else "?"
        return index, (
            f"no flange is farther from the base than {distance[index] * 1e3:.4g} mm: are they a "
            f"thousand times too near{why}"
        )
    return None


def joint_unit_fault(arm: SerialArm, q: Array) -> tuple[int, str] | None:
    """The row of joint values (m, n), rad (prismatic: m), that cannot be some, and why."""
    most = np.where(arm.prismatic, FARTHEST_M, MOST_TURNS * 2.0 * np.pi)
    beyond = np.abs(q) / most
    index, joint = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    if beyond[index, joint] <= 1.0:
        return None
    unit, other = ("m", "mm") if arm.prismatic[joint] else ("rad", "degrees")
    return int(index), (
        f"joint {arm.joint_names[joint]} is at {q[index, joint]:.6g} {unit}: {other} where {unit} "
        "are expected?"
    )
