"""Commands of ``robocal thermal`` about poses and parameters: plan-poses, screen."""

import argparse
import csv
import io
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cli.arguments import (
    ROBOT_HELP,
    add_sigma,
    count,
    describe_robot,
    positive,
    seed,
    warn,
)
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import write_text
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.tables import read_measurements
from robocal_ros.report.figures import draw_rounds
from robocal_ros.thermal.cli import check_visits, cold_spots, warm_visits
from robocal_ros.thermal.learning import DriftHistory, read_prior, share_within
from robocal_ros.thermal.planning import PosePlan, SensorField, plan_cycle
from robocal_ros.thermal.process import drift_prior
from robocal_ros.thermal.screening import best_subset, screen
from robocal_ros.thermal.sensor_calibration import read_sensor

if TYPE_CHECKING:
    from rich.console import Console


POSES, CANDIDATES = 6, 1000
FIELD_MM = "570,430,700,550,850"


def _field(value: str) -> tuple[float, ...]:
    """Type of five lengths in mm.

    Raises
    ------
    argparse.ArgumentTypeError
        For anything else.
    """
    numbers = tuple(positive(part) for part in value.split(","))
    if len(numbers) != 5 or numbers[3] >= numbers[4]:
        raise argparse.ArgumentTypeError(
            f"'{value}' is not width,height,at,near,far in mm with near below far"
        )
    return numbers


def add_plan_poses(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``plan-poses``."""
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
    """Do ``plan-poses``. Raises `RobocalError` for what a user can mend."""
    warnings: list[str] = []
    arm = describe_robot(args.robot, warnings).arm
    document: Document = plan_files(arm, args) | {"warnings": warnings}
    warn(warnings)
    return CliResult(document, partial(_show_plan_poses, document=document))


def _show_plan_poses(console: "Console", document: Document) -> None:
    from rich.table import Table
    from rich.text import Text

    console.print(
        f"Predicted error of the tool after one cycle: {document['predicted_mm']:.3f} mm rms; of "
        f"as many random poses {document['random_mm']:.3f} mm ({document['gain']:.0%} less), "
        f"without a cycle {document['before_mm']:.3f} mm.",
        soft_wrap=True,
    )
    if document["own_mm"] is not None:
        console.print(f"Of your own {document['own_poses']} poses: {document['own_mm']:.3f} mm.")
    table = Table(title="In the order of the shortest way", title_justify="left", box=None)
    table.add_column("pose")
    for name in document["columns"]:
        table.add_column(name, justify="right")
    for pose in document["poses"]:
        table.add_row(pose["pose"], *(f"{value:.2f}" for value in pose["joints"]))
    console.print(table)
    if document["output"]:
        console.print(Text(f"Written: {document['output']}"), soft_wrap=True)


# ---- from files to planned poses: what ``robocal thermal plan-poses`` computes ------------------


Array = NDArray[np.float64]


def plan_files(arm: SerialArm, args: argparse.Namespace) -> Document:
    """Plan, compare, and write the poses.

    Raises
    ------
    InputError, WrongRobotError
        When a file cannot be read or belongs to another robot.
    LimitError, TooFewSamplesError
        When the sphere cannot be brought into the field often enough.
    """
    sensor = read_sensor(args.sensor, arm)
    own = None if args.own is None else _joints(args.own, arm)
    found = plan_cycle(
        arm,
        sensor.T_sensor_base,
        sensor.sphere_in_flange,
        SensorField(*(1e-3 * x for x in args.field_mm)),
        prior=drift_prior(arm) if args.prior is None else read_prior(args.prior, arm),
        sigma_m=args.sigma_mm * 1e-3,
        count=args.poses,
        candidates=args.candidates,
        working=None if args.working is None else _joints(args.working, arm),
        own=own,
        seed=args.seed,
    )
    document = _document(arm, found.plan) | {
        "working_poses": found.working,
        "candidates": found.candidates,
        "own_mm": None if found.own_rms_m is None else found.own_rms_m * 1e3,
        "own_poses": None if own is None else len(own),
        "output": None,
    }
    if args.output is not None:
        _write(args.output, document)
        document["output"] = str(args.output)
    return document


def _joints(path: Path, arm: SerialArm) -> Array:
    return read_measurements(path, arm).q


def _document(arm: SerialArm, plan: PosePlan) -> Document:
    unit = np.where(arm.prismatic, 1e3, np.degrees(1.0))
    names = [f"q{i}_{'mm' if slides else 'deg'}" for i, slides in enumerate(arm.prismatic, 1)]
    return {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "columns": names,
        "poses": [
            {"pose": f"p{i}", "joints": (q * unit).tolist()} for i, q in enumerate(plan.q, start=1)
        ],
        "predicted_mm": plan.predicted_rms_m * 1e3,
        "random_mm": plan.random_rms_m * 1e3,
        "before_mm": plan.before_rms_m * 1e3,
        "gain": 1.0 - plan.predicted_rms_m / plan.random_rms_m,
    }


def _write(path: Path, document: Document) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["pose", *document["columns"]])
    for pose in document["poses"]:
        writer.writerow([pose["pose"], *(f"{value:.4f}" for value in pose["joints"])])
    write_text(path, text.getvalue())


# ---- robocal thermal screen ---------------------------------------------------------------------


WANTED = 8
THRESHOLD_MM = 0.1


def add_screen(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``screen``."""
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
    """Do ``screen``. Raises `RobocalError` for what a user can mend."""
    warnings: list[str] = []
    arm = describe_robot(args.robot, warnings).arm
    if args.wanted > len(arm.parameters):
        raise InputError(f"--wanted {args.wanted}: this robot has {len(arm.parameters)} parameters")
    history = _history(args, arm)
    found = screen(
        history,
        wanted=args.wanted,
        removal=args.removal,
        threshold_m=args.threshold_mm * 1e-3,
    )
    document: Document = {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "removal": args.removal,
        "threshold_mm": args.threshold_mm,
        "cycles": len(history.displacement),
        "uncompensated": found.uncompensated,
        "rounds": found.rows(),
        "chosen": list(found.chosen.names),
        "highest": list(found.highest.names),
        "best_subset": _best_subset(args, history),
        "plot": None if args.plot is None else str(args.plot),
        "warnings": warnings,
    }
    if args.plot is not None:
        draw_rounds(args.plot, document)
    warn(warnings)
    return CliResult(document, partial(_show_screen, document=document))


def _history(args: argparse.Namespace, arm: "SerialArm") -> "DriftHistory":
    cold, spots = cold_spots(arm, read_sensor(args.sensor, arm), args.cold)
    warm = warm_visits(args.warm, arm, cold)
    check = check_visits(args.check, arm, cold, warm)
    shared = [name for name in warm.cycles if name in check.cycles]
    if not shared:
        raise InputError(
            f"no cycle of {args.warm} is here: the column cycle names the same cycles in both",
            file=str(args.check),
            column="cycle",
        )
    return DriftHistory.of(
        spots,
        [warm.of_cycle(name).data for name in shared],
        [check.of_cycle(name).data for name in shared],
    )


def _best_subset(args: argparse.Namespace, history: "DriftHistory") -> Document | None:
    if not args.best_subset:
        return None

    found = best_subset(history, args.wanted)
    chosen = [history.names.index(name) for name in found.names]
    share = share_within(history.residual(chosen), args.threshold_mm * 1e-3)
    return {"names": list(found.names), "cp": found.cp, "share": share}


def _show_screen(console: "Console", document: Document) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title=f"Share of directions within {document['threshold_mm']:g} mm over "
        f"{document['cycles']} cycles; uncompensated {document['uncompensated']:.1%}",
        title_justify="left",
        box=None,
    )
    for name, justify in (("left", "right"), ("share", "right"), ("removed", "left")):
        table.add_column(name, justify="right" if justify == "right" else "left")
    table.add_column("stationary")
    for row in document["rounds"]:
        share = "-" if row["share"] is None else f"{row['share']:.1%}"
        names = " ".join(row["stationary"])
        table.add_row(str(row["parameters"]), share, row["removed"] or "", names)
    console.print(table)
    for words, names in (("Chosen", document["chosen"]), ("Highest share", document["highest"])):
        console.print(Text(f"{words} ({len(names)}): {', '.join(names)}"), soft_wrap=True)
    other = document["best_subset"]
    if other is not None:
        console.print(
            Text(f"By Mallows' C_p, share {other['share']:.1%}: {', '.join(other['names'])}"),
            soft_wrap=True,
        )
    if document["plot"]:
        console.print(Text(f"Drawn: {document['plot']}"), soft_wrap=True)
