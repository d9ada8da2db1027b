"""Messages into the thermal session: the same for live topics and for recorded ones."""

from typing import Any

from robocal_ros.core.errors import InputError
from robocal_ros.core.samples import joint_sample, point_sample, pose_sample
from robocal_ros.sessions.observations import JOINTS, POINT, POSE
from robocal_ros.sessions.thermal import ThermalSession


def take_message(session: ThermalSession, kind: str, message: Any) -> None:
    """Give a message to the session; one that cannot be used is counted with its reason.

    ``kind`` is the input that the message belongs to; other kinds are left alone.
    """
    try:
        if kind == JOINTS:
            session.add(joint_sample(message))
        elif kind == POINT:
            session.add(point_sample(message, session.config.target))
        elif kind == POSE:
            session.add(pose_sample(message, session.config.target))
    except InputError as error:
        session.desk.ignored.add(kind, str(error))
