# SPDX-License-Identifier: Apache-2.0
"""What a sensor sent, and the data set of a hand-eye calibration that captures make of it.

Shots are kept as they came, and read only when a capture waits: a sensor that runs freely costs
next to nothing while nobody asks.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code, InputError, LimitError, RobocalError
from robocal_ros.ground.frames import Array, Document
from robocal_ros.ground.samples import (
    JOINTS,
    JointStream,
    NotStillError,
    StandstillRule,
    joint_sample,
    point_sample,
    pose_sample,
    stamp_ns,
)
from robocal_ros.hand_eye.boards import find_corners, message_image
from robocal_ros.hand_eye.camera_data import Mount
from robocal_ros.hand_eye.profiles import (
    DEFAULT,
    Profile,
    SensorDescription,
    cloud_profile,
    profile_of,
)
from robocal_ros.hand_eye.targets import ROLES, BoardTarget, target_of
from robocal_ros.history.history_records import Head
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.session import events
from robocal_ros.session.events import GAP_NS, Command
from robocal_ros.session.inputs import AheadOfJoints, Ignored

PROFILE, TARGET_POSE, IMAGE = "profile", "target_pose", "image"
TRACKER_POINT = "tracker_point"
COMPRESSED = "image/compressed"  # the input ``image`` in another encoding
SHOTS = (PROFILE, TARGET_POSE, IMAGE, COMPRESSED, TRACKER_POINT)
MOST_KEPT, MOST_BYTES = 500, 256 << 20  # an image may wait for the joints of a second
BEHIND_NS = 10_000_000_000  # the joints, when a shot arrives
FARTHEST_TRACKED_M = 100.0  # the longest trackers measure 80 m


@dataclass(frozen=True, eq=False)
class Shot:
    """One profile (``PointCloud2``), target pose (``PoseStamped``), image or point.

    An image is an ``Image`` or a ``CompressedImage``; a point (``PointStamped``) is the reflector
    of a laser tracker.

    ``sensor``: how a line laser tells its profiles.
    """

    topic: str
    stamp_ns: int
    frame: str
    message: Any
    sensor: SensorDescription = DEFAULT

    @property
    def size(self) -> int:
        """Bytes of a cloud's points or an image's pixels."""
        return len(getattr(self.message, "data", ()))

    @cached_property
    def _values(self) -> NDArray[Any]:
        if self.topic == PROFILE:
            return cloud_profile(self.message, self.sensor).points
        return _READERS[self.topic](self.message)

    def read(self) -> NDArray[Any]:
        """Of a profile its points (n, 2), x and z, m, sensor frame; of a target pose (1, 7).

        That is position, m, and quaternion x, y, z, w of the target in the sensor frame. Of an
        image its grey pixels (h, w), 8 bits. Of a point (1, 3), m, tracker frame.
        """
        return self._values


def shot_of(topic: str, message: Any, sensor: SensorDescription = DEFAULT) -> Shot:
    """A shot from the message of an input; its content is not looked at."""
    topic = IMAGE if topic == COMPRESSED else topic
    return Shot(topic, stamp_ns(message.header.stamp), message.header.frame_id, message, sensor)


def _pose(message: Any) -> Array:
    pose_sample(message)
    p, o = message.pose.position, message.pose.orientation
    return np.array([[p.x, p.y, p.z, o.x, o.y, o.z, o.w]])


def _tracked(message: Any) -> Array:
    point = point_sample(message).position_m
    distance = float(np.linalg.norm(point))
    if distance > FARTHEST_TRACKED_M:
        raise InputError(f"the reflector is {distance:.4g} m from the tracker: is it in mm?")
    return point[None]


_READERS: Mapping[str, Callable[[Any], NDArray[Any]]] = {
    TARGET_POSE: _pose,
    IMAGE: message_image,
    TRACKER_POINT: _tracked,
}


class ShotLog:
    """The latest shots, oldest first."""

    def __init__(self) -> None:
        self._shots: deque[Shot] = deque()
        self._bytes = 0
        self.ahead: AheadOfJoints[Shot] = AheadOfJoints()

    def add(self, shot: Shot, frame: str, joints_ns: int) -> None:
        """Take a shot; ``joints_ns``: newest stamp of the joints, 0 before any.

        Raises `InputError` when it is of another frame or stamped on another clock than the joints;
        also when it is ahead of them, or there are none yet: then it waits.
        """
        if shot.frame != frame:
            whose = "tracker" if shot.topic == TRACKER_POINT else "sensor"
            raise InputError(
                f"{shot.topic} in frame '{shot.frame}', the {whose}'s frame is '{frame}': set "
                f"{whose}_frame, or connect the right {whose}"
            )
        most = min(MOST_KEPT, MOST_BYTES // (shot.size + 1) + 1)
        if why := self.ahead.why(shot.topic, shot, joints_ns, most):
            raise InputError(f"{shot.topic} {why}")
        away_ns = shot.stamp_ns - joints_ns
        if away_ns < -BEHIND_NS:
            raise InputError(
                f"{shot.topic} at {shot.stamp_ns} ns is {away_ns * 1e-9:+.1f} s from the joint "
                "states: stamp both on one clock"
            )
        self._keep(shot)

    def come(self, joints_ns: int) -> list[Shot]:
        """Take the shots whose joint readings have come."""
        found = self.ahead.come(joints_ns) if self.ahead else []
        for shot in found:
            self._keep(shot)
        return found

    def _keep(self, shot: Shot) -> None:
        self._shots.append(shot)
        self._bytes += shot.size
        while len(self._shots) > MOST_KEPT or (self._bytes > MOST_BYTES and len(self._shots) > 1):
            self._bytes -= self._shots.popleft().size

    def since(self, topic: str, from_ns: int) -> Iterator[Shot]:
        """Shots of a topic from a stamp on, by stamp."""
        found = [s for s in self._shots if s.topic == topic and s.stamp_ns >= from_ns]
        return iter(sorted(found, key=lambda shot: shot.stamp_ns))

    def at(self, topic: str, at_ns: int) -> Shot:
        """The shot of a stamp. Raises `InputError` when there is none."""
        shot = next(self.since(topic, at_ns), None)
        if shot is None or shot.stamp_ns != at_ns:
            raise InputError(f"no {topic} of {at_ns} ns was received")
        return shot

    def clear(self) -> None:
        """Forget all."""
        self._shots.clear()
        self.ahead.clear()
        self._bytes = 0


@dataclass(frozen=True, eq=False)
class StandingShot:
    """A profile, named by its number in the recording, and the mean joints (n,) of its standstill.

    ``mark``: of a staircase, where the recording tells it; else empty.
    """

    name: str
    shot: Shot
    q: Array
    mark: str = ""


class Standstills:
    """Pairs profiles with standstills, as a session does for a capture.

    ``found``: shots in the order of the recording. ``rejected``: name of each other profile, and
    why it is none. ``ignored``: joint readings that were not used.
    """

    def __init__(
        self, joint_names: tuple[str, ...], rule: StandstillRule, sensor: SensorDescription
    ) -> None:
        self._stream, self._rule, self._sensor = JointStream(joint_names), rule, sensor
        self._waiting: deque[tuple[str, Shot]] = deque()
        self._count, self._frame = 0, ""
        self.found: list[StandingShot] = []
        self.rejected: dict[str, str] = {}
        self.ignored = Ignored()

    def take(self, kind: str, message: Any) -> None:
        """Take a message of an input; one that cannot be used is counted, or named."""
        if kind == PROFILE:
            self._take_profile(message)
        elif kind == JOINTS:
            try:
                self._stream.add(joint_sample(message), GAP_NS)
            except RobocalError as error:
                self.ignored.add(kind, str(error))
        while self._waiting and self._settled(*self._waiting[0]):
            self._waiting.popleft()

    def close(self) -> None:
        """No more messages come."""
        for name, shot in self._waiting:
            told = self.ignored.words() or "the recording ends, or its clocks differ"
            self.rejected[name] = f"no joint readings about {shot.stamp_ns} ns: {told}"
        self._waiting.clear()

    def _take_profile(self, message: Any) -> None:
        self._count += 1
        name = f"shot_{self._count:02d}"
        try:
            shot = shot_of(PROFILE, message, self._sensor)
            shot.read()
        except RobocalError as error:
            self.rejected[name] = str(error)
            return
        self._frame = self._frame or shot.frame
        if shot.frame == self._frame:
            self._waiting.append((name, shot))
        else:
            told = f"in frame '{shot.frame}', those before it in '{self._frame}'"
            self.rejected[name] = f"of another sensor: {told}"

    def _settled(self, name: str, shot: Shot) -> bool:
        try:
            q = self._stream.resting(shot.stamp_ns, self._rule)
        except NotStillError as error:
            self.rejected[name] = f"not at standstill: {error}"
            return True
        if q is None:
            return False
        self.found.append(StandingShot(name, shot, q))
        return True


def captured_marks(commands: Sequence[tuple[Command, Mapping[str, Any]]]) -> dict[int, str] | None:
    """Stamp and mark of the shots that a recorded session holds in the end.

    ``commands``: each with its recorded outcome. None: they tell of no data set.
    """
    begun = False
    asked: dict[int, str] = {}
    stamps: dict[int, int] = {}
    for command, outcome in commands:
        name, arguments = command.name, command.arguments
        if outcome["status"] != Code.ACCEPT:
            continue
        begun |= name in (events.START, events.LOAD, events.SAMPLE)
        if name in (events.START, events.LOAD):
            asked, stamps = {}, {}
        elif name == events.CAPTURE:
            asked[int(arguments["handle"])] = str(arguments.get("mark", ""))
        elif name == events.SAMPLE:
            stamps[int(arguments["handle"])] = int(arguments["shot_ns"])
        elif name == events.REMOVE:
            stamps.pop(int(arguments["handle"]), None)
    return {at: asked.get(handle, "") for handle, at in stamps.items()} if begun else None


def first_of_each(
    found: Sequence[StandingShot], tolerance_rad: float
) -> tuple[list[StandingShot], dict[str, str]]:
    """The first shot of each standstill, and why the others are left out.

    What errs in a pose is common to all shots from it: they are not measurements of their own.
    """
    kept: list[StandingShot] = []
    rejected: dict[str, str] = {}
    for one in found:
        if kept and float(np.max(np.abs(one.q - kept[-1].q))) <= tolerance_rad:
            rejected[one.name] = f"taken at the same standstill as {kept[-1].name}"
        else:
            kept.append(one)
    return kept, rejected


Feature = Literal["edge", "groove"]

IN_HAND: Mount = "in-hand"
TO_HAND: Mount = "to-hand"
MOUNTS = (IN_HAND, TO_HAND)
TRACKER, POINT = "tracker", "point"  # the target of a laser tracker's method; marked points
SCAN = "scan"  # mark of what the sensor sees of a tracker's target
WITHOUT_FILE = ("line", "camera", POINT)  # solved with the sensor's place, or touched
FEATURES: tuple[Feature, ...] = ("edge", "groove")
TOPIC_OF = {
    "sphere": PROFILE, "step": PROFILE, "line": PROFILE, "camera": TARGET_POSE,
    TRACKER: TRACKER_POINT, POINT: PROFILE,
}  # fmt: skip

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

    def arm(self, nominal: SerialArm) -> SerialArm:
        """The robot by it. Raises as `arm_of`."""
        return nominal if self.model is None else arm_of(self.model, nominal)


class PoseModels:
    """The models of a session; ``began_with`` was in force at its beginning."""

    def __init__(self, began_with: Head) -> None:
        self._began_with = began_with.revision
        self._newest = PoseModel(began_with.revision, began_with.model)

    def of(self, command: Command, in_force: Head) -> tuple[PoseModel, Command]:
        """The model of a sample that a command takes, and the command, which says it if need be.

        That is where another than at the beginning is in force: so a replay, which knows that of
        the beginning, takes the same flange poses.
        """
        told = command.arguments.get(THERMAL_MODEL)
        if told is None:
            told = {"revision": in_force.revision, "model": in_force.model}
            if in_force.revision != self._began_with:
                arguments = {**command.arguments, THERMAL_MODEL: told}
                command = replace(command, arguments=arguments)
        if self._newest.revision != told["revision"]:
            self._newest = PoseModel(int(told["revision"]), told["model"])
        return self._newest, command


@dataclass(eq=False)
class HandEyeSample:
    """What was seen at one standstill.

    ``handle``: its name. ``mark``: of a step target the mark that the laser plane lies through, of
    a tracker's one of `ROLES` or `SCAN`, of marked points the name; else empty. ``stamp_ns``: of
    the shot. ``q`` (n,) mean of the joint readings at standstill, rad (prismatic: m). ``values``:
    see `Shot.read`; of an image `seen_corners`. ``thermal``: what was in force then, so that a set
    of a cold robot stays one.
    """

    handle: int
    mark: str
    stamp_ns: int
    q: Array
    values: Array
    thermal: PoseModel

    @property
    def profile(self) -> Profile:
        """What a line laser saw, named by the handle."""
        return Profile(self.values, str(self.handle))


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

    ``target``: document of the target, with its ``kind``.
    ``method``: best or classic; ``mount`` in-hand or to-hand; ``feature`` of a line, in a profile.
    ``captures``, ``samples``: by handle; a capture that failed or waits has no sample.
    ``candidate``: the last calibration in the history; 0 without.
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

    def topic_of(self, mark: str) -> str:
        """The input that shows what is captured with a mark."""
        return PROFILE if self.kind == TRACKER and mark == SCAN else self.topic

    @property
    def waiting(self) -> Capture | None:
        """The capture that waits; None while there is none."""
        return next((c for c in self.captures.values() if c.code is Code.NONE), None)

    def require_mark(self, mark: str) -> None:
        """Refuse a mark that the target does not have; marked points are named freely.

        Raises `InputError`, naming those that there are.
        """
        if self.kind == POINT:
            if not mark.strip():
                raise InputError("mark is empty: name the point that the laser line passes")
            return
        known = tuple(self.target.get("corners", ("",)))
        if self.kind == TRACKER:
            known = (*ROLES, SCAN)
        if mark not in known:
            words = ", ".join(known) if any(known) else "none"
            raise InputError(f"mark '{mark}' is none of the target's: {words}")

    def put(self, sample: HandEyeSample) -> str:
        """Add a sample; says what it is. Raises `InputError` when it cannot be one of this set."""
        count = len(sample.values)
        topic = self.topic_of(sample.mark)
        seen = f"{count} points" if topic == PROFILE else "the target's pose"
        if topic == TRACKER_POINT:
            seen = f"a point of {sample.mark}"
        elif topic == IMAGE:
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
        board_of(self.target).board.seen(values[1:])
        first = next(iter(self.samples.values()), None)
        expected = self.target.get("size") or (values if first is None else first.values)[0, :2]
        if not np.array_equal(values[0, :2], expected):
            found, wanted = ("{:.0f}x{:.0f} px".format(*size[:2]) for size in (values[0], expected))
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

        ``thermal`` of a sample: index of its model among ``thermal_models``; ``topic``: its input,
        where that is not the set's.
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
                | ({} if (own := self.topic_of(sample.mark)) == self.topic else {"topic": own})
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
            sample = _sample_of(row, found.topic_of(str(row["mark"])), arm, models)
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
        values = values if values.ndim == 2 else values.reshape(-1, 2)
    elif topic == TRACKER_POINT:
        values = values.reshape(1, 3)
    elif values.shape != (1, 7) or abs(float(np.linalg.norm(values[0, 3:])) - 1.0) > UNIT:
        raise InputError(f"sample {handle} of the data set is no pose: {values.tolist()}")
    thermal = row["thermal"]
    if type(thermal) is not int or not 0 <= thermal < len(models):
        raise InputError(f"sample {handle} of the data set is of thermal model {thermal}: no such")
    return HandEyeSample(handle, str(row["mark"]), at_ns, q, values, models[thermal])


def seen_corners(target: Mapping[str, Any], shot: Shot) -> Array:
    """Width and height of an image, then the corners of the board in it: (1 + n, 2), px.

    Of a ChArUco board (1 + k, 3), with the number of each corner that is seen.

    Raises `InputError` when the image does not show the board.
    """
    board = board_of(target).board
    image = shot.read()
    corners = find_corners(image, board)
    if corners is None:
        raise InputError(
            f"no {board} in the image of {shot.stamp_ns} ns: look for light, focus, and that "
            f"{'enough' if board.markers else 'all'} of the board is in sight"
        )
    width_height = np.zeros((1, corners.shape[1]))
    width_height[0, :2] = image.shape[::-1]
    return np.vstack([width_height, corners])


def board_of(target: Mapping[str, Any]) -> BoardTarget:
    """The board that a document of a target describes.

    Raises `InputError` when it describes none.
    """
    found = target_of(target)
    if not isinstance(found, BoardTarget):
        raise InputError(f"a {target['kind']} without a board shows no corners")
    return found
