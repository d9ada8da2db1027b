"""The data set of a hand-eye calibration: its target, and what was captured of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code, InputError, LimitError
from robocal_ros.ground.frames import Document
from robocal_ros.hand_eye.board import find_corners
from robocal_ros.hand_eye.camera_model import Mount
from robocal_ros.hand_eye.shots import IMAGE, PROFILE, TARGET_POSE, Shot, profile_of
from robocal_ros.hand_eye.targets import BoardTarget, target_of
from robocal_ros.history.history_records import Head
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.session.events import Command

Array = NDArray[np.float64]

Feature = Literal["edge", "groove"]

IN_HAND: Mount = "in-hand"
TO_HAND: Mount = "to-hand"
MOUNTS = (IN_HAND, TO_HAND)
WITHOUT_FILE = ("line", "camera")  # solved with the sensor's place
FEATURES: tuple[Feature, ...] = ("edge", "groove")
TOPIC_OF = {"sphere": PROFILE, "step": PROFILE, "line": PROFILE, "camera": TARGET_POSE}

MOST_CAPTURES = 500
MOST_HANDLE = 2**32 - 1
MOST_POINTS = 250_000  # of a set that is loaded: some 10 MB of text in the recording
UNIT = 1e-3  # length of a quaternion, from 1
THERMAL_MODEL = "thermal_model"  # argument of a command


@dataclass(frozen=True, eq=False)
class PoseModel:
    """A thermal model (None: nominal) and its revision; samples of one model share one object."""

    revision: int
    model: Document | None


def flange_poses(q: Array, models: Sequence[PoseModel], nominal: SerialArm) -> Array:
    """T_base_flange (k, 4, 4), m, of joints (k, n), each by its own model."""
    found = np.zeros((len(q), 4, 4))
    for one in dict.fromkeys(models):
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


@dataclass(eq=False)
class HandEyeSample:
    """What was seen at one standstill.

    Attributes
    ----------
    handle : its name.
    mark : of a step target the mark that the laser plane lies through; else empty.
    stamp_ns : of the shot.
    q : (n,) mean of the joint readings at standstill, rad (prismatic: m).
    values : see `hand_eye_shots.Shot`; of an image see `hand_eye_images.seen_corners`.
    thermal : what was in force then, so that a set of a cold robot stays one.
    """

    handle: int
    mark: str
    stamp_ns: int
    q: Array
    values: Array
    thermal: PoseModel


@dataclass(eq=False)
class Capture:
    """One capture as it is told: without ``code`` it waits; ``from_ns``: its shot is no older."""

    handle: int
    mark: str
    from_ns: int
    reason: str
    code: Code = Code.NONE
    stamp_ns: int = 0


@dataclass(eq=False)
class DataSet:
    """A target and its captures.

    Attributes
    ----------
    target : document of the target, with its ``kind``.
    method : best or classic; ``mount`` in-hand or to-hand; ``feature`` of a line, in a profile.
    captures, samples : by handle; a capture that failed or waits has no sample.
    candidate : the last calibration in the history; 0 without.
    """

    target: Document
    method: str
    mount: Mount
    feature: Feature
    captures: dict[int, Capture] = field(default_factory=dict)
    samples: dict[int, HandEyeSample] = field(default_factory=dict)
    candidate: int = 0

    @property
    def kind(self) -> str:
        """Kind of the target."""
        return str(self.target["kind"])

    @property
    def topic(self) -> str:
        """The input that shows the target."""
        return IMAGE if "columns" in self.target else TOPIC_OF[self.kind]

    @property
    def waiting(self) -> Capture | None:
        """The capture that waits; None while there is none."""
        return next((c for c in self.captures.values() if c.code is Code.NONE), None)

    def require_mark(self, mark: str) -> None:
        """Refuse a mark that the target does not have; only a step has any.

        Raises `InputError`, naming those that there are.
        """
        known = tuple(self.target.get("corners", ("",)))
        if mark not in known:
            words = ", ".join(known) if any(known) else "none"
            raise InputError(f"mark '{mark}' is none of the target's: {words}")

    def put(self, sample: HandEyeSample) -> str:
        """Add a sample; says what it is. Raises `InputError` when it cannot be one of this set."""
        count = len(sample.values)
        seen = f"{count} points" if self.topic == PROFILE else "the target's pose"
        if self.topic == IMAGE:
            self._require_image(sample.values)
            seen = f"{count - 1} corners"
        words = f"{seen}, sample {len(self.samples) + 1}"
        capture = Capture(
            sample.handle, sample.mark, sample.stamp_ns, words, Code.ACCEPT, sample.stamp_ns
        )
        self.samples[sample.handle], self.captures[sample.handle] = sample, capture
        return words

    def _require_image(self, values: Array) -> None:
        """Refuse corners of another board, or of an image of another size."""
        count = int(self.target["columns"]) * int(self.target["rows"])
        if len(values) != 1 + count:
            raise InputError(f"{len(values) - 1} corners where the board has {count}")
        first = next(iter(self.samples.values()), None)
        expected = self.target.get("size") or (values if first is None else first.values)[0]
        if not np.array_equal(values[0], expected):
            found, wanted = ("{:.0f}x{:.0f} px".format(*size) for size in (values[0], expected))
            raise InputError(
                f"the image has {found} where {wanted} are expected, as the intrinsics or the "
                "samples before have it: keep the camera at one resolution"
            )

    def chosen(self, handles: Sequence[int]) -> list[HandEyeSample]:
        """The samples of these handles, all without any, in the order of their handles.

        Raises `InputError` when one has no sample.
        """
        unknown = sorted(set(handles) - set(self.samples))
        if unknown:
            raise InputError(
                f"no sample {', '.join(map(str, unknown))}; there are "
                f"{', '.join(map(str, sorted(self.samples))) or 'none'}"
            )
        wanted = set(handles) or set(self.samples)
        return [self.samples[handle] for handle in sorted(wanted)]

    def document(self) -> Document:
        """Plain values; `data_set_of` reads them back to the last bit.

        ``thermal`` of a sample: index of its model among ``thermal_models``.
        """
        models = list(dict.fromkeys(sample.thermal for sample in self.samples.values()))
        return {
            "target": self.target,
            "method": self.method,
            "mount": self.mount,
            "feature": self.feature,
            "thermal_models": [{"revision": one.revision, "model": one.model} for one in models],
            "samples": [
                {
                    "handle": sample.handle,
                    "mark": sample.mark,
                    "stamp_ns": sample.stamp_ns,
                    "thermal": models.index(sample.thermal),
                    "q": sample.q.tolist(),
                    "values": sample.values.tolist(),
                }
                for _, sample in sorted(self.samples.items())
            ],
        }


def data_set_begun(document: Mapping[str, Any]) -> DataSet:
    """A data set without samples; its names are not checked."""
    return DataSet(
        dict(document["target"]),
        str(document["method"]),
        cast(Mount, document["mount"]),
        cast(Feature, document["feature"]),
    )


def data_set_of(document: Mapping[str, Any], arm: SerialArm) -> DataSet:
    """Read what `DataSet.document` gave, also after JSON; ``arm``: whose joints they are.

    Raises `InputError` when it is no such document; `TooFewSamplesError` or `LimitError` when a
    profile shows too little, or there are more samples or points than are kept.
    """
    try:
        found = data_set_begun(document)
        target_of(found.target)
        rows = document["samples"]
        if len(rows) > MOST_CAPTURES:
            raise LimitError(f"{len(rows)} samples: a data set has at most {MOST_CAPTURES}")
        points = sum(len(row["values"]) for row in rows)
        if points > MOST_POINTS:
            raise LimitError(
                f"{points} points in {len(rows)} samples: at most {MOST_POINTS} can be loaded, "
                "since the recording holds them; save fewer samples, or profiles of fewer points"
            )
        models = []
        for one in document["thermal_models"]:
            models.append(PoseModel(int(one["revision"]), one["model"]))
            if models[-1].model is not None:
                arm_of(models[-1].model, arm)  # of this robot
        for row in rows:
            sample = _sample_of(row, found.topic, arm, models)
            if sample.handle in found.samples:
                raise InputError(f"the data set has two samples of handle {sample.handle}")
            found.require_mark(sample.mark)
            found.put(sample)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"the data set cannot be read: {error}") from error
    return found


def _sample_of(
    row: Document, topic: str, arm: SerialArm, models: Sequence[PoseModel]
) -> HandEyeSample:
    """One sample of a document, checked as one that is captured."""
    handle, at_ns = row["handle"], row["stamp_ns"]
    if type(handle) is not int or not 1 <= handle <= MOST_HANDLE:
        raise InputError(f"handle {handle} of the data set is none of 1 to {MOST_HANDLE}")
    if type(at_ns) is not int or not 0 < at_ns < 2**63:
        raise InputError(f"sample {handle} of the data set has no time stamp, but {at_ns}")
    q = np.array(row["q"], dtype=np.float64).reshape(arm.n)
    values = np.array(row["values"], dtype=np.float64)
    if not (np.all(np.isfinite(q)) and np.all(np.isfinite(values))):
        raise InputError(f"sample {handle} of the data set holds what is no number")
    if topic == PROFILE:
        profile_of(values, f"of sample {handle}")
    elif topic == IMAGE:
        values = values.reshape(-1, 2)
    elif values.shape != (1, 7) or abs(float(np.linalg.norm(values[0, 3:])) - 1.0) > UNIT:
        raise InputError(f"sample {handle} of the data set is no pose: {values.tolist()}")
    thermal = row["thermal"]
    if type(thermal) is not int or not 0 <= thermal < len(models):
        raise InputError(f"sample {handle} of the data set is of thermal model {thermal}: no such")
    return HandEyeSample(handle, str(row["mark"]), at_ns, q, values, models[thermal])


def seen_corners(target: Mapping[str, Any], shot: Shot) -> Array:
    """Width and height of an image, then the corners of the board in it: (1 + n, 2), px.

    Raises `InputError` when the image does not show the board.
    """
    board = board_of(target).board
    image = shot.read()
    corners = find_corners(image, board)
    if corners is None:
        raise InputError(
            f"no board of {board.columns}x{board.rows} inner corners in the image of "
            f"{shot.stamp_ns} ns: look for light, focus, and that all of the board is in sight"
        )
    return np.vstack([image.shape[::-1], corners])


def board_of(target: Mapping[str, Any]) -> BoardTarget:
    """The board that a document of a target describes.

    Raises `InputError` when it describes none.
    """
    found = target_of(target)
    if not isinstance(found, BoardTarget):
        raise InputError(f"a {target['kind']} without a board shows no corners")
    return found
