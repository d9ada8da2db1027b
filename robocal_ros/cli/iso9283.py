"""``robocal iso9283``: how accurately and how repeatably a robot attains its positions."""

import argparse
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import warn
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.ground.files import nearest, quoted

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.identification.iso9283 import Repeated

NAME = "iso9283"
HELP = (
    "position accuracy and repeatability (AP, RP) of single poses as ISO 9283, 7.2, defines them; "
    "no whole test"
)

EVERY = ""  # stands for every target that has no commanded position of its own
Point = tuple[float, ...]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--data",
        required=True,
        type=Path,
        metavar="CSV",
        help="attained positions: x_mm, y_mm, z_mm, and target where there are several",
    )
    parser.add_argument(
        "--commanded",
        type=_commanded,
        action="append",
        default=[],
        metavar="[TARGET=]X,Y,Z",
        help="commanded position in mm, in the frame of the table, which must come from other "
        "points than these; TARGET=X,Y,Z, repeated, where there are several targets. Without it "
        "AP is not known",
    )


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    import numpy as np

    from robocal_ros.identification.iso9283 import CYCLES, repeated
    from robocal_ros.identification.position_tables import read_positions

    table = read_positions(args.data)
    commanded = _by_target(args.commanded, list(table), str(args.data))
    targets: Document = {}
    warnings = []
    if EVERY in commanded and len(table) > 1:
        warnings.append(
            "one commanded position is taken for the targets "
            f"{', '.join(name for name in table if name not in commanded)}: give each its own "
            "with --commanded TARGET=X,Y,Z"
        )
    for name, position in table.items():
        where = commanded.get(name, commanded.get(EVERY))
        try:
            found = repeated(position, None if where is None else np.array(where) * 1e-3)
        except TooFewSamplesError as error:
            raise TooFewSamplesError(f"{args.data}, target {quoted(name)}: {error}") from error
        targets[name] = _document(found)
        if found.n < CYCLES:
            warnings.append(
                f"target {quoted(name)}: {found.n} cycles; ISO 9283 asks for {CYCLES}: RP is less "
                "certain"
            )
    warn(warnings)
    document: Document = {"targets": targets, "warnings": warnings}
    return CliResult(document, partial(_show, document=document))


def _document(found: "Repeated") -> Document:
    axes = (None,) * 3 if found.offset is None else (found.offset * 1e3).tolist()
    return {
        "n": found.n,
        "AP_mm": None if found.AP_m is None else found.AP_m * 1e3,
        "RP_mm": found.RP_m * 1e3,
        "mean_distance_mm": found.mean_distance_m * 1e3,
        "S_mm": found.S_m * 1e3,
        "barycentre_mm": (found.barycentre * 1e3).tolist(),
        **dict(zip(("AP_x_mm", "AP_y_mm", "AP_z_mm"), axes, strict=True)),
    }


def _commanded(value: str) -> tuple[str, Point]:
    """Target, or ``EVERY``, and its commanded position in mm."""
    name, sign, cells = value.rpartition("=")
    try:
        point = tuple(float(cell) for cell in cells.split(","))
    except ValueError:
        point = ()
    if len(point) != 3 or not all(map(math.isfinite, point)) or (sign and not name):
        raise argparse.ArgumentTypeError(
            f"{quoted(value)} is not X,Y,Z or TARGET=X,Y,Z, in mm with a point as decimal mark"
        )
    return name, point


def _by_target(
    given: Sequence[tuple[str, Point]], targets: Sequence[str], file: str
) -> Mapping[str, Point]:
    """Commanded positions by target.

    Raises
    ------
    InputError
        For a target that the table has not, or that is given twice.
    """
    found: dict[str, Point] = {}
    for name, point in given:
        if name != EVERY and name not in targets:
            hint = nearest(name, targets)
            raise InputError(
                f"--commanded: no target {quoted(name)}{hint}; the table has {', '.join(targets)}",
                file=file,
            )
        if name in found:
            whose = f"target {quoted(name)}" if name else "all targets"
            raise InputError(f"--commanded: a position of {whose} is given twice")
        found[name] = point
    return found


def _show(console: "Console", document: Document) -> None:
    from rich.table import Table
    from rich.text import Text

    title = "Position accuracy and repeatability as in ISO 9283, 7.2, in mm"
    table = Table(title=title, title_justify="left", box=None)
    table.add_column("target")
    for head in ("cycles", "AP", "AP x", "AP y", "AP z", "RP", "mean distance", "S"):
        table.add_column(head, justify="right")
    keys = ("AP_mm", "AP_x_mm", "AP_y_mm", "AP_z_mm", "RP_mm", "mean_distance_mm", "S_mm")
    for name, found in document["targets"].items():
        values = ["-" if found[key] is None else f"{found[key]:z.4f}" for key in keys]
        table.add_row(Text(name), str(found["n"]), *values)
    console.print(table)
