# SPDX-License-Identifier: Apache-2.0
"""``robocal replay``: a bag through the sessions of the live nodes, with the same results."""

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from robocal_ros import __version__
from robocal_ros.bags.bags import BagMessage, open_bag
from robocal_ros.bags.foreign import StreamAverage, stream_timing
from robocal_ros.bags.replay import ReplayReport, feed, one_by_one, replay
from robocal_ros.cli.identify import show_identification
from robocal_ros.cli.main import (
    DONE,
    ROBOT_HELP,
    CliResult,
    Document,
    exit_status,
    input_topic,
    print_table,
    print_words,
    progress_console,
    refusal,
)
from robocal_ros.cli.recording import UNASKED, BagOverview, find_robot, open_recording
from robocal_ros.fixture.session import (
    FixtureSession,
    fixture_session_as_recorded,
    take_fixture_message,
)
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.ground.frames import transform_document
from robocal_ros.hand_eye.session import (
    HandEyeSession,
    hand_eye_session_as_recorded,
    take_hand_eye_message,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL, Action
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of, layer_of, model_document, payload_note
from robocal_ros.maintenance.session import RUN as MAINTAIN
from robocal_ros.session import events
from robocal_ros.session.events import Command, Outcome, SessionBase, session_kind
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.session import (
    ThermalSession,
    accepting,
    automatic_commands,
    session_as_recorded,
    take_message,
    window_commands,
)
from robocal_ros.tool.session import ToolSession, take_tool_message, tool_session_as_recorded

if TYPE_CHECKING:
    from rich.console import Console


def seconds(stamp_ns: int | None) -> float:
    return (stamp_ns or 0) * 1e-9


def commanded_document(
    report: ReplayReport,
    session: SessionBase,
    recording: BagOverview,
    candidates: Document | None = None,
) -> Document:
    """What a replay tells, whatever it measures; ``candidates`` stand behind the topics."""
    topic = {kind: name for name, kind in recording.inputs.items()}
    ignored = {topic.get(kind, kind): why for kind, why in session.ignored.told().items()}
    stream, damaged = session.stream, recording.reader.info.lost
    return {
        "robot": session.nominal.name,
        "model_hash": session.nominal.model_hash,
        "start_ns": recording.start_ns,
        "topics": topic,
        **({"recorded": True} if candidates is None else candidates),
        "ignored": {name: sum(why.values()) for name, why in ignored.items()},
        "ignored_reasons": ignored,
        "gaps": {
            "count": stream.gap_count,
            "longest_s": stream.longest_gap_ns * 1e-9,
            "damaged": [{"from_ns": part.from_ns, "to_ns": part.to_ns} for part in damaged],
        },
        "commands": [
            {
                "command": outcome.command.name,
                "stamp": seconds(outcome.command.stamp_ns),
                "code": outcome.status.name,
                "message": outcome.message,
                "samples": outcome.samples,
            }
            for outcome in report.outcomes
        ],
        "differs": report.differs,
        "warnings": [*recording.warnings, *report.warnings],
    }


def _of_tool(session: ToolSession, outcomes: Sequence[Outcome]) -> Document:
    """What a tool node's recording gives: each run with its answer."""
    final = transform_document(session.current.tool.T_flange_tool)
    return {
        "runs": [
            {
                "stamp": seconds(o.command.stamp_ns),
                "run": o.command.arguments.get("run", 0),
                **o.document,
            }
            for o in outcomes
            if o.document is not None
        ],
        "final_tool": final | {"revision": session.in_force.revision},
    }


def _kept(outcomes: Sequence[Outcome]) -> list[Document]:
    """Documents of what was put into the history."""
    return [
        {"stamp": seconds(o.command.stamp_ns), **o.document}
        for o in outcomes
        if o.document is not None and o.calibration_id
    ]


def _of_hand_eye(session: HandEyeSession, outcomes: Sequence[Outcome]) -> Document:
    """What a hand-eye node's recording gives: each calibration."""
    final, head = None, session.in_force
    if head.model is not None:
        frames = {name: head.model[name] for name in ("parent", "child")}
        T = np.array(head.model["T_parent_sensor"])
        final = frames | transform_document(T) | {"revision": head.revision}
    return {"calibrations": _kept(outcomes), "final_sensor": final}


def _of_fixture(session: FixtureSession, outcomes: Sequence[Outcome]) -> Document:
    """What a fixture node's recording gives: each frame."""
    final, in_force = None, session.current.fixture
    if in_force is not None:
        place = transform_document(in_force.T_base_fixture)
        final = {"name": session.fixture.name, **place, "revision": session.in_force.revision}
    return {"fixtures": _kept(outcomes), "final_fixture": final}


# Beside thermal nodes: what makes a session with the recorded settings, gives it a message of an
# input, and tells what came of it.
_OF_OTHER_NODES: Mapping[
    str, tuple[Callable[..., Any], Callable[..., None], Callable[..., Document]]
] = {
    "tool": (tool_session_as_recorded, take_tool_message, _of_tool),
    "hand_eye": (hand_eye_session_as_recorded, take_hand_eye_message, _of_hand_eye),
    "fixture": (fixture_session_as_recorded, take_fixture_message, _of_fixture),
}


def _replayed(
    recording: BagOverview, arm: SerialArm, history: CalibrationHistory, samples: "Samples"
) -> Document:
    """What one of them recorded, in a session with its settings."""
    as_recorded, take, results = _OF_OTHER_NODES[session_kind(recording.configured)]
    session = as_recorded(arm, history, recording.configured, __version__)
    report = replay(session, samples, recording.commands, recording.inputs, take)
    return commanded_document(report, session, recording) | results(session, report.outcomes)


Window = tuple[float, float]
Commands = Sequence[tuple[Command, Mapping[str, Any]]]
Samples = Iterator[BagMessage]
Watch = Callable[[str, BagOverview], Samples]


@dataclass(frozen=True)
class ReplayRequest:
    """What to replay and how.

    ``find_robot``: gives the arm for the recorded configuration (None: nothing was recorded).
    ``robot_named``: whether the user said which robot it is. ``cold``, ``warm``: windows, s from
    the first joint reading; without any the recorded commands. ``topics``: input to topic of the
    bag, where given. ``state``: folder of a history that is kept; None: one that is not.
    ``accept``: with ``auto``, accept each candidate that its verdict accepts. ``observe``: gets a
    thermal session and its samples, and hands these on.
    """

    bag: Path
    find_robot: Callable[[Command | None], SerialArm]
    cold: Window | None = None
    warm: tuple[Window, ...] = ()
    robot_named: bool = False
    auto: bool = False
    topics: Mapping[str, str] = field(default_factory=dict)
    state: Path | None = None
    accept: bool = False
    observe: Callable[[ThermalSession, BagOverview, Samples], Samples] | None = None


def replay_bag(request: ReplayRequest, watch: Watch) -> Document:
    """Replay a bag: the document, with ``error`` in it where the data gave no candidate.

    ``watch`` reads a recording's samples; it may show how far it is.

    Raises `InputError` or `WrongRobotError`: the bag cannot be read, or lacks what a replay needs.
    """
    given = bool(request.auto or request.cold or request.warm)  # in place of recorded commands
    with ExitStack() as opened:
        reader = opened.enter_context(open_bag(request.bag))
        recording = open_recording(reader, request.topics)
        if not given:
            # Refuse a recording without commands that can be obeyed.
            if not recording.commands:
                configured = recording.configured
                words = _NO_COMMANDS if configured is None else f"{recording.events}: {UNASKED}"
                words += _WINDOWS if session_kind(configured) in ("", "thermal") else ""
                words += "" if request.robot_named or configured is not None else _NO_ROBOT
                raise InputError(words, file=str(request.bag))
            if any(command.name == MAINTAIN for command, _ in recording.commands):
                raise InputError(_NOT_REPLAYED, file=str(request.bag))
            recording.require_inputs()
        arm = request.find_robot(recording.configured)
        state = request.state or Path(opened.enter_context(TemporaryDirectory(prefix="robocal-")))
        serial = request.bag.resolve().stem
        history = opened.enter_context(
            CalibrationHistory.open(serial, model_hash=arm.model_hash, state_dir=state)
        )
        kind = session_kind(recording.configured)
        if kind in _OF_OTHER_NODES:
            if given:
                raise InputError(
                    f"the bag is of a {kind.replace('_', '-')} node: --auto, --cold and --warm are "
                    "for thermal ones"
                )
            document = _replayed(recording, arm, history, watch("replaying", recording))
            document["warnings"] += payload_notes(history, arm)
            return document
        kept = _GOES_ON.format(history.path) if history.list(1) else ""
        streams = None
        if recording.configured is None:  # no node of ours, which takes each sample as it comes
            timing = stream_timing(reader, recording.inputs, arm)
            streams = StreamAverage(recording.inputs, timing) if timing else None

        def read(what: str) -> Samples:
            samples = watch(what, recording)
            return samples if streams is None else streams.of(samples)

        begin = partial(_session, recording, arm, history, streams)
        session = begin()  # the first one: an empty history gets what was in force
        commands = _commands(request, recording, begin, read)
        samples = read("replaying")
        if request.observe is not None:
            samples = request.observe(session, recording, samples)
        report = replay(session, samples, commands, recording.inputs, take_message)
        used = commands is recording.commands
        document = _document(report, session, recording) | {"recorded": used}
        if streams is not None:
            document["streams"] = {topic: asdict(one) for topic, one in streams.timing.items()}
            document["warnings"] += [one.words(topic) for topic, one in streams.timing.items()]
        document["warnings"] += payload_notes(history, arm)
        document["warnings"] += [kept] if kept else []
        return document


def payload_notes(history: CalibrationHistory, nominal: SerialArm) -> list[str]:
    """What it may cost that models which were in force were identified with other loads.

    Than the robot file says; the newest model of each load tells.
    """
    notes: dict[str, str] = {}
    for decision in reversed(history.decisions()):
        chosen = decision.calibration_id
        if decision.kind == THERMAL and decision.action is not Action.REJECT and chosen is not None:
            model = history.model(chosen)
            load = str(model.get("load"))
            if load not in notes:
                found = layer_of(model)[1]
                notes[load] = payload_note(arm_of(model, nominal), found, nominal.load)
    return [note for note in notes.values() if note]


_NO_COMMANDS = "the bag holds no commands (session_events)"
_WINDOWS = (
    ": say when the robot was measured with --warm T0:T1 "
    "(repeat it for more cycles; --cold T0:T1 for a cold reference), in seconds from the first "
    "joint reading, or let --auto find the cycles"
)
_NO_ROBOT = "; and name its robot with --robot"
_NOT_REPLAYED = (
    "these are the decisions of a maintenance_node: they cannot be replayed; 'robocal validate' "
    "lists each with its reason"
)
_GOES_ON = "{} already holds calibrations: the replay went on from there"


def _session(
    recording: BagOverview,
    arm: SerialArm,
    history: CalibrationHistory,
    streams: StreamAverage | None,
) -> ThermalSession:
    if recording.configured is None:
        config = ThermalConfig()
        if streams is not None:
            config = replace(config, standstill=streams.standstill(config.standstill))
        return ThermalSession(arm, history, config, __version__)
    return session_as_recorded(arm, history, recording.configured, __version__)


def _commands(
    request: ReplayRequest,
    recording: BagOverview,
    begin: Callable[[], ThermalSession],
    read: Callable[[str], Samples],
) -> Commands:
    """The user's windows, else what --auto finds in a session of its own, else the recorded."""
    if request.cold or request.warm:

        def stamps(window: Window) -> tuple[int, int]:
            start, end = (recording.start_ns + round(t * 1e9) for t in window)
            return start, end

        cold = None if request.cold is None else stamps(request.cold)
        return window_commands(cold, [stamps(window) for window in request.warm])
    if not request.auto:
        return recording.commands
    scout = begin()
    for sample in one_by_one(scout, read("looking for cycles")):
        feed(scout, sample, recording.inputs, take_message)
    observed = scout.desk.window(-1, scout.desk.clock_ns, scout.desk.marks)
    if not observed:
        lost = scout.desk.ignored.words()
        words = "no measurement at standstill in this recording" + (f"; {lost}" if lost else "")
        lacks = recording.lacks_measurements
        words = f"no measurement at standstill in this recording: {lacks}" if lacks else words
        raise InputError(words, file=str(request.bag))
    commands = automatic_commands(observed)
    return accepting(commands, by="replay") if request.accept else commands


def _document(report: ReplayReport, session: ThermalSession, recording: BagOverview) -> Document:
    placed = events.CALIBRATE_SENSOR  # what it found is no candidate for the model
    made = [o for o in report.outcomes if o.document is not None and o.command.name != placed]
    place = {outcome.calibration_id: index for index, outcome in enumerate(made)}
    candidates = {
        "candidates": [
            {"stamp": seconds(o.command.stamp_ns), **dict(o.document or {})} for o in made
        ],
        "accepted": [
            {
                "stamp": seconds(o.command.stamp_ns),
                "revision": o.revision,
                "candidate": place.get(o.calibration_id),
                "by": str(o.command.arguments.get("by", "")),
                "reason": str(o.command.arguments.get("reason", "")),
            }
            for o in report.outcomes
            if o.command.name == events.ACCEPT and o.done
        ],
        "final_model": model_document(session.current.arm)
        | {"revision": session.in_force.revision},
    }
    return _failure(report, made) | commanded_document(report, session, recording, candidates)


def _failure(report: ReplayReport, made: list[Outcome]) -> Document:
    """Error and verdict where a reference or every identification failed; else empty.

    A drift without its cold reference would be judged as a calibration. A recorded session that
    went on without one is followed.
    """
    asked = [o for o in report.outcomes if o.command.name == events.IDENTIFY]
    failed = [o for o in report.outcomes if o.command.name == events.CAPTURE_REFERENCE]
    failed = [o for o in failed if not o.done and o.command.arguments.get("by") == "replay"]
    if not failed and (made or not asked):
        return {}
    first = next((o for o in (*failed, *asked) if not o.done), asked[0])
    return {**refusal(first.status, first.message)}


MOST_REASONS = 5
_FINAL = ("final_tool", "final_sensor", "final_fixture")
_NOTHING_ACCEPTED = (
    "Nothing was accepted: each cycle is judged against the model in force at the start."
)
_COLUMNS = (
    "number", "time (UTC)", "cycle", "samples", "in force", "candidate", "predicted", "verdict",
)  # fmt: skip


def show_replay(console: "Console", document: Document) -> None:
    """Print a replay; a single candidate in full, several as a table."""
    thermal = "candidates" in document
    candidates = document["candidates"] if thermal else []
    if len(candidates) == 1:
        show_identification(console, candidates[0])
    elif candidates:
        _show_candidates(console, candidates)
        if not document["recorded"]:
            console.print(_NOTHING_ACCEPTED, soft_wrap=True)
    for entry in document["commands"]:
        refused, identified = entry["code"] != "ACCEPT", entry["command"] == "identify"
        if thermal and identified and (not refused or entry["samples"]):
            continue  # it is a candidate
        code = f"{entry['code']}: " if refused or not thermal else ""
        words = f"{entry['command']}: {code}{entry['message']}"
        print_words(console, words, "red" if refused else "")
    if not thermal:
        final = next(document[name] for name in _FINAL if name in document)
        if final is None:
            console.print("Nothing is in force at the end.")
        else:
            where = ", ".join(f"{x:.3f}" for x in final["xyz_mm"])
            console.print(f"In force at the end: revision {final['revision']}, ({where}) mm")
    for topic, reasons in document["ignored_reasons"].items():
        print_words(console, f"Not used: {document['ignored'][topic]} messages of {topic}")
        for reason, number in sorted(reasons.items(), key=lambda item: -item[1])[:MOST_REASONS]:
            print_words(console, f"  {number}: {reason}")
    gaps = document["gaps"]
    if gaps["count"]:
        console.print(
            f"{gaps['count']} pauses in the joint readings, the longest {gaps['longest_s']:.2f} s"
        )
    if document["recorded"]:
        if not document["differs"]:
            console.print("Every recorded result comes out equal, bit for bit.", style="green")
        for words in document["differs"]:
            print_words(console, f"Differs from the recording: {words}", "red")


def _show_candidates(console: "Console", candidates: list[Document]) -> None:
    from rich.text import Text

    rows = []
    for number, one in enumerate(candidates, start=1):
        verdict = one["verdict"]
        rows.append(
            [
                str(number),
                datetime.fromtimestamp(one["stamp"], UTC).strftime("%Y-%m-%d %H:%M:%S"),
                one["cycle_id"],
                str(one["samples"]),
                f"{one['in_force']['held_out']['rms_mm']:.3f}",
                f"{one['calibrated']['held_out']['rms_mm']:.3f}",
                f"{one['calibrated']['predicted']['total_rms_mm']:.3f}",
                Text(verdict["code"], style="green" if verdict["accept"] else "red"),
            ]
        )
    title = "Candidates; rms errors at unseen measurements in mm"
    print_table(console, title, _COLUMNS, rows, words=(1, 2, 7))


_SHOW_EVERY = 100


def add_replay(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "bag", type=Path, metavar="BAG", help=".mcap, .db3 or .bag (ROS 1) file, or folder of a bag"
    )
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
    status = exit_status(Code[document["error"]["code"]]) if "error" in document else DONE
    return CliResult(document, show_replay, status)


def _watch(what: str, recording: "BagOverview") -> "Iterator[BagMessage]":
    """Samples of a recording, with a progress bar on a terminal."""
    if not sys.stderr.isatty():
        yield from recording.blocks()
        return
    from rich.progress import Progress

    with Progress(console=progress_console(), transient=True) as progress:
        start_ns = recording.reader.info.start_ns or 0
        task = progress.add_task(
            what, total=seconds(recording.reader.info.end_ns) - seconds(start_ns)
        )
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
