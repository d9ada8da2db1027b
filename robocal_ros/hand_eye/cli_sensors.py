# SPDX-License-Identifier: Apache-2.0
"""Commands of ``robocal hand-eye`` for a camera and a laser tracker, export and check-plan."""

import argparse
from dataclasses import replace
from math import degrees, radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robocal_ros.cli.main import (
    ROBOT_HELP,
    CliResult,
    Document,
    add_joint_error,
    describe_robot,
    joint_error_rad,
    positive,
    print_table,
    print_text,
    print_verdict,
    spaced,
    text,
    three_numbers,
    warn,
)
from robocal_ros.estimation.assessment import verdict_document
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.ground.files import quoted
from robocal_ros.ground.frames import transform_document
from robocal_ros.hand_eye.boards import (
    Chessboard,
    Intrinsics,
    SeenBoards,
    board_pairs,
    intrinsics_document,
    read_intrinsics,
    see_boards,
)
from robocal_ros.hand_eye.camera import (
    METHODS,
    CameraSettings,
    CheckPairs,
    calibrate_camera,
    calibrate_streams,
)
from robocal_ros.hand_eye.camera_data import PosePairs, stream_of
from robocal_ros.hand_eye.camera_fit import GivenNoise
from robocal_ros.hand_eye.cli import (
    KINDS,
    LIMIT_MM,
    add_description,
    add_figures,
    add_limit,
    add_limits,
    add_robot,
    add_robot_sigma,
    add_sensor,
    add_target,
    arm_of,
    described,
    drawn_document,
    given_target,
    require_unused,
    robot_sigma_of,
    settings_of,
    show_judged,
    show_placed,
    show_sigma,
)
from robocal_ros.hand_eye.data import MOUNTS
from robocal_ros.hand_eye.files import (
    PoseTable,
    exported,
    read_flange_mount,
    read_images,
    read_mount,
    read_pose_table,
    read_profiles,
    read_tracker_points,
    write_pose_table,
)
from robocal_ros.hand_eye.planning import (
    ROBOT_SIGMA_M,
    PlannedStairs,
    PlanReport,
    check_plan,
    planned_target,
)
from robocal_ros.hand_eye.profiles import Profile, SensorDescription
from robocal_ros.hand_eye.result import HandEyeResult
from robocal_ros.hand_eye.targets import (
    FARTHEST_MM,
    BoardTarget,
    TrackerTarget,
    read_target,
    read_tracker_target,
)
from robocal_ros.hand_eye.tracker import LIMIT_M, solve_tracker
from robocal_ros.hand_eye.tracker_data import TrackerData, TrackerNoise
from robocal_ros.kinematics import SerialArm

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.hand_eye.documents import CheckedPlanDocument


# ---- from the tables and images of ``robocal hand-eye camera`` to its result --------------------


def _tables(
    args: argparse.Namespace, file_column: str | None
) -> tuple[PoseTable, PoseTable | None]:
    """The robot's poses that solve, and those that judge."""
    arm = arm_of(args)
    used = read_pose_table(args.poses, arm, file_column)
    if args.check is None:
        return used, None
    judges = read_pose_table(args.check, arm, file_column)
    require_unused(judges, used)
    return used, judges


def _settings(args: argparse.Namespace, joints: bool) -> CameraSettings:
    """How to calibrate; ``joints``: whether those of each pose are known."""
    noise, joint_rad = GivenNoise(*robot_sigma_of(args)), joint_error_rad(args, joints)
    return CameraSettings(args.method, noise, args.limit_mm * 1e-3, joint_rad)


def _from_images(args: argparse.Namespace) -> HandEyeResult:
    board, intrinsics = _described(args)
    used, judges = _tables(args, "image")
    pairs, seen = _pairs_of_images(used, args, board, intrinsics)
    check = None
    if judges is not None:
        held, shown = _pairs_of_images(judges, args, board, seen.intrinsics, pairs)
        check = CheckPairs(held, shown.rejected)
    return calibrate_camera(
        pairs,
        _settings(args, used.joints is not None),
        check=check,
        rejected=seen.rejected,
        more={"intrinsics": intrinsics_document(seen, intrinsics is None)},
    )


def _described(args: argparse.Namespace) -> tuple[Chessboard, Intrinsics | None]:
    """The board and what is known of the camera, from the options or a target file."""
    intrinsics = None if args.intrinsics is None else read_intrinsics(args.intrinsics)
    if isinstance(args.board, tuple):
        if args.square_mm is None:
            raise InputError("give --square-mm, the side of a square of the board")
        columns, rows = args.board
        return Chessboard(columns, rows, args.square_mm * 1e-3), intrinsics
    if args.square_mm is not None:
        raise InputError("--square-mm belongs to --board 9x6: a file tells the size itself")
    target = read_target(args.board)
    if not isinstance(target, BoardTarget):
        raise InputError("describes no board", file=str(args.board))
    if target.camera_info and intrinsics is None:
        words = "takes the intrinsics from a topic: give them as --intrinsics"
        raise InputError(words, file=str(args.board))
    return target.board, intrinsics or target.intrinsics


def _pairs_of_images(
    table: PoseTable, args: argparse.Namespace, board: Chessboard,
    intrinsics: Intrinsics | None, beside: PosePairs | None = None,
) -> tuple[PosePairs, SeenBoards]:  # fmt: skip

    images, unread = read_images(args.profiles, table)
    seen = see_boards(images, board, intrinsics, unread)
    pairs = board_pairs(
        seen, board, table.names, table.T_base_flange, args.mount, table.joints, beside
    )
    return pairs, seen


def _from_poses(args: argparse.Namespace) -> HandEyeResult:
    robot, check = _tables(args, None)
    camera = read_pose_table(args.measured, None, None)
    tables = [robot, camera] if check is None else [robot, camera, check]
    stamps = [table.stamp_ns for table in tables if table.stamp_ns is not None]
    if len(stamps) == len(tables) and not all(table.named for table in tables):
        origin_ns = int(min(stamp_ns[0] for stamp_ns in stamps))
        streams = [
            stream_of(stamp_ns, table.T_base_flange, table.names, origin_ns, table.path)
            for stamp_ns, table in zip(stamps, tables, strict=True)
        ]
        judge = None if check is None else streams[2]
        return calibrate_streams(
            streams[0], streams[1], args.mount, _settings(args, joints=False), judge
        )
    if check is not None and not check.named:
        raise InputError("needs a column sample, as the measured poses", file=check.path, row=1)
    pairs, alone = _paired(robot, camera, args.mount)
    judges = None
    if check is not None:
        for name, row in zip(check.names, check.rows, strict=True):
            if name in robot.names:
                words = f"{quoted(name)} is in --poses too: other samples must judge"
                raise InputError(words, file=check.path, row=row, column="sample")
        held, absent = _paired(check, camera, args.mount)
        judges = CheckPairs(held, {name: absent[name] for name in check.names if name in absent})
        alone = {name: why for name, why in alone.items() if name not in held.names}
    settings = _settings(args, robot.joints is not None)
    if args.robot_sigma_mm is not None:
        words = "--robot-sigma-mm counts for images alone: positions of both sides scatter together"
        warn([f"{words}, and by how much is found from them"])
    return calibrate_camera(pairs, settings, check=judges, rejected=alone)


def _paired(robot: PoseTable, camera: PoseTable, mount: Any) -> tuple[PosePairs, dict[str, str]]:
    """Pairs of the same sample, or row; and the samples that only one table has."""
    if not robot.named and not camera.named:
        if len(robot) != len(camera):
            raise InputError(
                f"has {len(camera)} rows, {robot.path} has {len(robot)}: name them in a column "
                "sample in both tables, or give stamp_s in both",
                file=camera.path,
            )
        camera = replace(camera, names=robot.names)  # blank lines in either one count for nothing
    place = {name: index for index, name in enumerate(camera.names)}
    rows = np.array(
        [index for index, name in enumerate(robot.names) if name in place], dtype=np.int64
    )
    names = tuple(robot.names[index] for index in rows)
    if not names:
        raise InputError(f"has no sample of {robot.path}", file=camera.path, column="sample")
    pairs = PosePairs(
        robot.T_base_flange[rows],
        camera.T_base_flange[[place[name] for name in names]],
        names,
        mount,
        joints=None if robot.joints is None else robot.joints.take(rows),
    )
    alone = {name: f"not in {camera.path}" for name in robot.names if name not in place}
    known = set(robot.names)
    alone |= {name: f"not in {robot.path}" for name in camera.names if name not in known}
    return pairs, alone


# ---- robocal hand-eye camera --------------------------------------------------------------------


CAMERA_WHERE = "where the boards were"  # the expected error holds


def add_camera(parser: argparse.ArgumentParser) -> None:
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
    parser.add_argument(
        "--board",
        type=_board,
        metavar="9x6",
        help="inner corners of the board, or a file that describes it (also of a ChArUco board)",
    )
    parser.add_argument("--square-mm", type=positive, metavar="S", help="side of a square")
    parser.add_argument(
        "--intrinsics",
        type=Path,
        metavar="YAML",
        help="of the camera, as ROS writes them; default: from the same images",
    )
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
    add_joint_error(parser)
    add_limit(parser, CAMERA_WHERE, LIMIT_MM)
    parser.add_argument(
        "--check",
        type=Path,
        metavar="CSV",
        help="poses as --poses that judge the result and are not used to find it",
    )
    add_figures(parser)


def run_camera(args: argparse.Namespace) -> CliResult:
    if args.measured is not None:
        for option in ("profiles", "board", "square_mm", "intrinsics"):
            if getattr(args, option) is not None:
                raise InputError(
                    f"--{option.replace('_', '-')} belongs to images, --measured to poses: give "
                    "one of both"
                )
        result = _from_poses(args)
    elif args.profiles is None or args.board is None:
        raise InputError(
            "give --profiles, --board and --square-mm for images, or --measured for board poses"
        )
    else:
        result = _from_images(args)
    return CliResult(drawn_document(result, args, {}), _show_camera)


def _board(value: str) -> tuple[int, int] | Path:
    """Type of inner corners along both sides, such as 9x6, or of a file."""
    sides = value.lower().split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() for side in sides):
        if Path(value).suffix:
            return Path(value)
        raise argparse.ArgumentTypeError(f"'{value}' is not columns and rows such as 9x6")
    return int(sides[0]), int(sides[1])


def _show_camera(console: "Console", document: Document) -> None:
    show_placed(console, document, "Camera", CAMERA_WHERE)
    if document.get("time_offset_s") is not None:
        console.print(
            f"Time offset, to be added to the camera's stamps: {document['time_offset_s']:.4f} s "
            f"± {document['time_offset_sigma_s']:.4f}"
        )
    rows = [
        [name, "failed" if value is None else f"{value:.3f}"]
        for name, value in document["closed_forms_mean_mm"].items()
    ]
    per_sample = document["residual_mm"]["per_sample"].values()
    rows.append([document["method"], f"{sum(per_sample) / len(per_sample):.3f}"])
    print_table(console, "Mean residual, mm", ("method", "mm"), rows)
    show_judged(console, document)


# ---- ``robocal hand-eye tracker``: a profile sensor on a robot, placed by a laser tracker -------


TRACKER_WHERE = "at the working distance"  # the expected error holds


def add_tracker(parser: argparse.ArgumentParser) -> None:
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
    add_sensor(parser)
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument("--target", type=Path, metavar="YAML", help="radii and reflector's height")
    target.add_argument(
        "--radius-mm",
        type=positive,
        metavar="R",
        help="instead of a target file: of the sphere and of the reflector alike",
    )
    parser.add_argument("--method", choices=("best", "classic"), default="best")
    noise = parser.add_argument_group("noise, one sigma")
    for option, default in (
        ("tracker-sigma-mm", "0.015"), ("joint-sigma-deg", "0.0029 (5e-5 rad)"),
        ("joint-sigma-mm", "0.02"),
    ):  # fmt: skip
        noise.add_argument(f"--{option}", type=positive, metavar="S", help=f"default {default}")
    add_joint_error(parser)
    add_limit(parser, TRACKER_WHERE, 1e3 * LIMIT_M)
    add_figures(parser)


def run_tracker(args: argparse.Namespace) -> CliResult:
    robot, warnings = describe_robot(args.robot)
    if args.target is None:
        target = TrackerTarget(args.radius_mm * 1e-3, args.radius_mm * 1e-3)
    else:
        target = read_tracker_target(args.target)
    sensor = described(args)
    data, rejected = _read(args, robot.arm, sensor)
    noise = TrackerNoise()
    if args.tracker_sigma_mm is not None:
        noise = replace(noise, tracker_m=args.tracker_sigma_mm * 1e-3)
    if args.joint_sigma_deg is not None:
        noise = replace(noise, joint_rad=radians(args.joint_sigma_deg))
    if args.joint_sigma_mm is not None:
        noise = replace(noise, joint_m=args.joint_sigma_mm * 1e-3)
    limit_m, joint_rad = args.limit_mm * 1e-3, joint_error_rad(args)
    result = solve_tracker(data, target, noise, args.method, limit_m, joint_rad, sensor.towards)
    warn(warnings)
    result = replace(result, rejected={**rejected, **result.rejected})
    return CliResult(drawn_document(result, args, {}), _show_tracker)


def _read(
    args: argparse.Namespace, arm: SerialArm, sensor: SensorDescription
) -> tuple[TrackerData, dict[str, str]]:
    """All measurements, and the profiles that show next to nothing, with why."""
    arcs, sphere, faces = read_tracker_points(args.points, arm)
    table = read_pose_table(args.poses, arm)
    if table.joints is None:
        raise InputError(
            "the joints are missing: the arcs and the scan are tied by the robot's joints; add "
            "q1_deg …",
            file=str(args.poses),
            row=1,
        )
    shots = read_profiles(args.profiles, table, sensor)
    rejected = {
        name: str(shot)
        for name, shot in zip(table.names, shots, strict=True)
        if isinstance(shot, TooFewSamplesError)
    }
    seen = [index for index, name in enumerate(table.names) if name not in rejected]
    profiles = [shot for shot in shots if isinstance(shot, Profile)]
    return TrackerData(arm, arcs, sphere, faces, table.joints.q[seen], profiles), rejected


def _show_tracker(console: "Console", document: Document) -> None:
    show_placed(console, document, "Sensor", TRACKER_WHERE)
    residual = document["residual_mm"]
    console.print(
        f"Profiles from the target: rms {residual['rms']:.3f} mm, largest {residual['max']:.3f} mm"
    )
    show_judged(console, document)


FORMATS = ("urdf", "xacro", "yaml", "static-transform")
PARENTS = {"flange": "tool0", "base": "base"}
SENSOR = {
    "near": (
        190.0,
        "z of the near end of what the sensor sees, in its own coordinates; above that "
        "of the far end where z grows towards it",
    ),
    "far": (210.0, "z of the far end"),
    "width": (60.0, "of the field, half way"),
    "noise": (0.037, "of a point along the beam, one sigma"),
}


def add_export(parser: argparse.ArgumentParser) -> None:
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
    mount = read_mount(args.result, accepted=True)
    T, parent = mount.T_parent_sensor, args.parent or PARENTS[mount.parent]
    document: Document = {
        "format": args.format,
        "parent": parent,
        "child": args.child,
        "text": exported(T, parent, args.child, args.format),
        f"T_{mount.parent}_sensor": transform_document(T),
    }
    return CliResult(document, print_text)


def add_check_plan(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--target-kind", required=True, choices=KINDS, help="what the shots show")
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
            type=float if name in ("near", "far") else positive,
            metavar="L",
            help=f"{words}; default: as --sensor has it, {value:g} without",
        )
    add_description(parser)
    add_limits(parser, f"default {1e3 * ROBOT_SIGMA_M:g} mm, 0 deg")
    parser.add_argument("--propose", type=Path, metavar="CSV", help="write the proposed poses")


def run_check_plan(args: argparse.Namespace) -> CliResult:
    settings = settings_of(args)
    told = {f"{name}_mm": getattr(args, f"{name}_mm") for name in SENSOR}
    told = {name: value for name, value in told.items() if value is not None}
    if len({"near_mm", "far_mm"} & set(told)) == 1:
        raise InputError("give both --near-mm and --far-mm, or none")
    usual = {f"{name}_mm": value for name, (value, _) in SENSOR.items()}
    replaced: dict[str, Any] = dict.fromkeys(told)  # what the options tell counts before a file
    description = replace(described(args), **replaced)
    if "near_mm" in told and args.near_mm > args.far_mm and not args.sensor:
        description = replace(description, z_grows="towards")  # nothing else says it
    sensor = description.seen_range(**usual | told)
    if not 0.0 < abs(sensor.near_m - sensor.far_m) < FARTHEST_MM * 1e-3:
        raise InputError(f"--near-mm {sensor.near_m * 1e3:g} is --far-mm: the field has no depth")
    known = given_target(args.target_kind, args.target, args.radius_mm)
    table = read_pose_table(args.poses, arm_of(args), None)
    centre = None if args.center_mm is None else tuple(x * 1e-3 for x in args.center_mm)
    if centre is not None and args.target_kind != "sphere":
        raise InputError("--center-mm is a sphere's")
    target = planned_target(known, sensor, centre, table.mark)
    X = read_flange_mount(args.mount).T_parent_sensor
    report = check_plan(target, table.T_base_flange, X, settings.noise(), settings.limit_m)
    marks = None
    if table.mark is not None and isinstance(target, PlannedStairs):
        marks = list(target.lit(report.proposed @ X))  # on which the light is laid
    if args.propose is not None:
        names = [f"proposed_{i + 1:02d}" for i in range(len(report.proposed))]
        write_pose_table(args.propose, report.proposed, names=names, mark=marks)
    document = _document(report, table.names, marks)
    return CliResult(document, _show_check_plan)


def _document(
    report: PlanReport, names: tuple[str, ...], marks: list[str] | None
) -> "CheckedPlanDocument":
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
        "proposed_marks": marks,
    }


def _show_check_plan(console: "Console", document: Document) -> None:
    print_verdict(console, document)
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
        xyz, quat = spaced(pose["xyz_mm"], 1, ", "), spaced(pose["quat_xyzw"], 4)
        console.print(f"  {xyz} mm; x y z w {quat} {mark}".rstrip())
