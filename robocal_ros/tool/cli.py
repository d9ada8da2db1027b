# SPDX-License-Identifier: Apache-2.0
"""Commands of ``robocal tool``: beams, station, crossed, points, parallel, export.

``crossed`` gives of one circle the place of its axis, of a whole run tip and axis.
"""

import argparse
from math import isfinite, radians
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cli.main import (
    ROBOT_HELP,
    SIGMA_MM,
    CliResult,
    Document,
    add_joint_error,
    add_state,
    describe_robot,
    joint_error_rad,
    positive,
    print_output,
    print_table,
    print_text,
    print_verdict,
    spaced,
    text,
    three_numbers,
    warn,
)
from robocal_ros.cli.programs import model_history
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.ground.frames import transform_document
from robocal_ros.history.history_records import LASER_FRAME
from robocal_ros.kinematics.joint_errors import with_joint_errors
from robocal_ros.programs.conventions import Load
from robocal_ros.tool.circle import CircleMotion, classic_from_path, fit_circle
from robocal_ros.tool.crossed_model import estimate_tool
from robocal_ros.tool.edges import InputRule, ParallelStation, debounced
from robocal_ros.tool.files import (
    circle_document,
    classic_run_document,
    exported,
    laser_document,
    named_steps,
    parallel_document,
    read_beam_points,
    read_edges,
    read_flange_poses,
    read_joint_path,
    read_step_edges,
    read_sweeps,
    read_tool,
    run_document,
    touch_document,
)
from robocal_ros.tool.judging import KnownTool, ToolLimits, judge_run, tip_errors
from robocal_ros.tool.laser_frame import LaserFile, calibrate_laser, read_laser_for, write_laser
from robocal_ros.tool.station import StationTrend, measurement_of, station_shift
from robocal_ros.tool.touch_points import fit_four, fit_parallel, fit_seven

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.tool.documents import (
        BeamsDocument,
        ExportedToolDocument,
        StationDocument,
        ToolRunDocument,
        TouchesDocument,
    )


def add_beams(parser: argparse.ArgumentParser) -> None:
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
    parser.add_argument(
        "--output", type=Path, metavar="FILE", help="write the laser file; needs the two below"
    )
    parser.add_argument(
        "--robot", metavar="R.yaml", help=f"that carried the cylinder: {ROBOT_HELP}"
    )
    parser.add_argument("--station", type=text, metavar="NAME", help="of these beams")
    parser.add_argument(
        "--sigma-mm",
        type=positive,
        metavar="S",
        help=f"noise of a coordinate of a beam's point, for the file; default {SIGMA_MM}",
    )


def run_beams(args: argparse.Namespace) -> CliResult:
    # Refuse a file without its robot or station, and options that only the file needs.
    for option in ("robot", "station", "sigma_mm"):
        given, name = getattr(args, option) is not None, f"--{option.replace('_', '-')}"
        if args.output is not None and not given and option != "sigma_mm":
            raise InputError(f"--output needs {name}: a laser file says whose it is")
        if args.output is None and given:
            raise InputError(f"{name} only matters for a laser file: give --output too")
    radius_m = None if args.radius_mm is None else args.radius_mm * 1e-3
    sigma_m = 1e-3 * (SIGMA_MM if args.sigma_mm is None else args.sigma_mm)
    laser = calibrate_laser(read_beam_points(args.data), sigma_m, radius_m)
    document: BeamsDocument = {**laser_document(laser), "reach_mm": None, "output": None}
    if radius_m is not None:
        x, y = (laser.reach * 1e3).tolist()
        document["reach_mm"] = {"x": x, "y": y}
    if args.output is not None:
        robot, warnings = describe_robot(args.robot)
        arm = robot.arm
        warn(warnings)
        write_laser(args.output, LaserFile(laser, args.station, arm.name, arm.model_hash))
        document["output"] = str(args.output)
    return CliResult(document, _show_beams)


def _show_beams(console: "Console", document: Document) -> None:
    console.print(f"The beams cross at {spaced(document['origin_mm'], 3)} mm in base")
    console.print(
        f"at {document['beam_angle_deg']:.3f} deg, the y-beam {document['gap_mm']:+.4f} mm above "
        "the x-beam."
    )
    for name, axis in zip("xyz", document["axes"], strict=True):
        console.print(f"{name} axis in base: {spaced(axis, 6)}")
    print_output(console, document)


def add_frame_options(parser: "argparse._ActionsContainer", tip: str, turn: str) -> None:
    """Offer ``--tool``, and in numbers its ``tip`` and its ``turn``: the names of both options."""
    parser.add_argument(
        "--tool", type=Path, metavar="FILE", help="JSON of a tool, as robocal tool prints it"
    )
    parser.add_argument(
        tip,
        dest="xyz_mm",
        type=three_numbers,
        metavar="X,Y,Z",
        help="or the tip in the flange frame",
    )
    parser.add_argument(
        turn,
        dest="rpy_deg",
        type=three_numbers,
        metavar="R,P,Y",
        help="turns about the flange's x, y, z in this order, where the tool brings none",
    )


def given_frame(args: argparse.Namespace) -> "NDArray[np.float64] | None":
    """T_flange_tool (4, 4) of the options of `add_frame_options`; None without any.

    Raises `InputError` when both are given, or a turn alone; further what `read_tool` raises.
    """
    R = None if args.rpy_deg is None else frames.rotation_from_rpy(np.radians(args.rpy_deg))
    if args.tool is not None and args.xyz_mm is not None:
        raise InputError("the tool is given twice: as a file, and in numbers; keep one")
    if args.tool is not None:
        return read_tool(args.tool, R)
    if args.xyz_mm is not None:
        return frames.transform(np.eye(3) if R is None else R, 1e-3 * np.array(args.xyz_mm))
    if R is not None:
        raise InputError("roll, pitch and yaw alone are no tool: give its tip too")
    return None


NEEDED = ("joints", "robot", "laser")


def add_run_options(parser: "argparse._ActionsContainer") -> None:
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
    add_joint_error(parser)


def run_whole(args: argparse.Namespace, rule: "InputRule") -> CliResult:
    missing = [f"--{name}" for name in NEEDED if getattr(args, name) is None]
    if missing:
        raise InputError(
            f"a whole run needs --joints, --robot and --laser: {missing[0]} is missing"
        )
    robot, warnings = describe_robot(args.robot)
    arm = robot.arm
    laser = read_laser_for(args.laser, arm).laser
    given = given_frame(args)
    taught = arm.T_flange_tool if given is None else given
    path, origin_ns = read_joint_path(args.joints, arm)
    edges, names = read_step_edges(args.events, rule.sigma_s, origin_ns)
    steps = named_steps(edges, names, rule.debounce_s)
    figure = erring = None
    if args.method == "classic":
        tool = classic_run_document(classic_from_path(laser, path, steps, taught))
    else:
        circles = [step.name for step in steps if step.kind == "circle"]
        found = estimate_tool(laser, path, steps, taught)
        known, verdict = KnownTool.measured(found), judge_run(found, ToolLimits())
        if (size_rad := joint_error_rad(args)) > 0.0:
            last_s = max(edge.time_s for edge in steps[-1].edges)
            q = path.q[np.searchsorted(path.time_s, last_s)]
            erring = tip_errors(arm, size_rad, (q, found.tip), None, found.covariance[:3, :3])
        if erring is not None:
            verdict = with_joint_errors(verdict, erring, "tip")
        tool = run_document(known, found, circles, verdict)
        if args.figures is not None:
            left: dict[str, list[float]] = {step.name: [] for step in steps}
            for step, value in zip(found.edge_step, 1e3 * found.edge_m, strict=True):
                left[steps[step].name].append(float(value))
            figure = _drawn(args.figures, left, found.covariance[:3, :3], found.misfit_m)
    document: ToolRunDocument = {
        **tool,
        "joint_errors": None if erring is None else erring.document(),
        "figures": figure,
        "warnings": warnings,
    }
    return CliResult(document, _show_tool)


def add_figures(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--figures",
        type=Path,
        metavar="DIR",
        help="write tool.svg there: residuals, and how well the tip is known",
    )


def _drawn(
    folder: Path,
    residual_mm: dict[str, list[float]],
    covariance: NDArray[np.float64],
    rms_m: float,
) -> str:
    from robocal_ros.report.measured_figures import keep_figure, result_figure

    place = "the tip, axes of the flange"
    figure = result_figure(residual_mm, covariance, place=place, rms_mm=1e3 * rms_m)
    return keep_figure(folder, "tool", figure)


def _show_tool(console: "Console", document: Document) -> None:
    from rich.text import Text

    print_verdict(console, document)
    sigma = document["sigma_mm"] or [None] * 3
    tip = ", ".join(
        f"{value:.3f}" + ("" if spread is None else f" ± {spread:.3f}")
        for value, spread in zip(document["tcp_mm"], sigma, strict=True)
    )
    console.print(f"Tip in the flange frame, mm: {tip}")
    for name, key in (("Axis", "axis"), ("Orientation, quaternion x y z w", "quat_xyzw")):
        if document.get(key) is not None:
            console.print(f"{name}: {spaced(document[key], 6)}")
    for radius in document.get("tool_radius_mm") or ():
        console.print(Text(f"Tool radius on {radius['circle']}: {radius['x']:.3f} mm as the x-beam "
                           f"sees it, {radius['y']:.3f} mm as the y-beam"))  # fmt: skip
    if document.get("latency_s") is not None:
        console.print(f"Latency of the input: {document['latency_s'] * 1e3:.3f} ms")


METHODS = ("best", "classic")
DIRECTIONS = {"ccw": 1, "cw": -1}
JITTER_S = 20e-6
OF_CIRCLE = ("radius_mm", "period_s", "start_deg", "direction", "beam_angle_deg", "latency_s")
OF_RUN = (
    "joints", "robot", "laser", "tool", "xyz_mm", "rpy_deg", "joint_error_urad", "figures",
)  # fmt: skip


def add_crossed(parser: argparse.ArgumentParser) -> None:
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
    add_figures(parser)
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


def run_crossed(args: argparse.Namespace) -> CliResult:
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
    document = circle_document(fit_circle(motion, edges, args.method, latency_s=args.latency_s))
    return CliResult(document, _show_crossed)


def _given(args: argparse.Namespace, names: tuple[str, ...]) -> list[str]:
    taught = {"xyz_mm": "taught_mm", "rpy_deg": "taught_rpy_deg"}
    return [
        f"--{taught.get(name, name).replace('_', '-')}"
        for name in names
        if getattr(args, name) is not None
    ]


def _show_crossed(console: "Console", document: Document) -> None:
    print_verdict(console, document)
    if document["tool_radius_mm"] is not None:
        x, y = document["tool_radius_mm"].values()
        console.print(f"Tool radius: {x:.3f} mm as the x-beam sees it, {y:.3f} mm as the y-beam")
    console.print(f"Latency of the input: {document['latency_s'] * 1e3:.3f} ms")


POINT_METHODS = ("four", "seven")


def add_points(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--method", choices=POINT_METHODS, default=POINT_METHODS[0])
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
    add_figures(parser)


def run_points(args: argparse.Namespace) -> CliResult:
    fit = {"four": fit_four, "seven": fit_seven}[args.method]
    sigma_m = None if args.sigma_mm is None else args.sigma_mm * 1e-3
    found = fit(read_flange_poses(args.data), sigma_m)
    document: TouchesDocument = {"method": args.method, **touch_document(found), "figures": None}
    if args.figures is not None:
        far_mm = 1e3 * np.linalg.norm(found.residual, axis=1)
        left = {str(i): [float(far)] for i, far in enumerate(far_mm, start=1)}
        document["figures"] = _drawn(args.figures, left, found.covariance, found.rms_m)
    return CliResult(document, _show_tool)


def add_parallel(parser: argparse.ArgumentParser) -> None:
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


def run_parallel(args: argparse.Namespace) -> CliResult:
    if not all(map(isfinite, (args.up_mm, args.down_mm, args.x_mm or 0.0))):
        raise InputError("--up-mm, --down-mm and --x-mm must be finite numbers")
    x_m = None if args.x_mm is None else args.x_mm * 1e-3
    station = ParallelStation(args.up_mm * 1e-3, args.down_mm * 1e-3, x_m)
    fit = fit_parallel(station, read_sweeps(args.data))
    return CliResult(parallel_document(fit.axis, fit.tip), _show_parallel)


def _show_parallel(console: "Console", document: Document) -> None:
    print_verdict(console, document)
    console.print(f"Axis: {spaced(document['axis'], 6)}")
    if document["tcp_mm"] is not None:
        console.print(f"Tip in the flange frame, mm: {spaced(document['tcp_mm'], 3, ', ')}")


FORMATS = ("urdf", "kuka", "abb", "fanuc", "ur", "kawasaki")


def add_export(parser: argparse.ArgumentParser) -> None:
    add_frame_options(parser, "--xyz-mm", "--rpy-deg")
    parser.add_argument("--format", required=True, choices=FORMATS)
    parser.add_argument(
        "--mass-kg", type=positive, metavar="M", help="of the tool, for abb; with the next"
    )
    parser.add_argument(
        "--cog-mm",
        type=three_numbers,
        metavar="X,Y,Z",
        help="the tool's centre of gravity in the flange frame, for abb",
    )


def run_export(args: argparse.Namespace) -> CliResult:
    T_flange_tool = given_frame(args)
    if T_flange_tool is None:
        raise InputError("give the tool: --tool, or --xyz-mm and --rpy-deg")
    load = None
    if args.mass_kg is not None or args.cog_mm is not None:
        if args.format != "abb":
            raise InputError(f"--mass-kg and --cog-mm are for --format abb, not for {args.format}")
        if args.mass_kg is None or args.cog_mm is None:
            raise InputError("--mass-kg and --cog-mm go together: a load has both")
        x, y, z = args.cog_mm
        load = Load(args.mass_kg, (x * 1e-3, y * 1e-3, z * 1e-3))
    document: ExportedToolDocument = {
        "format": args.format,
        "text": exported(T_flange_tool, args.format, load),
        "T_flange_tool": transform_document(T_flange_tool),
    }
    return CliResult(document, print_text)


MOST_LISTED = 1_000_000  # all that a history holds


def add_station(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    parser.add_argument(
        "--robot-serial", required=True, type=text, metavar="S", help="whose history is read"
    )
    add_state(parser)
    parser.add_argument(
        "--output", type=Path, metavar="FILE", help="write the last measurement as a laser file"
    )


def run_station(args: argparse.Namespace) -> CliResult:
    robot, warnings = describe_robot(args.robot)
    with model_history(args, robot.arm) as history:
        entries = [e for e in reversed(history.list(MOST_LISTED)) if e.kind == LASER_FRAME]
        models = [history.model(entry.id) for entry in entries]
        path = str(history.path)
    if not entries:
        raise InputError("no laser frame was measured: mode LASER_FRAME of tcf_node", file=path)
    # Of another mandrel, radius or laser file the node compares with another first one.
    began = models[-1]["first"]
    kept = [
        (entry, model)
        for entry, model in zip(entries, models, strict=True)
        if model["first"]["points_m"] == began["points_m"]
    ]
    first = measurement_of(began)
    later = [(entry, measurement_of(model)) for entry, model in kept[1:]]
    shifts = [station_shift(first, found) for _, found in later]
    stamps = [entry.stamp_ns for entry, _ in later]
    last = measurement_of(kept[-1][1])
    trend = StationTrend().after(kept[0][0].stamp_ns, station_shift(first, first))
    for stamp, (entry, _), shift in zip(stamps, later, shifts, strict=True):
        if entry.code is Code.ACCEPT:  # a knock is no drift
            trend = trend.after(stamp, shift)
    document: StationDocument = {
        "robot": robot.arm.name,
        "model_hash": robot.arm.model_hash,
        "station": kept[-1][1]["made_with"]["station"],
        **laser_document(last.laser),
        "first_stamp_ns": kept[0][0].stamp_ns,
        "measured": [
            {"stamp_ns": stamp, "calibration": entry.id, **shift.document()}
            for stamp, (entry, _), shift in zip(stamps, later, shifts, strict=True)
        ],
        "trend": trend.document(),
        "output": None,
        "warnings": warnings,
    }
    if args.output is not None:
        newest = kept[-1][0]
        if newest.code not in (Code.ACCEPT, Code.STATION_MOVED):
            words = (
                f"the last measurement, calibration {newest.id}, is {newest.code.name}: repeat it"
            )
            raise InputError(f"{words}; no laser file is written from it", file=path)
        station, arm = document["station"], robot.arm
        write_laser(
            args.output,
            LaserFile(last.laser, station, arm.name, arm.model_hash, args.robot_serial),
        )
        document["output"] = str(args.output)
    return CliResult(document, _show_station)


def _show_station(console: "Console", document: Document) -> None:
    rows = [
        [
            f"{(row['stamp_ns'] - document['first_stamp_ns']) / 3.6e12:.2f}",
            spaced(row["shift_mm"], 3),
            spaced(row["shift_sigma_mm"], 3),
            spaced(row["turn_deg"], 3),
            "yes" if row["moved"] else "",
        ]
        for row in document["measured"]
    ]
    head = ("hours", "shift x y z, mm", "sigma", "turn, deg", "moved")
    print_table(console, "Station since it was first measured, in its own axes", head, rows)
    if document["trend"]["per_day_mm"] is not None:
        per_day, sigma = document["trend"]["per_day_mm"], document["trend"]["sigma_mm"]
        console.print(f"Trend, mm a day: {spaced(per_day, 3)} (sigma {spaced(sigma, 3)})")
    print_output(console, document)
