"""Decisions about calibrations: a command to the history."""

from collections.abc import Mapping
from dataclasses import replace

from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.ground.proposals import BEFORE_ANY, THERMAL, TOOL, Decision, Entry
from robocal_ros.ground.samples import JOINTS
from robocal_ros.session import events
from robocal_ros.session.events import Command, Outcome
from robocal_ros.session.history import History

FIRST = {THERMAL: "identify", TOOL: "measure"}  # what gives a candidate of a kind
ONLY, NEWEST = "only", "newest"  # which pending candidate a command without an id is about


def decide(
    history: History, command: Command, expected: int, wall_ns: int, kind: str = THERMAL
) -> Outcome:
    """Accept, reject or roll back a calibration of a kind whose revision in force is ``expected``.

    A command with ``choose`` (`ONLY`, `NEWEST`) in place of an id is about a candidate that is
    pending now, not when it was given. The outcome's command says which: replay obeys that.

    Raises
    ------
    RobocalError
        When the history refuses.
    """
    command = named(history, command, kind)
    arguments = command.arguments
    if "refused" in arguments:
        return Outcome(command, Code.CONFLICT, str(arguments["refused"]))
    chosen = int(arguments.get("id", 0))
    by, why = str(arguments.get("by", "")), str(arguments.get("reason", ""))
    try:
        if command.name != events.ROLLBACK and (own := history.get(chosen).kind) != kind:
            raise InputError(f"calibration {chosen} is of kind {own}, not {kind}")
        if command.name == events.REJECT:
            history.reject(chosen, by=by, reason=why, wall_ns=wall_ns)
            return Outcome(command, Code.ACCEPT, f"calibration {chosen} rejected", None, chosen)
        if command.name == events.ACCEPT:
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


def measured_with(history: History, entry: Entry) -> dict[str, int]:
    """Revisions, by kind, beside which alone a calibration may come into force.

    A tool's flange poses came from a thermal model: with another one, what the drift did to the
    flange would stay in the tool, and be corrected a second time.
    """
    if entry.kind != TOOL:
        return {}
    return {THERMAL: int(history.model(entry.id)["thermal_revision"])}


def named(history: History, command: Command, kind: str) -> Command:
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
