# SPDX-License-Identifier: Apache-2.0
"""``robocal history``: calibrations listed and shown, decisions taken, damage acknowledged."""

import argparse
import getpass
import os
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from robocal_ros.cli.main import (
    CliResult,
    Document,
    add_state,
    count,
    print_table,
    print_words,
    text,
)
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import quoted
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_file import acknowledge, damaged_files, known_serials, state_folder
from robocal_ros.history.history_records import (
    BEFORE_ANY,
    FRAME_SHIFT,
    HEALTHY_TOOL,
    LASER_FRAME,
    MANDREL,
    THERMAL,
    TOOL,
    fixture_kind,
    hand_eye_kind,
)

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.history.documents import (
        DecisionDocument,
        HistoryAcknowledgeDocument,
        HistoryCorrectionsDocument,
        HistoryDecisionDocument,
        HistoryFileDocument,
        HistoryListDocument,
        HistoryShowDocument,
    )


_LISTED = (
    "id", "revision", "kind", "state", "verdict", "rms mm", "data (UTC)", "cycle", "last decision",
)  # fmt: skip
_CORRECTED = (
    "since (UTC)", "correction", "model", "tool", "reference", "from", "its hash", "version",
)  # fmt: skip
_STYLES = {"in_force": "bold green", "pending": "bold yellow", "refused": "red"}


def show_list(console: "Console", document: "HistoryListDocument") -> None:
    from rich.text import Text

    _show_damage(console, document)
    rows: list[list[str | Text]] = []
    for entry in document["calibrations"]:
        rms = entry["candidate_rms_mm"]
        rows.append(
            [
                str(entry["id"]),
                str(entry["revision"] or ""),
                entry["kind"],
                Text(entry["state"], style=_STYLES.get(entry["state"], "")),
                entry["code"],
                "" if rms is None else f"{rms:.3f}",
                _time(entry["stamp_ns"]),
                entry["cycle_id"],
                _words(entry["decisions"][-1]) if entry["decisions"] else "",
            ]
        )
    print_table(console, f"Robot {document['serial']}", _LISTED, rows, words=(2, 3, 4, 6, 7, 8))
    for head in document["in_force"]:
        number = head["calibration_id"]
        name = "the nominal model" if number is None else f"calibration {number}"
        console.print(Text(f"In force: {name}, {head['kind']} revision {head['revision']}"))
    if not document["in_force"]:
        console.print("In force: the nominal model; nothing was accepted yet")


def show_entry(console: "Console", document: Document) -> None:
    from rich.table import Table
    from rich.text import Text

    _show_damage(console, document)
    entry = document["calibration"]
    table = Table(box=None, show_header=False)
    table.add_row("robot", Text(document["serial"]))
    for name, value in entry.items():
        if name == "decisions" or value is None:
            continue
        shown = _time(value) if name.endswith("_ns") else str(value)
        table.add_row(name.removesuffix("_ns").replace("_", " "), Text(shown))
    for name, kind in document["inputs"].items():
        size = " x ".join(str(n) for n in kind["shape"])
        table.add_row(f"input {name}", f"{kind['dtype']} {size}")
    for decision in entry["decisions"]:
        table.add_row("decision", Text(_words(decision)))
    console.print(table)
    console.print("The full document, the model and its figures: --json")


def show_corrections(console: "Console", document: "HistoryCorrectionsDocument") -> None:
    from rich.text import Text

    _show_damage(console, document)
    rows: list[list[str | Text]] = []
    for record in document["corrections"]:
        asked = ("shadow" if record["shadow"] else "on") if record["enabled"] else "off"
        rows.append(
            [
                _time(record["wall_ns"]),
                Text(asked, style="bold green" if asked == "on" else ""),
                str(record["model_revision"] or "none"),
                str(record["tool_revision"] or "taught"),
                record["reference"],
                record["reference_source"],
                record["reference_hash"][:8],
                record["software"],
            ]
        )
    words = (0, 1, 4, 5, 6, 7)
    print_table(console, f"Robot {document['serial']}", _CORRECTED, rows, words)
    if not document["corrections"]:
        console.print("Nothing yet: joint_correction_node adds a record when it becomes active")


def show_acknowledged(console: "Console", document: "HistoryAcknowledgeDocument") -> None:
    for path in document["acknowledged"]:
        print_words(console, f"Acknowledged by {document['by']}: {path}")
    if not document["acknowledged"]:
        console.print("There is nothing to acknowledge")


def show_decided(console: "Console", document: "HistoryDecisionDocument") -> None:
    _show_damage(console, document)
    said = document["verdict"]["reason"]
    print_words(console, said[0].upper() + said[1:])


def _show_damage(console: "Console", document: Mapping[str, Any]) -> None:
    if document["damaged"]:
        console.print(
            f"The history was damaged and is kept as {document['damaged']}; 'robocal history "
            "acknowledge' ends the warnings",
            style="bold red",
            soft_wrap=True,
        )


def _words(decision: "DecisionDocument") -> str:
    number = decision["calibration_id"]
    target = ""
    if decision["action"] == "rollback":
        target = " to nominal" if number is None else f" to {number}"
    by = f" by {decision['by']}" if decision["by"] else ""
    why = f": {decision['reason']}" if decision["reason"] else ""
    return f"{_time(decision['wall_ns'])} {decision['action']}{target}{by}{why}"


def _time(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S")


_PREVIOUS = "previous"
_NOMINAL = "nominal"
_KINDS = (THERMAL, "reference", TOOL, HEALTHY_TOOL, MANDREL, LASER_FRAME, FRAME_SHIFT)
KNOWN_KINDS = ", ".join((*_KINDS, hand_eye_kind("SENSOR"), fixture_kind("NAME")))


def _kind(value: str) -> str:
    """A kind of calibration; each sensor and each fixture has its own."""
    starts = (hand_eye_kind(""), fixture_kind(""))
    named = value.startswith(starts) and value not in starts
    if value not in _KINDS and not named:
        raise argparse.ArgumentTypeError(f"'{value}' is none of {KNOWN_KINDS}")
    return value


def _target(value: str) -> int | None:
    if value == _PREVIOUS:
        return None
    if value == _NOMINAL:
        return 0
    try:
        return count(value)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(
            f"{quoted(value)} is neither an id of the list nor {_NOMINAL!r} nor {_PREVIOUS!r}"
        ) from error


def add_history(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="action")

    def add(name: str, words: str) -> argparse.ArgumentParser:
        action = actions.add_parser(name, help=words, description=words)
        action.add_argument(
            "--robot-serial",
            type=text,
            metavar="S",
            help="robot serial; may be left out where only one robot has a history",
        )
        add_state(action)
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
    action.add_argument(
        "--to",
        type=_target,
        metavar="ID",
        help="an accepted calibration, 'nominal', or 'previous' (default): the one in force "
        "before the present one",
    )
    action.add_argument(
        "--kind",
        type=_kind,
        metavar="KIND",
        default=THERMAL,
        help=f"{KNOWN_KINDS}; default {THERMAL}",
    )


def run_history(args: argparse.Namespace) -> CliResult:
    folder = state_folder() if args.state is None else args.state.absolute()
    serial = args.robot_serial
    if serial is None:
        serials = known_serials(folder)
        if len(serials) != 1:
            raise InputError(
                f"several robots have a history: {', '.join(serials)}; choose one with "
                "--robot-serial"
                if serials
                else "no calibration history here; name its folder with --state or ROBOCAL_STATE",
                file=str(folder),
            )
        serial = serials[0]
    with CalibrationHistory.open(serial, state_dir=folder, create=False, owner=False) as history:
        done, shown = _ACTIONS[args.action]
        return CliResult(done(history, args), shown)


def _file(history: CalibrationHistory) -> "HistoryFileDocument":
    damaged = damaged_files(history.path)
    return {
        "serial": history.serial,
        "file": str(history.path),
        "damaged": str(damaged[-1]) if damaged else None,
    }


def _list(history: CalibrationHistory, args: argparse.Namespace) -> "HistoryListDocument":
    return {
        **_file(history),
        "in_force": [
            {"kind": h.kind, "revision": h.revision, "calibration_id": h.calibration_id}
            for h in history.heads()
        ],
        "calibrations": [entry.document() for entry in history.list(args.limit)],
    }


def _show_history(history: CalibrationHistory, args: argparse.Namespace) -> "HistoryShowDocument":
    entry = history.get(args.id)
    return {
        **_file(history),
        "calibration": entry.document(),
        "document": history.document(entry.id),
        "model": history.model(entry.id),
        "inputs": {
            name: {"dtype": str(array.dtype), "shape": list(array.shape)}
            for name, array in history.inputs(entry.id).items()
        },
    }


def _corrections(
    history: CalibrationHistory, args: argparse.Namespace
) -> "HistoryCorrectionsDocument":
    records = history.corrections(args.limit)
    return {**_file(history), "corrections": [record.document() for record in records]}


def _acknowledge(
    history: CalibrationHistory, args: argparse.Namespace
) -> "HistoryAcknowledgeDocument":
    by = _by(args)
    files = acknowledge(history.path, by, time.time_ns())
    return {**_file(history), "acknowledged": [str(path) for path in files], "by": by}


def _accept(history: CalibrationHistory, args: argparse.Namespace) -> "HistoryDecisionDocument":
    head = history.accept(
        args.id,
        by=_by(args),
        reason=args.reason,
        expected_head=args.expect_revision,
        wall_ns=time.time_ns(),
        with_heads=history.measured_with(args.id),
    )
    said = f"calibration {args.id} is in force as {head.kind} revision {head.revision}"
    return _decided(history, args, head.kind, args.id, head.revision, said)


def _reject(history: CalibrationHistory, args: argparse.Namespace) -> "HistoryDecisionDocument":
    history.reject(args.id, by=_by(args), reason=args.reason, wall_ns=time.time_ns())
    kind = history.get(args.id).kind
    revision = history.get(args.id).decisions[-1].head_after
    said = f"calibration {args.id} is rejected; {kind} revision {revision} stays in force"
    return _decided(history, args, kind, args.id, revision, said)


def _rollback(history: CalibrationHistory, args: argparse.Namespace) -> "HistoryDecisionDocument":
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
    return _decided(history, args, head.kind, number, head.revision, said)


# What carries an action out and gives its document, and what prints that.
_ACTIONS: Mapping[str, tuple[Callable[..., Mapping[str, Any]], Callable[..., None]]] = {
    "list": (_list, show_list),
    "acknowledge": (_acknowledge, show_acknowledged),
    "show": (_show_history, show_entry),
    "corrections": (_corrections, show_corrections),
    "accept": (_accept, show_decided),
    "reject": (_reject, show_decided),
    "rollback": (_rollback, show_decided),
}


def _decided(
    history: CalibrationHistory,
    args: argparse.Namespace,
    kind: str,
    calibration_id: int | None,
    revision: int,
    said: str,
) -> "HistoryDecisionDocument":
    return {
        **_file(history),
        "action": args.action,
        "kind": kind,
        "calibration_id": calibration_id,
        "revision": revision,
        "by": _by(args),
        "reason": args.reason,
        "verdict": {"accept": True, "code": "ACCEPT", "reason": said},
    }


def _by(args: argparse.Namespace) -> str:
    if args.by is not None:
        return str(args.by)
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as in containers
        return f"uid {os.getuid()}"
