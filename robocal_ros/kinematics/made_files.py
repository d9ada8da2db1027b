"""Files that a command made for one robot: YAML, with the nominal model they belong to."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from robocal_ros.ground.errors import WrongRobotError
from robocal_ros.ground.files import read_text, write_text
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robot_fields import Fields, load_yaml


def write_made(path: Path, document: dict[str, Any], keys: Sequence[str], command: str) -> None:
    """Write the parts of a document that a later command needs; the file appears whole or not."""
    kept = {key: document[key] for key in keys}
    text = yaml.safe_dump(kept, sort_keys=False, default_flow_style=None, width=2**16)
    write_text(path, f"# Written by robocal {command}.\n{text}")


def read_fields(path: Path, what: str) -> Fields:
    """Read a YAML (or JSON) file of keys and values.

    Raises
    ------
    InputError
        When there is no such file, or it is not YAML.
    """
    return Fields(load_yaml(read_text(path, what), str(path)), str(path), "")


def read_made(path: Path, arm: SerialArm, keys: Sequence[str], what: str, remedy: str) -> Fields:
    """Read the keys of such a file, made for ``arm``.

    Raises
    ------
    InputError
        When there is no such file, it is not YAML or has other keys.
    WrongRobotError
        When it was made for another nominal model.
    """
    top = read_fields(path, what)
    top.only(*keys)
    require_made_for(arm, path, top.text("robot"), top.text("model_hash"), remedy)
    return top


def require_made_for(arm: SerialArm, path: Path, robot: str, model_hash: str, remedy: str) -> None:
    """Refuse a file that was made for another nominal model than ``arm``.

    Raises
    ------
    WrongRobotError
        With what to do: ``remedy``.
    """
    if model_hash != arm.model_hash:
        raise WrongRobotError(
            f"{path} was made for {robot} with the model {model_hash}, "
            f"not for {arm.name} ({arm.model_hash}): {remedy} with this robot file"
        )
