# SPDX-License-Identifier: Apache-2.0
"""What the sensor of a measuring robot sees, in base: by the model in force, where the robot was.

A point is measured at one instant and has the joints of that instant, in motion too; live it waits
for the joint reading after its stamp, so that the place does not depend on which topic came first.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import JointStream, cloud_points, stamp_ns
from robocal_ros.kinematics import SerialArm

LONGEST_GAP_S = 0.05  # between two joint readings; at 10 rad/s^2 the line misses by 3 mrad
MOST_WAITING = 200  # shots that wait for joints: more means that none come
AHEAD_NS = 1_000_000_000  # of a shot before the newest joints: more is another clock


@dataclass(frozen=True, eq=False)
class SensorShot:
    """Points (m, 3), m, of one instant in the sensor; ``name`` says to the caller what it is."""

    stamp_ns: int
    frame: str
    points: Array
    name: str = ""

    def require_usable(self) -> None:
        """Raise `InputError` when it has no stamp, or holds what is not finite."""
        if self.stamp_ns <= 0:
            raise InputError("no time stamp")
        if not len(self.points) or not np.all(np.isfinite(self.points)):
            raise InputError("points must be finite, one at least")


def shot_of(message: Any, name: str) -> SensorShot:
    """The shot of a ``PointStamped`` or a ``PointCloud2``, without points that are missing.

    Raises as `cloud_points`.
    """
    if hasattr(message, "point"):
        p = message.point
        points = np.array([[p.x, p.y, p.z]])
    else:
        points = cloud_points(message)
        points = points[np.all(np.isfinite(points), axis=1)]
    frame = message.header.frame_id.lstrip("/")
    return SensorShot(stamp_ns(message.header.stamp), frame, points, name)


@dataclass(frozen=True, eq=False)
class PlacedShot:
    """A shot with the joints (n,), the flange T_base_flange (4, 4) and points (m, 3) in base, m."""

    shot: SensorShot
    q: Array
    T_base_flange: Array
    points: Array


def placed_shot(
    shot: SensorShot, stream: JointStream, arm: SerialArm, T_flange_sensor: Array
) -> PlacedShot:
    """A shot with the joints of its instant.

    Raises `InputError` when they are missing, or too far apart.
    """
    q = stream.at(shot.stamp_ns, LONGEST_GAP_S)
    T = arm.fk(q)
    return PlacedShot(shot, q, T, frames.apply(T @ T_flange_sensor, shot.points))


@dataclass
class PointQueue:
    """Shots that wait for the joints of their instant, in the order in which they came."""

    stream: JointStream
    _waiting: deque[SensorShot] = field(default_factory=deque)

    def add(self, shot: SensorShot) -> None:
        """Take a shot.

        Raises `InputError` when it has no stamp, is stamped far ahead of the joints, holds what is
        not finite, or too many wait already.
        """
        shot.require_usable()
        newest = self.stream.newest_ns
        if newest is not None and shot.stamp_ns > newest + AHEAD_NS:
            raise _ahead(shot.stamp_ns - newest)
        if len(self._waiting) >= MOST_WAITING:
            raise InputError(f"{MOST_WAITING} wait for joint states: does the driver publish them?")
        self._waiting.append(shot)

    def ready(
        self, arm: SerialArm, T_flange_sensor: Array
    ) -> Iterator[tuple[SensorShot, PlacedShot | RobocalError]]:
        """Shots whose joints are complete, with their places or why there are none.

        One that came before any joints may be stamped far ahead of them: the others do not wait
        for it.
        """
        newest = self.stream.newest_ns
        while newest is not None and self._waiting:
            ahead_ns = self._waiting[0].stamp_ns - newest
            if 0 < ahead_ns <= AHEAD_NS:
                return
            shot = self._waiting.popleft()
            if ahead_ns > 0:
                yield shot, _ahead(ahead_ns)
                continue
            try:
                yield shot, placed_shot(shot, self.stream, arm, T_flange_sensor)
            except RobocalError as error:
                yield shot, error

    def end(self) -> Iterator[tuple[SensorShot, RobocalError]]:
        """Shots that still wait, when no more joints will come."""
        while self._waiting:
            yield self._waiting.popleft(), InputError("no joint readings after the measurement")


def _ahead(ahead_ns: int) -> InputError:
    return InputError(
        f"stamped {1e-9 * ahead_ns:.1f} s ahead of the joint states: stamp both on one clock"
    )
