"""``robocal hand-eye check-plan``: will planned poses do, and which would do better."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import positive
from robocal_ros.cli.hand_eye_shots import (
    add_limits,
    add_robot,
    add_target,
    add_target_kind,
    arm_of,
    given_target,
    settings_of,
)
from robocal_ros.cli.hand_eye_view import show_sigma, show_verdict
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.cli.tool_frames import three_numbers
from robocal_ros.ground.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import Console

    from robocal_ros.hand_eye.mount_problem import PoseNoise
    from robocal_ros.hand_eye.planning import PlannedTarget, PlanReport, SensorRange
    from robocal_ros.hand_eye.quality import HandEyeSettings
    from robocal_ros.hand_eye.target_files import Target

NAME = "check-plan"
HELP = "tell before the robot moves what planned poses would give, and which others would do"

SENSOR = {
    "near": (190.0, "nearest distance that the sensor sees"),
    "far": (210.0, "farthest"),
    "width": (60.0, "of the field, half way"),
    "noise": (0.037, "of a point along the beam, one sigma"),
}
ROBOT_SIGMA_MM = 0.05


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_target_kind(parser)
    parser.add_argument(
        "--poses",
        required=True,
        type=Path,
        metavar="CSV",
        help="planned flange poses in base, or joints with --robot",
    )
    parser.add_argument(
        "--mount",
        required=True,
        type=Path,
        metavar="FILE",
        help="T_flange_sensor, roughly: JSON of an earlier result, or YAML with xyz_mm and rpy_deg "
        "or quat_xyzw",
    )
    add_target(parser)
    parser.add_argument(
        "--center-mm",
        type=three_numbers,
        metavar="X,Y,Z",
        help="of a sphere, roughly, in base; default: where most of the poses see it",
    )
    add_robot(parser)
    sensor = parser.add_argument_group("the sensor")
    for name, (value, words) in SENSOR.items():
        sensor.add_argument(
            f"--{name}-mm",
            type=positive,
            default=value,
            metavar="L",
            help=f"{words}; default {value:g}",
        )
    add_limits(parser, f"default {ROBOT_SIGMA_MM:g} mm, 0 deg")
    parser.add_argument("--propose", type=Path, metavar="CSV", help="write the proposed poses")


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.hand_eye.files import read_flange_mount
    from robocal_ros.hand_eye.planning import check_plan
    from robocal_ros.hand_eye.tables import read_pose_table, write_pose_table

    settings, sensor = settings_of(args), _sensor(args)
    known = given_target(args.target_kind, args.target, args.radius_mm)
    table = read_pose_table(args.poses, arm_of(args), None)
    target = _planned(known, args.center_mm, sensor, table.mark)
    X = read_flange_mount(args.mount)
    report = check_plan(target, table.T_base_flange, X, sensor, _noise(settings), settings.limit_m)
    marks = None if table.mark is None else _lit(target, report.proposed @ X)
    if args.propose is not None:
        names = [f"proposed_{i + 1:02d}" for i in range(len(report.proposed))]
        write_pose_table(args.propose, report.proposed, names=names, mark=marks)
    document = _document(report, table.names) | {"proposed_marks": marks}
    return CliResult(document, partial(_show, document=document))


def _sensor(args: argparse.Namespace) -> "SensorRange":
    from robocal_ros.hand_eye.planning import SensorRange

    if args.near_mm >= args.far_mm:
        raise InputError(f"--near-mm {args.near_mm:g} must be below --far-mm {args.far_mm:g}")
    return SensorRange(
        near_m=args.near_mm * 1e-3,
        far_m=args.far_mm * 1e-3,
        width_m=args.width_mm * 1e-3,
        noise_m=args.noise_mm * 1e-3,
    )


def _noise(settings: "HandEyeSettings") -> "PoseNoise":
    from robocal_ros.hand_eye.mount_problem import PoseNoise

    return settings.noise() or PoseNoise(ROBOT_SIGMA_MM * 1e-3, 0.0)


def _planned(
    target: "Target | None",
    center_mm: tuple[float, float, float] | None,
    sensor: "SensorRange",
    marks: tuple[str, ...] | None,
) -> "PlannedTarget":
    import numpy as np

    from robocal_ros.hand_eye.planning import PlannedLine, PlannedSphere, PlannedStairs
    from robocal_ros.hand_eye.targets import SphereTarget, StepTarget

    if isinstance(target, SphereTarget):
        if center_mm is None:
            return PlannedSphere(target.radius_m, sensor)
        x, y, z = center_mm
        return PlannedSphere(target.radius_m, sensor, (x * 1e-3, y * 1e-3, z * 1e-3))
    if center_mm is not None:
        raise InputError("--center-mm is a sphere's")
    if isinstance(target, StepTarget):
        return PlannedStairs(target, sensor, marks)
    line = None if target is None else np.stack([target.point_base, target.direction_base])
    return PlannedLine(sensor, line)


def _lit(target: "PlannedTarget", T_base_sensor: "NDArray[np.float64]") -> list[str] | None:
    """Marks of the stairs on which proposed poses lay the light."""
    from robocal_ros.hand_eye.planning import PlannedStairs

    return list(target.lit(T_base_sensor)) if isinstance(target, PlannedStairs) else None


def _document(report: "PlanReport", names: tuple[str, ...]) -> Document:
    from math import degrees

    from robocal_ros.estimation.assessment import verdict_document
    from robocal_ros.ground.frames import transform_document

    sigma, error_m, better_m = report.sigma, report.working_error_m, report.proposed_error_m
    return {
        "rank": report.rank,
        "unknowns": report.unknowns,
        "unobservable": list(report.unobservable),
        "sigma": None
        if sigma is None
        else {
            "xyz_mm": (sigma[:3] * 1e3).tolist(),
            "rot_deg": [degrees(value) for value in sigma[3:]],
        },
        "working_error_mm": None if error_m is None else error_m * 1e3,
        "unseen": {names[index]: why for index, why in report.unseen.items()},
        "proposed": [transform_document(T) for T in report.proposed],
        "proposed_error_mm": None if better_m is None else better_m * 1e3,
        "verdict": verdict_document(report.verdict),
    }


def _show(console: "Console", document: Document) -> None:
    show_verdict(console, document)
    console.print(f"Rank: {document['rank']} of {document['unknowns']}")
    for words in document["unobservable"]:
        console.print(f"Open: {words}", soft_wrap=True)
    if document["sigma"] is not None:
        show_sigma(console, document["sigma"])
    for name, why in document["unseen"].items():
        console.print(f"Out of view: {name}: {why}", soft_wrap=True, markup=False)
    proposed = document["proposed"]
    if proposed:
        console.print(
            f"With {len(proposed)} more poses, expected error "
            f"{document['proposed_error_mm']:.3f} mm rms:"
        )
    for pose, mark in zip(
        proposed, document["proposed_marks"] or [""] * len(proposed), strict=True
    ):
        xyz = ", ".join(f"{value:.1f}" for value in pose["xyz_mm"])
        quat = " ".join(f"{value:.4f}" for value in pose["quat_xyzw"])
        console.print(f"  {xyz} mm; x y z w {quat} {mark}".rstrip())
