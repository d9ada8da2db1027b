# SPDX-License-Identifier: Apache-2.0
"""Commands of ``robocal thermal`` (all of its help), and ``robocal correct-points``."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robocal_ros.bags.bags import BagReader
from robocal_ros.cli.identify import show_identification
from robocal_ros.cli.main import (
    ROBOT_HELP,
    CliResult,
    Document,
    add_sigma,
    count,
    describe_robot,
    positive,
    print_output,
    print_table,
    print_verdict,
    print_words,
    seed,
    spaced,
    text,
)
from robocal_ros.cli.programs import add_given_model, given_model, model_history
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.ground.files import write_text
from robocal_ros.ground.frames import Array, transform_document
from robocal_ros.ground.samples import JOINTS, JointStream, joint_sample
from robocal_ros.history.history_records import REFERENCE
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import random_postures
from robocal_ros.kinematics.robots import read_fields, read_pose
from robocal_ros.kinematics.tables import read_measurements, stamp_texts, texts, write_cells
from robocal_ros.report.figures import draw_rounds
from robocal_ros.thermal.accuracy import learn_drift, read_prior, write_prior
from robocal_ros.thermal.cell_setup import (
    SensorField,
    calibrate_sensor,
    placed_spots,
    plan_cycle,
    read_sensor,
    sensor_document,
    write_sensor,
)
from robocal_ros.thermal.drift_following import ARRANGEMENTS, FIXED, FLANGE
from robocal_ros.thermal.flange_sensor import (
    flange_sensor_document,
    identify_and_judge_flange_sensor,
)
from robocal_ros.thermal.identification import (
    cycle_document,
    drift_prior,
    identify_cycle,
    identify_subset,
    judge_cycle,
)
from robocal_ros.thermal.observations import PlacedShot, PointQueue, shot_of
from robocal_ros.thermal.reference import (
    ONLY_CYCLE,
    ColdSpots,
    Visits,
    read_visits,
    require_cold_counterparts,
)
from robocal_ros.thermal.screening import DriftHistory, best_subset, screen, share_within

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.identification.documents import PlannedPoseDocument
    from robocal_ros.thermal import documents


def add_calibrate_sensor(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    parser.add_argument(
        "--data", required=True, type=Path, metavar="CSV", help="joints and measured sphere centres"
    )
    parser.add_argument(
        "--method",
        choices=("ml", "classic"),
        default="ml",
        help="ml (default): maximum likelihood on the manifold; classic: linear with a penalty",
    )
    parser.add_argument(
        "--output", type=Path, metavar="FILE", help="write the sensor file, only if it is accepted"
    )


def run_calibrate_sensor(args: argparse.Namespace) -> CliResult:
    robot, warnings = describe_robot(args.robot)
    arm = robot.arm
    data = read_measurements(args.data, arm)
    document: documents.SensorDocument = {
        **sensor_document(calibrate_sensor(arm, data, args.method), arm),
        "data": {"file": str(args.data)},
        "output": None,
        "warnings": warnings,
    }
    verdict = document["verdict"]
    if args.output is not None and verdict["accept"]:
        write_sensor(args.output, document)
        document["output"] = str(args.output)
    elif args.output is not None:
        warnings.append(f"{args.output} is not written: the verdict is {verdict['code']}")
    return CliResult(document, _show_calibrate_sensor)


def _show_calibrate_sensor(console: "Console", document: Document) -> None:
    print_verdict(console, document)
    pose, left = document["T_sensor_base"], document["left_out"]
    console.print(f"T_sensor_base: {spaced(pose['xyz_mm'], 3)} mm, quaternion x y z w "
                  f"{spaced(pose['quat_xyzw'], 6)}")  # fmt: skip
    console.print(f"Sphere in the flange frame: {spaced(document['sphere_in_flange_mm'], 3)} mm")
    if document["sigma"] is not None:
        words = ", ".join(f"{name} {value:.4f}" for name, value in document["sigma"].items())
        console.print(f"Standard deviations: {words}", soft_wrap=True)
    if left is not None:
        console.print(
            f"Each of {left['n']} poses from the others, mm: mean {left['mean_mm']:.3f}, "
            f"rms {left['rms_mm']:.3f}, largest {left['max_mm']:.3f}"
        )
    if document["rejected"]:
        print_words(console, f"Rejected: {', '.join(document['rejected'])}")
    print_output(console, document)


_FIXED_ONLY = ("sensor", "cold", "warm", "prior", "parameters")


def add_identify(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    parser.add_argument(
        "--arrangement",
        choices=ARRANGEMENTS,
        default=FIXED,
        help="where the sensor is: fixed with the sphere on the flange (default), or on the flange "
        "with spheres fixed in the cell",
    )
    parser.add_argument("--check", type=Path, metavar="CSV", help="measurements to judge on")
    fixed = parser.add_argument_group(FIXED)
    fixed.add_argument("--sensor", type=Path, metavar="S.yaml", help="from calibrate-sensor")
    fixed.add_argument("--cold", type=Path, metavar="CSV", help="visits of the cold robot")
    fixed.add_argument("--warm", type=Path, metavar="CSV", help="visits of the warm robot")
    fixed.add_argument("--prior", type=Path, metavar="P.yaml", help="from learn-prior, for map")
    fixed.add_argument(
        "--method",
        choices=("map", "subset"),
        default="map",
        help="map (default): all parameters with a prior; subset: some by least squares",
    )
    fixed.add_argument(
        "--parameters", type=text, metavar="NAMES", help="for subset: d4_mm,a1_mm,beta2_deg …"
    )
    add_sigma(fixed, ", sensor and repeatability, where the tables have no sigma_mm")
    flange = parser.add_argument_group(FLANGE)
    flange.add_argument(
        "--data",
        type=Path,
        action="append",
        metavar="CSV",
        help="a session: joints and sphere centres in the sensor; repeat for several",
    )


def run_identify(args: argparse.Namespace) -> CliResult:
    _require_sense(args)
    robot, warnings = describe_robot(args.robot)
    arm = robot.arm
    if args.arrangement == FLANGE:
        sessions = [read_measurements(path, arm) for path in args.data]
        check = None if args.check is None else read_measurements(args.check, arm)
        judged = identify_and_judge_flange_sensor(arm, sessions, check)
        read = {"sessions": [str(path) for path in args.data], "check": _name(args.check)}
        document = flange_sensor_document(judged) | {"data": read}
    else:
        document = identify_fixed_files(arm, args)
    document |= {"arrangement": args.arrangement, "warnings": warnings}
    return CliResult(document, show_identification)


def _require_sense(args: argparse.Namespace) -> None:
    """Refuse options that are missing or belong to the other arrangement."""
    if args.arrangement == FLANGE:
        wrong = [name for name in _FIXED_ONLY if getattr(args, name) is not None]
        if wrong:
            raise InputError(f"--{wrong[0]} is for --arrangement {FIXED}: leave it out")
        if not args.data:
            raise InputError(f"--arrangement {FLANGE} needs --data: a session's table")
        return
    if args.data:
        raise InputError(f"--data is for --arrangement {FLANGE}; give --sensor, --cold and --warm")
    missing = [name for name in ("sensor", "cold", "warm") if getattr(args, name) is None]
    if missing:
        raise InputError(f"--{missing[0]} is missing: {FIXED} needs --sensor, --cold and --warm")
    if (args.method == "subset") != (args.parameters is not None):
        raise InputError("--method subset and --parameters NAMES belong together")
    if args.method == "subset" and args.prior is not None:
        raise InputError("--prior is for --method map: a subset is solved without one")


def add_learn_prior(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    parser.add_argument(
        "--sensor", required=True, type=Path, metavar="S.yaml", help="from calibrate-sensor"
    )
    for name, words in (
        ("cold", "visits of the cold robot"),
        ("warm", "the cycles that followed, with a column cycle"),
    ):
        parser.add_argument(
            f"--{name}",
            required=True,
            type=Path,
            action="append",
            metavar="CSV",
            help=f"{words}; repeat both for several shifts",
        )
    add_sigma(parser)
    parser.add_argument("--output", type=Path, metavar="FILE", help="write the prior file")


def run_learn_prior(args: argparse.Namespace) -> CliResult:
    if len(args.cold) != len(args.warm):
        raise InputError(
            f"{len(args.cold)} --cold and {len(args.warm)} --warm: give one of each for each shift"
        )
    robot, warnings = describe_robot(args.robot)
    arm = robot.arm
    histories = []
    for cold_file, warm_file in zip(args.cold, args.warm, strict=True):
        cold, spots = cold_spots(arm, args.sensor, cold_file)
        warm = warm_visits(warm_file, arm, cold)
        histories.append((spots, [warm.of_cycle(name).data for name in warm.cycles]))
    covariance = learn_drift(histories, sigma_m=args.sigma_mm * 1e-3)
    spread = np.sqrt(np.diag(covariance)) * arm.parameters.to_display
    document: documents.PriorDocument = {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "parameters": list(arm.parameters.names),
        "covariance": covariance.tolist(),
        "sigma": dict(zip(arm.parameters.names, spread.tolist(), strict=True)),
        "cycles": sum(len(cycles) for _, cycles in histories),
        "output": None,
        "warnings": warnings,
    }
    if args.output is not None:
        write_prior(args.output, document)
        document["output"] = str(args.output)
    return CliResult(document, _show_learn_prior)


def _show_learn_prior(console: "Console", document: Document) -> None:
    title = f"Expected drift, learned from {document['cycles']} cycles"
    rows = [[name, f"{value:.4f}"] for name, value in document["sigma"].items()]
    print_table(console, title, ("parameter", "sigma"), rows)
    print_output(console, document)


def identify_fixed_files(arm: SerialArm, args: argparse.Namespace) -> Document:
    """Identify each cycle of the warm table; the document is the last one's."""
    chosen = tuple(name.strip() for name in (args.parameters or "").split(",") if name.strip())
    sigma_m = args.sigma_mm * 1e-3
    cold, spots = cold_spots(arm, args.sensor, args.cold)
    warm = warm_visits(args.warm, arm, cold)
    check = None
    if args.check is not None:
        check = check_visits(args.check, arm, cold, warm, only=warm.cycles[-1])
    prior = drift_prior(arm) if args.prior is None else read_prior(args.prior, arm)
    documents = []
    for name in warm.cycles:
        data = warm.of_cycle(name).data
        if chosen:
            found = identify_subset(spots, data, chosen, sigma_m=sigma_m)
        else:
            found = identify_cycle(spots, data, prior_covariance=prior, sigma_m=sigma_m)
        unseen = None
        if check is not None and name in check.cycles:
            unseen = check.of_cycle(name).data
        judged = judge_cycle(found, spots, in_force=arm, check=unseen, sigma_m=sigma_m)
        method = "subset" if chosen else "map"
        documents.append(cycle_document(found, judged, spots, arm, method) | {"cycle": name})
    return documents[-1] | {
        "cycles": documents,
        "cold_rejected": list(spots.rejected),
        "data": {
            "sensor": str(args.sensor),
            "cold": str(args.cold),
            "warm": str(args.warm),
            "check": _name(args.check),
            "prior": _name(args.prior),
        },
    }


def _name(path: Path | None) -> str | None:
    return None if path is None else str(path)


def cold_spots(arm: SerialArm, sensor: Path, path: Path) -> tuple[Visits, ColdSpots]:
    """Read a table of cold visits and average those of each pose."""
    cold = read_visits(path, arm)
    targets = cold.data.targets
    if len(targets) > 1:
        raise InputError(
            f"{len(targets)} targets ({', '.join(targets)}): the sensor file knows one sphere",
            file=str(path),
            column="target",
        )
    return cold, placed_spots(arm, sensor, cold.data)


def warm_visits(path: Path, arm: SerialArm, cold: Visits, only: str = ONLY_CYCLE) -> Visits:
    """Read a table of warm visits of poses that were visited cold."""
    warm = read_visits(path, arm, only)
    require_cold_counterparts(cold, warm, str(path))
    return warm


def check_visits(
    path: Path, arm: SerialArm, cold: Visits, warm: Visits, only: str = ONLY_CYCLE
) -> Visits:
    """Read a table of warm visits of poses that are not in the warm table, of its cycles."""
    check = warm_visits(path, arm, cold, only)
    shared = sorted(set(check.pose) & set(warm.pose))
    if shared:
        raise InputError(
            f"pose '{shared[0]}' is in the warm table too: a drift is judged at poses that were "
            "not used to solve",
            file=str(path),
            column="pose",
        )
    if not set(check.cycles) & set(warm.cycles):
        raise InputError(
            f"cycle '{check.cycles[0]}' is not in the warm table, nor is another of these: the "
            "column cycle names the same cycles in both",
            file=str(path),
            column="cycle",
        )
    return check


POSES, CANDIDATES = 6, 1000
FIELD_MM = "570,430,700,550,850"


def _field(value: str) -> tuple[float, ...]:
    """Type of five lengths in mm."""
    numbers = tuple(positive(part) for part in value.split(","))
    if len(numbers) != 5 or numbers[3] >= numbers[4]:
        raise argparse.ArgumentTypeError(
            f"'{value}' is not width,height,at,near,far in mm with near below far"
        )
    return numbers


def add_plan_poses(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    parser.add_argument(
        "--sensor", required=True, type=Path, metavar="S.yaml", help="from calibrate-sensor"
    )
    parser.add_argument(
        "--poses", type=count, default=POSES, metavar="N", help=f"how many, default {POSES}"
    )
    parser.add_argument(
        "--field-mm",
        type=_field,
        default=_field(FIELD_MM),
        metavar="W,H,AT,NEAR,FAR",
        help="where the sensor measures: width and height at a distance, nearest and farthest "
        f"distance; default {FIELD_MM}",
    )
    parser.add_argument(
        "--working",
        type=Path,
        metavar="CSV",
        help="a table whose joints are the working poses; default: all over the joint limits",
    )
    parser.add_argument(
        "--own", type=Path, metavar="CSV", help="a table of your own measuring poses, to compare"
    )
    parser.add_argument("--prior", type=Path, metavar="P.yaml", help="from learn-prior")
    add_sigma(parser)
    parser.add_argument(
        "--candidates", type=count, default=CANDIDATES, metavar="N", help=f"default {CANDIDATES}"
    )
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="of the candidates")
    parser.add_argument("--output", type=Path, metavar="CSV", help="write the poses")


def run_plan_poses(args: argparse.Namespace) -> CliResult:
    robot, warnings = describe_robot(args.robot)
    arm = robot.arm
    sensor = read_sensor(args.sensor, arm)
    own = None if args.own is None else read_measurements(args.own, arm).q
    working = random_postures(arm)
    if args.working is not None:
        working = read_measurements(args.working, arm).q
    plan = plan_cycle(
        arm,
        sensor,
        SensorField(*(1e-3 * x for x in args.field_mm)),
        prior=drift_prior(arm) if args.prior is None else read_prior(args.prior, arm),
        sigma_m=args.sigma_mm * 1e-3,
        working=working,
        count=args.poses,
        candidates=args.candidates,
        own=own,
        seed=args.seed,
    )
    unit = np.where(arm.prismatic, 1e3, np.degrees(1.0))
    names = [f"q{i}_{'mm' if slides else 'deg'}" for i, slides in enumerate(arm.prismatic, 1)]
    poses: list[PlannedPoseDocument] = [
        {"pose": f"p{i}", "joints": (q * unit).tolist()} for i, q in enumerate(plan.q, 1)
    ]
    if args.output is not None:
        rows = [[pose["pose"], *(f"{value:.4f}" for value in pose["joints"])] for pose in poses]
        lines = [",".join(row) for row in [["pose", *names], *rows]]
        write_text(args.output, "\n".join(lines) + "\n")
    document: documents.ThermalPlanDocument = {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "columns": names,
        "poses": poses,
        "predicted_mm": plan.predicted_rms_m * 1e3,
        "random_mm": plan.random_rms_m * 1e3,
        "before_mm": plan.before_rms_m * 1e3,
        "gain": 1.0 - plan.predicted_rms_m / plan.random_rms_m,
        "working_poses": len(working),
        "candidates": args.candidates,
        "own_mm": None if plan.own_rms_m is None else plan.own_rms_m * 1e3,
        "own_poses": None if own is None else len(own),
        "output": None if args.output is None else str(args.output),
        "warnings": warnings,
    }
    return CliResult(document, _show_plan_poses)


def _show_plan_poses(console: "Console", document: Document) -> None:
    console.print(
        f"Predicted error of the tool after one cycle: {document['predicted_mm']:.3f} mm rms; of "
        f"as many random poses {document['random_mm']:.3f} mm ({document['gain']:.0%} less), "
        f"without a cycle {document['before_mm']:.3f} mm.",
        soft_wrap=True,
    )
    if document["own_mm"] is not None:
        console.print(f"Of your own {document['own_poses']} poses: {document['own_mm']:.3f} mm.")
    rows = [[pose["pose"], *(f"{q:.2f}" for q in pose["joints"])] for pose in document["poses"]]
    head = ("pose", *document["columns"])
    print_table(console, "In the order of the shortest way", head, rows)
    print_output(console, document)


WANTED = 8
THRESHOLD_MM = 0.1


def add_screen(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    for name, metavar, words in (
        ("sensor", "S.yaml", "from calibrate-sensor"),
        ("cold", "CSV", "visits of the cold robot: measuring and check poses"),
        ("warm", "CSV", "cycles of the measuring poses (column cycle), 21 or more"),
        ("check", "CSV", "the same cycles at other poses: they judge"),
    ):
        parser.add_argument(f"--{name}", required=True, type=Path, metavar=metavar, help=words)
    parser.add_argument(
        "--wanted", type=count, default=WANTED, metavar="N", help=f"stop at N, default {WANTED}"
    )
    parser.add_argument(
        "--removal",
        choices=("best", "classic"),
        default="best",
        help="best (default): what leaves the highest share; classic: the first that does no harm",
    )
    parser.add_argument(
        "--stationarity",
        choices=("autocorrelation", "ljung-box"),
        default="autocorrelation",
        help="when a series is stationary: by how many of its autocorrelations lie outside of what "
        "white noise has (default), or by the Ljung-Box test, both at 5 %%",
    )
    parser.add_argument(
        "--threshold-mm",
        type=positive,
        default=THRESHOLD_MM,
        metavar="T",
        help=f"what a direction must stay within, default {THRESHOLD_MM}",
    )
    parser.add_argument(
        "--best-subset", action="store_true", help="add Mallows' C_p, the older baseline (seconds)"
    )
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw the share of every round")


def run_screen(args: argparse.Namespace) -> CliResult:
    robot, warnings = describe_robot(args.robot)
    arm = robot.arm
    if args.wanted > len(arm.parameters):
        raise InputError(f"--wanted {args.wanted}: this robot has {len(arm.parameters)} parameters")
    history = _history(args, arm)
    limit = args.threshold_mm * 1e-3
    found = screen(
        history, wanted=args.wanted, removal=args.removal, test=args.stationarity, threshold_m=limit
    )
    document: documents.ScreenDocument = {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "removal": args.removal,
        "stationarity": args.stationarity,
        "threshold_mm": args.threshold_mm,
        "cycles": len(history.displacement),
        "uncompensated": found.uncompensated,
        "rounds": found.rows(),
        "chosen": list(found.chosen.names),
        "highest": list(found.highest.names),
        "best_subset": None,
        "plot": None if args.plot is None else str(args.plot),
        "warnings": warnings,
    }
    if args.best_subset:
        best = best_subset(history, args.wanted)
        left = history.residual(history.columns(best.names))
        share = share_within(left, limit)
        document["best_subset"] = {"names": list(best.names), "cp": best.cp, "share": share}
    if args.plot is not None:
        draw_rounds(args.plot, document)
    return CliResult(document, _show_screen)


def _history(args: argparse.Namespace, arm: SerialArm) -> DriftHistory:
    cold, spots = cold_spots(arm, args.sensor, args.cold)
    warm = warm_visits(args.warm, arm, cold)
    check = check_visits(args.check, arm, cold, warm)
    shared = [name for name in warm.cycles if name in check.cycles]
    return DriftHistory.of(
        spots,
        [warm.of_cycle(name).data for name in shared],
        [check.of_cycle(name).data for name in shared],
    )


def _show_screen(console: "Console", document: Document) -> None:
    rows = []
    for row in document["rounds"]:
        share = "-" if row["share"] is None else f"{row['share']:.1%}"
        names = " ".join(row["stationary"])
        rows.append([str(row["parameters"]), share, row["removed"] or "", names])
    title = (
        f"Share of directions within {document['threshold_mm']:g} mm over "
        f"{document['cycles']} cycles; uncompensated {document['uncompensated']:.1%}"
    )
    print_table(console, title, ("left", "share", "removed", "stationary"), rows, words=(2, 3))
    for words, names in (("Chosen", document["chosen"]), ("Highest share", document["highest"])):
        print_words(console, f"{words} ({len(names)}): {', '.join(names)}")
    if (other := document["best_subset"]) is not None:
        shown = f"share {other['share']:.1%}: {', '.join(other['names'])}"
        print_words(console, f"By Mallows' C_p, {shown}")
    if document["plot"]:
        print_words(console, f"Drawn: {document['plot']}")


GAP_NS = 250_000_000  # a longer pause of the joints is counted as one
JOINT_STATE = "sensor_msgs/msg/JointState"
CLOUD = "sensor_msgs/msg/PointCloud2"
POINT = "geometry_msgs/msg/PointStamped"


def add_correct_points(parser: argparse.ArgumentParser) -> None:
    add_given_model(parser)
    parser.add_argument(
        "--mount",
        type=Path,
        metavar="FILE",
        help="T_flange_sensor of a result or description; default: of the cold reference in the "
        "history of --robot-serial",
    )
    given = parser.add_mutually_exclusive_group(required=True)
    given.add_argument(
        "--data", type=Path, metavar="CSV", help="joints, and x, y, z in the sensor's frame"
    )
    given.add_argument(
        "--bag", type=Path, metavar="BAG", help="joint states, and points or clouds with stamps"
    )
    parser.add_argument("--points", default="point", metavar="TOPIC", help="of the bag's points")
    parser.add_argument("--joints", default=JOINTS, metavar="TOPIC", help="of its joint states")
    parser.add_argument("--output", type=Path, metavar="CSV", help="write the points in base")


def run_correct_points(args: argparse.Namespace) -> CliResult:
    robot, warnings = describe_robot(args.robot)
    arm, mount = given_model(args, robot.arm, warnings), _mount(args, robot.arm)
    lost: list[str] = []
    if args.data is not None:
        data = read_measurements(args.data, robot.arm)
        names, stamps = data.sample, data.stamp_ns
        points = frames.apply(arm.fk(data.q) @ mount, data.position)
    else:
        rows = list(_of_bag(args, arm, mount, lost))
        if not rows:
            why = f": {lost[0]}" if lost else ""
            raise InputError(f"no point of {args.points} could be placed{why}", file=str(args.bag))
        names = tuple(name for name, _, _ in rows)
        stamps = np.array([stamp for _, stamp, _ in rows], dtype=np.int64)
        points = np.array([point for _, _, point in rows])
    if args.output is not None:
        columns = {"sample": list(names)}
        if stamps is not None:
            columns["stamp_s"] = stamp_texts(stamps)
        columns |= {f"{axis}_mm": texts(1e3 * points[:, i]) for i, axis in enumerate("xyz")}
        write_cells(args.output, columns)
    document: documents.CorrectedPointsDocument = {
        "robot": robot.arm.name,
        "model_hash": robot.arm.model_hash,
        "T_flange_sensor": transform_document(mount),
        "points": [
            {"sample": name, "xyz_mm": (1e3 * point).tolist()}
            for name, point in zip(names, points, strict=True)
        ],
        "not_placed": lost,
        "output": None if args.output is None else str(args.output),
        "warnings": warnings,
    }
    return CliResult(document, _show_correct_points)


def _mount(args: argparse.Namespace, nominal: SerialArm) -> Array:
    if args.mount is not None:
        return read_pose(read_fields(args.mount, "mount").below("T_flange_sensor"))
    if args.robot_serial is None:
        raise InputError("--mount is missing: where the sensor sits on the flange")
    with model_history(args, nominal) as history:
        model = history.head(REFERENCE).model or {}
        if "T_flange_sensor" not in model:
            raise InputError(
                f"no cold reference of {args.robot_serial} was captured with a sensor on the "
                "flange: give --mount",
                file=str(history.path),
            )
        return np.array(model["T_flange_sensor"])


def _of_bag(
    args: argparse.Namespace, arm: SerialArm, mount: Array, lost: list[str]
) -> Iterator[tuple[str, int, Array]]:
    """Name, stamp and place (3,) in base of each point, in the order of the recording."""
    queue = PointQueue(JointStream(arm.joint_names))

    def ready() -> Iterator[tuple[str, int, Array]]:
        for shot, placed in queue.ready(arm, mount):
            if not isinstance(placed, PlacedShot):
                lost.append(f"{shot.name}: {placed}")
                continue
            for i, point in enumerate(placed.points):
                name = shot.name if len(placed.points) == 1 else f"{shot.name}/{i}"
                yield name, shot.stamp_ns, point

    with BagReader(args.bag) as reader:
        wanted = {topic.strip("/"): topic for topic in (args.joints, args.points)}
        known = {name.strip("/"): name for name in reader.info.topics}
        if missing := [topic for topic in wanted if topic not in known]:
            raise InputError(
                f"no topic {missing[0]}; it has {', '.join(reader.info.topics)}", file=str(args.bag)
            )
        for topic, kinds in ((args.joints, (JOINT_STATE,)), (args.points, (POINT, CLOUD))):
            kind = reader.info.topics[known[topic.strip("/")]].msgtype
            if kind not in kinds:
                raise InputError(
                    f"{topic} is of type {kind}, not {' or '.join(kinds)}", file=str(args.bag)
                )
        count = 0
        for recorded in reader.messages([known[topic] for topic in wanted]):
            message, name = recorded.message, recorded.topic
            try:
                if recorded.topic == known[args.joints.strip("/")]:
                    queue.stream.add(joint_sample(message), GAP_NS)
                else:
                    count += 1
                    name = f"{args.points.strip('/')}/{count}"
                    queue.add(shot_of(message, name))
            except RobocalError as error:
                lost.append(f"{name}: {error}")
            yield from ready()
        lost.extend(f"{shot.name}: {error}" for shot, error in queue.end())


def _show_correct_points(console: "Console", document: Document) -> None:
    print_words(console, f"{len(document['points'])} points in base")
    for words in document["not_placed"]:
        print_words(console, f"Not placed: {words}")
    print_output(console, document)
