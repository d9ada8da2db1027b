"""``robocal replay``: a bag through the sessions of the live nodes, with the same results."""

import argparse
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robocal_ros.bags.bags import BagMessage
from robocal_ros.cli.arguments import ROBOT_HELP, input_topic, warn
from robocal_ros.cli.identify import show_identification
from robocal_ros.cli.output import BAD_REQUEST, DONE, NO_ANSWER, CliResult, progress_console, tell
from robocal_ros.cli.recording import BagOverview, find_robot
from robocal_ros.cli.replaying import ReplayRequest, replay_bag
from robocal_ros.ground.errors import Code, InputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


# ---- a replay for people ------------------------------------------------------------------------


Document = dict[str, Any]

MOST_REASONS = 5
_NOTHING_ACCEPTED = (
    "Nothing was accepted: each cycle is judged against the model in force at the start."
)
_COLUMNS = (
    "number", "time (UTC)", "cycle", "samples", "in force", "candidate", "predicted", "verdict",
)  # fmt: skip


def show_replay(console: "Console", document: Document) -> None:
    """Print a replay; a single candidate in full, several as a table."""
    from rich.text import Text

    if "runs" in document or "calibrations" in document:
        _show_commands(console, document)
        return
    candidates = document["candidates"]
    if len(candidates) == 1:
        show_identification(console, candidates[0])
    elif candidates:
        console.print(_candidates(candidates))
        if not document["recorded"]:
            console.print(_NOTHING_ACCEPTED, soft_wrap=True)
    for entry in document["commands"]:
        if entry["code"] != "ACCEPT" and not (entry["command"] == "identify" and entry["samples"]):
            words = f"{entry['command']}: {entry['code']}: {entry['message']}"
            console.print(Text(words, style="red"), soft_wrap=True)
        elif entry["command"] != "identify":
            console.print(Text(f"{entry['command']}: {entry['message']}"), soft_wrap=True)
    _show_losses(console, document)
    _show_equality(console, document)


def _show_commands(console: "Console", document: Document) -> None:
    from rich.text import Text

    for entry in document["commands"]:
        style = "" if entry["code"] == "ACCEPT" else "red"
        words = f"{entry['command']}: {entry['code']}: {entry['message']}"
        console.print(Text(words, style=style), soft_wrap=True)
    final = document["final_tool"] if "runs" in document else document["final_sensor"]
    if final is None:
        console.print("Nothing is in force at the end.")
    else:
        where = ", ".join(f"{x:.3f}" for x in final["xyz_mm"])
        console.print(f"In force at the end: revision {final['revision']}, ({where}) mm")
    _show_losses(console, document)
    _show_equality(console, document)


def _candidates(candidates: list[Document]) -> "Table":
    from rich.table import Table
    from rich.text import Text

    title = "Candidates; rms errors at unseen measurements in mm"
    table = Table(title=title, title_justify="left", box=None)
    for name in _COLUMNS:
        words = name in ("time (UTC)", "cycle", "verdict")
        table.add_column(name, justify="left" if words else "right")
    for number, one in enumerate(candidates, start=1):
        verdict = one["verdict"]
        table.add_row(
            str(number),
            datetime.fromtimestamp(one["stamp"], UTC).strftime("%Y-%m-%d %H:%M:%S"),
            Text(one["cycle_id"]),
            str(one["samples"]),
            f"{one['in_force']['held_out']['rms_mm']:.3f}",
            f"{one['calibrated']['held_out']['rms_mm']:.3f}",
            f"{one['calibrated']['predicted']['total_rms_mm']:.3f}",
            Text(verdict["code"], style="green" if verdict["accept"] else "red"),
        )
    return table


def _show_losses(console: "Console", document: Document) -> None:
    from rich.text import Text

    for topic, reasons in document["ignored_reasons"].items():
        count = document["ignored"][topic]
        console.print(Text(f"Not used: {count} messages of {topic}"), soft_wrap=True)
        most = sorted(reasons.items(), key=lambda item: -item[1])[:MOST_REASONS]
        for reason, number in most:
            console.print(Text(f"  {number}: {reason}"), soft_wrap=True)
    gaps = document["gaps"]
    if gaps["count"]:
        console.print(
            f"{gaps['count']} pauses in the joint readings, the longest {gaps['longest_s']:.2f} s"
        )


def _show_equality(console: "Console", document: Document) -> None:
    from rich.text import Text

    if not document["recorded"]:
        return
    if not document["differs"]:
        console.print("Every recorded result comes out equal, bit for bit.", style="green")
    for words in document["differs"]:
        console.print(Text(f"Differs from the recording: {words}", style="red"), soft_wrap=True)


# ---- robocal replay -----------------------------------------------------------------------------


_NO_ANSWER = (Code.RANK_DEFICIENT.name, Code.TOO_FEW_SAMPLES.name)
_SHOW_EVERY = 100


def add_replay(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``replay``."""
    parser.add_argument("bag", type=Path, metavar="BAG", help=".mcap file, or folder of a bag")
    parser.add_argument(
        "--robot", metavar="R.yaml", help=f"{ROBOT_HELP}; default: the one recorded"
    )
    parser.add_argument(
        "--cold",
        type=_window,
        metavar="T0:T1",
        help="cold reference: from T0 to T1, in s from the first joint reading",
    )
    parser.add_argument(
        "--warm",
        type=_window,
        action="append",
        default=[],
        metavar="T0:T1",
        help="measuring cycle; repeat it for more. Instead of the recorded commands",
    )
    parser.add_argument(
        "--auto",
        action="store_true",
        help="find the cycles: poses that recur, the first visit is the cold reference",
    )
    parser.add_argument(
        "--topic",
        type=input_topic,
        action="append",
        default=[],
        metavar="INPUT:=TOPIC",
        help="topic of an input: joint_states, measured_point, measured_pose, beam_events, "
        "profile, image, target_pose, motor_temperatures, session_events",
    )
    parser.add_argument(
        "--state",
        type=Path,
        metavar="DIR",
        help="keep the history of the replay in this folder (default: it is not kept)",
    )


def run_replay(args: argparse.Namespace) -> CliResult:
    """Do ``replay``. Raises `RobocalError` for what a user can mend."""
    if args.auto and (args.cold or args.warm):
        raise InputError("--auto finds the cycles itself: leave out --cold and --warm")
    if args.cold and not args.warm:
        raise InputError("--cold alone identifies nothing: give a cycle with --warm T0:T1")
    warnings: list[str] = []
    request = ReplayRequest(
        bag=args.bag,
        find_robot=partial(find_robot, args.robot, warnings),
        robot_named=args.robot is not None,
        cold=args.cold,
        warm=tuple(args.warm),
        auto=args.auto,
        topics=dict(args.topic),
        state=args.state,
    )
    document = replay_bag(request, _watch)
    document["warnings"] = [*warnings, *document["warnings"]]
    warn(document["warnings"])
    return CliResult(document, partial(show_replay, document=document), _status(document))


def _status(document: dict[str, Any]) -> int:
    """0, or that of the error in the document; people read the error here."""
    if "error" not in document:
        return DONE
    error = document["error"]
    tell(error["code"], error["message"])
    return NO_ANSWER if error["code"] in _NO_ANSWER else BAD_REQUEST


def _watch(what: str, recording: "BagOverview") -> "Iterator[BagMessage]":
    """Samples of a recording, with a progress bar on a terminal."""
    if not sys.stderr.isatty():
        yield from recording.blocks()
        return
    from rich.progress import Progress

    with Progress(console=progress_console(), transient=True) as progress:
        start_ns, end_ns = recording.span_ns
        task = progress.add_task(what, total=(end_ns - start_ns) * 1e-9)
        for number, sample in enumerate(recording.blocks()):
            if number % _SHOW_EVERY == 0:
                progress.update(task, completed=(sample.log_time_ns - start_ns) * 1e-9)
            yield sample


def _window(value: str) -> tuple[float, float]:
    try:
        start, end = (float(part) for part in value.split(":"))
    except ValueError:
        start, end = 0.0, 0.0
    if not 0.0 <= start < end < float("inf"):
        raise argparse.ArgumentTypeError(
            f"'{value}' is no window T0:T1 in seconds, with 0 <= T0 < T1"
        )
    return start, end
