# SPDX-License-Identifier: Apache-2.0
"""A profile, and how a maker's line laser tells it: the sensor description, files and clouds.

Files: tables of text, PLY (Turk 1994, "The PLY polygon file format") and PCD 0.7
(pointclouds.org, "The PCD file format"). Facts of the makers and where they were read stand in
docs/hand_eye.md, "The sensor description".
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground.errors import InputError, RobocalError, TooFewSamplesError
from robocal_ros.ground.files import quoted, read_bytes
from robocal_ros.ground.frames import Array, Document
from robocal_ros.ground.samples import cloud_columns, stamp_ns
from robocal_ros.kinematics.robots import Fields, read_fields

Columns = Mapping[str, Array]

FEWEST_POINTS = 10
NO_RETURN_M = 0.02  # from all points: what lies nearer may be a surface
NARROWEST_M, WIDEST_M = 1e-3, 20.0  # no line laser's field of view is outside of this
PLANE_M = 1e-5  # a profile's points lie so near to one y
Z_GROWS = ("away", "towards")  # of z, from the sensor: a distance or a height
UNITS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "inch": 0.0254}
FARTHEST_MM = 20e3
CLOUDS = (".ply", ".pcd")
ANEW = 0.5  # of the extent: x that steps back by so much begins another profile
SCATTERED = 0.1  # share of steps back, from which points are in no order


@dataclass(frozen=True, eq=False)
class Profile:
    """Points of one profile.

    ``points`` (n, 2) x along the laser line and z along the beam, either way, sensor frame, m, in
    the order of the sensor's columns; its plane is y = 0. What the sensor did not see is left out.
    ``name``: of the shot, for reports.
    """

    points: Array
    name: str


def profile_of(points: ArrayLike, name: str) -> Profile:
    """Check and wrap points (n, 2), m; columns without a return are left out.

    Those are not-a-number, or hold one z that recurs and lies farther from all others than these
    extend: what stands for no return depends on the sensor (0, -32768 steps, -99.9999 mm …).

    Raises `InputError` when the points are not (n, 2), or their extent is that of another unit;
    `TooFewSamplesError` when nearly nothing was seen.
    """
    rows = np.asarray(points, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 2:
        raise InputError(f"profile {name} has shape {rows.shape}, not (points, 2)")
    rows = rows[np.all(np.isfinite(rows), axis=1)]
    for value in (np.min(rows[:, 1], initial=np.inf), np.max(rows[:, 1], initial=-np.inf)):
        same = rows[:, 1] == value
        if np.sum(same) > 1 and len(others := rows[~same, 1]) >= FEWEST_POINTS:
            apart = float(np.min(np.abs(others - value)))
            if apart > max(float(np.ptp(others)), NO_RETURN_M):
                rows = rows[~same]
    if len(rows) < FEWEST_POINTS:
        raise TooFewSamplesError(
            f"profile {name} has {len(rows)} points (at least {FEWEST_POINTS}): check the exposure "
            "and that the target is in range"
        )
    extent = float(np.ptp(rows, axis=0).max())
    if not NARROWEST_M <= extent <= WIDEST_M:
        small = extent < NARROWEST_M
        width = f"{extent * 1e3:.4g} mm" if small else f"{extent:.4g} m"
        raise InputError(
            f"profile {name} comes out {width} wide: is it a thousand times too "
            f"{'small' if small else 'large'}? A table's x_mm and z_mm hold mm, a message m; other "
            "units stand in the sensor's description"
        )
    return Profile(rows, name)


@dataclass(frozen=True)
class SensorRange:
    """What a line-laser sensor sees: width (m), points, noise along the beam (m).

    ``near_m``, ``far_m``: z of the field's ends, in the sensor's own coordinates; where z grows
    towards the sensor the first is the larger one.
    """

    near_m: float = 0.19
    far_m: float = 0.21
    width_m: float = 0.06
    points: int = 1280
    noise_m: float = 3.7e-5

    @property
    def middle_m(self) -> float:
        """The distance to work at."""
        return 0.5 * (self.near_m + self.far_m)

    @property
    def sense(self) -> float:
        """1 where z grows away from the sensor, -1 where towards it."""
        return 1.0 if self.far_m > self.near_m else -1.0

    @property
    def reach_m(self) -> float:
        """Distance at which turns count."""
        return max(abs(self.middle_m), 0.5 * self.width_m)

    @property
    def pivot(self) -> Array:
        """The middle (3,) of its field, sensor frame, m."""
        return np.array([0.0, 0.0, self.middle_m])

    @property
    def field_points(self) -> Array:
        """Middle and corners (5, 3) of its field, sensor frame, m."""
        half = 0.5 * self.width_m
        corners = [[x, 0.0, z] for x in (-half, half) for z in (self.near_m, self.far_m)]
        return np.array([self.pivot, *corners])


@dataclass(frozen=True)
class SensorDescription:
    """How a line laser tells its profiles; plain values, so that a recording carries them.

    ``z_grows``: away from the sensor, or towards it. ``x``, ``z``: columns of a table, by name or
    number (from 1), or fields of a cloud, along the laser line and along the beam; empty: ``x_mm``
    and ``z_mm`` of a table, x and z of a cloud. ``unit``, ``cloud_unit``: of both in files, and in
    messages; a table's own columns are in mm. ``x_pitch_mm``: from column to column where nothing
    tells x, the first at ``x_start_mm`` or, if None, so that 0 is amid them; 0: x is told.
    ``lines``: whether each line of a table holds the heights of a profile, at that pitch.
    ``z_step_mm``, ``z_zero``: of a count, and which count is 0; a step of 0: z is a length.
    ``no_return``: values of z, as they are told, that stand for none. ``intensity``,
    ``least_intensity``: a column or field; weaker points are left out. ``row``: a column or field
    that numbers the profiles, where there are several. ``ordered``: whether points follow the
    sensor's columns; else they are sorted along x. ``near_mm``, ``far_mm``, ``width_mm``,
    ``noise_mm``: of the field and of a point along the beam; see `SensorRange`; None where
    nothing is told.
    """

    z_grows: str = Z_GROWS[0]
    x: str = ""
    z: str = ""
    unit: str = "mm"
    cloud_unit: str = "m"
    x_pitch_mm: float = 0.0
    x_start_mm: float | None = None
    lines: bool = False
    z_step_mm: float = 0.0
    z_zero: float = 0.0
    no_return: tuple[float, ...] = ()
    intensity: str = ""
    least_intensity: float = 0.0
    row: str = ""
    ordered: bool = True
    near_mm: float | None = None
    far_mm: float | None = None
    width_mm: float | None = None
    noise_mm: float | None = None

    @property
    def towards(self) -> bool:
        """Whether z is a height."""
        return self.z_grows == "towards"

    @property
    def tells_columns(self) -> bool:
        """Whether tables are others than of ``x_mm`` and ``z_mm``."""
        return bool(self.z or self.x or self.x_pitch_mm or self.row or self.intensity)

    def seen_range(
        self, near_mm: float, far_mm: float, width_mm: float, noise_mm: float
    ) -> SensorRange:
        """What it sees; by the numbers where nothing is told of it.

        Of numbers that are distances the middle counts as 0 where z grows towards the sensor.

        Raises `InputError` for heights where z grows away from it.
        """
        if self.near_mm is not None and self.far_mm is not None:
            near_mm, far_mm = self.near_mm, self.far_mm
        elif self.towards and near_mm < far_mm:
            near_mm, far_mm = 0.5 * (far_mm - near_mm), -0.5 * (far_mm - near_mm)
        elif near_mm > far_mm and not self.towards:
            raise InputError(
                f"the sensor's field is given from {near_mm:g} to {far_mm:g} mm, but its z grows "
                "away from it: say z_grows, or exchange the two"
            )
        width_mm = width_mm if self.width_mm is None else self.width_mm
        noise_mm = noise_mm if self.noise_mm is None else self.noise_mm
        ends = near_mm * 1e-3, far_mm * 1e-3
        return SensorRange(*ends, width_mm * 1e-3, noise_m=noise_mm * 1e-3)

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "SensorDescription":
        """Read plain values (`asdict`), also after JSON. Raises `TypeError` as a constructor."""
        values = dict(document)
        return cls(**(values | {"no_return": tuple(values.get("no_return", ()))}))


DEFAULT = SensorDescription()
PRESETS = {
    "keyence": SensorDescription(
        z_grows="towards", no_return=(-2147483648.0, -2147483647.0, -2147483646.0, -2147483645.0)
    ),
    "lmi-gocator": SensorDescription(z_grows="towards", no_return=(-32768.0,)),
    "micro-epsilon": SensorDescription(z_grows="away"),
    "sick-ruler": SensorDescription(z_grows="towards", no_return=(0.0,)),
    "wenglor": SensorDescription(z_grows="away"),
}


def sensor_of(name: str, z_grows: str = "") -> SensorDescription:
    """The description of a preset's name or in a file; of neither the default.

    ``z_grows``: that is said beside it.

    Raises `InputError`, naming file and key, when there is none, or it is not as
    docs/hand_eye.md says.
    """
    if not name:
        found = DEFAULT
    elif name in PRESETS:
        found = PRESETS[name]
    elif Path(name).suffix or Path(name).exists():
        return _read_description(Path(name), z_grows)
    else:
        raise InputError(
            f"sensor {quoted(name)} is no file, and none of {', '.join(PRESETS)}: describe it in "
            "a YAML file"
        )
    return replace(found, z_grows=z_grows) if z_grows else found


def _read_description(path: Path, z_grows: str) -> SensorDescription:
    top = read_fields(path, "sensor description")
    known: Document = asdict(DEFAULT)
    top.only("preset", *known)
    base = PRESETS[top.choice("preset", tuple(PRESETS))] if "preset" in top.values else DEFAULT
    told: Document = {}
    for key in top.values:
        if key in ("x", "z", "intensity", "row"):
            value = top.values[key]
            if str(value) == "0":
                top.fail("is 0: columns count from 1", key)
            told[key] = str(value) if type(value) is int and value > 0 else top.text(key)
        elif key in ("lines", "ordered"):
            told[key] = top.yes(key)
        elif key == "z_grows":
            told[key] = top.choice(key, Z_GROWS)
        elif key in ("unit", "cloud_unit"):
            told[key] = top.choice(key, tuple(UNITS))
        elif key == "no_return":
            several = isinstance(top.values[key], list)
            told[key] = tuple(top.row(key)) if several else (top.number(key),)
        elif key in ("x_pitch_mm", "z_step_mm", "width_mm", "noise_mm"):
            told[key] = top.positive(key)
        elif key != "preset":
            told[key] = top.number(key)
    found = replace(base, **told | ({"z_grows": z_grows} if z_grows else {}))
    _require_whole(found, top)
    return found


def _require_whole(sensor: SensorDescription, top: Fields) -> None:
    """Refuse what is said by half. Raises `InputError`."""
    if bool(sensor.x) != bool(sensor.z) and not sensor.x_pitch_mm:
        top.fail("must be given with the other one, or x_pitch_mm", "z" if sensor.z else "x")
    if sensor.x and sensor.x_pitch_mm:
        top.fail("is given beside x: keep the one that tells it", "x_pitch_mm")
    if sensor.lines and not sensor.x_pitch_mm:
        top.fail("needs x_pitch_mm, which tells x", "lines")
    if sensor.least_intensity and not sensor.intensity:
        top.fail("needs intensity, the name of the column", "least_intensity")
    ends = (sensor.near_mm, sensor.far_mm)
    if (ends[0] is None) != (ends[1] is None):
        top.fail("must give both near_mm and far_mm, or none")
    if ends[0] is not None and ends[1] is not None:
        if not 0.0 < abs(ends[0] - ends[1]) < FARTHEST_MM:
            top.fail(f"is {ends[0]:g}, far_mm {ends[1]:g}: the field has no depth", "near_mm")
        if (ends[0] > ends[1]) != sensor.towards:
            top.fail(
                f"is {ends[0]:g}, far_mm {ends[1]:g}, but z grows "
                f"{'towards' if sensor.towards else 'away from'} the sensor: say z_grows, or "
                "exchange the two",
                "near_mm",
            )


# ---- from columns to a profile ------------------------------------------------------------------


def columns_profile(
    columns: Columns, width: int, sensor: SensorDescription, unit_m: float, name: str
) -> Profile:
    """The profile of columns (n,) of points; of several profiles the one of the most points.

    ``width``: of an organised cloud, whose rows are profiles; else 0. All profiles of a standstill
    share its pose, whose error is larger than what a mean of them would lower.
    """
    told = columns["z"]
    z: Array = (
        (told - sensor.z_zero) * sensor.z_step_mm * 1e-3 if sensor.z_step_mm else told * unit_m
    )
    numbers = _rows_of(columns, width, unit_m)
    if "x" in columns:
        x: Array = columns["x"] * unit_m
    else:
        # Place (n,) of each point within its profile.
        order = np.argsort(numbers, kind="stable")
        ordered = numbers[order]
        place = np.empty(len(numbers), dtype=np.int64)
        place[order] = np.arange(len(numbers)) - np.searchsorted(ordered, ordered)
        count = int(place.max()) + 1
        middle_mm = -0.5 * (count - 1) * sensor.x_pitch_mm
        start_mm = middle_mm if sensor.x_start_mm is None else sensor.x_start_mm
        x = np.asarray(1e-3 * (start_mm + sensor.x_pitch_mm * place))
    none = np.asarray(sensor.no_return, dtype=np.float32)  # clouds tell numbers no finer
    with np.errstate(over="ignore"):
        seen = np.isfinite(x) & np.isfinite(z) & ~np.isin(told.astype(np.float32), none)
    if "intensity" in columns:
        seen &= columns["intensity"] >= sensor.least_intensity
    rows, size = np.unique(numbers[seen], return_counts=True)
    if not len(rows):
        return profile_of(np.empty((0, 2)), name)
    seen &= numbers == rows[int(np.argmax(size))]
    if "y" in columns:
        _require_plane(unit_m * columns["y"][seen], len(rows) > 1, name)
    points = np.column_stack([x, z])[seen]
    if not sensor.ordered:
        points = points[np.argsort(points[:, 0], kind="stable")]
    return profile_of(points, name)


def _require_plane(y: Array, of_several: bool, name: str) -> None:
    """Refuse points of a profile that are beside their plane, m; one of several may have its own.

    Raises `InputError`.
    """
    off_m = float(np.ptp(y) if of_several else np.max(np.abs(y)))
    if not off_m <= PLANE_M:
        raise InputError(
            f"profile {name} has points {off_m * 1e3:.4g} mm beside the plane y = 0: x is along "
            "the laser line, z along the beam; turn the sensor's axes accordingly"
        )


def _rows_of(columns: Columns, width: int, unit_m: float) -> NDArray[np.int64]:
    """Number (n,) of the profile that each point is of.

    By the field that tells it, the row of an organised cloud, y as of a sensor that believes to
    move, or where x begins anew.
    """
    count = len(columns["z"])
    one = np.zeros(count, dtype=np.int64)
    if "row" in columns:
        return np.asarray(np.unique(columns["row"], return_inverse=True)[1].ravel(), np.int64)
    if 0 < width < count:
        return np.arange(count, dtype=np.int64) // width
    if "y" in columns and np.any(np.abs(unit_m * columns["y"]) > PLANE_M):
        plane = np.round(unit_m * columns["y"] / PLANE_M)
        _, numbers, size = np.unique(plane, return_inverse=True, return_counts=True)
        if len(size) > 1 and np.median(size) >= FEWEST_POINTS:
            return np.asarray(numbers.ravel(), np.int64)
        return one
    if "x" not in columns or np.sum(told := np.isfinite(columns["x"])) < FEWEST_POINTS:
        return one
    x = columns["x"][told]
    steps = np.diff(x) * (-1.0 if np.median(np.diff(x)) < 0.0 else 1.0)  # either way
    if np.mean(steps < 0.0) > SCATTERED:
        return one  # in no order at all
    one[np.flatnonzero(told)[1:][steps < -ANEW * np.ptp(x)]] = 1
    return np.cumsum(one)


def _wanted(sensor: SensorDescription, x: str, z: str, y: str = "") -> dict[str, str]:
    """What columns stand for, and their names, of the description or as they are without."""
    told = "" if sensor.x_pitch_mm else sensor.x or x
    names = {"x": told, "y": y, "z": sensor.z or z}
    names |= {"intensity": sensor.intensity, "row": sensor.row}
    return {what: name for what, name in names.items() if name}


def cloud_profile(message: Any, sensor: SensorDescription = DEFAULT) -> Profile:
    """The profile of a ``sensor_msgs/PointCloud2``: one profile, or several of one standstill.

    These are the rows of an organised cloud, or told by a field, by y, or where x begins anew.
    """
    fields = [field.name for field in message.fields]
    # A cloud of x, y and z is expected: that y is missing is told, unless other fields are named.
    plane = "y" if "y" not in (sensor.x, sensor.z) and ("y" in fields or not sensor.x) else ""
    wanted = _wanted(sensor, "x", "z", plane)
    read = dict(zip(wanted, cloud_columns(message, list(wanted.values())).T, strict=True))
    width = _width(int(message.width), int(message.height))
    unit_m = UNITS[sensor.cloud_unit]
    return columns_profile(read, width, sensor, unit_m, f"at {stamp_ns(message.header.stamp)} ns")


def _width(width: int, height: int) -> int:
    """Length of the rows of an organised cloud, each a profile; 0 of one that is not."""
    return width if height > 1 and width > 1 else 0


# ---- files of the makers ------------------------------------------------------------------------


def file_profile(path: Path, sensor: SensorDescription, name: str) -> Profile:
    """The profile of a file: ``.ply``, ``.pcd``, else a table of text as described.

    Raises `InputError`, naming the file, when it is not as the description says, or of another
    unit; `TooFewSamplesError` when nearly nothing was seen.
    """
    suffix, width, unit_m = path.suffix.lower(), 0, UNITS[sensor.unit]
    try:
        if suffix in CLOUDS:
            every, width = (_ply if suffix == ".ply" else _pcd)(read_bytes(path, "profile"))
            plane = "y" if "y" in every and "y" not in (sensor.x, sensor.z) else ""
            wanted = _wanted(sensor, "x", "z", plane)
            for column in wanted.values():
                if column not in every:
                    raise InputError(f"has no {quoted(column)}, but {', '.join(every)}")
            columns: Columns = {what: every[column] for what, column in wanted.items()}
        else:
            columns, width = _text(read_bytes(path, "profile"), sensor)
        return columns_profile(columns, width, sensor, unit_m, name)
    except InputError as error:
        raise InputError(str(error), file=str(path)) from error


def _text(data: bytes, sensor: SensorDescription) -> tuple[Columns, int]:
    """Columns of a table whose header, if any, names them; what stands before it is passed over.

    Cells are separated by ``;``, else tabs, else commas, else blanks, the first with which columns
    and numbers are found; but for commas a decimal mark may be one.
    """
    text = data.decode("utf-8-sig", errors="replace")
    first: RobocalError | None = None
    for mark in (*(m for m in ";\t," if m in text), None):
        try:
            return _separated(text, mark, sensor)
        except (InputError, TooFewSamplesError) as error:
            first = first or error
    assert first is not None
    raise first


def _separated(text: str, mark: str | None, sensor: SensorDescription) -> tuple[Columns, int]:
    lines = [
        [cell.strip().strip('"') for cell in line.split(mark)]
        for line in text.splitlines()
        if line.strip()
    ]
    decimal = mark != ","
    if sensor.lines:
        told = [row for line in lines if (row := _numbers(line, decimal)) is not None]
        width = max(map(len, told), default=0)
        if width < FEWEST_POINTS:
            raise TooFewSamplesError(f"no line of it has {FEWEST_POINTS} numbers or more")
        return {"z": np.concatenate([row for row in told if len(row) == width])}, width
    wanted = _wanted(sensor, "x_mm", "z_mm")
    at = {what: int(name) - 1 for what, name in wanted.items() if name.isdecimal()}
    words = [name for name in wanted.values() if not name.isdecimal()]
    start = 0
    if words:
        start = next((i for i, line in enumerate(lines) if set(words) <= set(line)), -1)
        if start < 0:
            raise InputError(f"no line names the columns {', '.join(words)}")
        at |= {what: lines[start].index(name) for what, name in wanted.items() if name in words}
        start += 1
    cells = [
        [line[i] for i in at.values()] for line in lines[start:] if len(line) > max(at.values())
    ]
    begin = next((i for i, row in enumerate(cells) if _numbers(row, decimal) is not None), -1)
    if begin < 0:
        raise TooFewSamplesError("no line of it holds numbers where the description has columns")
    rows = [[_number(cell, decimal) for cell in row] for row in cells[begin:]]
    table = np.array(rows, dtype=np.float64)  # a word in a cell stands for no return
    return dict(zip(at, table.T, strict=True)), 0


_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def _number(cell: str, decimal_comma: bool) -> float | None:
    """A cell as a number, an empty one or nan as not-a-number; None where it is a word."""
    text = cell.replace(",", ".") if decimal_comma else cell
    if text.lower() in ("", "nan"):
        return float("nan")
    return float(text) if _NUMBER.fullmatch(text) else None


def _numbers(cells: Sequence[str], decimal_comma: bool) -> Array | None:
    """Cells as numbers; None where one is a word."""
    found = [_number(cell, decimal_comma) for cell in cells]
    return None if None in found else np.array(found, dtype=np.float64)


_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_PLY_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">"}


def _ply(data: bytes) -> tuple[Columns, int]:
    """Properties of the vertices of a PLY file, which must be its first element."""
    head, found, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not found:
        raise InputError("is no PLY file")
    form, count, inside = "", -1, False
    kinds: list[tuple[str, str]] = []
    for words in (line.split() for line in head.decode("ascii", errors="replace").splitlines()):
        if words[:1] == ["format"] and len(words) > 1:
            form = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            if count < 0 and words[1] != "vertex":
                raise InputError(f"begins with {words[1]}s: save its vertices alone")
            inside = count < 0
            count = int(words[2]) if inside and words[2].isdecimal() else count
        elif words[:1] == ["property"] and inside:
            if len(words) != 3 or words[1] not in _PLY_TYPES:
                raise InputError(f"has a vertex property that is no number: {' '.join(words)}")
            kinds.append((words[2], _PLY_TYPES[words[1]]))
    body = body[2 if body.startswith(b"\r\n") else 1 :]
    if form == "ascii":
        return _ascii_columns(body, [name for name, _ in kinds], count), 0
    if form not in _PLY_ORDER:
        raise InputError(f"is PLY of the unknown format {quoted(form)}")
    return _binary_columns(
        body, [(name, _PLY_ORDER[form] + kind) for name, kind in kinds], count
    ), 0


def _pcd(data: bytes) -> tuple[Columns, int]:
    """Fields of a PCD file, and its width where it is organised."""
    match = re.search(rb"^DATA[ \t]+(\S+)[ \t]*\r?\n", data, re.MULTILINE)
    if match is None:
        raise InputError("is no PCD file: it has no line DATA")
    head: dict[str, list[str]] = {}
    for line in data[: match.start()].decode("ascii", errors="replace").splitlines():
        words = line.split()
        if words and not line.startswith("#"):
            head[words[0]] = words[1:]
    try:
        # "_" is padding, of which there may be several
        names = [f"_{i}" if name == "_" else name for i, name in enumerate(head["FIELDS"])]
        sizes, types = head["SIZE"], head["TYPE"]
        each = [int(word) for word in head.get("COUNT", ["1"] * len(names))]
        if min(each, default=0) < 1:
            raise ValueError("a COUNT below 1")
        width, height = int(head["WIDTH"][0]), int(head["HEIGHT"][0])
        kinds = [
            (name, f"<{kind.lower()}{size}", (number,))
            for name, size, kind, number in zip(names, sizes, types, each, strict=True)
        ]
        np.dtype(kinds)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise InputError(f"has a PCD header that cannot be read: {error}") from error
    form, body = match.group(1).decode("ascii", errors="replace"), data[match.end() :]
    organised = _width(width, height)
    if form == "ascii":
        every = [name for name, number in zip(names, each, strict=True) for _ in range(number)]
        return _ascii_columns(body, every, width * height), organised
    if form != "binary":
        raise InputError(f"is PCD of the form {quoted(form)}: save it as binary or ascii")
    return _binary_columns(body, kinds, width * height), organised


def _ascii_columns(body: bytes, names: Sequence[str], count: int) -> Columns:
    lines = body.decode("ascii", errors="replace").splitlines()[: max(count, 0)]
    rows = [_numbers(line.split(), decimal_comma=False) for line in lines if line.strip()]
    whole = [row for row in rows if row is not None and len(row) == len(names)]
    if not names or len(whole) != count:
        raise InputError(f"holds {len(whole)} rows of {len(names)} numbers, not {count}")
    return dict(zip(names, np.array(whole).reshape(-1, len(names)).T, strict=True))


def _binary_columns(body: bytes, kinds: Sequence[Any], count: int) -> Columns:
    try:
        kind = np.dtype(list(kinds))
    except ValueError as error:
        raise InputError(f"has fields that cannot be read: {error}") from error
    if not kinds or not 0 <= count * kind.itemsize <= len(body):
        raise InputError(f"holds {len(body)} bytes, not {count} points of {kind.itemsize}")
    table = np.frombuffer(body, dtype=kind, count=count)
    columns = {name: np.asarray(table[name], dtype=np.float64) for name in kind.names or ()}
    return {name: one if one.ndim == 1 else one[:, 0] for name, one in columns.items()}
