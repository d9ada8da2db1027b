"""Whether other nodes put a frame onto tf, below another parent or with another pose."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile

from robocal_ros.core import frames
from robocal_ros.nodes import qos

Array = NDArray[np.float64]

MANY_LATCHED = QoSProfile(
    depth=100, reliability=qos.LATCHED.reliability, durability=qos.LATCHED.durability
)

TOPICS = {"/tf_static": MANY_LATCHED, "/tf": qos.SENSOR}
SETTLE_S = 2.0  # until what others have latched has arrived
SAME_M, SAME_RAD = 1e-6, 1e-6  # a pose that was written as text and read again


class FrameWatch:
    """Listens to ``/tf`` and ``/tf_static`` for one child frame; without tf2_msgs it hears nothing.

    ``own``: the transforms that the node itself has published, which grow as it publishes more.
    """

    def __init__(self, node: LifecycleNode, child: str, own: Sequence[Any]) -> None:
        self._node, self._child, self._own = node, child, own
        self._seen: dict[str, Any] = {}
        self._publishers = 0
        self._subscriptions: list[Any] = []
        self._listen()

    def _listen(self) -> None:
        self._since = time.monotonic()
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            return
        for topic, profile in TOPICS.items():
            made = self._node.create_subscription(TFMessage, topic, self._take, qos.own(profile))
            self._subscriptions.append(made)

    @property
    def settled(self) -> bool:
        """Whether it has listened for so long that what others have latched was heard."""
        return time.monotonic() - self._since >= SETTLE_S

    def look(self) -> None:
        """Listen anew when a publisher has gone: what it said holds no more."""
        publishers = sum(self._node.count_publishers(topic) for topic in TOPICS)
        if publishers < self._publishers:
            self.close()
            self._seen.clear()
            self._listen()
        self._publishers = publishers

    def _take(self, message: Any) -> None:
        for transform in message.transforms:
            if transform.child_frame_id == self._child and transform not in self._own:
                self._seen[transform.header.frame_id] = transform.transform

    def conflict(self, parent: str, T_parent_child: Array) -> str:
        """Why the frame cannot stand below a parent with this pose (4, 4); empty when it can."""
        others = sorted(set(self._seen) - {parent})
        if others:
            return (
                f"tf shows '{self._child}' below '{', '.join(others)}' already, it cannot stand "
                f"below '{parent}' too: stop the node that publishes it, or rename sensor_frame"
            )
        if parent not in self._seen:
            return ""
        step_m, turn_rad = _apart(T_parent_child, self._seen[parent])
        if step_m <= SAME_M and turn_rad <= SAME_RAD:
            return ""
        return (
            f"tf shows '{parent}' to '{self._child}' from another node already, "
            f"{step_m * 1e3:.3f} mm and {np.degrees(turn_rad):.3f} deg apart: take the joint out "
            "of the URDF (robot_state_publisher), or give the frame another name there"
        )

    def close(self) -> None:
        """Hear no more."""
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop())


def _apart(T: Array, transform: Any) -> tuple[float, float]:
    """Distance (m) and angle (rad) of a transform from T; infinite where it has no rotation."""
    t, r = transform.translation, transform.rotation
    quat = np.array([r.x, r.y, r.z, r.w])
    norm = float(np.linalg.norm(quat))
    place = np.array([t.x, t.y, t.z])
    if not (norm > 0.5 and np.all(np.isfinite(place))):
        return np.inf, np.inf
    turn = frames.transform_from_quat(place, quat / norm)[:3, :3].T @ T[:3, :3]
    return float(np.linalg.norm(place - T[:3, 3])), float(np.linalg.norm(frames.log_rotation(turn)))
