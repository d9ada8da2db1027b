"""A hand-eye session's settings for the record, and a session that starts where one did."""

from collections.abc import Mapping

from robocal_ros.ground.proposals import THERMAL, hand_eye_kind
from robocal_ros.hand_eye.config import HandEyeConfig
from robocal_ros.hand_eye.session import HandEyeSession
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.base import configured_with, recorded_arguments
from robocal_ros.session.decisions import History, seeded
from robocal_ros.session.events import Command

OWN = "sensor"  # only a hand-eye session's configuration has it


def configuration(session: HandEyeSession, topics: Mapping[str, str]) -> Command:
    """Settings and what is in force, so that a replay can start from the same.

    ``topics``: name of each input's topic.
    """
    current = session.current
    in_force = {"model": current.thermal.model, OWN: current.head.model}
    return configured_with(session, topics, session.config.document(), in_force)


def is_hand_eye_session(configured: Command | None) -> bool:
    """Whether a configuration was recorded by a hand-eye session."""
    return configured is not None and OWN in configured.arguments


def hand_eye_session_as_recorded(
    nominal: SerialArm, history: History, configured: Command, software: str
) -> HandEyeSession:
    """Make a session with the recorded settings; an empty history gets what was in force.

    Raises
    ------
    WrongRobotError
        The recording was made with another nominal model.
    InputError
        The configuration cannot be read.
    """
    arguments = recorded_arguments(nominal, configured, ("model", OWN))
    config = HandEyeConfig.of_document(arguments["config"])
    in_force = {THERMAL: arguments["model"], hand_eye_kind(config.sensor_frame): arguments[OWN]}
    seeded(history, nominal, in_force, software)
    return HandEyeSession(nominal, history, config, software)
