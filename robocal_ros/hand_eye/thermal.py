"""Which thermal model a sample's flange pose comes from: the one in force when it was taken."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.proposals import Head
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.session.events import Command

Array = NDArray[np.float64]
Document = dict[str, Any]

THERMAL_MODEL = "thermal_model"  # argument of a command


@dataclass(frozen=True, eq=False)
class PoseModel:
    """A thermal model (None: nominal) and its revision; samples of one model share one object."""

    revision: int
    model: Document | None

    def document(self) -> Document:
        """Plain values; `pose_model_of` reads them back."""
        return {"revision": self.revision, "model": self.model}


def pose_model_of(document: Mapping[str, Any], nominal: SerialArm) -> PoseModel:
    """Read what `PoseModel.document` gave, and try it on the robot.

    Raises
    ------
    KeyError, TypeError, ValueError
        When it is no such document, or of another robot.
    """
    found = PoseModel(int(document["revision"]), document["model"])
    if found.model is not None:
        arm_of(found.model, nominal)
    return found


def models_used(models: Iterable[PoseModel]) -> list[PoseModel]:
    """Each once, in order."""
    return list(dict.fromkeys(models))


def flange_poses(q: Array, models: Sequence[PoseModel], nominal: SerialArm) -> Array:
    """T_base_flange (k, 4, 4), m, of joints (k, n), each by its own model."""
    found = np.zeros((len(q), 4, 4))
    for one in models_used(models):
        rows = [i for i, model in enumerate(models) if model is one]
        arm = nominal if one.model is None else arm_of(one.model, nominal)
        found[rows] = arm.fk(q[rows])
    return found


class PoseModels:
    """The models of a session; ``began_with`` was in force at its beginning."""

    def __init__(self, began_with: Head) -> None:
        self._began_with = began_with.revision
        self._newest = PoseModel(began_with.revision, began_with.model)

    def bound(self, command: Command, in_force: Head) -> Command:
        """The command with the model, where another than at the beginning is in force.

        So a replay, which knows that of the beginning, takes the same flange poses.
        """
        if THERMAL_MODEL in command.arguments or in_force.revision == self._began_with:
            return command
        told = {THERMAL_MODEL: {"revision": in_force.revision, "model": in_force.model}}
        return replace(command, arguments={**command.arguments, **told})

    def of(self, command: Command, in_force: Head) -> PoseModel:
        """The model of a sample that the command, `bound`, takes."""
        told = command.arguments.get(THERMAL_MODEL)
        if told is None:
            told = {"revision": in_force.revision, "model": in_force.model}
        if self._newest.revision != told["revision"]:
            self._newest = PoseModel(int(told["revision"]), told["model"])
        return self._newest
