"""What replays of all kinds tell: commands, pauses, damaged parts of the bag."""

from robocal_ros.cli.output import Document
from robocal_ros.cli.recording import Recording
from robocal_ros.core.streams import JointStream
from robocal_ros.sessions.events import Outcome


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
