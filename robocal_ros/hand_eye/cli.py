"""Commands of ``robocal hand-eye`` for a line laser, and export and check-plan of any sensor."""

import argparse
from dataclasses import replace
from functools import partial
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.main import CliResult, Document, positive, text, three_numbers
from robocal_ros.estimation.assessment import errors_document, summarise, verdict_document
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import quoted
from robocal_ros.ground.frames import transform_document
from robocal_ros.hand_eye.cli_shots import (
    KINDS,
    add_feature,
    add_limits,
    add_robot,
    add_shots,
    add_target,
    add_target_file,
    add_target_kind,
    arm_of,
    given_shots,
    given_target,
    read_shots,
    require_unused,
    settings_of,
    show_held_out,
    show_mount,
    show_pose,
    show_sigma,
    show_verdict,
    task_of,
)
from robocal_ros.hand_eye.files import (
    exported,
    read_flange_mount,
    read_mount,
    read_pose_table,
    write_pose_table,
)
from robocal_ros.hand_eye.planning import (
    PlannedStairs,
    PlanReport,
    SensorRange,
    check_plan,
    planned_target,
)
from robocal_ros.hand_eye.result import (
    METHODS,
    PoseNoise,
    by_shot,
    hand_eye_document,
)
from robocal_ros.hand_eye.solve import held_out, judged, solve_joint, solve_task, verify

if TYPE_CHECKING:
    from rich.console import Console


FORMATS = ("urdf", "xacro", "yaml", "static-transform")
PARENTS = {"flange": "tool0", "base": "base"}
SENSOR = {
    "near": (190.0, "nearest distance that the sensor sees"),
    "far": (210.0, "farthest"),
    "width": (60.0, "of the field, half way"),
    "noise": (0.037, "of a point along the beam, one sigma"),
}
ROBOT_SIGMA_MM = 0.05


def add_target_action(parser: argparse.ArgumentParser) -> None:
    """Offer what all targets have in common."""
    add_shots(parser)
    parser.add_argument("--method", choices=METHODS, default=METHODS[0])
    add_limits(parser, "default: from the residuals")
    parser.add_argument(
        "--check",
        type=Path,
        metavar="FILE",
        help="shots of the same target, as --poses or --bag, that judge the result and are not "
        "used to find it",
    )


def run_target(kind: str, args: argparse.Namespace, radius_mm: float | None = None) -> CliResult:
    """Place the sensor. Raises `RobocalError` for what a user can mend."""
    arm, settings = arm_of(args), settings_of(args)
    target = given_target(kind, args.target, radius_mm)
    task = task_of(target, getattr(args, "line_kind", None), args.method == "classic")
    shots = given_shots(args, arm)
    judges = None if args.check is None else given_shots(args, arm, args.check)
    if judges is not None:
        if judges.table is not None and shots.table is not None:
            require_unused(judges.table, shots.table)
        elif args.check.resolve() == args.bag.resolve():
            raise InputError("--check is --bag: other shots must judge", file=str(args.check))
    result = solve_task(task, shots.data, args.method, settings)
    result = replace(result, rejected={**shots.rejected, **result.rejected})
    if judges is not None:
        if result.place is None:
            raise ValueError("a result of one target has its place")
        seen = held_out(task, judges.data, result.T_flange_sensor, result.place)
        result = judged(result, seen, len(judges.data.names), settings, judges.rejected)
    document: Document = hand_eye_document(result)
    return CliResult(document, partial(show_mount, document=document))


def add_sphere(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``sphere``."""
    add_target_action(parser)
    add_target(parser)


def run_sphere(args: argparse.Namespace) -> CliResult:
    """Do ``sphere``. Raises `RobocalError` for what a user can mend."""
    return run_target("sphere", args, args.radius_mm)


def add_step(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``step``."""
    add_target_action(parser)
    add_target_file(parser, "the stairs and where they were taught")


def run_step(args: argparse.Namespace) -> CliResult:
    """Do ``step``. Raises `RobocalError` for what a user can mend."""
    return run_target("step", args)


def add_line(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``line``."""
    add_target_action(parser)
    add_target_file(parser, "where the line is; default: that is found too")
    add_feature(parser)


def run_line(args: argparse.Namespace) -> CliResult:
    """Do ``line``. Raises `RobocalError` for what a user can mend."""
    return run_target("line", args)


def add_joint(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``joint``."""
    for kind in KINDS:
        without = "; without target.yaml the line is found too" if kind == "line" else ""
        parser.add_argument(
            f"--{kind}",
            type=Path,
            metavar="DIR",
            help=f"folder with poses.csv, profiles/ and target.yaml of a {kind}{without}",
        )
    add_feature(parser)
    add_robot(parser)
    add_limits(parser, "default: from the residuals")
    parser.add_argument(
        "--check",
        type=text,
        metavar="NAME",
        help="table in the folders, such as check.csv: other shots of the same targets, of one or "
        "more, that judge the result and are not used to find it",
    )


def run_joint(args: argparse.Namespace) -> CliResult:
    """Do ``joint``. Raises `RobocalError` for what a user can mend."""
    arm, settings = arm_of(args), settings_of(args)
    folders = {kind: getattr(args, kind) for kind in KINDS if getattr(args, kind) is not None}
    if len(folders) < 2:
        raise InputError("give the folders of at least two of --sphere, --step, --line")
    parts, checks = [], {}
    for kind, folder in folders.items():
        file, profiles = folder / "target.yaml", folder / "profiles"
        known = kind != "line" or file.exists()
        task = task_of(given_target(kind, file if known else None, None), args.line_kind)
        shots = read_shots(folder / "poses.csv", profiles, arm)
        parts.append((task, shots.data))
        if args.check is not None and (folder / args.check).exists():
            judges = read_shots(folder / args.check, profiles, arm)
            if judges.table is not None and shots.table is not None:
                require_unused(judges.table, shots.table)
            checks[task.kind] = judges.data
    if args.check is not None and not checks:
        raise InputError(f"none of the folders holds the table of --check, {quoted(args.check)}")
    result = solve_joint(parts, settings, checks)
    document: Document = hand_eye_document(result)
    return CliResult(document, partial(show_mount, document=document))


def add_verify(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``verify``."""
    parser.add_argument(
        "--result",
        required=True,
        type=Path,
        metavar="FILE",
        help="JSON that sphere, step, line, joint or tracker printed",
    )
    add_target_kind(parser)
    add_shots(parser)
    add_target(parser)
    add_feature(parser)
    add_limits(parser, "default 0.05 mm, 0.003 deg")


def run_verify(args: argparse.Namespace) -> CliResult:
    """Do ``verify``. Raises `RobocalError` for what a user can mend."""
    settings = settings_of(args)
    T_flange_sensor = read_flange_mount(args.result)
    task = task_of(given_target(args.target_kind, args.target, args.radius_mm), args.line_kind)
    shots = given_shots(args, arm_of(args))
    found = verify(task, shots.data, T_flange_sensor, settings)
    errors = errors_document(summarise(found.distance_m))
    rejected = {**shots.rejected, **by_shot(found.rejected, found.samples)}
    document: Document = {
        "kind": args.target_kind,
        "T_flange_sensor": transform_document(T_flange_sensor),
        "target": found.target,
        "held_out": errors | {"rejected": list(rejected), "rejected_because": rejected},
        "per_sample_mm": dict(zip(found.samples, (found.distance_m * 1e3).tolist(), strict=True)),
        "verdict": verdict_document(found.verdict),
    }
    return CliResult(document, partial(_show_verify, document=document))


def _show_verify(console: "Console", document: Document) -> None:
    show_verdict(console, document)
    show_pose(console, "Sensor in the flange frame, as given", document["T_flange_sensor"])
    show_held_out(console, document["held_out"])


def add_export(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``export``."""
    parser.add_argument(
        "--result", required=True, type=Path, metavar="FILE", help="JSON that was printed before"
    )
    parser.add_argument("--format", required=True, choices=FORMATS)
    parser.add_argument(
        "--parent",
        type=text,
        metavar="FRAME",
        help="default tool0; of a sensor beside the robot base",
    )
    parser.add_argument(
        "--child", type=text, default="laser", metavar="FRAME", help="default laser"
    )


def run_export(args: argparse.Namespace) -> CliResult:
    """Do ``export``. Raises `RobocalError` for what a user can mend."""
    mount = read_mount(args.result, accepted=True)
    T, parent = mount.T_parent_sensor, args.parent or PARENTS[mount.parent]
    document: Document = {
        "format": args.format,
        "parent": parent,
        "child": args.child,
        "text": exported(T, parent, args.child, args.format),
        f"T_{mount.parent}_sensor": transform_document(T),
    }
    return CliResult(document, lambda console: console.out(document["text"], highlight=False))


def add_check_plan(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``check-plan``."""
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


def run_check_plan(args: argparse.Namespace) -> CliResult:
    """Do ``check-plan``. Raises `RobocalError` for what a user can mend."""
    settings = settings_of(args)
    if args.near_mm >= args.far_mm:
        raise InputError(f"--near-mm {args.near_mm:g} must be below --far-mm {args.far_mm:g}")
    sensor = SensorRange(
        near_m=args.near_mm * 1e-3,
        far_m=args.far_mm * 1e-3,
        width_m=args.width_mm * 1e-3,
        noise_m=args.noise_mm * 1e-3,
    )
    known = given_target(args.target_kind, args.target, args.radius_mm)
    table = read_pose_table(args.poses, arm_of(args), None)
    centre = None if args.center_mm is None else tuple(x * 1e-3 for x in args.center_mm)
    if centre is not None and args.target_kind != "sphere":
        raise InputError("--center-mm is a sphere's")
    target = planned_target(known, sensor, centre, table.mark)
    X = read_flange_mount(args.mount)
    noise = settings.noise() or PoseNoise(ROBOT_SIGMA_MM * 1e-3, 0.0)
    report = check_plan(target, table.T_base_flange, X, sensor, noise, settings.limit_m)
    marks = None
    if table.mark is not None and isinstance(target, PlannedStairs):
        marks = list(target.lit(report.proposed @ X))  # on which the light is laid
    if args.propose is not None:
        names = [f"proposed_{i + 1:02d}" for i in range(len(report.proposed))]
        write_pose_table(args.propose, report.proposed, names=names, mark=marks)
    document = _document(report, table.names) | {"proposed_marks": marks}
    return CliResult(document, partial(_show_check_plan, document=document))


def _document(report: "PlanReport", names: tuple[str, ...]) -> Document:
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


def _show_check_plan(console: "Console", document: Document) -> None:
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
