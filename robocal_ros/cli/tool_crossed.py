"""``robocal tool crossed``: a tool's axis from one circle through two crossed beams."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import positive
from robocal_ros.cli.output import Document, Outcome

if TYPE_CHECKING:
    from rich.console import Console

NAME = "crossed"
HELP = "find a tool's axis from the edges of one circle at constant speed"

METHODS = ("best", "classic")
DIRECTIONS = {"ccw": 1, "cw": -1}
JITTER_S = 20e-6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--events",
        required=True,
        type=Path,
        metavar="CSV",
        help="columns stamp_s, beam (x or y), blocked (1 or 0), sigma_s where it is known",
    )
    parser.add_argument("--radius-mm", required=True, type=positive, metavar="R")
    parser.add_argument("--period-s", required=True, type=positive, metavar="T", help="of a turn")
    parser.add_argument(
        "--start-deg",
        type=float,
        default=0.0,
        metavar="A",
        help="where the flange stands at stamp 0, counter-clockwise from the laser's x; default 0",
    )
    parser.add_argument("--direction", choices=tuple(DIRECTIONS), default="ccw")
    parser.add_argument(
        "--beam-angle-deg", type=positive, default=90.0, metavar="B", help="default 90"
    )
    parser.add_argument(
        "--latency-s", type=float, metavar="L", help="of the input, where it is known"
    )
    parser.add_argument(
        "--sample-period-s",
        type=float,
        default=0.0,
        metavar="P",
        help="of an input that is read every so often; default 0: stamped by interrupt",
    )
    parser.add_argument("--method", choices=METHODS, default=METHODS[0])


def run(args: argparse.Namespace) -> Outcome:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from math import isfinite, radians

    from robocal_ros.core.errors import InputError
    from robocal_ros.core.tool.beam_edges import InputRule, debounced
    from robocal_ros.core.tool.circle_edges import CircleMotion
    from robocal_ros.core.tool.crossed_beams import fit_circle
    from robocal_ros.core.tool.documents import circle_document
    from robocal_ros.storage.tool_tables import read_edges

    latency_s = args.latency_s
    given = (args.start_deg, args.sample_period_s, latency_s or 0.0)
    if not all(map(isfinite, given)) or args.sample_period_s < 0.0:
        raise InputError("--start-deg, --latency-s and --sample-period-s must be finite numbers")
    if not args.beam_angle_deg < 180.0:
        raise InputError(f"--beam-angle-deg {args.beam_angle_deg:g}: must lie between 0 and 180")
    rule = InputRule(JITTER_S, args.sample_period_s)
    motion = CircleMotion(
        radius_m=args.radius_mm * 1e-3,
        period_s=args.period_s,
        start_rad=radians(args.start_deg),
        direction=DIRECTIONS[args.direction],
        beam_angle_rad=radians(args.beam_angle_deg),
    )
    edges = debounced(read_edges(args.events, rule.sigma_s), rule.debounce_s)
    fit = fit_circle(motion, edges, args.method, latency_s=latency_s)
    document: Document = circle_document(fit)
    return Outcome(document, partial(_show, document=document))


def _show(console: "Console", document: Document) -> None:
    from rich.text import Text

    verdict = document["verdict"]
    console.print(Text(f"{verdict['code']}: {verdict['reason']}", style="bold green"))
    if document["tool_radius_mm"] is not None:
        x, y = document["tool_radius_mm"].values()
        console.print(f"Tool radius: {x:.3f} mm as the x-beam sees it, {y:.3f} mm as the y-beam")
    console.print(f"Latency of the input: {document['latency_s'] * 1e3:.3f} ms")
