"""Which parent other nodes give a frame on tf."""

from typing import Any

from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile

from robocal_ros.nodes import qos

MANY_LATCHED = QoSProfile(
    depth=100, reliability=qos.LATCHED.reliability, durability=qos.LATCHED.durability
)

TOPICS = {"/tf_static": MANY_LATCHED, "/tf": qos.SENSOR}


class FrameWatch:
    """Listens to ``/tf`` and ``/tf_static`` for one child frame; without tf2_msgs it hears nothing.

    ``own``: parents under which the node itself has published the frame.
    """

    def __init__(self, node: LifecycleNode, child: str) -> None:
        self._node, self._child = node, child
        self._seen: set[str] = set()
        self.own: set[str] = set()
        self._publishers = 0
        self._subscriptions: list[Any] = []
        self._listen()

    def _listen(self) -> None:
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            return
        for topic, profile in TOPICS.items():
            made = self._node.create_subscription(TFMessage, topic, self._take, qos.own(profile))
            self._subscriptions.append(made)

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
            if transform.child_frame_id == self._child:
                self._seen.add(transform.header.frame_id)

    def conflict(self, parent: str) -> str:
        """Why the frame cannot stand below a parent; empty when it can."""
        others = sorted(self._seen - self.own - {parent})
        if not others:
            return ""
        return (
            f"tf shows '{self._child}' below '{', '.join(others)}' already, it cannot stand below "
            f"'{parent}' too: stop the node that publishes it, or rename sensor_frame"
        )

    def close(self) -> None:
        """Hear no more."""
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop())
