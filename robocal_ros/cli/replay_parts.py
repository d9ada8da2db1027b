"""What replays of all kinds tell: commands, pauses, damaged parts of the bag."""

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from robocal_ros import __version__
from robocal_ros.bags.replay import ReplayReport, replay
from robocal_ros.cli.output import Document
from robocal_ros.cli.recording import BagOverview
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.streams import JointStream
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.base import Commanded
from robocal_ros.session.events import Command, Outcome

S = TypeVar("S", bound=Commanded)
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
    report: ReplayReport, session: Commanded, recording: BagOverview
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
