"""What the sensor sent: profiles, target poses and images, kept until a capture takes them.

They are kept as they came, and read only when a capture waits: a sensor that runs freely costs
next to nothing while nobody asks.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError, RobocalError, TooFewSamplesError
from robocal_ros.ground.samples import (
    JOINTS,
    JointStream,
    NotStillError,
    StandstillRule,
    cloud_points,
    image_array,
    joint_sample,
    pose_sample,
    stamp_ns,
)
from robocal_ros.session import events
from robocal_ros.session.base import GAP_NS, Ignored
from robocal_ros.session.events import Command

Array = NDArray[np.float64]

FEWEST_POINTS = 10
NARROWEST_M, WIDEST_M = 1e-3, 20.0  # no line laser's field of view is outside of this
PROFILE, TARGET_POSE, IMAGE = "profile", "target_pose", "image"
SHOTS = (PROFILE, TARGET_POSE, IMAGE)
PLANE_M = 1e-5  # a profile's points lie so near to y = 0
MOST_KEPT, MOST_BYTES = 500, 256 << 20  # an image may wait for the joints of a second
AHEAD_NS, BEHIND_NS = 1_000_000_000, 10_000_000_000  # of the joints, when a shot arrives


@dataclass(frozen=True, eq=False)
class Profile:
    """Points of one profile.

    Attributes
    ----------
    points : (n, 2) x along the laser line and z along the beam, sensor frame, m, in the order of
        the sensor's columns; its plane is y = 0. Finite: what the sensor did not see is left out.
    name : of the shot, for reports.
    """

    points: Array
    name: str


def profile_of(points: ArrayLike, name: str) -> Profile:
    """Check and wrap points (n, 2), m; columns without a return (not-a-number) are left out.

    Raises `InputError` when the points are not (n, 2), or their extent is that of another unit;
    `TooFewSamplesError` when nearly nothing was seen.
    """
    rows = np.asarray(points, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 2:
        raise InputError(f"profile {name} has shape {rows.shape}, not (points, 2)")
    rows = rows[np.all(np.isfinite(rows), axis=1)]
    if len(rows) < FEWEST_POINTS:
        raise TooFewSamplesError(
            f"profile {name} has {len(rows)} points (at least {FEWEST_POINTS}): check the exposure "
            "and that the target is in range"
        )
    extent = float(np.ptp(rows, axis=0).max())
    if not NARROWEST_M <= extent <= WIDEST_M:
        small = extent < NARROWEST_M
        width = f"{extent * 1e3:.4g} mm" if small else f"{extent:.4g} m"
        raise InputError(
            f"profile {name} comes out {width} wide: is it a thousand times too "
            f"{'small' if small else 'large'}? A table's x_mm and z_mm hold mm, a message m"
        )
    return Profile(rows, name)


@dataclass(frozen=True, eq=False)
class Shot:
    """One profile (``PointCloud2``), target pose (``PoseStamped``) or image (``Image``)."""

    topic: str
    stamp_ns: int
    frame: str
    message: Any

    @property
    def size(self) -> int:
        """Bytes of a cloud's points or an image's pixels."""
        return len(getattr(self.message, "data", ()))

    @cached_property
    def _values(self) -> NDArray[Any]:
        return _READERS[self.topic](self.message)

    def read(self) -> NDArray[Any]:
        """Of a profile its points (n, 2), x and z, m, sensor frame; of a target pose (1, 7).

        That is position, m, and quaternion x, y, z, w of the target in the sensor frame. Of an
        image its grey pixels (h, w), 8 bits.

        Raises `InputError` when the message is no cloud or image that is read, points are not in
        the plane y = 0, a value of a pose is not finite or its quaternion is not of unit length;
        `TooFewSamplesError` when nearly nothing was seen.
        """
        return self._values


def shot_of(topic: str, message: Any) -> Shot:
    """A shot from the message of an input; its content is not looked at."""
    return Shot(topic, stamp_ns(message.header.stamp), message.header.frame_id, message)


def _points(message: Any) -> Array:
    at_ns = stamp_ns(message.header.stamp)
    points = cloud_points(message)
    points = points[np.all(np.isfinite(points), axis=1)]
    profile = profile_of(points[:, [0, 2]], f"at {at_ns} ns")
    off_m = float(np.max(np.abs(points[:, 1])))
    if off_m > PLANE_M:
        raise InputError(
            f"profile {profile.name} has points {off_m * 1e3:.4g} mm beside the plane y = 0: "
            "x is along the laser line, z along the beam; turn the sensor's axes accordingly"
        )
    return profile.points


def _pose(message: Any) -> Array:
    pose_sample(message)
    p, o = message.pose.position, message.pose.orientation
    return np.array([[p.x, p.y, p.z, o.x, o.y, o.z, o.w]])


_READERS: Mapping[str, Callable[[Any], NDArray[Any]]] = {
    PROFILE: _points,
    TARGET_POSE: _pose,
    IMAGE: image_array,
}


def target_poses(values: Array) -> Array:
    """T_sensor_target (m, 4, 4) of target poses (m, 7)."""
    return frames.transform_from_quat(values[:, :3], values[:, 3:])


class ShotLog:
    """The latest shots, oldest first."""

    def __init__(self) -> None:
        self._shots: deque[Shot] = deque()
        self._bytes = 0

    def add(self, shot: Shot, frame: str, joints_ns: int) -> None:
        """Take a shot; ``joints_ns``: newest stamp of the joints, 0 before any.

        Raises `InputError` when it is of another frame, or stamped on another clock than the
        joints, or there are no joints yet.
        """
        if shot.frame != frame:
            raise InputError(
                f"{shot.topic} in frame '{shot.frame}', the sensor's frame is '{frame}': set "
                "sensor_frame, or connect the right sensor"
            )
        if not joints_ns:
            raise InputError(f"{shot.topic} came before any joint states")
        away_ns = shot.stamp_ns - joints_ns
        if not -BEHIND_NS <= away_ns <= AHEAD_NS:
            raise InputError(
                f"{shot.topic} at {shot.stamp_ns} ns is {away_ns * 1e-9:+.1f} s from the joint "
                "states: stamp both on one clock"
            )
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

    Attributes
    ----------
    found : shots in the order of the recording.
    rejected : name of each other profile, and why it is none.
    ignored : joint readings that were not used.
    """

    def __init__(self, joint_names: tuple[str, ...], rule: StandstillRule) -> None:
        self._stream, self._rule = JointStream(joint_names), rule
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
            shot = shot_of(PROFILE, message)
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


def captured_marks(
    commands: Sequence[tuple[Command, Mapping[str, Any]]],
) -> dict[int, str] | None:
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
