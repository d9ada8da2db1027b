"""``robocal hand-eye camera``: a camera's place, from images of a chessboard or board poses."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import positive
from robocal_ros.cli.hand_eye_pairs import calibrate
from robocal_ros.cli.hand_eye_shots import add_limit, add_robot, add_robot_sigma
from robocal_ros.cli.hand_eye_view import show_judged, show_placed
from robocal_ros.cli.output import CliResult, Document

if TYPE_CHECKING:
    from rich.console import Console

NAME = "camera"
HELP = "place a camera from images of a chessboard, or from poses of a board or a tracked target"

METHODS = ("best", "classic", "tsai", "park", "horaud", "andreff", "daniilidis", "shah", "li")
MOUNTS = ("in-hand", "to-hand")
LIMIT_MM = 2.0
WHERE = "where the boards were"  # the expected error holds


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--poses",
        required=True,
        type=Path,
        metavar="CSV",
        help="flange poses in base, or joints with --robot; column image names each file",
    )
    parser.add_argument(
        "--profiles", "--images", type=Path, metavar="DIR", help="folder of the images"
    )
    parser.add_argument("--board", type=_board, metavar="9x6", help="inner corners of the board")
    parser.add_argument("--square-mm", type=positive, metavar="S", help="side of a square")
    parser.add_argument(
        "--intrinsics",
        type=Path,
        metavar="YAML",
        help="of the camera, as ROS writes them; default: from the same images",
    )
    _add_other_options(parser)


def _add_other_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--measured",
        type=Path,
        metavar="CSV",
        help="instead of images: the board's poses in the camera, paired by row, sample or stamp_s",
    )
    parser.add_argument("--mount", choices=MOUNTS, default=MOUNTS[0])
    parser.add_argument(
        "--method",
        choices=METHODS,
        default=METHODS[0],
        help="best; the closed form from which the search starts; or classic, a closed form alone",
    )
    add_robot(parser)
    add_robot_sigma(parser, "default: from the residuals")
    add_limit(parser, WHERE, LIMIT_MM)
    parser.add_argument(
        "--check",
        type=Path,
        metavar="CSV",
        help="poses as --poses that judge the result and are not used to find it",
    )


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.hand_eye.result import hand_eye_document

    document = hand_eye_document(calibrate(args))
    return CliResult(document, partial(_show, document=document))


def _board(value: str) -> tuple[int, int]:
    """Type of inner corners along both sides, such as 9x6.

    Raises
    ------
    argparse.ArgumentTypeError
        For anything else.
    """
    sides = value.lower().split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() for side in sides):
        raise argparse.ArgumentTypeError(f"'{value}' is not columns and rows such as 9x6")
    return int(sides[0]), int(sides[1])


def _show(console: "Console", document: Document) -> None:
    show_placed(console, document, "Camera", WHERE)
    if document.get("time_offset_s") is not None:
        console.print(
            f"Time offset, to be added to the camera's stamps: {document['time_offset_s']:.4f} s "
            f"± {document['time_offset_sigma_s']:.4f}"
        )
    _show_residuals(console, document)
    show_judged(console, document)


def _show_residuals(console: "Console", document: Document) -> None:
    from rich.table import Table

    table = Table(title="Mean residual, mm", title_justify="left")
    table.add_column("method")
    table.add_column("mm", justify="right")
    for name, value in document["closed_forms_mean_mm"].items():
        table.add_row(name, "failed" if value is None else f"{value:.3f}")
    per_sample = document["residual_mm"]["per_sample"].values()
    table.add_row(document["method"], f"{sum(per_sample) / len(per_sample):.3f}")
    console.print(table)
