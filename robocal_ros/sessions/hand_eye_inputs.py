"""Messages into the hand-eye session: the same for live topics and for recorded ones."""

from typing import Any

from robocal_ros.core.errors import RobocalError
from robocal_ros.core.samples import joint_sample
from robocal_ros.sessions.hand_eye import HandEyeSession
from robocal_ros.sessions.hand_eye_images import image_shot
from robocal_ros.sessions.hand_eye_shots import (
    IMAGE,
    PROFILE,
    TARGET_POSE,
    pose_shot,
    profile_shot,
)
from robocal_ros.sessions.observations import JOINTS


def take_hand_eye_message(session: HandEyeSession, kind: str, message: Any) -> None:
    """Give a message to the session; one that cannot be used is counted with its reason."""
    try:
        if kind == JOINTS:
            session.add(joint_sample(message))
        elif kind == PROFILE:
            session.add(profile_shot(message))
        elif kind == TARGET_POSE:
            session.add(pose_shot(message))
        elif kind == IMAGE:
            session.add(image_shot(message))
    except RobocalError as error:
        session.refuse(kind, error)
