"""``robocal tool beams``: where two crossed beams are, from their sixteen edges."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import ROBOT_HELP, SIGMA_MM, describe_robot, positive, text, warn
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.ground.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.tool.laser_frame import LaserFrame

NAME = "beams"
HELP = "place two crossed light beams from the edges A1 to D4 of a cylinder at the flange"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--data",
        required=True,
        type=Path,
        metavar="CSV",
        help="columns point (A1 to D4), x_mm, y_mm, z_mm: the flange at each edge",
    )
    parser.add_argument(
        "--radius-mm",
        type=positive,
        metavar="R",
        help="radius of the cylinder: tells how far from its middle each beam is broken",
    )
    parser.add_argument(
        "--output", type=Path, metavar="FILE", help="write the laser file; needs the two below"
    )
    parser.add_argument(
        "--robot", metavar="R.yaml", help=f"that carried the cylinder: {ROBOT_HELP}"
    )
    parser.add_argument("--station", type=text, metavar="NAME", help="of these beams")
    parser.add_argument(
        "--sigma-mm",
        type=positive,
        metavar="S",
        help=f"noise of a coordinate of a beam's point, for the file; default {SIGMA_MM}",
    )


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.tool.files import read_beam_points
    from robocal_ros.tool.laser_frame import calibrate_laser
    from robocal_ros.tool.quick_check import laser_document

    _require_together(args)
    radius_m = None if args.radius_mm is None else args.radius_mm * 1e-3
    sigma_m = 1e-3 * (SIGMA_MM if args.sigma_mm is None else args.sigma_mm)
    laser = calibrate_laser(read_beam_points(args.data), sigma_m, radius_m)
    document: Document = laser_document(laser)
    document["reach_mm"] = None
    if radius_m is not None:
        document["reach_mm"] = dict(zip("xy", (laser.reach * 1e3).tolist(), strict=True))
    document["output"] = None
    if args.output is not None:
        _write(args, laser)
        document["output"] = str(args.output)
    return CliResult(document, partial(_show, document=document))


def _require_together(args: argparse.Namespace) -> None:
    """Refuse a file without its robot or station, and options that only the file needs."""
    for option in ("robot", "station", "sigma_mm"):
        given, name = getattr(args, option) is not None, f"--{option.replace('_', '-')}"
        if args.output is not None and not given and option != "sigma_mm":
            raise InputError(f"--output needs {name}: a laser file says whose it is")
        if args.output is None and given:
            raise InputError(f"{name} only matters for a laser file: give --output too")


def _write(args: argparse.Namespace, laser: "LaserFrame") -> None:
    from robocal_ros.tool.laser_frame import LaserFile, write_laser

    warnings: list[str] = []
    arm = describe_robot(args.robot, warnings).arm
    warn(warnings)
    write_laser(args.output, LaserFile(laser, args.station, arm.name, arm.model_hash))


def _show(console: "Console", document: Document) -> None:
    from rich.text import Text

    x, y, z = document["origin_mm"]
    console.print(f"The beams cross at {x:.3f} {y:.3f} {z:.3f} mm in base")
    console.print(
        f"at {document['beam_angle_deg']:.3f} deg, the y-beam {document['gap_mm']:+.4f} mm above "
        "the x-beam."
    )
    for name, axis in zip("xyz", document["axes"], strict=True):
        console.print(f"{name} axis in base: {' '.join(f'{value:.6f}' for value in axis)}")
    if document["output"]:
        console.print(Text(f"Written: {document['output']}"), soft_wrap=True)
