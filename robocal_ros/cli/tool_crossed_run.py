"""The whole run of ``robocal tool crossed``: circles and plunges with the robot's joints."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import ROBOT_HELP, describe_robot, warn
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.cli.tool_frames import add_frame_options, given_frame
from robocal_ros.ground.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.tool.edges import InputRule

NEEDED = ("joints", "robot", "laser")


def add_run_options(parser: "argparse._ActionsContainer") -> None:
    """Declare the options of a whole run."""
    parser.add_argument(
        "--joints",
        type=Path,
        metavar="CSV",
        help="joint readings during the whole run: stamp_s and q1_deg …, on the edges' clock",
    )
    parser.add_argument("--robot", metavar="R.yaml", help=ROBOT_HELP)
    parser.add_argument(
        "--laser", type=Path, metavar="FILE", help="laser file of robocal tool beams"
    )
    add_frame_options(parser, "--taught-mm", "--taught-rpy-deg")


def run_whole(args: argparse.Namespace, rule: "InputRule") -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.tool.crossed_run import estimate_tool
    from robocal_ros.tool.driven_circle import classic_from_path
    from robocal_ros.tool.files import read_joint_path, read_step_edges
    from robocal_ros.tool.judging import KnownTool, ToolLimits, judge_run
    from robocal_ros.tool.laser_frame import read_laser_for
    from robocal_ros.tool.measuring_plan import named_steps
    from robocal_ros.tool.quick_check import classic_run_document, run_document

    missing = [f"--{name}" for name in NEEDED if getattr(args, name) is None]
    if missing:
        raise InputError(
            f"a whole run needs --joints, --robot and --laser: {missing[0]} is missing"
        )
    warnings: list[str] = []
    arm = describe_robot(args.robot, warnings).arm
    laser = read_laser_for(args.laser, arm).laser
    given = given_frame(args)
    taught = arm.T_flange_tool if given is None else given
    path, origin_ns = read_joint_path(args.joints, arm)
    edges, names = read_step_edges(args.events, rule.sigma_s, origin_ns)
    steps = named_steps(edges, names, rule.debounce_s)
    if args.method == "classic":
        document = classic_run_document(classic_from_path(laser, path, steps, taught))
    else:
        circles = [step.name for step in steps if step.kind == "circle"]
        found = estimate_tool(laser, path, steps, taught)
        known = KnownTool.measured(found)
        document = run_document(known, found, circles, judge_run(found, ToolLimits()))
    document["warnings"] = warnings
    warn(warnings)
    return CliResult(document, partial(_show, document=document))


def _show(console: "Console", document: Document) -> None:
    from rich.text import Text

    verdict = document["verdict"]
    style = "bold green" if verdict["accept"] else "bold red"
    console.print(Text(f"{verdict['code']}: {verdict['reason']}", style=style), soft_wrap=True)
    sigma = document["sigma_mm"] or [None] * 3
    tip = ", ".join(
        f"{value:.3f}" + ("" if spread is None else f" ± {spread:.3f}")
        for value, spread in zip(document["tcp_mm"], sigma, strict=True)
    )
    console.print(f"Tip in the flange frame, mm: {tip}")
    for name, key in (("Axis", "axis"), ("Orientation, quaternion x y z w", "quat_xyzw")):
        console.print(f"{name}: {' '.join(f'{value:.6f}' for value in document[key])}")
    for radius in document["tool_radius_mm"] or ():
        console.print(Text(f"Tool radius on {radius['circle']}: {radius['x']:.3f} mm as the x-beam "
                           f"sees it, {radius['y']:.3f} mm as the y-beam"))  # fmt: skip
    if document["latency_s"] is not None:
        console.print(f"Latency of the input: {document['latency_s'] * 1e3:.3f} ms")
