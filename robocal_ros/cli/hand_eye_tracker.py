"""``robocal hand-eye tracker``: a profile sensor on a robot, placed by a laser tracker."""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import ROBOT_HELP, describe_robot, positive, warn
from robocal_ros.cli.hand_eye_shots import add_limit
from robocal_ros.cli.hand_eye_view import show_judged, show_placed
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.ground.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.hand_eye.tracker_data import TrackerData, TrackerNoise
    from robocal_ros.kinematics import SerialArm

NAME = "tracker"
HELP = "place a profile sensor by a laser tracker that sees the flange, and a cube with a sphere"

METHODS = ("best", "classic")
LIMIT_MM = 0.5
WHERE = "at the working distance"  # the expected error holds


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--robot", required=True, metavar="NAME", help=ROBOT_HELP)
    parser.add_argument(
        "--poses",
        required=True,
        type=Path,
        metavar="CSV",
        help="the scan: joints q1_deg …, and profile, the file of each",
    )
    parser.add_argument(
        "--profiles", required=True, type=Path, metavar="DIR", help="folder of the profiles"
    )
    parser.add_argument(
        "--points",
        required=True,
        type=Path,
        metavar="CSV",
        help="of the tracker: role (arc_a, arc_b, sphere, face_1, face_2), x_mm, y_mm, z_mm, and "
        "on the arcs the joints",
    )
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument("--target", type=Path, metavar="YAML", help="radii and reflector's height")
    target.add_argument(
        "--radius-mm",
        type=positive,
        metavar="R",
        help="instead of a target file: of the sphere and of the reflector alike",
    )
    parser.add_argument("--method", choices=METHODS, default=METHODS[0])
    _add_limits(parser)


def _add_limits(parser: argparse.ArgumentParser) -> None:
    noise = parser.add_argument_group("noise, one sigma")
    for option, default in (
        ("tracker-sigma-mm", "0.015"), ("joint-sigma-deg", "0.0029 (5e-5 rad)"),
        ("joint-sigma-mm", "0.02"),
    ):  # fmt: skip
        noise.add_argument(f"--{option}", type=positive, metavar="S", help=f"default {default}")
    add_limit(parser, WHERE, LIMIT_MM)


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.hand_eye.result import hand_eye_document
    from robocal_ros.hand_eye.target_files import read_tracker_target
    from robocal_ros.hand_eye.tracker import solve_tracker
    from robocal_ros.hand_eye.tracker_data import TrackerTarget

    warnings: list[str] = []
    arm = describe_robot(args.robot, warnings).arm
    if args.target is None:
        target = TrackerTarget(args.radius_mm * 1e-3, args.radius_mm * 1e-3)
    else:
        target = read_tracker_target(args.target)
    data, rejected = _read(args, arm)
    result = solve_tracker(data, target, _noise(args), args.method, args.limit_mm * 1e-3)
    warn(warnings)
    result = replace(result, rejected={**rejected, **result.rejected})
    document = hand_eye_document(result)
    return CliResult(document, partial(_show, document=document))


def _noise(args: argparse.Namespace) -> "TrackerNoise":
    """What is given of it; the rest as `TrackerNoise` has it."""
    from math import radians

    from robocal_ros.hand_eye.tracker_data import TrackerNoise

    given = {}
    if args.tracker_sigma_mm is not None:
        given["tracker_m"] = args.tracker_sigma_mm * 1e-3
    if args.joint_sigma_deg is not None:
        given["joint_rad"] = radians(args.joint_sigma_deg)
    if args.joint_sigma_mm is not None:
        given["joint_m"] = args.joint_sigma_mm * 1e-3
    return TrackerNoise(**given)


def _read(args: argparse.Namespace, arm: "SerialArm") -> tuple["TrackerData", dict[str, str]]:
    """All measurements, and the profiles that show next to nothing, with why."""
    from robocal_ros.ground.errors import TooFewSamplesError
    from robocal_ros.hand_eye.shots import Profile
    from robocal_ros.hand_eye.tables import read_pose_table, read_profiles
    from robocal_ros.hand_eye.target_files import read_tracker_points
    from robocal_ros.hand_eye.tracker_data import TrackerData

    points = read_tracker_points(args.points, arm)
    table = read_pose_table(args.poses, arm)
    if table.q is None:
        raise InputError(
            "the joints are missing: the arcs and the scan are tied by the robot's joints; add "
            "q1_deg …",
            file=str(args.poses),
            row=1,
        )
    shots = read_profiles(args.profiles, table)
    rejected = {
        name: str(shot)
        for name, shot in zip(table.names, shots, strict=True)
        if isinstance(shot, TooFewSamplesError)
    }
    seen = [index for index, name in enumerate(table.names) if name not in rejected]
    profiles = [shot for shot in shots if isinstance(shot, Profile)]
    data = TrackerData(arm, points.arcs, points.sphere, points.faces, table.q[seen], profiles)
    return data, rejected


def _show(console: "Console", document: Document) -> None:
    show_placed(console, document, "Sensor", WHERE)
    residual = document["residual_mm"]
    console.print(
        f"Profiles from the target: rms {residual['rms']:.3f} mm, largest {residual['max']:.3f} mm"
    )
    show_judged(console, document)
