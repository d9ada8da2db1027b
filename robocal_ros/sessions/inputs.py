"""Messages into the thermal session: the same for live topics and for recorded ones."""

from typing import Any

from robocal_ros.core.errors import RobocalError
from robocal_ros.core.samples import (
    cloud_sample,
    joint_sample,
    point_sample,
    pose_sample,
    temperature_sample,
)
from robocal_ros.sessions.observations import CENTRE, CLOUD, FIXED, JOINTS, POINT, POSE
from robocal_ros.sessions.temperatures import TEMPERATURES
from robocal_ros.sessions.thermal import ThermalSession


def take_message(session: ThermalSession, kind: str, message: Any) -> None:
    """Give a message to the session; one that cannot be used is counted with its reason.

    ``kind`` is the input that the message belongs to; other kinds are left alone.
    """
    try:
        if kind == JOINTS:
            session.add(joint_sample(message))
        elif kind in (POINT, CENTRE, FIXED):
            session.add(point_sample(message, session.config.target, kind))
        elif kind == CLOUD:
            session.add(cloud_sample(message, session.config.sphere, session.config.target))
        elif kind == TEMPERATURES:
            session.add(temperature_sample(message))
        elif kind == POSE:
            session.add(pose_sample(message, session.config.target))
    except RobocalError as error:
        session.desk.ignored.add(kind, str(error))
