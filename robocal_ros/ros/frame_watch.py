"""Whether other nodes put a frame onto tf, below another parent or with another pose."""

import time
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile
from rclpy.task import Future

from robocal_ros.ground import frames
from robocal_ros.ros import endpoints
from robocal_ros.ros.endpoints import NotActiveError

Array = NDArray[np.float64]

MANY_LATCHED = QoSProfile(
    depth=100, reliability=endpoints.LATCHED.reliability, durability=endpoints.LATCHED.durability
)

STATIC, MOVING = "/tf_static", "/tf"
SETTLE_S = 2.0  # until what others have latched, or publish again and again, has arrived
FRESH_S = 5.0  # what was heard so lately is not listened for again
SAME_M, SAME_RAD = 1e-6, 1e-6  # a pose that was written as text and read again


class FrameWatch:
    """Listens to tf for one child frame: all the time to what is latched on ``/tf_static``, to
    ``/tf``, which is many messages, for `SETTLE_S` when it is asked to. Without tf2_msgs it hears
    nothing.

    ``own``: the transforms that the node itself has published, which grow as it publishes more.

    Attributes
    ----------
    settled : whether it has listened for so long that what others put onto tf was heard.
    """

    def __init__(self, node: LifecycleNode, child: str, own: Sequence[Any]) -> None:
        self._node, self._child, self._own = node, child, own
        self._seen: dict[str, Any] = {}
        self._publishers = 0
        self._subscriptions: dict[str, Any] = {}
        self._waiting: deque[Future] = deque()
        self._since = self._ended = 0.0
        self._listen_anew()

    def _listen_anew(self) -> None:
        self.settled, self._since = False, time.monotonic()
        self._subscribe(STATIC, MANY_LATCHED)
        self._subscribe(MOVING, endpoints.SENSOR)

    def _subscribe(self, topic: str, profile: QoSProfile) -> None:
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            return
        if topic not in self._subscriptions:
            made = self._node.create_subscription(
                TFMessage, topic, self._take, endpoints.own(profile)
            )
            self._subscriptions[topic] = made

    def _unsubscribe(self, topic: str) -> None:
        if topic in self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop(topic))

    def listen(self) -> None:
        """Listen to all again, unless it has just done so."""
        if self.settled and time.monotonic() - self._ended > FRESH_S:
            self._listen_anew()

    def heard(self) -> Future:
        """Listen; the future is done once all was heard."""
        self.listen()
        future: Future = Future()
        self._waiting.append(future)
        self.tick()
        return future

    def tick(self) -> None:
        """End what it listens to ``/tf`` when it was long enough."""
        now = time.monotonic()
        if not self.settled and now - self._since >= SETTLE_S:
            self._unsubscribe(MOVING)
            self.settled, self._ended = True, now
        while self.settled and self._waiting:
            self._waiting.popleft().set_result(None)

    def look(self) -> None:
        """Listen anew when a publisher has come; or gone: what it said holds no more."""
        publishers = sum(self._node.count_publishers(topic) for topic in (STATIC, MOVING))
        if publishers < self._publishers:
            self._unsubscribe(STATIC)
            self._unsubscribe(MOVING)
            self._seen.clear()
            self._listen_anew()
        elif publishers > self._publishers and self.settled:
            self._listen_anew()
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
        """Hear no more; who waits is answered."""
        self._unsubscribe(STATIC)
        self._unsubscribe(MOVING)
        while self._waiting:
            error = NotActiveError("deactivated while it listened to tf: nothing was done")
            self._waiting.popleft().set_exception(error)


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
