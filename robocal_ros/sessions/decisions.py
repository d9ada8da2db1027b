"""Decisions about calibrations: a command to the history."""

from robocal_ros.core.codes import Code
from robocal_ros.sessions import events
from robocal_ros.sessions.events import Command, Outcome
from robocal_ros.sessions.history import History


def decide(history: History, command: Command, expected: int, wall_ns: int) -> Outcome:
    """Accept, reject or roll back, where revision ``expected`` is in force.

    Raises
    ------
    RobocalError
        When the history refuses.
    """
    arguments = command.arguments
    chosen = int(arguments.get("id", 0))
    by, why = str(arguments.get("by", "")), str(arguments.get("reason", ""))
    if command.name == events.REJECT:
        history.reject(chosen, by=by, reason=why, wall_ns=wall_ns)
        return Outcome(command, Code.ACCEPT, f"calibration {chosen} rejected", None, chosen)
    if command.name == events.ACCEPT:
        head = history.accept(chosen, by=by, reason=why, expected_head=expected, wall_ns=wall_ns)
    else:
        head = history.rollback(
            None if arguments.get("previous", False) else chosen,
            by=by,
            reason=why,
            expected_head=expected,
            wall_ns=wall_ns,
        )
    chosen = head.calibration_id or 0
    what = f"calibration {chosen}" if chosen else "the nominal model"
    message = f"revision {head.revision}: {what} in force"
    return Outcome(command, Code.ACCEPT, message, None, chosen)
