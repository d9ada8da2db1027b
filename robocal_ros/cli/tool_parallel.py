"""``robocal tool parallel``: a tool by two parallel beams, one above the other."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.output import CliResult, Document

if TYPE_CHECKING:
    from rich.console import Console

NAME = "parallel"
HELP = "find a tool's axis, and its tip, by sweeps through two parallel beams along the base's y"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--data",
        required=True,
        type=Path,
        metavar="CSV",
        help="columns sweep (straight, turned, upright, upright_turned, plunge), beam (up, down), "
        "and the flange's pose at each edge",
    )
    for name in ("up", "down"):
        parser.add_argument(
            f"--{name}-mm",
            required=True,
            type=float,
            metavar="Z",
            help=f"height of the {'upper' if name == 'up' else 'lower'} beam in base",
        )
    parser.add_argument(
        "--x-mm",
        type=float,
        metavar="X",
        help="place of both beams along the base's x, for the tip",
    )


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from math import isfinite

    from robocal_ros.ground.errors import InputError
    from robocal_ros.tool.files import read_sweeps
    from robocal_ros.tool.parallel_beams import ParallelBeams, fit_parallel
    from robocal_ros.tool.quick_check import parallel_document

    if not all(map(isfinite, (args.up_mm, args.down_mm, args.x_mm or 0.0))):
        raise InputError("--up-mm, --down-mm and --x-mm must be finite numbers")
    beams = ParallelBeams(args.up_mm * 1e-3, args.down_mm * 1e-3)
    x_m = None if args.x_mm is None else args.x_mm * 1e-3
    fit = fit_parallel(beams, x_m, read_sweeps(args.data))
    document: Document = parallel_document(fit.axis, fit.tip)
    return CliResult(document, partial(_show, document=document))


def _show(console: "Console", document: Document) -> None:
    from rich.text import Text

    verdict = document["verdict"]
    console.print(Text(f"{verdict['code']}: {verdict['reason']}", style="bold green"))
    console.print(f"Axis: {' '.join(f'{value:.6f}' for value in document['axis'])}")
    if document["tcp_mm"] is not None:
        tip = ", ".join(f"{value:.3f}" for value in document["tcp_mm"])
        console.print(f"Tip in the flange frame, mm: {tip}")
