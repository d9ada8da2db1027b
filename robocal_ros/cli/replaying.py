"""From a bag to its calibrations: what ``robocal replay`` computes, without its printing."""

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from robocal_ros import __version__
from robocal_ros.bags.bags import BagMessage, BagReader
from robocal_ros.bags.replay import ReplayReport, feed, one_by_one, replay
from robocal_ros.cli.output import Document, refusal
from robocal_ros.cli.recording import UNASKED, BagOverview, open_recording
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import transform_document
from robocal_ros.ground.proposals import Head
from robocal_ros.ground.streams import JointStream
from robocal_ros.hand_eye.session import (
    hand_eye_session_as_recorded,
    is_hand_eye_session,
    take_hand_eye_message,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import model_document
from robocal_ros.maintenance.session import RUN as MAINTAIN
from robocal_ros.session import events
from robocal_ros.session.base import SessionBase
from robocal_ros.session.events import Command, Outcome
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.session import (
    ThermalSession,
    accepting,
    automatic_commands,
    is_thermal_session,
    session_as_recorded,
    take_message,
    window_commands,
)
from robocal_ros.tool.session import (
    ToolSession,
    is_tool_session,
    take_tool_message,
    tool_session_as_recorded,
)

# ---- what replays of all kinds tell: commands, pauses, damaged parts of the bag -----------------


S = TypeVar("S", bound=SessionBase)
AsRecorded = Callable[[SerialArm, CalibrationHistory, Command, str], S]


def seconds(stamp_ns: int | None) -> float:
    """A stamp in s."""
    return (stamp_ns or 0) * 1e-9


def gaps_document(stream: JointStream, recording: BagOverview) -> Document:
    """Pauses of the joint readings, and damaged parts of the bag."""
    damaged = recording.reader.info.lost
    return {
        "count": stream.gap_count,
        "longest_s": stream.longest_gap_ns * 1e-9,
        "damaged": [{"from_ns": part.from_ns, "to_ns": part.to_ns} for part in damaged],
    }


def command_document(outcome: Outcome) -> Document:
    """A command and what came of it."""
    return {
        "command": outcome.command.name,
        "stamp": seconds(outcome.command.stamp_ns),
        "code": outcome.status.name,
        "message": outcome.message,
        "samples": outcome.samples,
    }


def commanded_document(
    report: ReplayReport, session: SessionBase, recording: BagOverview
) -> Document:
    """What the replay of a recorded session tells, whatever it measures."""
    topic = {kind: name for name, kind in recording.inputs.items()}
    ignored = {topic.get(kind, kind): dict(why) for kind, why in session.ignored.items()}
    return {
        "robot": session.nominal.name,
        "model_hash": session.nominal.model_hash,
        "start_ns": recording.start_ns,
        "topics": topic,
        "recorded": True,
        "ignored": {name: sum(why.values()) for name, why in ignored.items()},
        "ignored_reasons": ignored,
        "gaps": gaps_document(session.stream, recording),
        "commands": [command_document(outcome) for outcome in report.outcomes],
        "differs": report.differs,
        "warnings": recording.warnings,
    }


def replay_commanded(
    recording: BagOverview,
    arm: SerialArm,
    history: CalibrationHistory,
    samples: Iterable[Any],
    as_recorded: AsRecorded[S],
    take: Callable[[S, str, Any], None],
) -> tuple[ReplayReport, S]:
    """Replay what a node recorded, in a session with its settings.

    ``as_recorded`` makes the session; ``take`` gives it a message of an input.

    Raises
    ------
    InputError, WrongRobotError
        The bag lacks what a replay needs.
    """
    if recording.configured is None:
        raise InputError("the bag holds no configuration of the node")
    session = as_recorded(arm, history, recording.configured, __version__)
    return replay(session, samples, recording.commands, recording.inputs, take), session


# ---- from the bag of a tool node to its tools: what ``robocal replay`` computes of it -----------


def replay_tool(
    recording: BagOverview, arm: SerialArm, history: CalibrationHistory, samples: Iterable[Any]
) -> Document:
    """Replay what a tool node recorded: each run with its answer.

    Raises
    ------
    InputError, WrongRobotError
        The bag lacks what a replay needs.
    """
    report, session = replay_commanded(
        recording, arm, history, samples, tool_session_as_recorded, take_tool_message
    )
    return _tool_document(report, session, recording)


def _tool_document(report: ReplayReport, session: ToolSession, recording: BagOverview) -> Document:
    return commanded_document(report, session, recording) | {
        "runs": [_run(o) for o in report.outcomes if o.document is not None],
        "final_tool": transform_document(session.current.tool.T_flange_tool)
        | {"revision": session.in_force.revision},
    }


def _run(outcome: Outcome) -> Document:
    number = outcome.command.arguments.get("run", 0)
    return {"stamp": seconds(outcome.command.stamp_ns), "run": number, **(outcome.document or {})}


# ---- a hand-eye session -------------------------------------------------------------------------


def replay_hand_eye(
    recording: BagOverview, arm: SerialArm, history: CalibrationHistory, samples: Iterable[Any]
) -> Document:
    """Replay what a hand-eye node recorded: each calibration with its figures.

    Raises
    ------
    InputError, WrongRobotError
        The bag lacks what a replay needs.
    """
    report, session = replay_commanded(
        recording, arm, history, samples, hand_eye_session_as_recorded, take_hand_eye_message
    )
    return commanded_document(report, session, recording) | {
        "calibrations": [
            {"stamp": seconds(o.command.stamp_ns), **(o.document or {})}
            for o in report.outcomes
            if o.document is not None and o.calibration_id
        ],
        "final_sensor": _sensor(session.in_force),
    }


def _sensor(head: Head) -> Document | None:
    """What is in force at the end; None: nothing is."""
    if head.model is None:
        return None
    frames = {name: head.model[name] for name in ("parent", "child")}
    T = np.array(head.model["T_parent_sensor"])
    return frames | transform_document(T) | {"revision": head.revision}


# ---- a thermal session --------------------------------------------------------------------------


Window = tuple[float, float]
Commands = Sequence[tuple[Command, Mapping[str, Any]]]
Samples = Iterator[BagMessage]
Watch = Callable[[str, BagOverview], Samples]


_OF_OTHER_NODES = (
    (is_tool_session, replay_tool, "tool"),
    (is_hand_eye_session, replay_hand_eye, "hand-eye"),
)


@dataclass(frozen=True)
class ReplayRequest:
    """What to replay and how.

    Attributes
    ----------
    find_robot : gives the arm for the recorded configuration (None: nothing was recorded).
    robot_named : whether the user said which robot it is.
    cold, warm : windows, s from the first joint reading; without any the recorded commands.
    topics : input to topic of the bag, where given.
    state : folder of a history that is kept; None: one that is not.
    accept : with ``auto``, accept each candidate that its verdict accepts.
    beside : gets a thermal session and its samples, and hands these on.
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
    beside: Callable[[ThermalSession, BagOverview, Samples], Samples] | None = None


def replay_bag(request: ReplayRequest, watch: Watch) -> Document:
    """Replay a bag: the document, with ``error`` in it where the data gave no candidate.

    ``watch`` reads a recording's samples; it may show how far it is.

    Raises
    ------
    InputError, WrongRobotError
        The bag cannot be read, or lacks what a replay needs.
    """
    with BagReader(request.bag) as reader:
        recording = open_recording(reader, request.topics)
        if not _given(request):
            _require_commands(request, recording)
        arm = request.find_robot(recording.configured)
        with _history(request, arm) as history:
            for is_of, replayed, node in _OF_OTHER_NODES:
                if not is_of(recording.configured):
                    continue
                if _given(request):
                    raise InputError(
                        f"the bag is of a {node} node: --auto, --cold and --warm are for thermal "
                        "ones"
                    )
                return replayed(recording, arm, history, watch("replaying", recording))
            kept = _GOES_ON.format(history.path) if history.list(1) else ""
            session = _session(recording, arm, history)
            commands = _commands(request, recording, arm, history, watch)
            samples = watch("replaying", recording)
            if request.beside is not None:
                samples = request.beside(session, recording, samples)
            report = replay(session, samples, commands, recording.inputs, take_message)
            used = commands is recording.commands
            document = _document(report, session, recording) | {"recorded": used}
            document["warnings"] += [kept] if kept else []
            return document


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


def _require_commands(request: ReplayRequest, recording: BagOverview) -> None:
    """Refuse a recording without commands that can be obeyed."""
    if not recording.commands:
        configured = recording.configured
        words = _NO_COMMANDS if configured is None else f"{recording.events}: {UNASKED}"
        words += _WINDOWS if configured is None or is_thermal_session(configured) else ""
        words += "" if request.robot_named or configured is not None else _NO_ROBOT
        raise InputError(words, file=str(request.bag))
    if any(command.name == MAINTAIN for command, _ in recording.commands):
        raise InputError(_NOT_REPLAYED, file=str(request.bag))
    recording.require_inputs()


def _given(request: ReplayRequest) -> bool:
    """Whether the user says what to carry out, in place of the recorded commands."""
    return bool(request.auto or request.cold or request.warm)


@contextmanager
def _history(request: ReplayRequest, arm: SerialArm) -> Iterator[CalibrationHistory]:
    serial = request.bag.resolve().stem
    with tempfile.TemporaryDirectory(prefix="robocal-") as folder:
        state_dir = request.state or Path(folder)
        with CalibrationHistory.open(
            serial, model_hash=arm.model_hash, state_dir=state_dir
        ) as history:
            yield history


def _session(recording: BagOverview, arm: SerialArm, history: CalibrationHistory) -> ThermalSession:
    if recording.configured is None:
        return ThermalSession(arm, history, ThermalConfig(), __version__)
    return session_as_recorded(arm, history, recording.configured, __version__)


def _commands(
    request: ReplayRequest,
    recording: BagOverview,
    arm: SerialArm,
    history: CalibrationHistory,
    watch: Watch,
) -> Commands:
    """The user's windows, else what --auto finds, else what was recorded."""
    if request.cold or request.warm:
        cold = None if request.cold is None else _stamps(request.cold, recording)
        return window_commands(cold, [_stamps(window, recording) for window in request.warm])
    if not request.auto:
        return recording.commands
    scout = _session(recording, arm, history)
    for sample in one_by_one(scout, watch("looking for cycles", recording)):
        feed(scout, sample, recording.inputs, take_message)
    observed = scout.desk.window(-1, scout.desk.clock_ns, scout.desk.marks)
    if not observed:
        lost = scout.desk.ignored.words()
        words = "no measurement at standstill in this recording" + (f"; {lost}" if lost else "")
        raise InputError(words, file=str(request.bag))
    commands = automatic_commands(observed)
    return accepting(commands, by="replay") if request.accept else commands


def _stamps(window: Window, recording: BagOverview) -> tuple[int, int]:
    start, end = (recording.start_ns + round(t * 1e9) for t in window)
    return start, end


def _document(report: ReplayReport, session: ThermalSession, recording: BagOverview) -> Document:
    placed = events.CALIBRATE_SENSOR  # what it found is no candidate for the model
    made = [o for o in report.outcomes if o.document is not None and o.command.name != placed]
    place = {outcome.calibration_id: index for index, outcome in enumerate(made)}
    head = session.in_force
    topic = {kind: name for name, kind in recording.inputs.items()}
    ignored = {topic.get(kind, kind): dict(why) for kind, why in session.desk.ignored.items()}
    return _failure(report, made) | {
        "robot": session.nominal.name,
        "model_hash": session.nominal.model_hash,
        "start_ns": recording.start_ns,
        "topics": topic,
        "candidates": [_candidate(outcome) for outcome in made],
        "accepted": [
            _accepted(outcome, place)
            for outcome in report.outcomes
            if outcome.command.name == events.ACCEPT and outcome.done
        ],
        "final_model": model_document(session.arm) | {"revision": head.revision},
        "ignored": {name: sum(why.values()) for name, why in ignored.items()},
        "ignored_reasons": ignored,
        "gaps": gaps_document(session.desk.stream, recording),
        "commands": [command_document(outcome) for outcome in report.outcomes],
        "differs": report.differs,
        "warnings": recording.warnings,
    }


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
    return refusal(first.status, first.message)


def _candidate(outcome: Outcome) -> Document:
    return {"stamp": seconds(outcome.command.stamp_ns), **dict(outcome.document or {})}


def _accepted(outcome: Outcome, place: Mapping[int, int]) -> Document:
    arguments = outcome.command.arguments
    return {
        "stamp": seconds(outcome.command.stamp_ns),
        "revision": outcome.revision,
        "candidate": place.get(outcome.calibration_id),
        "by": str(arguments.get("by", "")),
        "reason": str(arguments.get("reason", "")),
    }
