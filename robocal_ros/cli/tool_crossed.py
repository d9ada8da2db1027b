"""``robocal tool crossed``: a tool from its edges through two crossed beams.

From one circle the place of its axis; from a whole run tip and axis (see ``tool_crossed_run``).
"""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import positive
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.cli.tool_crossed_run import add_run_options, run_whole
from robocal_ros.ground.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.tool.edges import InputRule

NAME = "crossed"
HELP = "find a tool from the edges of a whole run, or its axis from one circle at constant speed"

METHODS = ("best", "classic")
DIRECTIONS = {"ccw": 1, "cw": -1}
JITTER_S = 20e-6
OF_CIRCLE = ("radius_mm", "period_s", "start_deg", "direction", "beam_angle_deg", "latency_s")
OF_RUN = ("joints", "robot", "laser", "tool", "xyz_mm", "rpy_deg")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--events",
        required=True,
        type=Path,
        metavar="CSV",
        help="columns stamp_s, beam (x or y), blocked (1 or 0), sigma_s where it is known, and of "
        "a whole run step",
    )
    parser.add_argument("--method", choices=METHODS, default=METHODS[0])
    parser.add_argument(
        "--sample-period-s",
        type=float,
        default=0.0,
        metavar="P",
        help="of an input that is read every so often; default 0: stamped by interrupt",
    )
    add_run_options(parser.add_argument_group("a whole run"))
    circle = parser.add_argument_group("one circle at constant speed")
    circle.add_argument("--radius-mm", type=positive, metavar="R")
    circle.add_argument("--period-s", type=positive, metavar="T", help="of a turn")
    circle.add_argument(
        "--start-deg",
        type=float,
        metavar="A",
        help="where the flange stands at stamp 0, counter-clockwise from the laser's x; default 0",
    )
    circle.add_argument("--direction", choices=tuple(DIRECTIONS), help="default ccw")
    circle.add_argument("--beam-angle-deg", type=positive, metavar="B", help="default 90")
    circle.add_argument(
        "--latency-s", type=float, metavar="L", help="of the input, where it is known"
    )


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from math import isfinite

    from robocal_ros.tool.edges import InputRule

    if not isfinite(args.sample_period_s) or args.sample_period_s < 0.0:
        raise InputError("--sample-period-s must be a finite number, not below 0")
    rule = InputRule(JITTER_S, args.sample_period_s)
    of_run, of_circle = _given(args, OF_RUN), _given(args, OF_CIRCLE)
    if of_run and of_circle:
        raise InputError(
            f"{of_run[0]} belongs to a whole run, {of_circle[0]} to one circle: the joints tell "
            "how the circle was driven; give the options of one of them"
        )
    if of_run:
        return run_whole(args, rule)
    if args.radius_mm is None or args.period_s is None:
        raise InputError(
            "give --joints, --robot and --laser for a whole run, or --radius-mm and --period-s "
            "for one circle"
        )
    document = _circle(args, rule)
    return CliResult(document, partial(_show, document=document))


def _given(args: argparse.Namespace, names: tuple[str, ...]) -> list[str]:
    taught = {"xyz_mm": "taught_mm", "rpy_deg": "taught_rpy_deg"}
    return [
        f"--{taught.get(name, name).replace('_', '-')}"
        for name in names
        if getattr(args, name) is not None
    ]


def _circle(args: argparse.Namespace, rule: "InputRule") -> Document:
    from math import isfinite, radians

    from robocal_ros.tool.crossed_model import fit_circle
    from robocal_ros.tool.edges import CircleMotion, debounced
    from robocal_ros.tool.files import read_edges
    from robocal_ros.tool.quick_check import circle_document

    start_deg = args.start_deg or 0.0
    beam_angle_deg = 90.0 if args.beam_angle_deg is None else args.beam_angle_deg
    if not (isfinite(start_deg) and isfinite(args.latency_s or 0.0)):
        raise InputError("--start-deg and --latency-s must be finite numbers")
    if not beam_angle_deg < 180.0:
        raise InputError(f"--beam-angle-deg {beam_angle_deg:g}: must lie between 0 and 180")
    motion = CircleMotion(
        radius_m=args.radius_mm * 1e-3,
        period_s=args.period_s,
        start_rad=radians(start_deg),
        direction=DIRECTIONS[args.direction or "ccw"],
        beam_angle_rad=radians(beam_angle_deg),
    )
    edges = debounced(read_edges(args.events, rule.sigma_s), rule.debounce_s)
    return circle_document(fit_circle(motion, edges, args.method, latency_s=args.latency_s))


def _show(console: "Console", document: Document) -> None:
    from rich.text import Text

    verdict = document["verdict"]
    console.print(Text(f"{verdict['code']}: {verdict['reason']}", style="bold green"))
    if document["tool_radius_mm"] is not None:
        x, y = document["tool_radius_mm"].values()
        console.print(f"Tool radius: {x:.3f} mm as the x-beam sees it, {y:.3f} mm as the y-beam")
    console.print(f"Latency of the input: {document['latency_s'] * 1e3:.3f} ms")
