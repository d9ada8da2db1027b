"""What the sensor sent: profiles, target poses and images, kept until a capture takes them."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.errors import InputError
from robocal_ros.core.hand_eye.profile import profile_of
from robocal_ros.core.point_clouds import cloud_points
from robocal_ros.core.samples import pose_sample, stamp_ns

Array = NDArray[np.float64]

PROFILE, TARGET_POSE, IMAGE = "profile", "target_pose", "image"
SHOTS = (PROFILE, TARGET_POSE, IMAGE)
PLANE_M = 1e-5  # a profile's points lie so near to y = 0
MOST_KEPT = 500
MOST_IMAGE_BYTES = 2**28  # of all images that are kept
AHEAD_NS, BEHIND_NS = 1_000_000_000, 10_000_000_000  # of the joints, when a shot arrives


@dataclass(frozen=True, eq=False)
class Shot:
    """One profile, target pose or image.

    ``values``: of a profile its points (n, 2), x and z, m, sensor frame; of a target pose
    (1, 7) position, m, and quaternion x, y, z, w of the target in the sensor frame; of an image
    its grey pixels (h, w), 8 bits.
    """

    topic: str
    stamp_ns: int
    frame: str
    values: NDArray[Any]


def profile_shot(message: Any) -> Shot:
    """Build a shot from a ``sensor_msgs/PointCloud2``.

    Raises
    ------
    InputError
        When the message is no cloud, or its points are not in the plane y = 0.
    TooFewSamplesError
        When nearly nothing was seen.
    """
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
    return Shot(PROFILE, at_ns, message.header.frame_id, profile.points)


def pose_shot(message: Any) -> Shot:
    """Build a shot from a ``geometry_msgs/PoseStamped``: the target in the sensor frame.

    Raises
    ------
    InputError
        When a value is not finite or the quaternion is not of unit length.
    """
    pose_sample(message)
    p, o = message.pose.position, message.pose.orientation
    values = np.array([[p.x, p.y, p.z, o.x, o.y, o.z, o.w]])
    return Shot(TARGET_POSE, stamp_ns(message.header.stamp), message.header.frame_id, values)


def target_poses(values: Array) -> Array:
    """T_sensor_target (m, 4, 4) of target poses (m, 7)."""
    return frames.transform_from_quat(values[:, :3], values[:, 3:])


class ShotLog:
    """The latest shots, oldest first."""

    def __init__(self) -> None:
        self._shots: deque[Shot] = deque(maxlen=MOST_KEPT)

    def add(self, shot: Shot, frame: str, joints_ns: int) -> None:
        """Take a shot; ``joints_ns``: newest stamp of the joints, 0 before any.

        Raises
        ------
        InputError
            When it is of another frame, or stamped on another clock than the joints.
        """
        if shot.frame != frame:
            raise InputError(
                f"{shot.topic} in frame '{shot.frame}', the sensor's frame is '{frame}': set "
                "sensor_frame, or connect the right sensor"
            )
        away_ns = shot.stamp_ns - joints_ns
        if joints_ns and not -BEHIND_NS <= away_ns <= AHEAD_NS:
            raise InputError(
                f"{shot.topic} at {shot.stamp_ns} ns is {away_ns * 1e-9:+.1f} s from the joint "
                "states: stamp both on one clock"
            )
        self._shots.append(shot)
        self._drop_images()

    def _drop_images(self) -> None:
        """Forget the oldest images beyond the memory that they may take, never the newest."""
        images = [s for s in self._shots if s.topic == IMAGE]
        taken = sum(s.values.nbytes for s in images)
        for oldest in images[:-1]:
            if taken <= MOST_IMAGE_BYTES:
                return
            self._shots.remove(oldest)
            taken -= oldest.values.nbytes

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
