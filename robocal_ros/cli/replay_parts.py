"""What replays of all kinds tell: commands, pauses, damaged parts of the bag."""

from robocal_ros.cli.output import Document
from robocal_ros.cli.recording import Recording
from robocal_ros.core.streams import JointStream
from robocal_ros.sessions.commanded import Commanded
from robocal_ros.sessions.events import Outcome
from robocal_ros.sessions.replay import ReplayReport


def seconds(stamp_ns: int | None) -> float:
    """A stamp in s."""
    return (stamp_ns or 0) * 1e-9


def gaps_document(stream: JointStream, recording: Recording) -> Document:
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


def commanded_document(report: ReplayReport, session: Commanded, recording: Recording) -> Document:
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
