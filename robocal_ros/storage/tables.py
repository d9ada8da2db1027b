"""Measurements as CSV tables; the contract is written in docs/csv.md."""

import csv
import io
from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocal_ros.core import frames
from robocal_ros.core.errors import InputError
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.samples import DEFAULT_TARGET, Measurements
from robocal_ros.core.thermal.visits import ONLY_CYCLE, Visits
from robocal_ros.storage.files import quoted, read_text, write_text
from robocal_ros.storage.table_columns import (
    EULER,
    QUATERNION,
    ROTATION_VECTOR,
    Layout,
    read_layout,
)

Array = NDArray[np.float64]

QUATERNION_TOLERANCE = 1e-3
LARGEST_STAMP_S = 9_000_000_000
LARGEST = 1e9  # in any unit: beyond it squares lose what is left of a measurement
SMALLEST_SIGMA_MM = 1e-9
DIGITS = ".12g"  # 1e-9 mm in a metre, and no trailing noise of binary fractions


class _Table(NamedTuple):
    """Cells of a file: its rows' numbers (the header is row 1) and its columns of text."""

    file: str
    layout: Layout
    rows: list[int]
    columns: list[tuple[str, ...]]

    def column(self, name: str) -> tuple[str, ...]:
        return self.columns[self.layout.place[name]]

    def fail(self, message: str, index: int, column: str) -> NoReturn:
        raise InputError(message, file=self.file, row=self.rows[index], column=column)


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
        With file, row and column, when anything in the file is not as docs/csv.md says.
    """
    return _measurements(_read_cells(Path(path), arm), arm)


def read_visits(path: str | Path, arm: SerialArm) -> Visits:
    """Read a table of visits of named poses: as ``read_measurements``, with a column ``pose``.

    Raises
    ------
    InputError
        As ``read_measurements``, and when the column ``pose`` is missing.
    """
    table = _read_cells(Path(path), arm)
    if "pose" not in table.layout.place:
        raise InputError(
            "column pose is missing: it names each measuring pose, the same name cold and warm",
            file=table.file,
            row=1,
        )
    data = _measurements(table, arm)
    cycle = _words(table, "cycle") or (ONLY_CYCLE,) * len(data)
    return Visits(data, _words(table, "pose"), cycle)


def _measurements(table: _Table, arm: SerialArm) -> Measurements:
    layout = table.layout
    numbers = _numbers(table)
    n = arm.n
    rest = numbers[:, n + 3 :]
    return Measurements(
        q=numbers[:, :n] * layout.joint_factors,
        position=numbers[:, n : n + 3] * layout.position_factor,
        target=_words(table, "target") or (DEFAULT_TARGET,) * len(numbers),
        sample=_samples(table),
        rotation=_rotations(table, rest),
        sigma=_sigma(table, rest[:, -1]) if "sigma_mm" in layout.place else None,
        stamp_ns=_stamps(table) if "stamp_s" in layout.place else None,
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
        columns["stamp_s"] = [f"{Decimal(int(t)).scaleb(-9):.9f}" for t in data.stamp_ns]
    for joint in range(arm.n):
        name, factor = ("mm", 1e3) if arm.prismatic[joint] else ("deg", 180.0 / np.pi)
        columns[f"q{joint + 1}_{name}"] = _texts(data.q[:, joint] * factor)
    for axis, name in enumerate(("x_mm", "y_mm", "z_mm")):
        columns[name] = _texts(data.position[:, axis] * 1e3)
    if data.rotation is not None:
        for axis, values in enumerate(frames.quat_xyzw(data.rotation).T):
            columns[QUATERNION[axis]] = _texts(values)
    if data.sigma is not None:
        columns["sigma_mm"] = _texts(data.sigma * 1e3)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_text(Path(path), text.getvalue())


def _texts(values: Array) -> list[str]:
    return [format(value, DIGITS) for value in values.tolist()]


def _read_cells(path: Path, arm: SerialArm) -> _Table:
    file = str(path)
    reader = csv.reader(io.StringIO(read_text(path, "table"), newline=""), strict=True)
    rows, numbers = [], []
    try:
        header = next(reader)
        layout = read_layout(header, arm, file)
        for number, row in enumerate(reader, start=2):
            if row:
                rows.append(row)
                numbers.append(number)
    except csv.Error as error:
        raise InputError(f"not a CSV table: {error}", file=file, row=reader.line_num) from error
    if not rows:
        raise InputError("the table has a header but no measurements", file=file)
    width = len(header)
    for number, row in zip(numbers, rows, strict=True):
        if len(row) != width:
            raise InputError(_ragged(row, width), file=file, row=number)
    return _Table(file, layout, numbers, list(zip(*rows, strict=True)))


def _ragged(row: list[str], width: int) -> str:
    message = f"{len(row)} cells, but the header has {width} columns"
    if len(row) > width:
        message += "; is the decimal mark a comma? It must be a point"
    return message


def _numbers(table: _Table) -> Array:
    """Numeric columns (m, k), all finite, in the order of ``layout.numeric``."""
    columns = [_column(table, name) for name in table.layout.numeric]
    numbers = np.array(columns).T
    bad = np.argwhere(~np.isfinite(numbers))
    if len(bad):
        name = table.layout.numeric[bad[0, 1]]
        text = table.column(name)[bad[0, 0]]
        table.fail(f"{quoted(text)} is not a finite number", int(bad[0, 0]), name)
    bad = np.argwhere(np.abs(numbers) > LARGEST)
    if len(bad):
        name = table.layout.numeric[bad[0, 1]]
        text = table.column(name)[bad[0, 0]]
        table.fail(f"{quoted(text)} is no measurement", int(bad[0, 0]), name)
    return numbers


def _column(table: _Table, name: str) -> list[float]:
    cells = table.column(name)
    try:
        values = list(map(float, cells))
    except ValueError:
        _fail_at_text(table, name, float)
    if "_" in "".join(cells):  # Python reads 1_000 as a thousand; a table must not mean that
        index = next(i for i, cell in enumerate(cells) if "_" in cell)
        table.fail(f"{quoted(cells[index])} is not a number", index, name)
    return values


def _fail_at_text(table: _Table, name: str, convert: Callable[[str], object]) -> NoReturn:
    """Report the first cell that ``convert`` refuses."""
    for index, cell in enumerate(table.column(name)):
        try:
            convert(cell.strip())
        except (ValueError, InvalidOperation):
            text = cell.strip()
            if not text:
                table.fail("the cell is empty", index, name)
            comma = text.count(",") == 1 and text.replace(",", "").lstrip("+-").isdigit()
            hint = "; the decimal mark must be a point" if comma else ""
            table.fail(f"{quoted(text)} is not a number{hint}", index, name)
    raise AssertionError(f"every cell of {name} is a number")


def _stamps(table: _Table) -> NDArray[np.int64]:
    """Nanoseconds, without the rounding that seconds since 1970 suffer in binary."""
    stamps = []
    try:
        seconds = [Decimal(cell.strip()) for cell in table.column("stamp_s")]
    except InvalidOperation:
        _fail_at_text(table, "stamp_s", Decimal)
    for index, value in enumerate(seconds):
        if not value.is_finite():
            table.fail(f"{quoted(value)} is not a finite number", index, "stamp_s")
        if abs(value) > LARGEST_STAMP_S:
            table.fail(
                f"{quoted(value)} is beyond any date; the unit is the second", index, "stamp_s"
            )
        stamps.append(int(value.scaleb(9).to_integral_value()))
    return np.array(stamps, dtype=np.int64)


def _words(table: _Table, name: str) -> tuple[str, ...]:
    if name not in table.layout.place:
        return ()
    words = tuple(cell.strip() for cell in table.column(name))
    if "" in words:
        table.fail("the cell is empty", words.index(""), name)
    return words


def _samples(table: _Table) -> tuple[str, ...]:
    samples = _words(table, "sample") or tuple(map(str, table.rows))
    if len(set(samples)) != len(samples):
        first: dict[str, int] = {}
        for index, name in enumerate(samples):
            if first.setdefault(name, index) != index:
                row = table.rows[first[name]]
                table.fail(f"sample {quoted(name)} is already in row {row}", index, "sample")
    return samples


def _sigma(table: _Table, sigma_mm: Array) -> Array:
    bad = np.flatnonzero(sigma_mm < SMALLEST_SIGMA_MM)
    if len(bad):
        index = int(bad[0])
        table.fail(f"{sigma_mm[index]:g} is no standard deviation", index, "sigma_mm")
    return sigma_mm * 1e-3


def _rotations(table: _Table, values: Array) -> Array | None:
    kind = table.layout.orientation
    if kind is None:
        return None
    if kind == EULER:
        # intrinsic XYZ: turn about x, then about the new y, then about the new z
        rotations = Rotation.from_euler("XYZ", values[:, :3], degrees=True)
    elif kind == ROTATION_VECTOR:
        rotations = Rotation.from_rotvec(values[:, :3])
    else:
        length = np.linalg.norm(values[:, :4], axis=1)
        bad = np.flatnonzero(np.abs(length - 1.0) > QUATERNION_TOLERANCE)
        if len(bad):
            index = int(bad[0])
            table.fail(f"the quaternion has length {length[index]:.6g}, not 1", index, "qw")
        rotations = Rotation.from_quat(values[:, :4])
    return np.asarray(rotations.as_matrix())
