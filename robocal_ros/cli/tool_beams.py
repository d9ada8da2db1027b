"""``robocal tool beams``: where two crossed beams are, from their sixteen edges."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import positive
from robocal_ros.cli.output import Document, Outcome

if TYPE_CHECKING:
    from rich.console import Console

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


def run(args: argparse.Namespace) -> Outcome:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.core.tool.documents import laser_document
    from robocal_ros.core.tool.laser_frame import calibrate_laser
    from robocal_ros.storage.tool_tables import read_beam_points

    radius_m = None if args.radius_mm is None else args.radius_mm * 1e-3
    laser = calibrate_laser(read_beam_points(args.data), radius_m=radius_m)
    document: Document = laser_document(laser)
    return Outcome(document, partial(_show, document=document))


def _show(console: "Console", document: Document) -> None:
    x, y, z = document["origin_mm"]
    console.print(f"The beams cross at {x:.3f} {y:.3f} {z:.3f} mm in base")
    console.print(
        f"at {document['beam_angle_deg']:.3f} deg, the y-beam {document['gap_mm']:+.4f} mm above "
        "the x-beam."
    )
    for name, axis in zip("xyz", document["axes"], strict=True):
        console.print(f"{name} axis in base: {' '.join(f'{value:.6f}' for value in axis)}")
