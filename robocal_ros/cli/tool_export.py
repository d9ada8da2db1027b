"""``robocal tool export``: a tool's frame in the words of a controller."""

import argparse
from functools import partial
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import positive
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.cli.tool_frames import add_frame_options, given_frame, three_numbers
from robocal_ros.ground.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.tool.files import Load

NAME = "export"
HELP = "print a tool's frame for a controller, or for URDF"

FORMATS = ("urdf", "kuka", "abb", "fanuc", "ur")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_frame_options(parser, "--xyz-mm", "--rpy-deg")
    parser.add_argument("--format", required=True, choices=FORMATS)
    parser.add_argument(
        "--mass-kg", type=positive, metavar="M", help="of the tool, for abb; with the next"
    )
    parser.add_argument(
        "--cog-mm",
        type=three_numbers,
        metavar="X,Y,Z",
        help="the tool's centre of gravity in the flange frame, for abb",
    )


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.ground.frames import transform_document
    from robocal_ros.tool.files import exported

    T_flange_tool = given_frame(args)
    if T_flange_tool is None:
        raise InputError("give the tool: --tool, or --xyz-mm and --rpy-deg")
    document: Document = {
        "format": args.format,
        "text": exported(T_flange_tool, args.format, _load(args)),
        "T_flange_tool": transform_document(T_flange_tool),
    }
    return CliResult(document, partial(_show, document=document))


def _load(args: argparse.Namespace) -> "Load | None":
    from robocal_ros.tool.files import Load

    if args.mass_kg is None and args.cog_mm is None:
        return None
    if args.format != "abb":
        raise InputError(f"--mass-kg and --cog-mm are for --format abb, not for {args.format}")
    if args.mass_kg is None or args.cog_mm is None:
        raise InputError("--mass-kg and --cog-mm go together: a load has both")
    x, y, z = args.cog_mm
    return Load(args.mass_kg, (x * 1e-3, y * 1e-3, z * 1e-3))


def _show(console: "Console", document: Document) -> None:
    console.out(document["text"], highlight=False)
