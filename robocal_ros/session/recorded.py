"""What the configuration records of all commanded sessions have in common."""

from collections.abc import Mapping, Sequence
from typing import Any

from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.commanded import Commanded
from robocal_ros.session.events import CONFIGURE, Command
from robocal_ros.session.history import require_robot

Document = Mapping[str, Any]


def configured_with(
    session: Commanded, topics: Mapping[str, str], config: Document, in_force: Document
) -> Command:
    """Settings and what is in force, so that a replay can start from the same.

    ``topics``: name of each input's topic.
    """
    arguments = {
        "robot": session.nominal.name,
        "model_hash": session.nominal.model_hash,
        "topics": dict(topics),
        "config": dict(config),
        **in_force,
    }
    return Command(CONFIGURE, arguments, session.newest_joints_ns, session.marks)


def recorded_arguments(nominal: SerialArm, configured: Command, names: Sequence[str]) -> Document:
    """Arguments of a configuration with ``config`` and these names.

    Raises
    ------
    WrongRobotError
        The recording was made with another nominal model.
    InputError
        One is missing.
    """
    require_robot(nominal, configured)
    arguments = configured.arguments
    missing = [name for name in ("config", *names) if name not in arguments]
    if missing:
        raise InputError(f"the recorded configuration lacks {', '.join(missing)}")
    return arguments
