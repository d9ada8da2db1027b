"""Messages into the hand-eye session: the same for live topics and for recorded ones."""

from typing import Any

from robocal_ros.ground.errors import RobocalError
from robocal_ros.ground.samples import JOINTS, joint_sample
from robocal_ros.hand_eye.session import HandEyeSession
from robocal_ros.hand_eye.shots import SHOTS, shot_of


def take_hand_eye_message(session: HandEyeSession, kind: str, message: Any) -> None:
    """Give a message to the session; one that cannot be used is counted with its reason."""
    try:
        if kind == JOINTS:
            session.add(joint_sample(message))
        elif kind in SHOTS:
            session.add(shot_of(kind, message))
    except RobocalError as error:
        session.refuse(kind, error)
