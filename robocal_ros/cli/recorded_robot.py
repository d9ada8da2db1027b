"""Which robot a bag is of."""

import contextlib

from robocal_ros.cli.arguments import describe_robot
from robocal_ros.ground.errors import InputError, WrongRobotError
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import robot_folders
from robocal_ros.session.events import Command


def find_robot(name: str | None, warnings: list[str], configured: Command | None) -> SerialArm:
    """The arm that the user named, else the shipped one that the bag was recorded with.

    Raises
    ------
    InputError
        Nothing says which robot it is, or its file is not as docs/robot_file.md says.
    WrongRobotError
        It is none of the shipped robots.
    """
    if name is not None:
        return describe_robot(name, warnings).arm
    if configured is None:
        raise InputError("the bag does not say which robot it is of: name it with --robot")
    wanted = configured.arguments.get("model_hash")
    for file in (file for folder in robot_folders() for file in sorted(folder.glob("*.yaml"))):
        notes: list[str] = []
        with contextlib.suppress(InputError):  # a broken file of another robot is no matter here
            arm = describe_robot(str(file), notes).arm
            if arm.model_hash == wanted:
                warnings += notes
                return arm
    raise WrongRobotError(
        f"recorded with robot '{configured.arguments.get('robot')}', nominal model {wanted}, which "
        "is none of the shipped robots: give its file with --robot"
    )
