"""Settings of the hand-eye session."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.proposals import THERMAL, Head, hand_eye_kind
from robocal_ros.ground.streams import StandstillRule
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.session.base import HistoryFollower
from robocal_ros.session.events import Command, History


@dataclass(frozen=True)
class HandEyeConfig:
    """Settings of a hand-eye session; plain values, so that a recording carries them.

    Attributes
    ----------
    base_frame, flange_frame, sensor_frame : names of the frames.
    standstill : when the robot counts as standing still about a measurement.
    capture_timeout_s : a capture without standstill or without a measurement for so long fails.
    robot_sigma_m, robot_sigma_rad : error of a reported flange pose along and about each axis, one
        sigma; None: found from the samples, but the second of a line laser as `HandEyeSettings`.
    limit_m : largest expected error at the working distance that is accepted.
    """

    base_frame: str = "base"
    flange_frame: str = "tool0"
    sensor_frame: str = "sensor"
    standstill: StandstillRule = field(default_factory=StandstillRule)
    capture_timeout_s: float = 10.0
    robot_sigma_m: float | None = None
    robot_sigma_rad: float | None = None
    limit_m: float = 1e-3

    def document(self) -> dict[str, Any]:
        """Plain values; `of_document` reads them back."""
        return asdict(self)

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "HandEyeConfig":
        """Read what `document` gave, also after JSON.

        Raises
        ------
        InputError
            When it has other settings than this version knows.
        """
        try:
            values = dict(document)
            return cls(standstill=StandstillRule(**values.pop("standstill")), **values)
        except (KeyError, TypeError) as error:
            raise InputError(f"the recorded configuration cannot be read: {error}") from error


# ---- in force -----------------------------------------------------------------------------------


class HandEyeInForce(HistoryFollower):
    """What the history has in force for a sensor, as of the last look.

    Attributes
    ----------
    head, thermal : heads of this sensor's calibrations and of the thermal models.
    """

    def __init__(self, history: History, nominal: SerialArm, sensor_frame: str) -> None:
        self._nominal = nominal
        super().__init__(history, hand_eye_kind(sensor_frame))

    def _read(self) -> None:
        super()._read()
        self.thermal: Head = self._history.head(THERMAL)

    @property
    def arm(self) -> SerialArm:
        """The arm with the thermal model in force."""
        model = self.thermal.model
        return self._nominal if model is None else arm_of(model, self._nominal)


# ---- thermal ------------------------------------------------------------------------------------


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
