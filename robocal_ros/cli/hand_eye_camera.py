"""``robocal hand-eye camera``: a camera's place, from images of a chessboard or board poses."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import ROBOT_HELP, positive
from robocal_ros.cli.hand_eye_pairs import calibrate
from robocal_ros.cli.output import Document, Outcome

if TYPE_CHECKING:
    from rich.console import Console

NAME = "camera"
HELP = "place a camera from images of a chessboard, or from poses of a board or a tracked target"

METHODS = ("best", "classic", "tsai", "park", "horaud", "andreff", "daniilidis", "shah", "li")
MOUNTS = ("in-hand", "to-hand")
MOST_NAMED = 5  # samples left out for one reason


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
    parser.add_argument("--robot", metavar="ROBOT", help=f"{ROBOT_HELP}; for tables of joints")
    for unit, of in (("mm", "position"), ("deg", "orientation")):
        parser.add_argument(
            f"--robot-sigma-{unit}",
            type=positive,
            metavar="S",
            help=f"noise of the flange's {of}, an axis; default: from the residuals",
        )
    parser.add_argument(
        "--limit-mm",
        type=positive,
        default=2.0,
        metavar="L",
        help="largest expected error where the boards were; default 2",
    )
    parser.add_argument(
        "--check",
        type=Path,
        metavar="CSV",
        help="poses as --poses that judge the result and are not used to find it",
    )


def run(args: argparse.Namespace) -> Outcome:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.core.hand_eye.result import hand_eye_document

    document = hand_eye_document(calibrate(args))
    return Outcome(document, partial(_show, document=document))


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
    from rich.text import Text

    verdict = document["verdict"]
    style = "bold green" if verdict["accept"] else "bold red"
    console.print(Text(f"{verdict['code']}: {verdict['reason']}", style=style), soft_wrap=True)
    parent = "flange" if "T_flange_sensor" in document else "base"
    pose = document[f"T_{parent}_sensor"]
    sigma = document["sigma"]
    spread = sigma["xyz_mm"] if sigma else [None] * 3
    numbers = ", ".join(
        f"{value:.3f}" + ("" if s is None else f" ± {s:.3f}")
        for value, s in zip(pose["xyz_mm"], spread, strict=True)
    )
    console.print(f"Camera in the {parent} frame, mm: {numbers}")
    quat = " ".join(f"{value:.6f}" for value in pose["quat_xyzw"])
    console.print(f"Orientation, quaternion x y z w: {quat}")
    if document.get("time_offset_s") is not None:
        console.print(
            f"Time offset, to be added to the camera's stamps: {document['time_offset_s']:.4f} s "
            f"± {document['time_offset_sigma_s']:.4f}"
        )
    if document["check"] is not None:
        check = document["check"]
        console.print(
            f"Check, {check['n']} poses: mean {check['mean_mm']:.3f} mm, max {check['max_mm']:.3f}"
        )
    _show_residuals(console, document)


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
    same: dict[str, list[str]] = {}
    for name, reason in document["rejected_because"].items():
        same.setdefault(reason, []).append(name)
    for reason, names in same.items():
        who = ", ".join(names[:MOST_NAMED]) + (", …" if len(names) > MOST_NAMED else "")
        count = f"{len(names)} samples, " if len(names) > 1 else ""
        console.print(f"Left out: {count}{who}: {reason}", soft_wrap=True, markup=False)
