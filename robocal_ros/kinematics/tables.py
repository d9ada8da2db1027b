"""Measurements as CSV tables; the contract is written in docs/csv.md."""

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocal_ros.ground import frames
from robocal_ros.ground.cells import Cells, read_cells, texts, write_cells
from robocal_ros.ground.files import quoted
from robocal_ros.ground.samples import DEFAULT_TARGET, Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.table_columns import (
    EULER,
    QUATERNION,
    ROTATION_VECTOR,
    TableLayout,
    read_layout,
)

Array = NDArray[np.float64]

QUATERNION_TOLERANCE = 1e-3
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
        With file, row and column, when anything in the file is not as docs/csv.md says.
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


def read_table(path: Path, arm: SerialArm) -> tuple[Cells, TableLayout]:
    """Cells of a table of measurements, and where its columns are."""
    found: list[TableLayout] = []
    table = read_cells(path, lambda header, file: found.append(read_layout(header, arm, file)))
    return table, found[0]


def read_samples(table: Cells, otherwise: tuple[str, ...]) -> tuple[str, ...]:
    """Names (m,) of the column ``sample``, all different; ``otherwise`` where there is none.

    Raises
    ------
    InputError
        At the first name that is there already.
    """
    require_different(table, "sample")
    return table.words("sample") or otherwise


def require_different(table: Cells, column: str) -> None:
    """Refuse a word that a column has twice.

    Raises
    ------
    InputError
        At the first word that is there already.
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

    Raises
    ------
    InputError
        When a quaternion is not of unit length.
    """
    values = np.column_stack([table.numbers(name) for name in kind])
    if kind == EULER:
        # intrinsic XYZ: turn about x, then about the new y, then about the new z
        rotations = Rotation.from_euler("XYZ", values, degrees=True)
    elif kind == ROTATION_VECTOR:
        rotations = Rotation.from_rotvec(values)
    else:
        length = np.linalg.norm(values, axis=1)
        bad = np.flatnonzero(np.abs(length - 1.0) > QUATERNION_TOLERANCE)
        if len(bad):
            index = int(bad[0])
            table.fail(f"the quaternion has length {length[index]:.6g}, not 1", index, "qw")
        rotations = Rotation.from_quat(values)
    return np.asarray(rotations.as_matrix())


def read_stamps(table: Cells) -> NDArray[np.int64]:
    """Nanoseconds (m,) of ``stamp_s``, without the rounding that seconds since 1970 suffer.

    Raises
    ------
    InputError
        At the first cell that is no time.
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
