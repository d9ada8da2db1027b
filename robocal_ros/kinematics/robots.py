# SPDX-License-Identifier: Apache-2.0
"""Robot files (YAML), described in docs/files.md, and where the shipped ones are."""

import hashlib
import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import yaml
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, WrongRobotError
from robocal_ros.ground.files import nearest, quoted, read_text, share_folders, write_text
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics.arm import SerialArm
from robocal_ros.kinematics.joint_functions import (
    STANDARD_GRAVITY,
    ArmLoad,
    IdentifiedFrom,
    JointFunctions,
)

try:  # a seventh of the time
    from yaml import CSafeLoader as SafeLoader
except ImportError:  # PyYAML without libyaml
    from yaml import SafeLoader  # type: ignore[assignment]

# ---- values of a YAML file by key, checked; errors name file, place and key ---------------------


class _StrictLoader(SafeLoader):
    """YAML in which a key that is given twice is an error, not the last one's victory."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            if str(key_node.value) in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {quoted(key_node.value)} appears twice",
                    problem_mark=key_node.start_mark,
                )
            seen.add(str(key_node.value))
        return super().construct_mapping(node, deep)


def load_yaml(text: str, file: str) -> Any:
    """Parse YAML.

    Raises `InputError` with file and row, when it is not YAML or gives a key twice; without a row
    for a value that is none of its kind, as the date 2026-02-30.
    """
    try:
        return yaml.load(text, Loader=_StrictLoader)
    except yaml.MarkedYAMLError as error:
        row = error.problem_mark.line + 1 if error.problem_mark else None
        raise InputError(f"not valid YAML: {error.problem}", file=file, row=row) from error
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"not valid YAML: {error}", file=file) from error
    except (TypeError, KeyError, AttributeError) as error:  # PyYAML's own, of a value with a tag
        words = "a value is none of the kind that its tag names"
        raise InputError(f"not valid YAML: {words}", file=file) from error


class Fields:
    """A mapping of the file; ``place`` says where it is ("" is the top)."""

    def __init__(self, values: Any, file: str, place: str) -> None:
        self.file = file
        self.place = place
        if not isinstance(values, dict):
            self.fail(f"must be keys and values, not {_kind(values)}")
        self.values: dict[Any, Any] = values

    def fail(self, message: str, key: str = "") -> NoReturn:
        """Refuse the file; ``message`` continues the place and the key."""
        place = ", ".join(part for part in (self.place, key) if part) or "the file"
        raise InputError(f"{place} {message}", file=self.file)

    def only(self, *known: str) -> None:
        """Refuse keys beside the known ones."""
        for key in self.values:
            if key not in known:
                self.fail(f"is not a known key{nearest(str(key), known)}", quoted(key))

    def _get(self, key: str) -> Any:
        if self.values.get(key) is None:
            self.fail("is missing" if key not in self.values else "has no value", key)
        return self.values[key]

    def text(self, key: str) -> str:
        """A text that is not empty."""
        value = self._get(key)
        if not isinstance(value, str) or not value.strip():
            self.fail(f"must be a text, not {_kind(value)}", key)
        return value

    def choice(self, key: str, known: Sequence[str], default: str | None = None) -> str:
        """One of the known words."""
        if key not in self.values and default is not None:
            return default
        value = self._get(key)
        if value not in known:
            words = " or ".join(known)
            self.fail(f"is {quoted(value)}; it must be {words}{nearest(str(value), known)}", key)
        return str(value)

    def yes(self, key: str) -> bool:
        """Whether it is true; false when it is left out."""
        value = self.values.get(key, False)
        if not isinstance(value, bool):
            self.fail("must be true or false", key)
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        if key not in self.values and default is not None:
            return default
        return self._number(self._get(key), key)

    def positive(self, key: str, default: float | None = None) -> float:
        """A number above zero."""
        value = self.number(key, default)
        if value <= 0.0:
            self.fail(f"is {value:g}; it must be above 0", key)
        return value

    def whole(self, key: str, low: int, high: int) -> int:
        """A whole number from ``low`` to ``high``."""
        value = self.number(key)
        if value != int(value) or not low <= value <= high:
            self.fail(f"is {value:g}; it must be a whole number from {low} to {high}", key)
        return int(value)

    def numbers(
        self, key: str, count: int, default: tuple[float, ...] | None = None
    ) -> list[float]:
        """A list of ``count`` finite numbers."""
        if key not in self.values and default is not None:
            return list(default)
        value = self._get(key)
        if not isinstance(value, list) or len(value) != count:
            self.fail(f"must be a list of {count} numbers", key)
        return [self._number(item, key) for item in value]

    def row(self, key: str) -> list[float]:
        """A list of finite numbers; none when it is left out."""
        value = self.values.get(key, [])
        return self.numbers(key, len(value) if isinstance(value, list) else 0, ())

    def rows(self, key: str, count: int, width: int) -> list[list[float]]:
        """A list of ``count`` lists of ``width`` finite numbers."""
        value = self._get(key)
        if not isinstance(value, list) or len(value) != count:
            self.fail(f"must be {count} lists of {width} numbers", key)
        return [Fields({key: row}, self.file, self.place).numbers(key, width) for row in value]

    def _number(self, value: Any, key: str) -> float:
        if isinstance(value, str):  # YAML 1.1 takes 1e-3 for a text
            try:
                value = float(value)
            except ValueError:
                self.fail(f"is {quoted(value)}, not a number", key)
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fail(f"must be a number, not {_kind(value)}", key)
        if not math.isfinite(value):
            self.fail(f"is {value}, not a finite number", key)
        return float(value)

    def below(self, key: str) -> "Fields":
        """The mapping at ``key``."""
        return Fields(self._get(key), self.file, key)

    def items(self, key: str, name: str) -> list["Fields"]:
        """The mappings of the list at ``key``, which must not be empty."""
        value = self._get(key)
        if not isinstance(value, list) or not value:
            self.fail(f"must be a list with at least one {name}", key)
        return [Fields(item, self.file, f"{name} {i}") for i, item in enumerate(value, start=1)]


def _kind(value: Any) -> str:
    kinds = {dict: "keys and values", list: "a list", str: quoted(value), type(None): "nothing"}
    return kinds.get(type(value), str(value))


# ---- robot files (YAML), described in docs/files.md, and where the shipped ones are --------


CONVENTIONS = ("dh", "mdh")
TYPES = ("revolute", "prismatic")
RAD = float(np.pi / 180.0)
MM = 1e-3
GEOMETRY = {"d_mm": MM, "theta_deg": RAD, "a_mm": MM, "alpha_deg": RAD, "beta_deg": RAD}
COMMON_KEYS = ("name", "type", "sign", *GEOMETRY)
UNITS = {False: ("deg", RAD), True: ("mm", MM)}
# Makers publish joint speeds and hardly ever accelerations: where the file gives none, the joint is
# taken to reach its full speed in this time.
FULL_SPEED_IN_S = 0.5


@dataclass(frozen=True)
class RobotDescription:
    """Content of a robot file.

    ``max_velocity`` (n,): rad/s (prismatic: m/s), NaN where the file gives none.
    ``max_acceleration`` (n,): rad/s² (prismatic: m/s²), NaN where neither it nor a speed is given.
    ``acceleration_assumed`` (n,): bool, where the file gives none: it is max_velocity / 0.5 s.
    ``notes``: what the file leaves open, in words.
    ``file_hash``: SHA-256 of the file's bytes, its first 16 hexadecimal digits: unlike
    `SerialArm.model_hash` it tells robots of one type apart that have their own files.
    """

    arm: SerialArm
    path: Path
    max_velocity: Array
    max_acceleration: Array
    acceleration_assumed: NDArray[np.bool_]
    notes: tuple[str, ...]
    file_hash: str


def load_robot(name: str | Path) -> SerialArm:
    """Arm of a robot file; warns of joint limits that the file does not give.

    ``name``: path of a file, or name of one in the folders of ``robot_folders``.

    Raises `InputError` naming file, joint and key, when the file is not as docs/files.md says.
    """
    description = load_description(name)
    for note in description.notes:
        warnings.warn(f"{description.path}: {note}", stacklevel=2)
    return description.arm


def load_description(name: str | Path) -> RobotDescription:
    """Everything that a robot file says; see ``load_robot``."""
    path = find_robot(name)
    text = read_text(path, "robot file")
    top = Fields(load_yaml(text, str(path)), str(path), "")
    known = ("robot", "convention", "joints", "base", "tool", "load", "functions")
    top.only(*known, "identified_from")
    robot = top.text("robot")
    convention = top.choice("convention", CONVENTIONS)
    joints = [_Joint(fields, convention) for fields in top.items("joints", "joint")]
    names = [joint.name for joint in joints]
    doubled = next((name for name in names if names.count(name) > 1), None)
    if doubled is not None:
        top.fail(f"two joints have the name {quoted(doubled)}", "joints")
    arm = SerialArm(
        name=robot,
        joint_names=tuple(names),
        mdh=np.array([joint.mdh for joint in joints]),
        sign=np.array([joint.sign for joint in joints]),
        prismatic=np.array([joint.prismatic for joint in joints]),
        lower=np.array([joint.lower for joint in joints]),
        upper=np.array([joint.upper for joint in joints]),
        T_base_root=_pose(top, "base"),
        T_flange_tool=_pose(top, "tool"),
        load=_load(top.below("load"), len(joints)) if "load" in top.values else None,
        functions=_functions(top, joints) if "functions" in top.values else None,
    )
    if "identified_from" in top.values and arm.functions is None:
        top.fail("is of joint functions, and there are none", "identified_from")
    velocity = np.array([joint.max_velocity for joint in joints])
    given = np.array([joint.max_acceleration for joint in joints])
    both = np.isinf(arm.lower) & np.isinf(arm.upper)
    notes = [
        f"{which} not given, nothing is assumed: {', '.join(np.array(names)[missing])}"
        for missing, which in (
            (both, "joint limits"),
            (np.isinf(arm.lower) & ~both, "a lower limit"),
            (np.isinf(arm.upper) & ~both, "an upper limit"),
        )
        if np.any(missing)
    ]
    return RobotDescription(
        arm=arm,
        path=path,
        max_velocity=velocity,
        max_acceleration=np.where(np.isnan(given), velocity / FULL_SPEED_IN_S, given),
        acceleration_assumed=np.isnan(given),
        notes=tuple(notes),
        file_hash=text_hash(text),
    )


def text_hash(text: str) -> str:
    """`RobotDescription.file_hash` of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def robot_folders() -> list[Path]:
    """Folders of robot files, in the order in which a name is looked up.

    ``$ROBOCAL_CONFIG/robots``, the source tree's ``config/robots``, then
    ``share/robocal_ros/config/robots`` of ROS' prefixes and of the one that this runs from.
    """
    own = os.environ.get("ROBOCAL_CONFIG")
    shipped = share_folders("robocal_ros", "config/robots", "config/robots")
    return [*([Path(own) / "robots"] if own else []), *shipped]


def find_robot(name: str | Path) -> Path:
    """File of a robot's name or path.

    Raises `InputError` when there is none; the message lists the known names.
    """
    path = Path(name)
    if path.is_file():
        return path
    if path.suffix in (".yaml", ".yml") or len(path.parts) != 1:
        raise InputError("no such robot file", file=str(name))
    known: dict[str, Path] = {}
    for folder in robot_folders():
        for file in sorted(folder.glob("*.yaml")):
            known.setdefault(file.stem, file)
    if str(name) not in known:
        raise InputError(
            f"no robot {quoted(name)}{nearest(str(name), known)}: give the path of a robot file, "
            f"or one of {', '.join(sorted(known)) or '(no robot files are installed)'}"
        )
    return known[str(name)]


def save_robot(
    arm: SerialArm, path: str | Path, like: RobotDescription | None = None, comment: str = ""
) -> None:
    """Write an arm as a robot file; the file appears whole or not at all.

    ``like``: robot file that the arm was made from; the joint speeds that it gives are kept.
    ``comment``: lines to begin the file with.

    Raises `InputError` when it cannot be written.
    """
    convention = "mdh" if np.any(arm.mdh[:, 4]) else "dh"
    document: dict[str, Any] = {"robot": arm.name, "convention": convention}
    document["joints"] = [_joint_document(arm, i, convention, like) for i in range(arm.n)]
    for key, T in (("base", arm.T_base_root), ("tool", arm.T_flange_tool)):
        if not np.array_equal(T, np.eye(4)):
            xyz = [_shown(value, MM) for value in T[:3, 3].tolist()]
            document[key] = {"xyz_mm": xyz, "quat_xyzw": frames.quat_xyzw(T).tolist()}
    if arm.load is not None:
        document["load"] = _load_document(arm.load)
    if arm.functions is not None:
        document["functions"] = _functions_document(arm, arm.functions)
        if arm.functions.identified_from is not None:
            told = _identified_document(arm.functions.identified_from, arm.prismatic)
            document["identified_from"] = told
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000)
    remarks = "".join(f"# {line}\n" for line in comment.splitlines())
    write_text(Path(path), remarks + text)


class _Joint:
    """One entry of ``joints``, in SI."""

    def __init__(self, fields: Fields, convention: str) -> None:
        self.name = fields.text("name")
        fields.place += f" {quoted(self.name)}"
        self.prismatic = fields.choice("type", TYPES, "revolute") == "prismatic"
        unit, factor = UNITS[self.prismatic]
        limits = (f"lower_{unit}", f"upper_{unit}")
        rates = (f"max_velocity_{unit}_s", f"max_acceleration_{unit}_s2")
        fields.only(*COMMON_KEYS, *limits, *rates)
        if convention == "dh" and "beta_deg" in fields.values:
            fields.fail("is not part of convention dh; use convention mdh", "beta_deg")
        self.sign = fields.number("sign", 1.0)
        if self.sign not in (1.0, -1.0):
            fields.fail(f"is {self.sign:g}; it must be 1 or -1", "sign")
        self.mdh = [
            fields.number(key, 0.0 if key == "beta_deg" else None) * to_si
            for key, to_si in GEOMETRY.items()
        ]
        self.lower = fields.number(limits[0], -np.inf) * factor
        self.upper = fields.number(limits[1], np.inf) * factor
        if self.lower >= self.upper:
            fields.fail(f"is not below {limits[1]}", limits[0])
        self.max_velocity, self.max_acceleration = (
            fields.positive(key, np.nan) * factor for key in rates
        )


def _pose(top: Fields, key: str) -> Array:
    """Transform (4, 4) of an optional pose."""
    return read_pose(top.below(key)) if key in top.values else np.eye(4)


def _shown(value: float, factor: float) -> float:
    """The shortest number that reads back as ``value``, where there is one."""
    neat = float(f"{value / factor:.12g}")
    return neat if neat * factor == value else value / factor


def _joint_document(
    arm: SerialArm, joint: int, convention: str, like: RobotDescription | None
) -> dict[str, Any]:
    prismatic = bool(arm.prismatic[joint])
    document: dict[str, Any] = {"name": arm.joint_names[joint]}
    if prismatic:
        document["type"] = "prismatic"
    document["sign"] = int(arm.sign[joint])
    for (key, factor), value in zip(GEOMETRY.items(), arm.mdh[joint].tolist(), strict=True):
        if convention == "mdh" or key != "beta_deg":
            document[key] = _shown(value, factor)
    unit, factor = UNITS[prismatic]
    for side, limit in (("lower", arm.lower[joint]), ("upper", arm.upper[joint])):
        if np.isfinite(limit):
            document[f"{side}_{unit}"] = _shown(float(limit), factor)
    if like is not None and np.isfinite(speed := float(like.max_velocity[joint])):
        document[f"max_velocity_{unit}_s"] = _shown(speed, factor)
    if like is not None and not like.acceleration_assumed[joint]:
        acceleration = float(like.max_acceleration[joint])
        document[f"max_acceleration_{unit}_s2"] = _shown(acceleration, factor)
    return document


# ---- what gravity pulls at, and what joints turn besides what is read ---------------------------

# Per kind of joint (slides or not): keys of first knot and spacing, of the function, of the
# compliance, and their units.
_FUNCTION_KEYS = {
    False: ("first_deg", "step_deg", "coefficients_urad", "compliance_urad_nm"),
    True: ("first_mm", "step_mm", "coefficients_um", "compliance_um_n"),
}
_MICRO = 1e-6


def _load_document(load: ArmLoad) -> dict[str, Any]:
    carried: dict[str, Any] = {
        "payload_kg": load.payload_mass,
        "payload_centre_mm": [_shown(x, MM) for x in load.payload_centre.tolist()],
    }
    return {
        "masses_kg": load.mass.tolist(),
        "centres_mm": [[_shown(x, MM) for x in row] for row in load.centre.tolist()],
        **({"found": True} if load.found else carried),
        "gravity_m_s2": load.gravity.tolist(),
    }


def _load(fields: Fields, n: int) -> ArmLoad:
    keys = ("masses_kg", "centres_mm", "payload_kg", "payload_centre_mm", "gravity_m_s2", "found")
    fields.only(*keys)
    centres, found = fields.rows("centres_mm", n, 3), fields.values.get("found", False)
    if not isinstance(found, bool):
        fields.fail(f"must be true or false, not {_kind(found)}", "found")
    try:
        return ArmLoad(
            np.array(fields.numbers("masses_kg", n)),
            np.array(centres) * MM,
            fields.number("payload_kg", 0.0),
            np.array(fields.numbers("payload_centre_mm", 3, (0.0, 0.0, 0.0))) * MM,
            np.array(fields.numbers("gravity_m_s2", 3, (0.0, 0.0, -STANDARD_GRAVITY))),
            found,
        )
    except ValueError as error:
        fields.fail(f"cannot be: {error}")


def _functions(top: Fields, joints: Sequence["_Joint"]) -> JointFunctions:
    """Of the joints that are named; the others have none."""
    names = [joint.name for joint in joints]
    first, step, compliance = np.zeros(len(names)), np.ones(len(names)), np.zeros(len(names))
    tables: list[list[float]] = [[] for _ in names]
    found: set[int] = set()
    for fields in top.items("functions", "joint function"):
        i = names.index(fields.choice("name", names))
        if i in found:
            fields.fail(f"is {quoted(names[i])}, which has a function already", "name")
        found.add(i)
        keys = _FUNCTION_KEYS[joints[i].prismatic]
        _, unit = UNITS[joints[i].prismatic]
        fields.only("name", *keys)
        first[i] = fields.number(keys[0], 0.0) * unit
        step[i] = fields.positive(keys[1], 1.0) * unit
        tables[i] = [value * _MICRO for value in fields.row(keys[2])]
        compliance[i] = fields.number(keys[3], 0.0) * _MICRO
    if np.any(compliance) and "load" not in top.values:
        top.fail("hold compliances, and there is no load", "functions")
    width = max(len(table) for table in tables)
    padded = np.array([table + [0.0] * (width - len(table)) for table in tables])
    try:
        told = None
        if "identified_from" in top.values:
            slides = np.array([joint.prismatic for joint in joints])
            told = _identified_from(top.below("identified_from"), slides)
        return JointFunctions(first, step, padded, compliance, told)
    except ValueError as error:
        top.fail(f"cannot be: {error}", "functions")


def _functions_document(arm: SerialArm, functions: JointFunctions) -> list[dict[str, Any]]:
    document = []
    for i, name in enumerate(arm.joint_names):
        prismatic = bool(arm.prismatic[i])
        numbers = zip(
            _FUNCTION_KEYS[prismatic],
            (functions.first, functions.step, functions.coefficients, functions.compliance),
            (UNITS[prismatic][1], UNITS[prismatic][1], _MICRO, _MICRO),
            strict=True,
        )
        row: dict[str, Any] = {"name": name}
        for key, values, unit in numbers:
            value = values[i].tolist()
            row[key] = [_shown(x, unit) for x in value] if values.ndim > 1 else _shown(value, unit)
        document.append(row)
    return document


def _identified_from(fields: Fields, slides: NDArray[np.bool_]) -> IdentifiedFrom:
    """Poses are rows of joints in deg (prismatic: mm), target, weight; raises ValueError."""
    fields.only("poses", "targets_mm", "lever_mm", "noise_mm", *_BEFORE, "length", "amplitude")
    n, units = len(slides), np.where(slides, MM, RAD)
    table = np.array([row.split() for row in fields.text("poses").splitlines()], dtype=np.float64)
    if table.shape[1] != n + 2:
        fields.fail(f"must have rows of {n} joints, target and weight", "poses")
    count = len(fields.values.get("targets_mm") or ())
    return IdentifiedFrom(
        q=table[:, :n] * units,
        target=table[:, n].astype(np.int64),
        weight=table[:, n + 1],
        p_flange=np.array(fields.rows("targets_mm", count, 3)).reshape(-1, 3) * MM,
        lever=fields.number("lever_mm") * MM,
        noise=fields.positive("noise_mm") * MM,
        parameter_sigma=np.array(fields.row("parameter_sigma")),
        base_sigma=fields.number("base_sigma"),
        target_sigma=fields.number("target_sigma"),
        length=np.array(fields.numbers("length", n)) * units,
        amplitude=np.array(fields.numbers("amplitude", n)) * _MICRO,
    )


# Standard deviations before the data, m and rad.
_BEFORE = ("parameter_sigma", "base_sigma", "target_sigma")


def _identified_document(told: IdentifiedFrom, slides: NDArray[np.bool_]) -> dict[str, Any]:
    units = np.where(slides, MM, RAD)
    rows = [
        " ".join([*(f"{x:z.5f}" for x in q), str(target), f"{weight:.6g}"])
        for q, target, weight in zip(told.q / units, told.target, told.weight, strict=True)
    ]
    return {
        "targets_mm": (told.p_flange / MM).tolist(),
        "lever_mm": told.lever / MM,
        "noise_mm": told.noise / MM,
        "parameter_sigma": told.parameter_sigma.tolist(),
        "base_sigma": told.base_sigma,
        "target_sigma": told.target_sigma,
        "length": (told.length / units).tolist(),
        "amplitude": (told.amplitude / _MICRO).tolist(),
        "poses": _Lines("\n".join(rows) + "\n"),
    }


class _Lines(str):
    """A text that a file shows line by line."""


yaml.SafeDumper.add_representer(
    _Lines, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|")
)


# ---- files that a command made for one robot: YAML, with the nominal model they belong to -------


def write_made(path: Path, document: Mapping[str, Any], keys: Sequence[str], command: str) -> None:
    """Write the parts of a document that a later command needs; the file appears whole or not."""
    kept = {key: document[key] for key in keys}
    text = yaml.safe_dump(kept, sort_keys=False, default_flow_style=None, width=2**16)
    write_text(path, f"# Written by robocal {command}.\n{text}")


def read_fields(path: Path, what: str) -> Fields:
    """Read a YAML (or JSON) file of keys and values.

    Raises `InputError` when there is no such file, or it is not YAML.
    """
    return Fields(load_yaml(read_text(path, what), str(path)), str(path), "")


def read_made(path: Path, arm: SerialArm, keys: Sequence[str], what: str, remedy: str) -> Fields:
    """Read the keys of such a file, made for ``arm``.

    Raises `InputError` when there is no such file, it is not YAML or has other keys;
    `WrongRobotError` when it was made for another nominal model.
    """
    top = read_fields(path, what)
    top.only(*keys)
    require_made_for(arm, path, top.text("robot"), top.text("model_hash"), remedy)
    return top


def require_made_for(arm: SerialArm, path: Path, robot: str, model_hash: str, remedy: str) -> None:
    """Refuse a file that was made for another nominal model than ``arm``.

    Raises `WrongRobotError` with what to do: ``remedy``.
    """
    if model_hash != arm.model_hash:
        raise WrongRobotError(
            f"{path} was made for {robot} with the model {model_hash}, "
            f"not for {arm.name} ({arm.model_hash}): {remedy} with this robot file"
        )


QUATERNION_TOLERANCE = 1e-3


def read_pose(fields: Fields) -> Array:
    """Transform (4, 4), m, of ``{xyz_mm, quat_xyzw or rpy_deg}``; not turned without the latter.

    Raises `InputError` for another key, both orientations, or a quaternion that is not of unit
    length.
    """
    fields.only("xyz_mm", "quat_xyzw", "rpy_deg")
    xyz = np.array(fields.numbers("xyz_mm", 3)) * 1e-3
    if "quat_xyzw" in fields.values and "rpy_deg" in fields.values:
        fields.fail("is given beside rpy_deg; use one of them", "quat_xyzw")
    if "quat_xyzw" in fields.values:
        quat = np.array(fields.numbers("quat_xyzw", 4))
        length = float(np.linalg.norm(quat))
        if abs(length - 1.0) > QUATERNION_TOLERANCE:
            fields.fail(f"has length {length:.6g}, not 1", "quat_xyzw")
        return frames.transform_from_quat(xyz, quat)
    rpy = np.array(fields.numbers("rpy_deg", 3, (0.0, 0.0, 0.0))) * (np.pi / 180.0)
    return frames.transform(frames.rotation_from_rpy(rpy), xyz)
