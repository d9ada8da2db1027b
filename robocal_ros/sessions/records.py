"""Commands and outcomes as the texts of ``robocal_msgs/SessionEvent``, and back."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from robocal_ros.core.errors import InputError
from robocal_ros.core.fitting.sphere import SphereRule
from robocal_ros.core.streams import StandstillRule
from robocal_ros.sessions.events import CONFIGURE, Command, Outcome
from robocal_ros.sessions.observations import JOINTS
from robocal_ros.sessions.thermal import ThermalSession
from robocal_ros.sessions.thermal_config import ThermalConfig

VERSION = 1
OWN = "tracker"  # only a thermal session's configuration has it


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


def configuration(session: ThermalSession, topics: Mapping[str, str] | None = None) -> Command:
    """The session's settings and what is in force, so that replay can start from the same.

    Recorded at the start and after each change of what is in force: a recording that begins
    later has it too. ``topics``: name of each input's topic.
    """
    return Command(
        CONFIGURE,
        {
            "robot": session.nominal.name,
            "model_hash": session.nominal.model_hash,
            "topics": dict(topics or {}),
            "config": asdict(session.config),
            "model": session.in_force.model,
            "reference": session.reference_model,
            OWN: None if session.follower is None else session.follower.state.document(),
        },
        session.desk.newest_ns.get(JOINTS, 0),
        session.desk.marks,
    )


def is_thermal_session(configured: Command | None) -> bool:
    """Whether a configuration was recorded by a thermal session."""
    return configured is not None and OWN in configured.arguments


def config_of(arguments: Mapping[str, Any]) -> ThermalConfig:
    """Read the settings back from a configuration record.

    Raises
    ------
    InputError
        When the record has other settings than this version knows.
    """
    try:
        values = dict(arguments["config"])
        rule = StandstillRule(**values.pop("standstill"))
        sphere = SphereRule(**values.pop("sphere"))
        for name in ("drift_parameters", "tip_m"):
            values[name] = tuple(values.get(name, ()))
        values["work_poses"] = tuple(tuple(q) for q in values.get("work_poses", ()))
        return ThermalConfig(standstill=rule, sphere=sphere, **values)
    except (KeyError, TypeError) as error:
        raise InputError(f"the recorded configuration cannot be read: {error}") from error
