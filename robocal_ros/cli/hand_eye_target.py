"""``robocal hand-eye sphere``, ``step`` and ``line``: a line laser from profiles of one target."""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.hand_eye_shots import (
    add_limits,
    add_shots,
    arm_of,
    given_target,
    read_shots,
    settings_of,
    task_of,
)
from robocal_ros.cli.hand_eye_view import show_mount
from robocal_ros.cli.output import Document, Outcome
from robocal_ros.storage.files import quoted

if TYPE_CHECKING:
    from robocal_ros.core.hand_eye.quality import HandEyeSettings
    from robocal_ros.core.hand_eye.result import HandEyeResult
    from robocal_ros.core.hand_eye.tasks import HandEyeData, Task
    from robocal_ros.storage.hand_eye_tables import PoseTable

METHODS = ("best", "classic")


def add_target_action(parser: argparse.ArgumentParser) -> None:
    """Offer what all targets have in common."""
    add_shots(parser)
    parser.add_argument("--method", choices=METHODS, default=METHODS[0])
    add_limits(parser, "default: from the residuals")
    parser.add_argument(
        "--check",
        type=Path,
        metavar="CSV",
        help="shots of the same target, as --poses, that judge the result and are not used to find "
        "it",
    )


def run_target(kind: str, args: argparse.Namespace, radius_mm: float | None = None) -> Outcome:
    """Place the sensor. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.core.hand_eye.result import hand_eye_document
    from robocal_ros.core.hand_eye.solve import solve_task

    arm, settings = arm_of(args), settings_of(args)
    target = given_target(kind, args.target, radius_mm)
    task = task_of(target, getattr(args, "feature", None), args.method == "classic")
    shots = read_shots(args.poses, args.profiles, arm)
    judges = None if args.check is None else read_shots(args.check, args.profiles, arm)
    if judges is not None:
        _require_unused(judges.table, shots.table)
    result = solve_task(task, shots.data, args.method, settings)
    held_out: Document | None = None
    if judges is not None:
        result, held_out = _judged(result, task, judges.data, settings)
    document = hand_eye_document(result) | {"held_out": held_out}
    return Outcome(document, partial(show_mount, document=document))


def _require_unused(judges: "PoseTable", used: "PoseTable") -> None:
    for index, file in enumerate(judges.files):
        if file in used.files:
            judges.fail(index, f"{quoted(file)} is in --poses too: other shots must judge")


def _judged(
    result: "HandEyeResult", task: "Task", judges: "HandEyeData", settings: "HandEyeSettings"
) -> "tuple[HandEyeResult, Document]":
    """Distances of other shots from the target that was found; they may refuse the result."""
    from robocal_ros.core.assessment import Verdict, summarise
    from robocal_ros.core.documents import errors_document
    from robocal_ros.core.hand_eye.quality import judge_residuals
    from robocal_ros.core.hand_eye.verification import held_out

    if result.place is None:
        raise ValueError("a result of one target has its place")
    seen = held_out(task, judges, result.T_flange_sensor, result.place)
    document: Document = errors_document(summarise(seen.distance_m))
    document |= {"rejected": list(seen.rejected), "rejected_because": dict(seen.rejected)}
    refused = judge_residuals(seen.distance_m, len(judges.names), len(seen.rejected), settings)
    if refused is not None and result.verdict.accept:
        words = f"shots that were not used to solve: {refused.reason}"
        result = replace(result, verdict=Verdict(refused.code, words))
    return result, document
