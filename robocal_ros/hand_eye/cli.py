# SPDX-License-Identifier: Apache-2.0
"""Commands of ``robocal hand-eye`` for a line laser, and the options and files of all."""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from robocal_ros.bags.bags import DATA_SET, open_bag, read_data_set
from robocal_ros.bags.replay import topic_kind
from robocal_ros.cli.main import (
    ROBOT_HELP,
    CliResult,
    Document,
    add_joint_error,
    input_topic,
    joint_error_rad,
    positive,
    print_table,
    print_verdict,
    spaced,
    text,
)
from robocal_ros.cli.recording import BagOverview, open_recording
from robocal_ros.estimation.assessment import errors_document, summarise, verdict_document
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.ground.files import quoted
from robocal_ros.ground.frames import Array, transform_document
from robocal_ros.ground.samples import StandstillRule
from robocal_ros.hand_eye.data import (
    FEATURES,
    PROFILE,
    StandingShot,
    Standstills,
    captured_marks,
    data_set_of,
    first_of_each,
)
from robocal_ros.hand_eye.files import (
    PoseTable,
    read_flange_mount,
    read_pose_table,
    read_profiles,
    read_scanned_points,
    read_touched_points,
)
from robocal_ros.hand_eye.profiles import PRESETS, Z_GROWS, Profile, SensorDescription, sensor_of
from robocal_ros.hand_eye.result import (
    METHODS,
    HandEyeResult,
    HandEyeSettings,
    by_shot,
    hand_eye_document,
    shots_of,
)
from robocal_ros.hand_eye.session import HandEyeConfig, laser_shots
from robocal_ros.hand_eye.solve import held_out, judged, solve_joint, solve_task, verify
from robocal_ros.hand_eye.stairs import task_of
from robocal_ros.hand_eye.targets import (
    KIND_OF,
    BoardTarget,
    LaserTarget,
    SphereTarget,
    TrackerTarget,
    read_target,
)
from robocal_ros.hand_eye.tasks import HandEyeData
from robocal_ros.hand_eye.touch_test import TouchTest, compared, touch_test
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_errors import ShotJoints
from robocal_ros.kinematics.robots import load_robot, read_fields
from robocal_ros.session.events import session_kind

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.hand_eye.documents import (
        TouchedResultDocument,
        TouchTestDocument,
    )


KINDS = ("sphere", "step", "line")
POINT: Final = "point"
LIMIT_MM = 1e3 * HandEyeSettings.limit_m
MOST_NAMED = 5  # samples left out for one reason


def add_shots(parser: argparse.ArgumentParser) -> None:
    """Offer the tables of a calibration, or a bag."""
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="CSV",
        help="flange poses in base, or joints with --robot; column profile names each shot's file",
    )
    parser.add_argument(
        "--profiles",
        type=Path,
        metavar="DIR",
        help="folder of the profiles, tables of x_mm and z_mm; default: that of --poses",
    )
    parser.add_argument(
        "--bag",
        type=Path,
        help="instead of the tables: a recording of joint_states and profile, or a data file of "
        "hand_eye_node; with --robot",
    )
    parser.add_argument(
        "--topic",
        type=input_topic,
        action="append",
        default=[],
        metavar="INPUT:=TOPIC",
        help="topic of an input in the bag: joint_states, profile, session_events",
    )
    add_robot(parser, "bags and tables of joints")
    add_sensor(parser)


def add_description(parser: argparse.ArgumentParser) -> None:
    """Offer how the sensor tells its profiles."""
    parser.add_argument(
        "--sensor",
        default="",
        metavar="NAME",
        help=f"how the profiles are told: {', '.join(PRESETS)}, or a YAML file that describes it",
    )


def add_sensor(parser: argparse.ArgumentParser) -> None:
    """Offer the same, and which way z grows."""
    add_description(parser)
    parser.add_argument(
        "--z-grows",
        choices=Z_GROWS,
        default="",
        help="z of the profiles: away from the sensor, a distance, or towards it, a height; "
        "default: as --sensor has it, away without one",
    )


def described(args: argparse.Namespace) -> SensorDescription:
    """The sensor that is given. Raises as `sensor_of`."""
    return sensor_of(args.sensor, getattr(args, "z_grows", ""))


def add_robot(parser: argparse.ArgumentParser, needed: str = "tables of joints") -> None:
    """Offer the robot, ``needed`` for these."""
    parser.add_argument("--robot", metavar="NAME", help=f"{ROBOT_HELP}; for {needed}")


def add_target(parser: argparse.ArgumentParser) -> None:
    """Offer what is known of a target of any kind."""
    add_target_file(parser)
    parser.add_argument("--radius-mm", type=positive, metavar="R", help="of a sphere, true")


def add_target_file(parser: argparse.ArgumentParser, help: str = "what is known of it") -> None:
    """Offer a target file."""
    parser.add_argument("--target", type=Path, metavar="YAML", help=help)


def add_feature(parser: argparse.ArgumentParser) -> None:
    """Offer what a line is."""
    parser.add_argument(
        "--line-kind",
        choices=FEATURES,
        default=FEATURES[0],
        help="the line: nearer to the sensor than the surfaces beside it (edge, the default), or "
        "farther (groove)",
    )


def add_limits(parser: argparse.ArgumentParser, sigma_default: str) -> None:
    """Offer the robot's scatter, and what is good enough."""
    add_robot_sigma(parser, sigma_default)
    add_limit(parser, "in the field of view", LIMIT_MM)


def add_robot_sigma(parser: argparse.ArgumentParser, default: str) -> None:
    """Offer the robot's scatter."""
    for unit, of in (("mm", "position"), ("deg", "orientation")):
        parser.add_argument(
            f"--robot-sigma-{unit}",
            type=positive,
            metavar="S",
            help=f"noise of a reported pose's {of} in each axis; {default}",
        )


def add_limit(parser: argparse.ArgumentParser, where: str, default_mm: float) -> None:
    """Offer what is good enough."""
    parser.add_argument(
        "--limit-mm",
        type=positive,
        default=default_mm,
        metavar="L",
        help=f"largest expected error (rms) {where} that is accepted; default {default_mm:g}",
    )


def robot_sigma_of(args: argparse.Namespace) -> tuple[float | None, float | None]:
    """The robot's scatter, m and rad, where it is given."""
    place_mm, turn_deg = args.robot_sigma_mm, args.robot_sigma_deg
    return (
        None if place_mm is None else place_mm * 1e-3,
        None if turn_deg is None else radians(turn_deg),
    )


def settings_of(args: argparse.Namespace, joints: bool = True) -> HandEyeSettings:
    """What is known of the robot, and what is good enough; ``joints``: whether they are known.

    Raises `InputError` for an orientation's noise alone; further as `joint_error_rad`.
    """
    if args.robot_sigma_mm is None and args.robot_sigma_deg is not None:
        raise InputError("--robot-sigma-deg goes with --robot-sigma-mm: give both, or the latter")
    joint_rad = joint_error_rad(args, joints)
    sigma = robot_sigma_of(args)
    return HandEyeSettings(*sigma, limit_m=args.limit_mm * 1e-3, joint_error_rad=joint_rad)


def arm_of(args: argparse.Namespace) -> SerialArm | None:
    """The robot that is named, if any. Raises as `load_robot`."""
    return None if args.robot is None else load_robot(args.robot)


@dataclass(frozen=True, eq=False)
class ReadShots:
    """Shots, the table that holds them (None: a bag), and its profiles that are none, with why."""

    data: HandEyeData
    table: PoseTable | None = None
    rejected: Mapping[str, str] = field(default_factory=dict)


def given_shots(
    args: argparse.Namespace,
    arm: SerialArm | None,
    sensor: SensorDescription,
    judges: Path | None = None,
) -> ReadShots:
    """Read the shots that are given, or those like them in the file of ``judges``.

    Raises `RobocalError` when too little or too much is given; further as `read_shots` and
    `read_bag_shots`.
    """
    if args.bag is None:
        if args.poses is None:
            raise InputError("give the shots: --poses, or --bag")
        folder = args.profiles or args.poses.parent
        return read_shots(judges or args.poses, folder, arm, sensor)

    if args.poses is not None or args.profiles is not None:
        raise InputError("the shots are given twice: --bag, and --poses or --profiles; keep one")
    if arm is None:
        raise InputError("a bag holds joints, not poses: name its robot with --robot")
    return read_bag_shots(judges or args.bag, arm, dict(args.topic), sensor)


def read_shots(
    poses: Path, profiles: Path, arm: SerialArm | None, sensor: SensorDescription
) -> ReadShots:
    """Read a table and its profiles. Raises as `read_pose_table` and `read_profiles`."""
    table = read_pose_table(poses, arm)
    seen = read_profiles(profiles, table, sensor)
    data = HandEyeData(table.names, table.T_base_flange, seen, table.mark, table.joints)
    return ReadShots(data, table)


def require_unused(judges: PoseTable, used: PoseTable) -> None:
    """Refuse judges that helped to solve. Raises `InputError`, naming the row."""
    for index, file in enumerate(judges.files):
        if file in used.files:
            judges.fail(index, f"{quoted(file)} is in --poses too: other shots must judge")


def given_target(kind: str, target: Path | None, radius_mm: float | None) -> LaserTarget | None:
    """What is known of a target: from its file, or a sphere's radius; None for an unknown line.

    Raises `InputError` when too little or too much is given, or the file is of another kind;
    further as `read_target`.
    """
    if radius_mm is not None:
        if kind != "sphere":
            raise InputError(f"--radius-mm is a sphere's: a {kind} has none")
        if target is not None:
            raise InputError("the sphere is given twice: --radius-mm and --target; keep one")
        return SphereTarget(radius_mm * 1e-3)
    if target is not None:
        known = read_target(target)
        if isinstance(known, BoardTarget | TrackerTarget) or KIND_OF[type(known)] != kind:
            words = f"describes a {KIND_OF[type(known)]}, not a {kind}"
            raise InputError(words, file=str(target))
        return known
    if kind == "line":
        return None
    missing = {"sphere": "give the sphere: --radius-mm or --target", "step": "give --target"}
    raise InputError(missing[kind])


def read_bag_shots(
    path: Path, arm: SerialArm, topics: Mapping[str, str], sensor: SensorDescription
) -> ReadShots:
    """Shots of a bag; ``topics``: input to topic, where given."""
    with open_bag(path) as reader:
        if DATA_SET not in reader.info.topics:
            given = dict(topics)
            seen = [topic for topic in reader.info.topics if topic_kind(topic) == PROFILE]
            if len(seen) == 1:
                given.setdefault(PROFILE, seen[0])
            return _recorded(open_recording(reader, given), arm, sensor)
    data = data_set_of(read_data_set(path, arm), arm)
    if data.topic != PROFILE:
        raise InputError(f"holds shots of a {data.kind}, not profiles", file=str(path))
    if not data.samples:
        raise TooFewSamplesError(f"{path}: the data file holds no sample")
    return ReadShots(laser_shots(data.chosen([]), arm))


def _recorded(recording: BagOverview, arm: SerialArm, sensor: SensorDescription) -> ReadShots:
    path = recording.reader.info.path
    if PROFILE not in recording.inputs.values():
        raise InputError(
            f"profiles are not found among {', '.join(recording.reader.info.topics)}: choose with "
            f"--topic {PROFILE}:=TOPIC",
            file=path,
        )
    rule, configured = StandstillRule(), recording.configured
    if configured is not None and session_kind(configured) == "hand_eye":
        rule = HandEyeConfig.of_document(configured.arguments["config"]).standstill
    standstills = Standstills(arm.joint_names, rule, sensor)
    for recorded in recording.samples():
        standstills.take(recording.inputs[recorded.topic], recorded.message)
    standstills.close()
    kept, left_out = _chosen(recording, standstills.found, rule)
    rejected = dict(sorted((standstills.rejected | left_out).items()))
    if not kept:
        why = next(iter(rejected.values()), "there is none")
        raise TooFewSamplesError(f"{path}: no profile is of use, of {len(rejected)}: {why}")
    marks = tuple(one.mark for one in kept)
    data = HandEyeData(
        tuple(one.name for one in kept),
        np.array([arm.fk(one.q) for one in kept]),
        [Profile(one.shot.read(), one.name) for one in kept],
        marks if any(marks) else None,
        ShotJoints(arm, np.array([one.q for one in kept])),
    )
    return ReadShots(data, None, rejected)


def _chosen(
    recording: BagOverview, found: list[StandingShot], rule: StandstillRule
) -> tuple[list[StandingShot], dict[str, str]]:
    """What the recorded session holds; without one, a shot of each standstill."""
    marks = captured_marks(recording.commands)
    if marks is None:
        return first_of_each(found, rule.tolerance_rad)
    kept = [
        replace(one, mark=marks[one.shot.stamp_ns]) for one in found if one.shot.stamp_ns in marks
    ]
    why = "not captured, or removed, in the recorded session"
    return kept, {one.name: why for one in found if one.shot.stamp_ns not in marks}


def show_mount(console: "Console", document: Document) -> None:
    """Print where a line laser sits, how well that is known, and which samples were left out."""
    show_placed(console, document, "Sensor", "in the field of view")
    residual = document["residual_mm"]
    console.print(
        f"Samples from the target: rms {residual['rms']:.3f} mm, largest {residual['max']:.3f} mm"
    )
    if (own := document.get("linearity")) is not None:
        console.print(
            f"The sensor's own linearity, taken out: rms {own['rms_um']:.0f} um, largest "
            f"{own['max_um']:.0f}, its scale aside; profiles differ from circles by "
            f"{own['residual_um']:.0f} um, with it {own['left_out_um']:.0f}; what is not known of "
            f"it makes {own['working_error_mm']:.3f} mm rms in the field of view"
        )
    every = document.get("spread")
    if every is not None and every["n"] > len(residual["per_sample"]):
        console.print(
            f"With those left out, {every['n']} samples: rms {every['rms_mm']:.3f} mm, largest "
            f"{every['max_mm']:.3f} mm"
        )
    show_judged(console, document)


def show_placed(console: "Console", document: Document, what: str, where: str) -> None:
    """Print the decision, where a sensor sits, and how well that is known, ``where`` it looks."""
    print_verdict(console, document)
    parent = "flange" if "T_flange_sensor" in document else "base"
    show_pose(console, f"{what} in the {parent} frame", document[f"T_{parent}_sensor"])
    if document["sigma"] is not None:
        show_sigma(console, document["sigma"])
    error_mm = document["working_error_mm"]
    if error_mm is not None:
        console.print(f"Expected error {where}: {error_mm:.3f} mm rms")


def show_judged(console: "Console", document: Document) -> None:
    """Print how far samples are from a result without them, and which were left out."""
    left_out = document["leave_one_out_mm"]
    if left_out is not None:
        console.print(
            f"Each without itself: mean {left_out['mean']:.3f} mm, largest {left_out['max']:.3f} mm"
        )
    if document.get("held_out") is not None:
        show_held_out(console, document["held_out"])
    show_rejected(console, document["rejected_because"])


def show_pose(console: "Console", what: str, pose: Document) -> None:
    """Print a pose."""
    console.print(f"{what}, mm: {spaced(pose['xyz_mm'], 3, ', ')}")
    console.print(f"Orientation, quaternion x y z w: {spaced(pose['quat_xyzw'], 6)}")


def show_held_out(console: "Console", held_out: Document) -> None:
    """Print the distances of samples that were not used to solve."""
    console.print(
        f"Not used to solve, {held_out['n']} samples: mean {held_out['mean_mm']:.3f} mm, rms "
        f"{held_out['rms_mm']:.3f} mm, largest {held_out['max_mm']:.3f} mm"
    )
    show_rejected(console, held_out["rejected_because"])


def show_rejected(console: "Console", because: Document) -> None:
    """Print which samples were left out, and why: those of one reason together."""
    same: dict[str, list[str]] = {}
    for name, why in because.items():
        same.setdefault(why, []).append(name)
    for why, names in same.items():
        who = ", ".join(names[:MOST_NAMED]) + (", …" if len(names) > MOST_NAMED else "")
        count = f"{len(names)} samples, " if len(names) > 1 else ""
        console.print(f"Not used: {count}{who}: {why}", soft_wrap=True, markup=False)


def show_sigma(console: "Console", sigma: Document) -> None:
    """Print standard deviations of a pose."""
    xyz, turns = spaced(sigma["xyz_mm"], 3, ", "), spaced(sigma["rot_deg"], 4, ", ")
    console.print(f"Standard deviations: {xyz} mm; {turns} deg")


def add_target_action(kind: str, parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``sphere``, ``step`` or ``line``."""
    add_shots(parser)
    parser.add_argument("--method", choices=METHODS, default=METHODS[0])
    add_limits(parser, "default: from the residuals")
    add_joint_error(parser)
    parser.add_argument(
        "--check",
        type=Path,
        metavar="FILE",
        help="shots of the same target, as --poses or --bag, that judge the result and are not "
        "used to find it",
    )
    add_figures(parser)
    if kind == "sphere":
        add_target(parser)
    elif kind == "step":
        add_target_file(parser, "the stairs and where they were taught")
    else:
        add_target_file(parser, "where the line is; default: that is found too")
        add_feature(parser)


def run_target(kind: str, args: argparse.Namespace) -> CliResult:
    """Do ``sphere``, ``step`` or ``line``. Raises `RobocalError` for what a user can mend."""
    arm = arm_of(args)
    target = given_target(kind, args.target, getattr(args, "radius_mm", None))
    classic, sensor = args.method == "classic", described(args)
    task = task_of(target, getattr(args, "line_kind", None), classic, sensor.towards)
    shots = given_shots(args, arm, sensor)
    settings = settings_of(args, shots.data.joints is not None)
    judges = None if args.check is None else given_shots(args, arm, sensor, args.check)
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
        X, linearity = result.T_flange_sensor, result.linearity
        seen = held_out(task, judges.data, X, result.place, linearity)
        result = judged(result, seen, len(judges.data.names), judges.rejected)
    read = None if args.figures is None else task.read(shots.data, result.T_flange_sensor)
    return CliResult(drawn_document(result, args, {} if read is None else read.points), show_mount)


def add_figures(parser: argparse.ArgumentParser) -> None:
    """Offer the figure of a result."""
    parser.add_argument(
        "--figures",
        type=Path,
        metavar="DIR",
        help="write hand_eye.svg there: residuals, how well the sensor's place is known, and of "
        "profiles the points on the target",
    )


def drawn_document(
    result: HandEyeResult, args: argparse.Namespace, seen: Mapping[str, Array]
) -> Document:
    """The result's document; its figure is drawn where one is asked for.

    ``seen``: points (n, 2), m, of the sensor's plane that each sample rests on.
    """
    document = hand_eye_document(result)
    if args.figures is None:
        return document
    from robocal_ros.report.measured_figures import keep_figure, result_figure

    left = document["residual_mm"]
    covariance = document["covariance"]
    figure = result_figure(
        {name: [value] for name, value in left["per_sample"].items()},
        None if covariance is None else np.array(covariance)[:3, :3],
        place=f"the sensor's origin, axes of the {result.parent}",
        rms_mm=left["rms"],
        seen=seen,
    )
    return document | {"figures": keep_figure(args.figures, "hand_eye", figure)}


add_sphere, add_step, add_line = (partial(add_target_action, kind) for kind in KINDS)
run_sphere, run_step, run_line = (partial(run_target, kind) for kind in KINDS)


def add_joint(parser: argparse.ArgumentParser) -> None:
    for kind in KINDS:
        without = "; without target.yaml the line is found too" if kind == "line" else ""
        parser.add_argument(
            f"--{kind}",
            type=Path,
            metavar="DIR",
            help=f"folder with poses.csv, profiles/ and target.yaml of a {kind}{without}",
        )
    add_feature(parser)
    add_sensor(parser)
    add_robot(parser)
    add_limits(parser, "default: from the residuals")
    add_joint_error(parser)
    parser.add_argument(
        "--check",
        type=text,
        metavar="NAME",
        help="table in the folders, such as check.csv: other shots of the same targets, of one or "
        "more, that judge the result and are not used to find it",
    )
    add_figures(parser)


def run_joint(args: argparse.Namespace) -> CliResult:
    arm = arm_of(args)
    folders = {kind: getattr(args, kind) for kind in KINDS if getattr(args, kind) is not None}
    if len(folders) < 2:
        raise InputError("give the folders of at least two of --sphere, --step, --line")
    parts, checks, sensor = [], {}, described(args)
    for kind, folder in folders.items():
        file, profiles = folder / "target.yaml", folder / "profiles"
        known = kind != "line" or file.exists()
        target = given_target(kind, file if known else None, None)
        task = task_of(target, args.line_kind, towards=sensor.towards)
        shots = read_shots(folder / "poses.csv", profiles, arm, sensor)
        parts.append((task, shots.data))
        if args.check is not None and (folder / args.check).exists():
            judges = read_shots(folder / args.check, profiles, arm, sensor)
            if judges.table is not None and shots.table is not None:
                require_unused(judges.table, shots.table)
            checks[task.kind] = judges.data
    if args.check is not None and not checks:
        raise InputError(f"none of the folders holds the table of --check, {quoted(args.check)}")
    settings = settings_of(args, all(data.joints is not None for _, data in parts))
    result = solve_joint(parts, settings, checks)
    return CliResult(drawn_document(result, args, {}), show_mount)


def add_verify(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--result",
        required=True,
        type=Path,
        action="append",
        metavar="FILE",
        help="JSON that sphere, step, line, joint or tracker printed; of point several, to compare",
    )
    parser.add_argument(
        "--target-kind",
        required=True,
        choices=(*KINDS, POINT),
        help="what the shots show; point: marked points, where --poses holds what was seen of them",
    )
    parser.add_argument(
        "--touched", type=Path, metavar="CSV", help="of point: where they are, touched by the robot"
    )
    add_shots(parser)
    add_target(parser)
    add_feature(parser)
    add_limits(parser, "default 0.05 mm, 0.003 deg")


def run_verify(args: argparse.Namespace) -> CliResult:
    if args.target_kind == POINT:
        return _run_touch_test(args)
    if len(args.result) > 1 or args.touched is not None:
        raise InputError("--touched, and a second --result, are for --target-kind point")
    settings = settings_of(args)
    mount = read_flange_mount(args.result[0])
    T_flange_sensor = mount.T_parent_sensor
    target = given_target(args.target_kind, args.target, args.radius_mm)
    sensor = described(args)
    task = task_of(target, args.line_kind, towards=sensor.towards)
    shots = given_shots(args, arm_of(args), sensor)
    found = verify(task, shots.data, T_flange_sensor, settings, mount.linearity)
    errors = errors_document(summarise(found.distance_m))
    rejected = {**shots.rejected, **by_shot(found.rejected, found.samples)}
    document: Document = {
        "kind": args.target_kind,
        "T_flange_sensor": transform_document(T_flange_sensor),
        "target": found.target,
        "held_out": {**errors, "rejected": list(rejected), "rejected_because": rejected},
        "per_sample_mm": dict(zip(found.samples, (found.distance_m * 1e3).tolist(), strict=True)),
        "verdict": verdict_document(found.verdict),
    }
    return CliResult(document, _show_verify)


def _run_touch_test(args: argparse.Namespace) -> CliResult:
    if args.poses is None or args.bag is not None:
        raise InputError("--target-kind point needs --poses, a table of what was seen of them")
    scanned = read_scanned_points(args.poses, arm_of(args))
    touched = {} if args.touched is None else read_touched_points(args.touched)
    rows: list[TouchedResultDocument] = []
    tests: dict[str, TouchTest] = {}
    for path in args.result:
        mount = read_flange_mount(path)
        found = touch_test(mount, scanned, touched, args.limit_mm * 1e-3)
        tests[str(path)] = found
        fields = read_fields(path, "mount file").values
        used = shots_of((fields.get("residual_mm") or {}).get("per_sample") or {})
        verdict = verdict_document(found.verdict)
        named: TouchedResultDocument = {
            "result": str(path),
            "shots": len(used) or None,
            **found.document(),
            "verdict": verdict,
        }
        rows.append(named)
    verdict = verdict_document(compared(tests))
    document: TouchTestDocument = {"kind": POINT, "results": rows, "verdict": verdict}
    return CliResult(document, _show_touch_test)


def _show_touch_test(console: "Console", document: Document) -> None:
    rows = []
    for row in document["results"]:
        accuracy, three = row["accuracy_mm"], row["three_sigma_mm"]
        figures = [accuracy[name] for name in ("mean_mm", "max_mm")] if accuracy else [None, None]
        shown = ["" if x is None else f"{x:.3f}" for x in (*figures, three)]
        rows.append([row["result"], str(row["shots"] or ""), *shown, row["verdict"]["code"]])
    head = ("result", "shots", "off, mean mm", "largest", "3 sigma, mm", "verdict")
    print_table(console, "Marked points, scanned and touched", head, rows, words=(0, 5))
    print_verdict(console, document)


def _show_verify(console: "Console", document: Document) -> None:
    print_verdict(console, document)
    show_pose(console, "Sensor in the flange frame, as given", document["T_flange_sensor"])
    show_held_out(console, document["held_out"])
