"""``robocal thermal plan-poses``: which poses a measuring cycle should visit."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import (
    ROBOT_HELP,
    add_sigma,
    count,
    describe_robot,
    positive,
    seed,
    warn,
)
from robocal_ros.cli.output import CliResult, Document

if TYPE_CHECKING:
    from rich.console import Console

NAME = "plan-poses"
HELP = "choose the poses of a measuring cycle that say most about the tool, and how much better"

POSES, CANDIDATES = 6, 1000
FIELD_MM = "570,430,700,550,850"


def _field(value: str) -> tuple[float, ...]:
    """Type of five lengths in mm.

    Raises
    ------
    argparse.ArgumentTypeError
        For anything else.
    """
    numbers = tuple(positive(part) for part in value.split(","))
    if len(numbers) != 5 or numbers[3] >= numbers[4]:
        raise argparse.ArgumentTypeError(
            f"'{value}' is not width,height,at,near,far in mm with near below far"
        )
    return numbers


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    parser.add_argument(
        "--sensor", required=True, type=Path, metavar="S.yaml", help="from calibrate-sensor"
    )
    parser.add_argument(
        "--poses", type=count, default=POSES, metavar="N", help=f"how many, default {POSES}"
    )
    parser.add_argument(
        "--field-mm",
        type=_field,
        default=_field(FIELD_MM),
        metavar="W,H,AT,NEAR,FAR",
        help="where the sensor measures: width and height at a distance, nearest and farthest "
        f"distance; default {FIELD_MM}",
    )
    parser.add_argument(
        "--working",
        type=Path,
        metavar="CSV",
        help="a table whose joints are the working poses; default: all over the joint limits",
    )
    parser.add_argument(
        "--own", type=Path, metavar="CSV", help="a table of your own measuring poses, to compare"
    )
    parser.add_argument("--prior", type=Path, metavar="P.yaml", help="from learn-prior")
    add_sigma(parser)
    parser.add_argument(
        "--candidates", type=count, default=CANDIDATES, metavar="N", help=f"default {CANDIDATES}"
    )
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="of the candidates")
    parser.add_argument("--output", type=Path, metavar="CSV", help="write the poses")


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.cli.thermal_planning import plan_files

    warnings: list[str] = []
    arm = describe_robot(args.robot, warnings).arm
    document: Document = plan_files(arm, args) | {"warnings": warnings}
    warn(warnings)
    return CliResult(document, partial(_show, document=document))


def _show(console: "Console", document: Document) -> None:
    from rich.table import Table
    from rich.text import Text

    console.print(
        f"Predicted error of the tool after one cycle: {document['predicted_mm']:.3f} mm rms; of "
        f"as many random poses {document['random_mm']:.3f} mm ({document['gain']:.0%} less), "
        f"without a cycle {document['before_mm']:.3f} mm.",
        soft_wrap=True,
    )
    if document["own_mm"] is not None:
        console.print(f"Of your own {document['own_poses']} poses: {document['own_mm']:.3f} mm.")
    table = Table(title="In the order of the shortest way", title_justify="left", box=None)
    table.add_column("pose")
    for name in document["columns"]:
        table.add_column(name, justify="right")
    for pose in document["poses"]:
        table.add_row(pose["pose"], *(f"{value:.2f}" for value in pose["joints"]))
    console.print(table)
    if document["output"]:
        console.print(Text(f"Written: {document['output']}"), soft_wrap=True)
