"""A tool session's settings for the record, and a session that starts where a recorded one did."""

from collections.abc import Mapping
from typing import Any

from robocal_ros.ground.errors import RobocalError
from robocal_ros.ground.proposals import HEALTHY_TOOL, MANDREL, THERMAL, TOOL
from robocal_ros.ground.samples import JOINTS, joint_sample
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.base import configured_with, recorded_arguments
from robocal_ros.session.decisions import History, seeded
from robocal_ros.session.events import Command
from robocal_ros.tool.edges import EDGES, edge_sample
from robocal_ros.tool.run import ToolConfig
from robocal_ros.tool.session import ToolSession

# ---- recorded -----------------------------------------------------------------------------------


IN_FORCE = {"model": THERMAL, "tool": TOOL, "healthy": HEALTHY_TOOL}
OWN = "healthy"  # only a tool session's configuration has it


def configuration(session: ToolSession, topics: Mapping[str, str]) -> Command:
    """Settings and what is in force, so that a replay can start from the same.

    ``topics``: name of each input's topic.
    """
    current = session.current
    in_force = {
        "model": current.thermal.model,
        "tool": current.head.model,
        OWN: current.healthy.model,
        "mandrel": current.mandrel.model,
    }
    return configured_with(session, topics, session.config.document(), in_force)


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
    arguments = recorded_arguments(nominal, configured, tuple(IN_FORCE))
    config = ToolConfig.of_document(arguments["config"])
    in_force = {kind: arguments[name] for name, kind in IN_FORCE.items()}
    in_force[MANDREL] = configured.arguments.get("mandrel")  # older recordings have none
    seeded(history, nominal, in_force, software)
    return ToolSession(nominal, history, config, software)


# ---- messages into the tool session: the same for live topics and for recorded ones -------------


def take_tool_message(session: ToolSession, kind: str, message: Any) -> None:
    """Give a message to the session; one that cannot be used is counted with its reason."""
    try:
        if kind == JOINTS:
            session.add(joint_sample(message))
        elif kind == EDGES:
            session.add(edge_sample(message, session.config.beams))
    except RobocalError as error:
        session.ignored.add(kind, str(error))
