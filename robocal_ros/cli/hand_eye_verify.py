"""``robocal hand-eye verify``: a line laser's place against other shots, of any target."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.hand_eye_shots import (
    add_feature,
    add_limits,
    add_shots,
    add_target,
    add_target_kind,
    arm_of,
    given_shots,
    given_target,
    settings_of,
    task_of,
)
from robocal_ros.cli.hand_eye_view import show_held_out, show_pose, show_verdict
from robocal_ros.cli.output import CliResult, Document

if TYPE_CHECKING:
    from rich.console import Console

NAME = "verify"
HELP = "judge a line laser's place by shots that did not give it, of the same target or another"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
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


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.estimation.assessment import errors_document, summarise, verdict_document
    from robocal_ros.ground.frames import transform_document
    from robocal_ros.hand_eye.files import read_flange_mount
    from robocal_ros.hand_eye.result import by_shot
    from robocal_ros.hand_eye.solve import verify

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
    return CliResult(document, partial(_show, document=document))


def _show(console: "Console", document: Document) -> None:
    show_verdict(console, document)
    show_pose(console, "Sensor in the flange frame, as given", document["T_flange_sensor"])
    show_held_out(console, document["held_out"])
