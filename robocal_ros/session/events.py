"""Commands to a session and what came of them: the record that replay obeys.

Decisions about calibrations are commands to the history.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from robocal_ros.ground.errors import Code, InputError, RobocalError, WrongRobotError
from robocal_ros.ground.samples import JOINTS, JUMPS
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import (
    BEFORE_ANY,
    THERMAL,
    TOOL,
    Decision,
    Entry,
    Proposal,
)
from robocal_ros.kinematics import SerialArm

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
    """Something asked of a session."""

    name: str  # one of the constants of this module
    arguments: Mapping[str, Any] = field(default_factory=dict)  # plain values (JSON)
    # data time of the command: only samples up to it count. None: the newest stamp known when the
    # session takes the command.
    stamp_ns: int | None = None
    # newest stamp taken from each topic when the command was carried out; None until then. A
    # recorded command carries them, so that replay uses the same samples.
    marks: Mapping[str, int] | None = None


@dataclass(frozen=True)
class Outcome:
    """A command carried out."""

    command: Command
    status: Code  # ACCEPT when done, else why not
    message: str
    document: Mapping[str, Any] | None = None  # the identification, where one was made
    # calibration_id, revision: what was proposed or decided, and the revision now in force
    calibration_id: int = 0
    revision: int = 0
    samples: int = 0
    outside: bool = False  # decided in the history by another process; nobody asked this session
    repeated: bool = False  # the answer of an earlier command, given again; nothing was done

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

    Raises `InputError` when the text is no such record, or of a newer version.
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


BY = "replay"


WHY = "in force when the recording began"


def require_robot(nominal: SerialArm, configured: Command) -> None:
    """Refuse a robot that the recording was not made with: `WrongRobotError` names both models."""
    recorded = str(configured.arguments.get("model_hash", ""))
    if recorded != nominal.model_hash:
        raise WrongRobotError(
            f"this was recorded with robot '{configured.arguments.get('robot', '')}' of nominal "
            f"model {recorded}; '{nominal.name}' is {nominal.model_hash}"
        )


def seeded(
    history: CalibrationHistory,
    nominal: SerialArm,
    in_force: Mapping[str, Mapping[str, Any] | None],
    software: str,
) -> bool:
    """Bring what was in force, by its kind, into an empty history; whether it was empty.

    Called once all else of the recording was read: what is left in a history after a failure would
    be taken for the user's own at the next try.
    """
    if history.list(1):
        return False
    for kind, model in in_force.items():
        bring_into_force(history, kind, nominal, model, software)
    return True


def bring_into_force(
    history: CalibrationHistory,
    kind: str,
    nominal: SerialArm,
    model: Mapping[str, Any] | None,
    software: str,
    why: str = WHY,
) -> None:
    """Accept what was in force when, or while, a recording was made; None: nothing was."""
    if model is None:
        return
    calibration_id = history.propose(
        Proposal(
            kind=kind,
            model_hash=nominal.model_hash,
            based_on=history.head(kind).revision,
            cycle_id="",
            stamp_ns=0,
            created_ns=0,
            software=software,
            method="",
            code=Code.ACCEPT,
            reason=why,
            document={},
            model=model,
        )
    )
    history.accept(calibration_id, by=BY, reason=why, expected_head=None, wall_ns=0)


FIRST = {THERMAL: "identify", TOOL: "measure"}  # what gives a candidate of a kind
ONLY, NEWEST = "only", "newest"  # which pending candidate a command without an id is about


def decide(
    history: CalibrationHistory, command: Command, expected: int, wall_ns: int, kind: str = THERMAL
) -> Outcome:
    """Accept, reject or roll back a calibration of a kind whose revision in force is ``expected``.

    A command with ``choose`` (`ONLY`, `NEWEST`) in place of an id is about a candidate that is
    pending now, not when it was given. The outcome's command says which: replay obeys that.

    Raises `RobocalError` when the history refuses.
    """
    command = named(history, command, kind)
    arguments = command.arguments
    if "refused" in arguments:
        return Outcome(command, Code.CONFLICT, str(arguments["refused"]))
    chosen = int(arguments.get("id", 0))
    by, why = str(arguments.get("by", "")), str(arguments.get("reason", ""))
    try:
        if command.name != ROLLBACK and (own := history.get(chosen).kind) != kind:
            raise InputError(f"calibration {chosen} is of kind {own}, not {kind}")
        if command.name == REJECT:
            history.reject(chosen, by=by, reason=why, wall_ns=wall_ns)
            return Outcome(command, Code.ACCEPT, f"calibration {chosen} rejected", None, chosen)
        if command.name == ACCEPT:
            head = history.accept(
                chosen,
                by=by,
                reason=why,
                expected_head=expected,
                wall_ns=wall_ns,
                with_heads=measured_with(history, history.get(chosen)),
            )
        else:
            head = history.rollback(
                None if arguments.get("previous", False) else chosen,
                by=by,
                reason=why,
                expected_head=expected,
                wall_ns=wall_ns,
                kind=kind,
            )
    except RobocalError as error:
        return Outcome(command, error.code, str(error))
    chosen = head.calibration_id or 0
    what = f"calibration {chosen}" if chosen else BEFORE_ANY.get(kind, "nothing")
    message = f"revision {head.revision}: {what} in force"
    return Outcome(command, Code.ACCEPT, message, None, chosen, head.revision)


def measured_with(history: CalibrationHistory, entry: Entry) -> dict[str, int]:
    """Revisions, by kind, beside which alone a calibration may come into force.

    A tool's flange poses came from a thermal model: with another one, what the drift did to the
    flange would stay in the tool, and be corrected a second time.
    """
    if entry.kind != TOOL:
        return {}
    return {THERMAL: int(history.model(entry.id)["thermal_revision"])}


def named(history: CalibrationHistory, command: Command, kind: str) -> Command:
    """Put the candidate's id, or why there is none (``refused``), in place of ``choose``."""
    if "choose" not in command.arguments:
        return command
    arguments = dict(command.arguments)
    pending = [entry.id for entry in history.pending(kind)]
    choose = arguments.pop("choose")
    if not pending:
        first = FIRST.get(kind, "calibrate")
        arguments["refused"] = f"no fresh candidate is pending: {first} first"
    elif choose == ONLY and len(pending) > 1:
        found = ", ".join(map(str, pending))
        arguments["refused"] = (
            f"exactly one fresh candidate must be pending, found {found}: decide by id"
        )
    else:
        arguments["id"] = pending[0]
    return replace(command, arguments=arguments)


def outside_decision(decision: Decision, marks: Mapping[str, int]) -> Outcome:
    """Put another process's decision as a command that was carried out, for the record."""
    chosen = decision.calibration_id or 0
    arguments = {"id": chosen, "by": decision.by, "reason": decision.reason}
    command = Command(decision.action.value, arguments, marks.get(JOINTS, 0), marks)
    message = f"revision {decision.head_after}: decided outside this node"
    return Outcome(command, Code.ACCEPT, message, None, chosen, decision.head_after, outside=True)
