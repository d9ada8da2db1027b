"""``robocal fk``: where the flange and the tool are at given joints."""

import argparse
import re
from functools import partial
from typing import TYPE_CHECKING, Any

from robocal_ros.cli.arguments import ROBOT_HELP, describe_robot, warn
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import quoted

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.kinematics import SerialArm

NAME = "fk"
HELP = "pose of the flange, and of the tool, at given joint values"

_VALUE = re.compile(r"\s*([-+]?[0-9.]+(?:e[-+]?[0-9]+)?)\s*([a-z]*)\s*", re.IGNORECASE)
_TO_SI = {"deg": 3.141592653589793 / 180.0, "rad": 1.0, "mm": 1e-3, "m": 1.0}

_MOST_DEG = 1e6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    joints = parser.add_mutually_exclusive_group(required=True)
    joints.add_argument("--joints-deg", metavar="Q1,Q2,…", help="joints in degrees")
    joints.add_argument("--joints-rad", metavar="Q1,Q2,…", help="joints in radians")
    joints.add_argument(
        "--joints",
        metavar="Q1,Q2,…",
        help="joints each with its unit, such as 100mm,90deg,0.5m (prismatic joints need it)",
    )


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    import numpy as np

    from robocal_ros.ground.frames import transform_document

    warnings: list[str] = []
    arm = describe_robot(args.robot, warnings).arm
    q = np.array(_joints(args, arm))
    T_base_flange = arm.fk(q)
    document: Document = {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "joints": _joint_documents(arm, q.tolist()),
        "T_base_flange": transform_document(T_base_flange),
    }
    if not np.array_equal(arm.T_flange_tool, np.eye(4)):
        document["T_base_tool"] = transform_document(T_base_flange @ arm.T_flange_tool)
    warnings += [
        f"{joint['name']} at {joint['value']:g} {joint['unit']} is beyond its limits"
        for joint in document["joints"]
        if not joint["within_limits"]
    ]
    document["warnings"] = warnings
    warn(warnings)
    return CliResult(document, partial(_show, document=document))


def _joints(args: argparse.Namespace, arm: "SerialArm") -> list[float]:
    """Joint values in SI."""
    option, unit = "--joints", ""
    if args.joints_deg is not None:
        option, unit = "--joints-deg", "deg"
    elif args.joints_rad is not None:
        option, unit = "--joints-rad", "rad"
    cells = getattr(args, option[2:].replace("-", "_")).split(",")
    if len(cells) != arm.n:
        raise InputError(f"{option} has {len(cells)} values; {arm.name} has {arm.n} joints")
    if unit and any(arm.prismatic):
        raise InputError(f"{arm.name} has prismatic joints: use --joints, each with its unit")
    return [_value(cell, unit, option, arm, joint) for joint, cell in enumerate(cells)]


def _value(cell: str, unit: str, option: str, arm: "SerialArm", joint: int) -> float:
    found = _VALUE.fullmatch(cell)
    units = ("mm", "m") if arm.prismatic[joint] else ("deg", "rad")
    try:
        number, given = float(found[1] if found else cell), found[2].lower() if found else ""
    except ValueError:
        number, given = float("nan"), ""
    if number != number or abs(number) == float("inf"):
        raise InputError(f"{option}: {quoted(cell)} of joint {joint + 1} is not a number")
    if unit and given:
        raise InputError(f"{option}: {quoted(cell)} has a unit; use --joints for values with one")
    if not unit and given not in units:
        kind = "prismatic" if arm.prismatic[joint] else "revolute"
        raise InputError(
            f"{option}: {quoted(cell)} needs the unit {' or '.join(units)}; joint {joint + 1} "
            f"of {arm.name} is {kind}"
        )
    value = number * _TO_SI[unit or given]
    if not arm.prismatic[joint] and abs(value) > _MOST_DEG * _TO_SI["deg"]:
        raise InputError(
            f"{option}: {quoted(cell)} of joint {joint + 1} is beyond {_MOST_DEG:g} deg; no "
            "joint turns that far"
        )
    return value


def _joint_documents(arm: "SerialArm", q: list[float]) -> list[dict[str, Any]]:
    documents = []
    for joint, value in enumerate(q):
        unit = "mm" if arm.prismatic[joint] else "deg"
        documents.append(
            {
                "name": arm.joint_names[joint],
                "value": value / _TO_SI[unit],
                "unit": unit,
                "within_limits": bool(arm.lower[joint] <= value <= arm.upper[joint]),
            }
        )
    return documents


def _show(console: "Console", document: Document) -> None:
    from rich.table import Table

    values = ", ".join(f"{joint['value']:g} {joint['unit']}" for joint in document["joints"])
    table = Table(title=f"{document['robot']} at {values}")
    for heading in ("", "x mm", "y mm", "z mm", "qx", "qy", "qz", "qw"):
        table.add_column(heading, justify="right")
    for key, name in (("T_base_flange", "flange"), ("T_base_tool", "tool")):
        if key in document:
            pose = document[key]
            lengths = [f"{value:z.3f}" for value in pose["xyz_mm"]]
            table.add_row(name, *lengths, *(f"{value:z.6f}" for value in pose["quat_xyzw"]))
    console.print(table)
