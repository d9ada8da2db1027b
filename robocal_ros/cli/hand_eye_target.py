"""``robocal hand-eye sphere``, ``step`` and ``line``: a line laser from profiles of one target."""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.hand_eye_shots import (
    Shots,
    add_limits,
    add_shots,
    arm_of,
    given_shots,
    given_target,
    settings_of,
    task_of,
)
from robocal_ros.cli.hand_eye_view import show_mount
from robocal_ros.cli.output import Document, Outcome
from robocal_ros.core.errors import InputError
from robocal_ros.storage.files import quoted

if TYPE_CHECKING:
    from robocal_ros.core.hand_eye.quality import HandEyeSettings
    from robocal_ros.core.hand_eye.result import HandEyeResult
    from robocal_ros.core.hand_eye.tasks import Task

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


def run_target(kind: str, args: argparse.Namespace, radius_mm: float | None = None) -> Outcome:
    """Place the sensor. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.core.hand_eye.result import hand_eye_document
    from robocal_ros.core.hand_eye.solve import solve_task

    arm, settings = arm_of(args), settings_of(args)
    target = given_target(kind, args.target, radius_mm)
    task = task_of(target, getattr(args, "line_kind", None), args.method == "classic")
    shots = given_shots(args, arm)
    judges = None if args.check is None else given_shots(args, arm, args.check)
    if judges is not None:
        _require_unused(args, judges, shots)
    result = solve_task(task, shots.data, args.method, settings)
    result = replace(result, rejected={**shots.rejected, **result.rejected})
    held_out: Document | None = None
    if judges is not None:
        result, held_out = _judged(result, task, judges, settings)
    document = hand_eye_document(result) | {"held_out": held_out}
    return Outcome(document, partial(show_mount, document=document))


def _require_unused(args: argparse.Namespace, judges: Shots, used: Shots) -> None:
    if judges.table is None or used.table is None:
        if args.check.resolve() == args.bag.resolve():
            raise InputError("--check is --bag: other shots must judge", file=str(args.check))
        return
    for index, file in enumerate(judges.table.files):
        if file in used.table.files:
            judges.table.fail(index, f"{quoted(file)} is in --poses too: other shots must judge")


def _judged(
    result: "HandEyeResult", task: "Task", judges: Shots, settings: "HandEyeSettings"
) -> "tuple[HandEyeResult, Document]":
    """Distances of other shots from the target that was found; they may refuse the result."""
    from robocal_ros.core.assessment import Verdict, summarise
    from robocal_ros.core.documents import errors_document
    from robocal_ros.core.hand_eye.quality import judge_residuals
    from robocal_ros.core.hand_eye.verification import held_out

    if result.place is None:
        raise ValueError("a result of one target has its place")
    seen = held_out(task, judges.data, result.T_flange_sensor, result.place)
    document: Document = errors_document(summarise(seen.distance_m))
    rejected = {**judges.rejected, **seen.rejected}
    document |= {"rejected": list(rejected), "rejected_because": rejected}
    count = len(judges.data.names)
    refused = judge_residuals(seen.distance_m, count, len(seen.rejected), settings)
    if refused is not None and result.verdict.accept:
        words = f"shots that were not used to solve: {refused.reason}"
        result = replace(result, verdict=Verdict(refused.code, words))
    return result, document
