"""Columns of a measurement table: names, units, and what is missing or unknown.

The contract is written in docs/csv.md.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import nearest, shortened
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]

ANGLE_UNITS = {"deg": float(np.pi / 180.0), "rad": 1.0}
LENGTH_UNITS = {"mm": 1e-3, "m": 1.0}
POSITION = {unit: tuple(f"{axis}_{unit}" for axis in "xyz") for unit in LENGTH_UNITS}
EULER = ("rx_deg", "ry_deg", "rz_deg")
ROTATION_VECTOR = ("rvx_rad", "rvy_rad", "rvz_rad")
QUATERNION = ("qx", "qy", "qz", "qw")
ORIENTATIONS = (EULER, ROTATION_VECTOR, QUATERNION)
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


def known_columns(arm: SerialArm) -> tuple[str, ...]:
    """Every column name that a table for this arm may have."""
    joints = [f"q{i + 1}_{unit}" for i in range(arm.n) for unit in joint_units(arm, i)]
    positions = [name for names in POSITION.values() for name in names]
    orientations = [name for names in ORIENTATIONS for name in names]
    return (*joints, *positions, *orientations, *NUMBERS, *WORDS)


def read_layout(header: Sequence[str], arm: SerialArm, file: str) -> TableLayout:
    """Understand a header.

    Raises
    ------
    InputError
        For an unknown, missing, doubled or nameless column, and for mixed units.
    """
    names = [name.strip() for name in header]
    _check_separator(names, file)
    _check_known(names, known_columns(arm), file, arm)
    place = {name: i for i, name in enumerate(names)}
    joints, factors = _joint_columns(place, arm, file)
    position, factor = _position_columns(place, file)
    return TableLayout(place, joints, factors, position, factor, orientation_columns(place, file))


def read_joint_columns(
    header: Sequence[str], arm: SerialArm, file: str
) -> tuple[tuple[str, ...], Array]:
    """Understand a header of stamps and joint readings: the joints' columns, their factors to SI.

    Raises
    ------
    InputError
        As `read_layout`.
    """
    names = [name.strip() for name in header]
    _check_separator(names, file)
    joints = [f"q{i + 1}_{unit}" for i in range(arm.n) for unit in joint_units(arm, i)]
    _check_known(names, ("stamp_s", *joints), file, arm)
    if "stamp_s" not in names:
        _fail("column stamp_s is missing", file)
    return _joint_columns({name: i for i, name in enumerate(names)}, arm, file)


def read_pose_columns(
    header: Sequence[str], arm: SerialArm | None, file: str, words: Sequence[str]
) -> TableLayout:
    """Understand a header of flange poses, of joint readings, or of both, and ``words``.

    Without ``arm`` columns of joints are known by their form alone, and are left out of the layout.

    Raises
    ------
    InputError
        As `read_layout`; for a position without an orientation, and when neither pose nor joints
        are there.
    """
    names = [name.strip() for name in header]
    _check_separator(names, file)
    joints = [name for name in names if JOINT.fullmatch(name)]
    known = [*words, *(name for group in (*POSITION.values(), *ORIENTATIONS) for name in group)]
    if arm is None:
        _check_known(names, [*known, *joints], file)
    else:
        of_arm = [f"q{i + 1}_{unit}" for i in range(arm.n) for unit in joint_units(arm, i)]
        _check_known(names, [*known, *of_arm], file, arm)
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

    Raises
    ------
    InputError
        For an unknown, missing, doubled or nameless column.
    """
    names = [name.strip() for name in header]
    _check_separator(names, file)
    _check_known(names, (*required, *optional), file)
    missing = [name for name in required if name not in names]
    if missing:
        _fail(f"column {', '.join(missing)} is missing", file)


def _fail(message: str, file: str, column: str | None = None) -> NoReturn:
    raise InputError(
        message, file=file, row=1, column=None if column is None else shortened(column)
    )


def _check_separator(names: list[str], file: str) -> None:
    if len(names) > 1:
        return
    for sign, called in SEPARATORS.items():
        if sign in names[0]:
            _fail(
                f"columns are separated by {called}; separate them by commas, with a point as "
                f"the decimal mark",
                file,
            )


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

    Raises
    ------
    InputError
        When it has several, or one in part.
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
