"""``robocal hand-eye export``: a sensor's place for a robot description, or for tf2."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import text
from robocal_ros.cli.output import CliResult, Document

if TYPE_CHECKING:
    from rich.console import Console

NAME = "export"
HELP = "print a sensor's place for URDF, xacro or tf2"

FORMATS = ("urdf", "xacro", "yaml", "static-transform")
PARENTS = {"flange": "tool0", "base": "base"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--result", required=True, type=Path, metavar="FILE", help="JSON that was printed before"
    )
    parser.add_argument("--format", required=True, choices=FORMATS)
    parser.add_argument(
        "--parent",
        type=text,
        metavar="FRAME",
        help="default tool0; of a sensor beside the robot base",
    )
    parser.add_argument(
        "--child", type=text, default="laser", metavar="FRAME", help="default laser"
    )


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.ground.frames import transform_document
    from robocal_ros.hand_eye.files import exported, read_mount

    mount = read_mount(args.result, accepted=True)
    T, parent = mount.T_parent_sensor, args.parent or PARENTS[mount.parent]
    document: Document = {
        "format": args.format,
        "parent": parent,
        "child": args.child,
        "text": exported(T, parent, args.child, args.format),
        f"T_{mount.parent}_sensor": transform_document(T),
    }
    return CliResult(document, partial(_show, document=document))


def _show(console: "Console", document: Document) -> None:
    console.out(document["text"], highlight=False)
