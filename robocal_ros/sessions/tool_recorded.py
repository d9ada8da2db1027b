"""A tool session's settings for the record, and a session that starts where a recorded one did."""

from collections.abc import Mapping

from robocal_ros.core.errors import InputError
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.proposals import HEALTHY_TOOL, THERMAL, TOOL
from robocal_ros.sessions.events import CONFIGURE, Command
from robocal_ros.sessions.history import History
from robocal_ros.sessions.seeding import bring_into_force, require_robot
from robocal_ros.sessions.tool import ToolSession
from robocal_ros.sessions.tool_config import ToolConfig

IN_FORCE = {"model": THERMAL, "tool": TOOL, "healthy": HEALTHY_TOOL}
OWN = "healthy"  # only a tool session's configuration has it


def configuration(session: ToolSession, topics: Mapping[str, str]) -> Command:
    """Settings and what is in force, so that a replay can start from the same.

    ``topics``: name of each input's topic.
    """
    current = session.current
    arguments = {
        "robot": session.nominal.name,
        "model_hash": session.nominal.model_hash,
        "topics": dict(topics),
        "config": session.config.document(),
        "model": current.thermal.model,
        "tool": current.head.model,
        "healthy": current.healthy.model,
    }
    return Command(CONFIGURE, arguments, session.newest_joints_ns, session.marks)


def is_tool_session(configured: Command | None) -> bool:
    """Whether a configuration was recorded by a tool session."""
    return configured is not None and OWN in configured.arguments


def tool_session_as_recorded(
    nominal: SerialArm, history: History, configured: Command, software: str
) -> ToolSession:
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
    missing = [name for name in ("config", *IN_FORCE) if name not in arguments]
    if missing:
        raise InputError(f"the recorded configuration lacks {', '.join(missing)}")
    if not history.list(1):
        for name, kind in IN_FORCE.items():
            bring_into_force(history, kind, nominal, arguments[name], software)
    config = ToolConfig.of_document(arguments["config"])
    return ToolSession(nominal, history, config, software)
