"""Commands to a session and what came of them: the record that replay obeys."""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.ground.samples import JOINTS, JUMPS

CONFIGURE = "configure"
CALIBRATE_SENSOR = "calibrate_sensor"
CAPTURE_REFERENCE = "capture_reference"
IDENTIFY = "identify"
BEGIN_CYCLE = "begin_cycle"
END_CYCLE = "end_cycle"
MEASURE_TOOL = "measure_tool"
STEP_BEGINS = "step_begins"
TOOL_STEP = "tool_step"
BREAK_OFF = "break_off"
LEFT_PLAN = "left_plan"  # argument of it: the robot was stopped because it left its plan
START = "start"
CAPTURE = "capture"
SAMPLE = "sample"
REMOVE = "remove"
CALIBRATE = "calibrate"
LOAD = "load"
ACCEPT = "accept"
REJECT = "reject"
ROLLBACK = "rollback"
WITHHOLD = "withhold"  # a candidate waits for a person
LEAVE = "leave"  # what does not fit a gap
CYCLE = (IDENTIFY, END_CYCLE)
SET_UP = (CALIBRATE_SENSOR, CAPTURE_REFERENCE)  # with the cold robot
MEASURED = (IDENTIFY, END_CYCLE, *SET_UP)  # wait for the last measurements


@dataclass(frozen=True)
class Command:
    """Something asked of a session.

    Attributes
    ----------
    name : one of the constants of this module.
    arguments : plain values (JSON).
    stamp_ns : data time of the command: only samples up to it count. None: the newest stamp
        known when the session takes the command.
    marks : newest stamp taken from each topic when the command was carried out; None until
        then. A recorded command carries them, so that replay uses the same samples.
    """

    name: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    stamp_ns: int | None = None
    marks: Mapping[str, int] | None = None


@dataclass(frozen=True)
class Outcome:
    """A command carried out.

    Attributes
    ----------
    status : ACCEPT when done, else why not.
    document : the identification, where one was made.
    calibration_id, revision : what was proposed or decided, and the revision now in force.
    outside : decided in the history by another process; nobody asked this session.
    repeated : the answer of an earlier command, given again; nothing was done.
    """

    command: Command
    status: Code
    message: str
    document: Mapping[str, Any] | None = None
    calibration_id: int = 0
    revision: int = 0
    samples: int = 0
    outside: bool = False
    repeated: bool = False

    @property
    def left_plan(self) -> bool:
        """Whether the robot was stopped because it left its plan: it may be held, or hit."""
        return bool(self.command.arguments.get(LEFT_PLAN, False))

    @property
    def done(self) -> bool:
        """Whether the command did what was asked."""
        return self.status is Code.ACCEPT


def carried_out(
    handlers: Mapping[str, Callable[[Command, int], Outcome]], command: Command, wall_ns: int
) -> Outcome:
    """What the command's handler makes of it; what it refuses is its outcome."""
    try:
        if command.name not in handlers:
            raise InputError(f"unknown command '{command.name}'; known: {', '.join(handlers)}")
        return handlers[command.name](command, wall_ns)
    except RobocalError as error:
        return Outcome(command, error.code, str(error))


def reached(marks: Mapping[str, int], newest_ns: Mapping[str, int], jumps: int) -> bool:
    """Whether samples have come as far as the marks of a recorded command."""
    wanted = marks.get(JUMPS, 0)
    topics = (topic for topic in marks if topic != JUMPS)
    near = all(newest_ns.get(topic, -1) >= marks[topic] for topic in topics)
    return jumps > wanted or (jumps == wanted and near)


def joints_awaited_ns(marks: Mapping[str, int], newest_ns: Mapping[str, int]) -> int | None:
    """Stamp of the joint reading with which the marks may be reached; None: not by one."""
    wanted = marks.get(JOINTS, -1)
    return wanted if newest_ns.get(JOINTS, -1) < wanted else None


# ---- commands and outcomes as the texts of ``robocal_msgs/SessionEvent``, and back --------------


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
