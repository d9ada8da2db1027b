"""What the sensor sent: profiles, target poses and images, kept until a capture takes them.

They are kept as they came, and read only when a capture waits: a sensor that runs freely costs
next to nothing while nobody asks.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import cloud_points, image_array, pose_sample, stamp_ns
from robocal_ros.hand_eye.profile import profile_of

Array = NDArray[np.float64]

PROFILE, TARGET_POSE, IMAGE = "profile", "target_pose", "image"
SHOTS = (PROFILE, TARGET_POSE, IMAGE)
PLANE_M = 1e-5  # a profile's points lie so near to y = 0
MOST_KEPT, MOST_BYTES = 500, 256 << 20  # an image may wait for the joints of a second
AHEAD_NS, BEHIND_NS = 1_000_000_000, 10_000_000_000  # of the joints, when a shot arrives


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

        Raises
        ------
        InputError
            When the message is no cloud or image that is read, points are not in the plane y = 0,
            a value of a pose is not finite or its quaternion is not of unit length.
        TooFewSamplesError
            When nearly nothing was seen.
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

        Raises
        ------
        InputError
            When it is of another frame, or stamped on another clock than the joints, or there are
        no joints yet whose clock it could be held against.
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
        """The shot of a stamp.

        Raises
        ------
        InputError
            When there is none.
        """
        shot = next(self.since(topic, at_ns), None)
        if shot is None or shot.stamp_ns != at_ns:
            raise InputError(f"no {topic} of {at_ns} ns was received")
        return shot

    def clear(self) -> None:
        """Forget all."""
        self._shots.clear()
        self._bytes = 0
