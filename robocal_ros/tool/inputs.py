"""Messages into the tool session: the same for live topics and for recorded ones."""

from typing import Any

from robocal_ros.ground.errors import RobocalError
from robocal_ros.ground.samples import JOINTS, joint_sample
from robocal_ros.tool.edge_log import EDGES
from robocal_ros.tool.edge_samples import edge_sample
from robocal_ros.tool.session import ToolSession


def take_tool_message(session: ToolSession, kind: str, message: Any) -> None:
    """Give a message to the session; one that cannot be used is counted with its reason."""
    try:
        if kind == JOINTS:
            session.add(joint_sample(message))
        elif kind == EDGES:
            session.add(edge_sample(message, session.config.beams))
    except RobocalError as error:
        session.ignored.add(kind, str(error))
