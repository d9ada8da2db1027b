"""``robocal history``: what was proposed, what is in force, and decisions about it."""

import argparse
import getpass
import os
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import count, text
from robocal_ros.cli.history_options import add_history, add_rollback_target
from robocal_ros.cli.history_view import (
    show_acknowledged,
    show_corrections,
    show_decision,
    show_entry,
    show_list,
)
from robocal_ros.cli.output import CliResult, Document
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.proposals import BEFORE_ANY, Decision, Entry

if TYPE_CHECKING:
    from robocal_ros.history.calibrations import CalibrationHistory

NAME = "history"
HELP = "list the calibrations of a robot; accept, reject or roll back"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="action")

    def add(name: str, words: str) -> argparse.ArgumentParser:
        action = actions.add_parser(name, help=words, description=words)
        add_history(action)
        return action

    for name, words in (
        ("list", "the latest calibrations, newest first"),
        ("corrections", "what joint_correction_node corrected with, newest change first"),
    ):
        listing = add(name, words)
        listing.add_argument("--limit", type=count, default=50, metavar="N", help="default 50")
    knowing = add("acknowledge", "say that you know of a damaged history that was set aside")
    knowing.add_argument("--by", type=text, help="who knows, default the user's name")
    showing = add("show", "all that is kept of one calibration")
    showing.add_argument("id", type=int, help="number in the list")
    for name, words in (
        ("accept", "bring a pending calibration into force"),
        ("reject", "rule out a calibration that was never accepted"),
        ("rollback", "return to an earlier calibration, as a new revision"),
    ):
        action = add(name, words)
        if name != "rollback":
            action.add_argument("id", type=int, help="number in the list")
        action.add_argument("--by", type=text, help="who decides, default the user's name")
        action.add_argument("--reason", type=text, default="", help="why, kept with the decision")
        if name != "reject":
            action.add_argument(
                "--expect-revision",
                type=int,
                metavar="N",
                help="refuse when another revision is in force",
            )
        if name == "rollback":
            add_rollback_target(action)


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.history.calibrations import CalibrationHistory
    from robocal_ros.history.history_file import damaged_files, known_serials, state_folder

    folder = state_folder() if args.state is None else args.state.absolute()
    serial = args.robot_serial
    if serial is None:
        serial = _only(known_serials(folder), folder)
    with CalibrationHistory.open(serial, state_dir=folder, create=False, owner=False) as history:
        document, render = _ACTIONS[args.action](history, args)
    damaged = damaged_files(history.path)
    place = {
        "serial": serial,
        "file": str(history.path),
        "damaged": str(damaged[-1]) if damaged else None,
    }
    complete = place | document
    return CliResult(complete, lambda console: render(console, complete))


def _only(serials: list[str], folder: Path) -> str:
    if len(serials) == 1:
        return serials[0]
    if not serials:
        raise InputError(
            "no calibration history here; name its folder with --state or ROBOCAL_STATE",
            file=str(folder),
        )
    raise InputError(
        f"several robots have a history: {', '.join(serials)}; choose one with --robot-serial",
        file=str(folder),
    )


Answer = tuple[Document, Callable[..., None]]


def _list(history: "CalibrationHistory", args: argparse.Namespace) -> Answer:
    document = {
        "in_force": [
            {"kind": h.kind, "revision": h.revision, "calibration_id": h.calibration_id}
            for h in history.heads()
        ],
        "calibrations": [_entry(entry) for entry in history.list(args.limit)],
    }
    return document, show_list


def _show(history: "CalibrationHistory", args: argparse.Namespace) -> Answer:
    entry = history.get(args.id)
    document = {
        "calibration": _entry(entry),
        "document": history.document(entry.id),
        "model": history.model(entry.id),
        "inputs": {
            name: {"dtype": str(array.dtype), "shape": list(array.shape)}
            for name, array in history.inputs(entry.id).items()
        },
    }
    return document, show_entry


def _corrections(history: "CalibrationHistory", args: argparse.Namespace) -> Answer:
    document = {
        "corrections": [
            asdict(record) | {"taught_tool": list(record.taught_tool)}
            for record in history.corrections(args.limit)
        ]
    }
    return document, show_corrections


def _acknowledge(history: "CalibrationHistory", args: argparse.Namespace) -> Answer:
    from robocal_ros.history.history_file import acknowledge

    files = acknowledge(history.path, _by(args), time.time_ns())
    return {"acknowledged": [str(path) for path in files], "by": _by(args)}, show_acknowledged


def _accept(history: "CalibrationHistory", args: argparse.Namespace) -> Answer:
    from robocal_ros.session.decisions import measured_with

    head = history.accept(
        args.id,
        by=_by(args),
        reason=args.reason,
        expected_head=args.expect_revision,
        wall_ns=time.time_ns(),
        with_heads=measured_with(history, history.get(args.id)),
    )
    said = f"calibration {args.id} is in force as {head.kind} revision {head.revision}"
    return _decided(args, head.kind, args.id, head.revision, said), show_decision


def _reject(history: "CalibrationHistory", args: argparse.Namespace) -> Answer:
    history.reject(args.id, by=_by(args), reason=args.reason, wall_ns=time.time_ns())
    kind = history.get(args.id).kind
    revision = history.get(args.id).decisions[-1].head_after
    said = f"calibration {args.id} is rejected; {kind} revision {revision} stays in force"
    return _decided(args, kind, args.id, revision, said), show_decision


def _rollback(history: "CalibrationHistory", args: argparse.Namespace) -> Answer:
    head = history.rollback(
        args.to,
        kind=args.kind,
        by=_by(args),
        reason=args.reason,
        expected_head=args.expect_revision,
        wall_ns=time.time_ns(),
    )
    number = head.calibration_id
    start = BEFORE_ANY.get(args.kind, "nothing")
    name = start if number is None else f"calibration {number}"
    said = f"{name} is in force again, as {head.kind} revision {head.revision}"
    return _decided(args, head.kind, number, head.revision, said), show_decision


_ACTIONS: dict[str, Callable[["CalibrationHistory", argparse.Namespace], Answer]] = {
    "list": _list,
    "acknowledge": _acknowledge,
    "show": _show,
    "corrections": _corrections,
    "accept": _accept,
    "reject": _reject,
    "rollback": _rollback,
}


def _decided(
    args: argparse.Namespace, kind: str, calibration_id: int | None, revision: int, said: str
) -> Document:
    return {
        "action": args.action,
        "kind": kind,
        "calibration_id": calibration_id,
        "revision": revision,
        "by": _by(args),
        "reason": args.reason,
        "verdict": {"accept": True, "code": "ACCEPT", "reason": said},
    }


def _entry(entry: Entry) -> Document:
    document = {
        "id": entry.id,
        "revision": entry.revision,
        "kind": entry.kind,
        "state": entry.state.value,
        "code": entry.code.name,
        "reason": entry.reason,
        "candidate_rms_mm": entry.candidate_rms_mm,
        "model_hash": entry.model_hash,
        "based_on": entry.based_on,
        "cycle_id": entry.cycle_id,
        "stamp_ns": entry.stamp_ns,
        "created_ns": entry.created_ns,
        "software": entry.software,
        "method": entry.method,
    }
    return document | {"decisions": [_decision(decision) for decision in entry.decisions]}


def _decision(decision: Decision) -> Document:
    return asdict(decision) | {"action": decision.action.value}


def _by(args: argparse.Namespace) -> str:
    if args.by is not None:
        return str(args.by)
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as in containers
        return f"uid {os.getuid()}"
