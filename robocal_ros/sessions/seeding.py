"""A session that starts where a recorded one started."""

from collections.abc import Mapping
from typing import Any

from robocal_ros.core.codes import Code
from robocal_ros.core.errors import InputError, WrongRobotError
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.proposals import THERMAL, Proposal
from robocal_ros.sessions.events import Command
from robocal_ros.sessions.follower_state import FollowerState
from robocal_ros.sessions.history import History
from robocal_ros.sessions.in_force import REFERENCE
from robocal_ros.sessions.records import config_of
from robocal_ros.sessions.thermal import ThermalSession

BY = "replay"
WHY = "in force when the recording began"


def require_robot(nominal: SerialArm, configured: Command) -> None:
    """Refuse a robot that the recording was not made with.

    Raises
    ------
    WrongRobotError
        Always then; the message names both models.
    """
    recorded = str(configured.arguments.get("model_hash", ""))
    if recorded != nominal.model_hash:
        raise WrongRobotError(
            f"this was recorded with robot '{configured.arguments.get('robot', '')}' of nominal "
            f"model {recorded}; '{nominal.name}' is {nominal.model_hash}"
        )


def session_as_recorded(
    nominal: SerialArm, history: History, configured: Command, software: str
) -> ThermalSession:
    """Make a session with the recorded settings; an empty history gets what was in force.

    Raises
    ------
    WrongRobotError
        The recording was made with another nominal model.
    InputError
        The configuration cannot be read.
    """
    require_robot(nominal, configured)
    arguments = configured.arguments
    try:
        model, reference = arguments["model"], arguments["reference"]
        tracker = arguments["tracker"]
    except KeyError as error:
        raise InputError(f"the recorded configuration lacks {error}") from error
    config = config_of(arguments)
    state = None if tracker is None else FollowerState.of_document(tracker)
    in_force = {THERMAL: model, REFERENCE: reference}
    fresh = seeded(history, nominal, in_force, software)
    session = ThermalSession(nominal, history, config, software)
    if fresh and state is not None and session.follower is not None:
        session.follower.go_on_from(state)
    return session


def seeded(
    history: History,
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
    history: History,
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
