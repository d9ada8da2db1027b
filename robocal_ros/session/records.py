"""Commands and outcomes as the texts of ``robocal_msgs/SessionEvent``, and back."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from robocal_ros.ground.errors import InputError
from robocal_ros.session.events import Command, Outcome

VERSION = 1


def _text(document: Mapping[str, Any]) -> str:
    return json.dumps(document, allow_nan=False, sort_keys=True)


def digest(document: Mapping[str, Any] | None) -> str:
    """Fingerprint of a document, equal when every number is equal to the last bit."""
    if document is None:
        return ""
    return hashlib.sha256(_text(document).encode()).hexdigest()[:16]


def arguments_text(command: Command) -> str:
    """Arguments and marks of a command as JSON, with the version of this form."""
    marks = dict(command.marks or {})
    return _text({"version": VERSION, "arguments": dict(command.arguments), "marks": marks})


def outcome_text(outcome: Outcome) -> str:
    """What came of a command as JSON; the document by its fingerprint."""
    return _text(
        {
            "status": int(outcome.status),
            "message": outcome.message,
            "id": outcome.calibration_id,
            "revision": outcome.revision,
            "samples": outcome.samples,
            "digest": digest(outcome.document),
        }
    )


def read_command(name: str, stamp_ns: int, arguments: str) -> Command:
    """Read a recorded command.

    Raises
    ------
    InputError
        When the text is no such record, or of a newer version.
    """
    try:
        record = json.loads(arguments)
        if record["version"] != VERSION:
            raise InputError(
                f"session event '{name}' has version {record['version']}; this software knows "
                f"version {VERSION}: replay it with the software that recorded it"
            )
        marks = {str(topic): int(mark) for topic, mark in record["marks"].items()}
        return Command(name, dict(record["arguments"]), stamp_ns, marks)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"session event '{name}' cannot be read: {error}") from error
