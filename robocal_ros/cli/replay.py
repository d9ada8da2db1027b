"""``robocal replay``: a bag through the sessions of the live nodes, with the same results."""

import argparse
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robocal_ros.cli.arguments import ROBOT_HELP, input_topic, warn
from robocal_ros.cli.output import BAD_REQUEST, DONE, NO_ANSWER, CliResult, progress_console, tell
from robocal_ros.cli.replay_view import show_replay
from robocal_ros.ground.errors import Code, InputError

if TYPE_CHECKING:
    from robocal_ros.bags.bags import BagMessage
    from robocal_ros.cli.recording import BagOverview

NAME = "replay"
HELP = "run a recorded bag (MCAP) through the sessions of the live nodes"

_NO_ANSWER = (Code.RANK_DEFICIENT.name, Code.TOO_FEW_SAMPLES.name)
_SHOW_EVERY = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
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


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.cli.recorded_robot import find_robot
    from robocal_ros.cli.replaying import ReplayRequest, replay_bag

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
