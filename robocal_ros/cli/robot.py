# SPDX-License-Identifier: Apache-2.0
"""Commands about one robot: ``fk``, ``joint-functions``, ``import-ur``, and URDF both ways."""

import argparse
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import yaml

from robocal_ros.cli.main import (
    FOUND_MASSES,
    ROBOT_HELP,
    CliResult,
    Document,
    describe_robot,
    print_output,
    print_table,
    print_words,
)
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import quoted, read_text, write_text
from robocal_ros.ground.frames import Array, log_rotation, transform_document
from robocal_ros.identification.known_model import KnownModel, known_model
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import random_postures
from robocal_ros.kinematics.robots import load_yaml, save_robot
from robocal_ros.kinematics.tables import read_joints
from robocal_ros.kinematics.universal_robots import (
    factory_arm,
    factory_dh,
    nominal_arm,
    parse_settings,
)
from robocal_ros.kinematics.urdf import (
    Chain,
    arm_of,
    chain,
    read_urdf,
    ur_chain,
    ur_kinematics,
    urdf_of,
    urdf_with,
)

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.cli.documents import (
        ConvertedUrdfDocument,
        ExportUrdfDocument,
        FkDocument,
        FunctionsOfJointsDocument,
        HayatiRowDocument,
        ImportUrdfDocument,
        ImportUrDocument,
        JointValueDocument,
        PredictedErrorDocument,
    )


_VALUE = re.compile(r"\s*([-+]?[0-9.]+(?:e[-+]?[0-9]+)?)\s*([a-z]*)\s*", re.IGNORECASE)
_TO_SI = {"deg": 3.141592653589793 / 180.0, "rad": 1.0, "mm": 1e-3, "m": 1.0}
_MOST_DEG = 1e6


def add_fk(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    joints = parser.add_mutually_exclusive_group(required=True)
    joints.add_argument("--joints-deg", metavar="Q1,Q2,…", help="joints in degrees")
    joints.add_argument("--joints-rad", metavar="Q1,Q2,…", help="joints in radians")
    joints.add_argument(
        "--joints",
        metavar="Q1,Q2,…",
        help="joints each with its unit, such as 100mm,90deg,0.5m (prismatic joints need it)",
    )


def run_fk(args: argparse.Namespace) -> CliResult:
    robot, warnings = describe_robot(args.robot)
    arm = robot.arm
    q = np.array(_given_joints(args, arm))
    T_base_flange = arm.fk(q)
    joints: list[JointValueDocument] = []
    for name, value, slides, lower, upper in zip(
        arm.joint_names, q.tolist(), arm.prismatic, arm.lower, arm.upper, strict=True
    ):
        unit: Literal["mm", "deg"] = "mm" if slides else "deg"
        shown, within = value / _TO_SI[unit], bool(lower <= value <= upper)
        joints.append({"name": name, "value": shown, "unit": unit, "within_limits": within})
        if not within:
            warnings.append(f"{name} at {shown:g} {unit} is beyond its limits")
    document: FkDocument = {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "joints": joints,
        "T_base_flange": transform_document(T_base_flange),
        "warnings": warnings,
    }
    if not np.array_equal(arm.T_flange_tool, np.eye(4)):
        document["T_base_tool"] = transform_document(T_base_flange @ arm.T_flange_tool)
    return CliResult(document, _show_fk)


def _given_joints(args: argparse.Namespace, arm: "SerialArm") -> list[float]:
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


def _show_fk(console: "Console", document: Document) -> None:
    values = ", ".join(f"{joint['value']:g} {joint['unit']}" for joint in document["joints"])
    rows = [
        [
            name,
            *(f"{value:z.3f}" for value in document[key]["xyz_mm"]),
            *(f"{value:z.6f}" for value in document[key]["quat_xyzw"]),
        ]
        for key, name in (("T_base_flange", "flange"), ("T_base_tool", "tool"))
        if key in document
    ]
    head = ("", "x mm", "y mm", "z mm", "qx", "qy", "qz", "qw")
    print_table(console, f"{document['robot']} at {values}", head, rows)


_ROWS_PER_KNOT = 4  # of a table: a cubic is drawn well by them


def add_joint_functions(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    parser.add_argument("--output", type=Path, metavar="T.csv", help="table to write")
    parser.add_argument(
        "--data", type=Path, metavar="CSV", help="poses: tell the error to expect there"
    )
    parser.add_argument(
        "--figures", type=Path, metavar="DIR", help="write joints.svg there: functions with bands"
    )


def run_joint_functions(args: argparse.Namespace) -> CliResult:
    robot, warnings = describe_robot(args.robot)
    arm = robot.arm
    functions = arm.functions
    if functions is None:
        raise InputError(f"{arm.name} has no joint functions: identify them", file=args.robot)
    knots = functions.coefficients.shape[1] + 4
    steps = np.arange(_ROWS_PER_KNOT * knots + 1)[:, None] / _ROWS_PER_KNOT
    q = functions.first + functions.step * steps
    delta, slope = functions.delta(q), functions.slope(q)
    kept = functions.identified_from is not None
    asked = args.data is not None or args.figures is not None  # refused where nothing tells it
    known = known_model(arm) if kept or asked else None
    sigma = np.full(q.shape, np.nan) if known is None else known.function_sigma(q)
    joints: list[Any] = []  # names of fields have the joint's unit
    rows = ["joint,q,q_unit,delta,delta_unit,slope,sigma"]
    for i, name in enumerate(arm.joint_names):
        unit, small = ("mm", "um") if arm.prismatic[i] else ("deg", "urad")
        shown, micro = q[:, i] / _TO_SI[unit], 1e6 * delta[:, i]
        used = np.flatnonzero(delta[:, i])
        rows += [
            f"{name},{shown[k]:.6f},{unit},{micro[k]:.4f},{small},{slope[k, i]:.8f},"
            f"{'' if known is None else f'{1e6 * sigma[k, i]:.4f}'}"
            for k in used
        ]
        joints.append(
            {
                "name": name,
                "unit": unit,
                "from": float(shown[used[0]]) if len(used) else None,
                "to": float(shown[used[-1]]) if len(used) else None,
                f"rms_{small}": _rms(micro[used]) if len(used) else 0.0,
                f"largest_{small}": float(np.max(np.abs(micro))),
                f"sigma_{small}": _rms(1e6 * sigma[used, i]) if known and len(used) else None,
                "compliance_micro": float(1e6 * functions.compliance[i]),
            }
        )
    if args.output is not None:
        write_text(args.output, "\n".join(rows) + "\n")
    document: FunctionsOfJointsDocument = {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "masses": arm.masses,
        "joints": joints,
        "predicted": _predicted(known, arm, args.data) if known and args.data else None,
        "figures": None,
        "output": None if args.output is None else str(args.output),
        "warnings": warnings,
    }
    if args.figures is not None and known is not None:
        from robocal_ros.report.figures import joint_functions_figure
        from robocal_ros.report.measured_figures import keep_figure

        document["figures"] = keep_figure(args.figures, "joints", joint_functions_figure(known))
    return CliResult(document, _show_joint_functions)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _predicted(known: KnownModel, arm: SerialArm, path: Path) -> "PredictedErrorDocument":
    """Error to expect of the first target at the poses of a table, base and target placed there."""
    q = read_joints(path, arm)
    variance = known.predicted_variance(q, np.zeros(len(q), dtype=np.int64), ("base", "tool"))
    error_mm = 1e3 * np.sqrt(np.trace(variance, axis1=1, axis2=2))
    return {
        "poses": len(q),
        "rms_mm": _rms(error_mm),
        "max_mm": float(error_mm.max()),
        "not_covered": float(np.mean(np.any(known.uncovered(q), axis=1))),
    }


def _show_joint_functions(console: "Console", document: Document) -> None:
    rows = []
    for joint in document["joints"]:
        ends = (joint["from"], joint["to"])
        span = ["" if end is None else f"{end:.1f} {joint['unit']}" for end in ends]
        small, unit, load = "um", "µm", "N"
        if joint["unit"] == "deg":
            small, unit, load = "urad", "µrad", "(N m)"
        sizes = [joint[f"{name}_{small}"] for name in ("rms", "largest", "sigma")]
        numbers = ["" if size is None else f"{size:.1f} {unit}" for size in sizes]
        compliance = f"{joint['compliance_micro']:.4f} {unit}/{load}"
        rows.append([joint["name"], *span, *numbers, compliance])
    title = f"{document['robot']}: what joints turn besides what is read"
    head = ("joint", "from", "to", "rms", "largest", "sigma", "compliance")
    print_table(console, title, head, rows)
    if document["masses"] == "found":
        print_words(console, FOUND_MASSES)
    if told := document["predicted"]:
        away = told["not_covered"]
        console.print(
            f"Error to expect at the {told['poses']} poses: {told['rms_mm']:.3f} mm rms, at most "
            f"{told['max_mm']:.3f} mm; {away:.1%} have a joint where it was not measured."
        )
    print_output(console, document)


_POSES = 1000
_MDH = ("d_mm", "theta_deg", "a_mm", "alpha_deg", "beta_deg")


def add_import_ur(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--calibration",
        required=True,
        type=Path,
        metavar="calibration.conf",
        help="deltas of this robot, from its controller's folder .urcontrol",
    )
    parser.add_argument(
        "--nominal",
        required=True,
        type=Path,
        metavar="urcontrol.conf",
        help="nominal model of its type, from the same folder",
    )
    parser.add_argument(
        "--output", required=True, type=Path, metavar="R.yaml", help="robot file to write"
    )
    parser.add_argument("--name", help="name of the robot, default that of the output file")


def run_import_ur(args: argparse.Namespace) -> CliResult:
    name = args.name or args.output.stem
    settings = [
        parse_settings(read_text(path, "configuration"), str(path))
        for path in (args.nominal, args.calibration)
    ]
    try:
        nominal = nominal_arm(settings[0], name)
        factory = factory_arm(settings[0], settings[1], name)
    except InputError as error:
        path = args.calibration if "delta_" in str(error) else args.nominal
        raise InputError(str(error), file=str(path)) from error
    # as calibrated in the controller's own numbers
    dh = replace(nominal, mdh=factory_dh(settings[0], settings[1]))
    save_robot(factory, args.output)
    distances = _distances(nominal, factory)
    document: ImportUrDocument = {
        "robot": name,
        "model_hash": factory.model_hash,
        "output": str(args.output),
        "joints": joint_rows(factory),
        "from_nominal": {
            "mean_mm": float(distances.mean() * 1e3),
            "max_mm": float(distances.max() * 1e3),
            "n": _POSES,
        },
        "conversion_error_mm": float(_distances(dh, factory).max() * 1e3),
    }
    return CliResult(document, _show_import_ur)


def joint_rows(arm: "SerialArm") -> "list[HayatiRowDocument]":
    """Each joint's name and its numbers `_MDH`."""
    factors = np.array([1e3, 180.0 / np.pi, 1e3, 180.0 / np.pi, 180.0 / np.pi])
    return [
        {
            "name": joint,
            "d_mm": d,
            "theta_deg": theta,
            "a_mm": a,
            "alpha_deg": alpha,
            "beta_deg": beta,
        }
        for joint, (d, theta, a, alpha, beta) in zip(
            arm.joint_names, (arm.mdh * factors).tolist(), strict=True
        )
    ]


def print_joints(console: "Console", title: str, joints: Sequence[Mapping[str, Any]]) -> None:
    rows = [[joint["name"], *(f"{joint[key]:z.4f}" for key in _MDH)] for joint in joints]
    print_table(console, title, ("joint", *(key.replace("_", " ") for key in _MDH)), rows)


def _distances(a: "SerialArm", b: "SerialArm") -> "Array":
    """Distances (m,), m, between the flanges of two arms over the whole joint space."""
    q = np.random.default_rng(0).uniform(a.lower, a.upper, (_POSES, a.n))
    return np.asarray(np.linalg.norm(a.fk(q)[:, :3, 3] - b.fk(q)[:, :3, 3], axis=1))


def _show_import_ur(console: "Console", document: Document) -> None:
    title = f"{document['robot']}, as calibrated by the factory"
    print_joints(console, title, document["joints"])
    far = document["from_nominal"]
    console.print(
        f"The flange is {far['mean_mm']:.3f} mm (at most {far['max_mm']:.3f} mm) from the nominal "
        f"model's over {far['n']} poses."
    )
    print_output(console, document)


_KINEMATICS = (".yaml", ".yml")
_LINKS = "default 'base', else the root link", "default 'tool0', 'flange', else the only last link"
_NO_PLACE = (
    "joint functions and compliances have no place in a URDF: what reads it has the arm's geometry "
    "alone"
)


def _add_links(parser: argparse.ArgumentParser) -> None:
    for name, default in zip(("base", "tip"), _LINKS, strict=True):
        parser.add_argument(f"--{name}", default="", metavar="LINK", help=default)


def _read_chain(path: Path, base: str, tip: str) -> Chain:
    text = read_text(path, "robot description")
    if path.suffix in _KINEMATICS:
        return ur_chain(load_yaml(text, str(path)), str(path))
    return chain(read_urdf(text, str(path)), base, tip)


def add_import_urdf(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "urdf", type=Path, metavar="FILE", help="URDF (xacro expanded), or a kinematics.yaml"
    )
    parser.add_argument(
        "--output", required=True, type=Path, metavar="R.yaml", help="robot file to write"
    )
    _add_links(parser)
    parser.add_argument("--name", default="", help="name of the robot, default the description's")


def run_import_urdf(args: argparse.Namespace) -> CliResult:
    links = _read_chain(args.urdf, args.base, args.tip)
    description = arm_of(links, args.name)
    arm = description.arm
    warnings = []
    if (unlimited := np.isnan(description.max_velocity)).any():
        names = ", ".join(np.array(arm.joint_names)[unlimited])
        warnings.append(
            f"no speed limit is given for {names}: an arm without them cannot be enabled for "
            "motion; add max_velocity_deg_s to the robot file"
        )
    comment = f"From {args.urdf.name}, {links.base} to {links.tip}, by robocal import-urdf."
    save_robot(arm, args.output, description, comment)
    document: ImportUrdfDocument = {
        **_document(links, arm, args.output, np.eye(4)),
        "joints": joint_rows(arm),
        "warnings": warnings,
    }
    return CliResult(document, _show_import)


def _document(
    links: Chain, arm: SerialArm, output: Path, T_tip_flange: Array
) -> "ConvertedUrdfDocument":
    """What both commands tell: in it the largest difference of the flange over the joints' ranges.

    Of an element of its pose, mm, or its like in rad at a metre.
    """
    q = random_postures(arm, _POSES)
    there = np.array([links.fk(row) @ T_tip_flange for row in q])
    return {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "base": links.base,
        "tip": links.tip,
        "output": str(output),
        "conversion_error_mm": float(
            np.abs(there - replace(arm, functions=None).fk(q)).max() * 1e3
        ),
    }


def _show_import(console: "Console", document: Document) -> None:
    title = f"{document['robot']}: {document['base']} to {document['tip']}"
    print_joints(console, title, document["joints"])
    console.print(
        f"The flange differs by {document['conversion_error_mm']:.1e} mm at most from the "
        f"description's over {_POSES} poses.",
        soft_wrap=True,
    )
    print_output(console, document)


def add_export_urdf(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    parser.add_argument(
        "--into",
        type=Path,
        metavar="FILE",
        help="URDF, or kinematics.yaml, whose kinematics are replaced and whose rest stays; "
        "without it a URDF of the joints alone",
    )
    parser.add_argument(
        "--output", required=True, type=Path, metavar="FILE", help="what to write; never FILE"
    )
    _add_links(parser)


def run_export_urdf(args: argparse.Namespace) -> CliResult:
    described, warnings = describe_robot(args.robot)
    arm = described.arm
    if args.output.exists():
        raise InputError("is there already: name another file", file=str(args.output))
    if arm.functions is not None:
        warnings.append(_NO_PLACE)
    beyond = np.eye(4)
    if args.into is None:
        text = urdf_of(arm, described.max_velocity)
        links = chain(read_urdf(text, str(args.output)))
    else:
        links = _read_chain(args.into, args.base, args.tip)
        if args.into.suffix in _KINEMATICS:
            values, beyond = ur_kinematics(links, arm)
            made = {"kinematics": values | {"hash": f"robocal_{arm.model_hash}"}}
            text = yaml.safe_dump(made, sort_keys=False)
            links = ur_chain(made, str(args.output))
        else:
            text = urdf_with(read_text(args.into, "robot description"), links, arm)
            links = chain(read_urdf(text, str(args.output)), args.base, args.tip)
    off_mm = float(np.linalg.norm(beyond[:3, 3]) * 1e3)
    off_deg = float(np.degrees(np.linalg.norm(log_rotation(beyond[:3, :3]))))
    if off_mm > 1e-6 or off_deg > 1e-6:
        xyz = ", ".join(f"{x * 1e3:.4f}" for x in beyond[:3, 3])
        warnings.append(
            f"the flange lies {off_mm:.4f} mm and {off_deg:.5f} deg from tool0, for which a "
            f"kinematics.yaml has no place: add ({xyz}) mm and that turn to the tool, or use a URDF"
        )
    write_text(args.output, text)
    document: ExportUrdfDocument = {
        **_document(links, arm, args.output, beyond),
        "T_tip_flange": transform_document(beyond),
        "warnings": warnings,
    }
    return CliResult(document, _show_export)


def _show_export(console: "Console", document: Document) -> None:
    console.print(
        f"{document['robot']}, {document['base']} to {document['tip']}: the flange differs by "
        f"{document['conversion_error_mm']:.1e} mm at most from the robot file's over {_POSES} "
        "poses.",
        soft_wrap=True,
    )
    print_output(console, document)
