"""``robocal thermal learn-prior``: what drift to expect of a robot, from cycles it has measured."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import ROBOT_HELP, add_sigma, describe_robot, warn
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.ground.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

NAME = "learn-prior"
HELP = "learn what drift to expect of a robot from tables of its measuring cycles"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
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


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    if len(args.cold) != len(args.warm):
        raise InputError(
            f"{len(args.cold)} --cold and {len(args.warm)} --warm: give one of each for each shift"
        )
    import numpy as np

    from robocal_ros.cli.thermal_identification import cold_spots, warm_visits
    from robocal_ros.thermal.learning import learn_drift, write_prior
    from robocal_ros.thermal.sensor_calibration import read_sensor

    warnings: list[str] = []
    arm = describe_robot(args.robot, warnings).arm
    sensor = read_sensor(args.sensor, arm)
    histories = []
    for cold_file, warm_file in zip(args.cold, args.warm, strict=True):
        cold, spots = cold_spots(arm, sensor, cold_file)
        warm = warm_visits(warm_file, arm, cold)
        histories.append((spots, [warm.of_cycle(name).data for name in warm.cycles]))
    learned = learn_drift(histories, sigma_m=args.sigma_mm * 1e-3)
    spread = np.sqrt(np.diag(learned.covariance)) * arm.parameters.to_display
    document: Document = {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "parameters": list(arm.parameters.names),
        "covariance": learned.covariance.tolist(),
        "sigma": dict(zip(arm.parameters.names, spread.tolist(), strict=True)),
        "cycles": learned.cycles,
        "output": None,
        "warnings": warnings,
    }
    if args.output is not None:
        write_prior(args.output, document)
        document["output"] = str(args.output)
    warn(warnings)
    return CliResult(document, partial(_show, document=document))


def _show(console: "Console", document: Document) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title=f"Expected drift, learned from {document['cycles']} cycles",
        title_justify="left",
        box=None,
    )
    table.add_column("parameter")
    table.add_column("sigma", justify="right")
    for name, value in document["sigma"].items():
        table.add_row(name, f"{value:.4f}")
    console.print(table)
    if document["output"]:
        console.print(Text(f"Written: {document['output']}"), soft_wrap=True)
