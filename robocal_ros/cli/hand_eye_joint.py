"""``robocal hand-eye joint``: one place of a line laser from several targets."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.hand_eye_shots import (
    KINDS,
    add_feature,
    add_limits,
    add_robot,
    arm_of,
    given_target,
    read_shots,
    settings_of,
    task_of,
)
from robocal_ros.cli.hand_eye_view import show_mount
from robocal_ros.cli.output import Document, Outcome
from robocal_ros.core.errors import InputError

if TYPE_CHECKING:
    from robocal_ros.core.hand_eye.joint import Part
    from robocal_ros.core.kinematics import SerialArm

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


def run(args: argparse.Namespace) -> Outcome:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.core.hand_eye.joint import solve_joint
    from robocal_ros.core.hand_eye.result import hand_eye_document

    arm, settings = arm_of(args), settings_of(args)
    folders = {kind: getattr(args, kind) for kind in KINDS if getattr(args, kind) is not None}
    if len(folders) < 2:
        raise InputError("give the folders of at least two of --sphere, --step, --line")
    parts = [_part(kind, folder, args.line_kind, arm) for kind, folder in folders.items()]
    document: Document = hand_eye_document(solve_joint(parts, settings))
    return Outcome(document, partial(show_mount, document=document))


def _part(kind: str, folder: Path, feature: str, arm: "SerialArm | None") -> "Part":
    file = folder / "target.yaml"
    known = kind != "line" or file.exists()
    target = given_target(kind, file if known else None, None)
    return task_of(target, feature), read_shots(folder / "poses.csv", folder / "profiles", arm).data
