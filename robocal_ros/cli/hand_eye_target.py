"""``robocal hand-eye sphere``, ``step`` and ``line``: a line laser from profiles of one target."""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

from robocal_ros.cli.hand_eye_shots import (
    ReadShots,
    add_limits,
    add_shots,
    arm_of,
    given_shots,
    given_target,
    require_unused,
    settings_of,
    task_of,
)
from robocal_ros.cli.hand_eye_view import show_mount
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.ground.errors import InputError

METHODS = ("best", "classic")


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
    from robocal_ros.hand_eye.result import hand_eye_document
    from robocal_ros.hand_eye.solve import held_out, judged, solve_task

    arm, settings = arm_of(args), settings_of(args)
    target = given_target(kind, args.target, radius_mm)
    task = task_of(target, getattr(args, "line_kind", None), args.method == "classic")
    shots = given_shots(args, arm)
    judges = None if args.check is None else given_shots(args, arm, args.check)
    if judges is not None:
        _require_unused(args, judges, shots)
    result = solve_task(task, shots.data, args.method, settings)
    result = replace(result, rejected={**shots.rejected, **result.rejected})
    if judges is not None:
        if result.place is None:
            raise ValueError("a result of one target has its place")
        seen = held_out(task, judges.data, result.T_flange_sensor, result.place)
        result = judged(result, seen, len(judges.data.names), settings, judges.rejected)
    document: Document = hand_eye_document(result)
    return CliResult(document, partial(show_mount, document=document))


def _require_unused(args: argparse.Namespace, judges: ReadShots, used: ReadShots) -> None:
    if judges.table is not None and used.table is not None:
        require_unused(judges.table, used.table)
    elif args.check.resolve() == args.bag.resolve():
        raise InputError("--check is --bag: other shots must judge", file=str(args.check))
