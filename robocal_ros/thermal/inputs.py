"""Messages into the thermal session: the same for live topics and for recorded ones."""

from typing import Any

from robocal_ros.estimation.sphere import cloud_sample
from robocal_ros.ground.errors import RobocalError
from robocal_ros.ground.samples import (
    JOINTS,
    MEASURED_POINT,
    MEASURED_POSE,
    REFERENCE_SPHERE,
    SPHERE_CENTER,
    SPHERE_CLOUD,
    TEMPERATURES,
    joint_sample,
    point_sample,
    pose_sample,
    temperature_sample,
)
from robocal_ros.thermal.session import ThermalSession


def take_message(session: ThermalSession, kind: str, message: Any) -> None:
    """Give a message to the session; one that cannot be used is counted with its reason.

    ``kind`` is the input that the message belongs to; other kinds are left alone.
    """
    try:
        if kind == JOINTS:
            session.add(joint_sample(message))
        elif kind in (MEASURED_POINT, SPHERE_CENTER, REFERENCE_SPHERE):
            session.add(point_sample(message, session.config.target, kind))
        elif kind == SPHERE_CLOUD:
            session.add(cloud_sample(message, session.config.sphere, session.config.target))
        elif kind == TEMPERATURES:
            session.add(temperature_sample(message))
        elif kind == MEASURED_POSE:
            session.add(pose_sample(message, session.config.target))
    except RobocalError as error:
        session.desk.ignored.add(kind, str(error))
