# SPDX-License-Identifier: Apache-2.0
"""Robot descriptions of ROS: ``robocal import-urdf`` and ``export-urdf``."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml

from robocal_ros.cli.main import ROBOT_HELP, CliResult, Document, describe_robot, print_output
from robocal_ros.cli.robot import joint_rows, print_joints
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import read_text, write_text
from robocal_ros.ground.frames import Array, log_rotation, transform_document
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_yaml, save_robot
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

_POSES = 1000
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
    """Declare the options of ``import-urdf``."""
    parser.add_argument(
        "urdf", type=Path, metavar="FILE", help="URDF (xacro expanded), or a kinematics.yaml"
    )
    parser.add_argument(
        "--output", required=True, type=Path, metavar="R.yaml", help="robot file to write"
    )
    _add_links(parser)
    parser.add_argument("--name", default="", help="name of the robot, default the description's")


def run_import_urdf(args: argparse.Namespace) -> CliResult:
    """Do ``import-urdf``. Raises `RobocalError` for what a user can mend."""
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
    document = _document(links, arm, args.output, np.eye(4)) | {"joints": joint_rows(arm)}
    return CliResult(document | {"warnings": warnings}, _show_import)


def _document(links: Chain, arm: SerialArm, output: Path, T_tip_flange: Array) -> Document:
    """What both commands tell: in it the largest difference of the flange over the joints' ranges.

    Of an element of its pose, mm, or its like in rad at a metre.
    """
    q = _poses(arm)
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


def _poses(arm: SerialArm) -> Array:
    low = np.where(np.isfinite(arm.lower), arm.lower, np.minimum(arm.upper - 1.0, -np.pi))
    high = np.where(np.isfinite(arm.upper), arm.upper, np.maximum(arm.lower + 1.0, np.pi))
    return np.random.default_rng(0).uniform(low, high, (_POSES, arm.n))


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
    """Declare the options of ``export-urdf``."""
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
    """Do ``export-urdf``. Raises `RobocalError` for what a user can mend."""
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
    document = _document(links, arm, args.output, beyond)
    document |= {"T_tip_flange": transform_document(beyond), "warnings": warnings}
    return CliResult(document, _show_export)


def _show_export(console: "Console", document: Document) -> None:
    console.print(
        f"{document['robot']}, {document['base']} to {document['tip']}: the flange differs by "
        f"{document['conversion_error_mm']:.1e} mm at most from the robot file's over {_POSES} "
        "poses.",
        soft_wrap=True,
    )
    print_output(console, document)
