"""``robocal hand-eye joint``: one place of a line laser from several targets."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import text
from robocal_ros.cli.hand_eye_shots import (
    KINDS,
    ReadShots,
    add_feature,
    add_limits,
    add_robot,
    arm_of,
    given_target,
    read_shots,
    require_unused,
    settings_of,
    task_of,
)
from robocal_ros.cli.hand_eye_view import show_mount
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import quoted

if TYPE_CHECKING:
    from robocal_ros.hand_eye.tasks import Task
    from robocal_ros.kinematics import SerialArm

NAME = "joint"
HELP = "place a line laser on the flange from the shots of two or three targets together"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    for kind in KINDS:
        without = "; without target.yaml the line is found too" if kind == "line" else ""
        parser.add_argument(
            f"--{kind}",
            type=Path,
            metavar="DIR",
            help=f"folder with poses.csv, profiles/ and target.yaml of a {kind}{without}",
        )
    add_feature(parser)
    add_robot(parser)
    add_limits(parser, "default: from the residuals")
    parser.add_argument(
        "--check",
        type=text,
        metavar="NAME",
        help="table in the folders, such as check.csv: other shots of the same targets, of one or "
        "more, that judge the result and are not used to find it",
    )


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.hand_eye.result import hand_eye_document
    from robocal_ros.hand_eye.solve import solve_joint

    arm, settings = arm_of(args), settings_of(args)
    folders = {kind: getattr(args, kind) for kind in KINDS if getattr(args, kind) is not None}
    if len(folders) < 2:
        raise InputError("give the folders of at least two of --sphere, --step, --line")
    parts, checks = [], {}
    for kind, folder in folders.items():
        task, shots = _task(kind, folder, args.line_kind), _shots(folder, "poses.csv", arm)
        parts.append((task, shots.data))
        if args.check is not None and (folder / args.check).exists():
            judges = _shots(folder, args.check, arm)
            if judges.table is not None and shots.table is not None:
                require_unused(judges.table, shots.table)
            checks[task.kind] = judges.data
    if args.check is not None and not checks:
        raise InputError(f"none of the folders holds the table of --check, {quoted(args.check)}")
    result = solve_joint(parts, settings, checks)
    document: Document = hand_eye_document(result)
    return CliResult(document, partial(show_mount, document=document))


def _task(kind: str, folder: Path, line_kind: str) -> "Task":
    file = folder / "target.yaml"
    known = kind != "line" or file.exists()
    return task_of(given_target(kind, file if known else None, None), line_kind)


def _shots(folder: Path, table: str, arm: "SerialArm | None") -> ReadShots:
    return read_shots(folder / table, folder / "profiles", arm)
