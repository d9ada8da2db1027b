"""``robocal thermal calibrate-sensor``: where the sensor stands, and the sphere on the flange."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import ROBOT_HELP, describe_robot, warn
from robocal_ros.cli.output import CliResult, Document

if TYPE_CHECKING:
    from rich.console import Console

NAME = "calibrate-sensor"
HELP = "place a fixed sensor and the sphere on the flange from one cold visit of five poses or more"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
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


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.kinematics.tables import read_measurements
    from robocal_ros.thermal.documents import sensor_document
    from robocal_ros.thermal.sensor_calibration import calibrate_sensor, write_sensor

    warnings: list[str] = []
    arm = describe_robot(args.robot, warnings).arm
    data = read_measurements(args.data, arm)
    document = sensor_document(calibrate_sensor(arm, data, args.method), arm)
    document |= {"data": {"file": str(args.data)}, "output": None}
    verdict = document["verdict"]
    if args.output is not None and verdict["accept"]:
        write_sensor(args.output, document)
        document["output"] = str(args.output)
    elif args.output is not None:
        warnings.append(f"{args.output} is not written: the verdict is {verdict['code']}")
    document["warnings"] = warnings
    warn(warnings)
    return CliResult(document, partial(_show, document=document))


def _show(console: "Console", document: Document) -> None:
    from rich.text import Text

    verdict, left = document["verdict"], document["left_out"]
    style = "bold green" if verdict["accept"] else "bold red"
    console.print(Text(f"{verdict['code']}: {verdict['reason']}", style=style), soft_wrap=True)
    pose = document["T_sensor_base"]
    console.print(f"T_sensor_base: {_numbers(pose['xyz_mm'], 3)} mm, quaternion x y z w "
                  f"{_numbers(pose['quat_xyzw'], 6)}")  # fmt: skip
    console.print(f"Sphere in the flange frame: {_numbers(document['sphere_in_flange_mm'], 3)} mm")
    if document["sigma"] is not None:
        words = ", ".join(f"{name} {value:.4f}" for name, value in document["sigma"].items())
        console.print(f"Standard deviations: {words}", soft_wrap=True)
    if left is not None:
        console.print(
            f"Each of {document['samples']} poses from the others, mm: mean {left['mean_mm']:.3f}, "
            f"rms {left['rms_mm']:.3f}, largest {left['max_mm']:.3f}"
        )
    if document["rejected"]:
        console.print(Text(f"Rejected: {', '.join(document['rejected'])}"), soft_wrap=True)
    if document["output"]:
        console.print(Text(f"Written: {document['output']}"), soft_wrap=True)


def _numbers(values: list[float], digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)
