"""``robocal tool points``: a tool's tip, and its orientation, by touching a point."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import positive
from robocal_ros.cli.output import CliResult, Document

if TYPE_CHECKING:
    from rich.console import Console

NAME = "points"
HELP = "find a tool's tip from four touches of one point or more; its orientation from seven poses"

METHODS = ("four", "seven")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--method", choices=METHODS, default=METHODS[0])
    parser.add_argument(
        "--data",
        required=True,
        type=Path,
        metavar="CSV",
        help="flange poses: x_mm, y_mm, z_mm, and qx, qy, qz, qw or another orientation",
    )
    parser.add_argument(
        "--sigma-mm", type=positive, metavar="S", help="of one touch; default: from the residuals"
    )


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.tool.files import read_flange_poses
    from robocal_ros.tool.quick_check import touch_document
    from robocal_ros.tool.touch_points import fit_four, fit_seven

    fit = {"four": fit_four, "seven": fit_seven}[args.method]
    sigma_m = None if args.sigma_mm is None else args.sigma_mm * 1e-3
    document: Document = {"method": args.method}
    document |= touch_document(fit(read_flange_poses(args.data), sigma_m))
    return CliResult(document, partial(_show, document=document))


def _show(console: "Console", document: Document) -> None:
    from rich.text import Text

    verdict = document["verdict"]
    style = "bold green" if verdict["accept"] else "bold red"
    console.print(Text(f"{verdict['code']}: {verdict['reason']}", style=style), soft_wrap=True)
    pairs = zip(document["tcp_mm"], document["sigma_mm"], strict=True)
    tip = ", ".join(f"{value:.3f} ± {sigma:.3f}" for value, sigma in pairs)
    console.print(f"Tip in the flange frame, mm: {tip}")
    if document["quat_xyzw"] is not None:
        quat = " ".join(f"{value:.6f}" for value in document["quat_xyzw"])
        console.print(f"Orientation, quaternion x y z w: {quat}")
