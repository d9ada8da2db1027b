"""``robocal thermal screen``: which parameters a robot's drift needs, from a recorded shift."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import ROBOT_HELP, count, describe_robot, positive, warn
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.ground.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.kinematics import SerialArm
    from robocal_ros.thermal.learning import DriftHistory

NAME = "screen"
HELP = "find which parameters a drift needs, by what is left at check poses"

WANTED = 8
THRESHOLD_MM = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
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


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.thermal.screening import screen

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
        from robocal_ros.report.screening import draw_rounds

        draw_rounds(args.plot, document)
    warn(warnings)
    return CliResult(document, partial(_show, document=document))


def _history(args: argparse.Namespace, arm: "SerialArm") -> "DriftHistory":
    from robocal_ros.cli.thermal_identification import check_visits, cold_spots, warm_visits
    from robocal_ros.thermal.learning import DriftHistory
    from robocal_ros.thermal.sensor_calibration import read_sensor

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
    from robocal_ros.thermal.learning import share_within
    from robocal_ros.thermal.screening import best_subset

    found = best_subset(history, args.wanted)
    chosen = [history.names.index(name) for name in found.names]
    share = share_within(history.residual(chosen), args.threshold_mm * 1e-3)
    return {"names": list(found.names), "cp": found.cp, "share": share}


def _show(console: "Console", document: Document) -> None:
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
