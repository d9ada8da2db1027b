"""Joints must come from the controller or the planner, not from a node that corrected them."""

from rclpy.node import Node

from robocal_ros.core.samples import UNCORRECTED
from robocal_ros.sessions.observations import JOINTS

_UNKNOWN = "_NODE_NAME_UNKNOWN_"  # not yet discovered


class SourceGuard:
    """Looks at who publishes a topic.

    Attributes
    ----------
    fault : why the readings must not be used; empty when they may.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self._topic = node.resolve_topic_name(topic)
        self._known = -1
        states = topic.rsplit("/", 1)[-1] == JOINTS
        self._why = (
            "its joint states are un-corrected, subscribe the robot's"
            if states
            else "it is corrected already, subscribe what the planner publishes"
        )
        self.fault = ""
        if UNCORRECTED in self._topic:
            self.fault = f"{self._topic} comes from a correction node: {self._why}"

    def fault_at(self, received: int) -> str:
        """The fault, when so many readings were received; before the first one it looks."""
        if not received:
            self.look()
        return self.fault

    def look(self) -> None:
        """Look again when the number of publishers changed; cheap otherwise."""
        count = self._node.count_publishers(self._topic)
        if count == self._known or UNCORRECTED in self._topic:
            return
        infos = self._node.get_publishers_info_by_topic(self._topic)
        names = sorted({info.node_name for info in infos})
        self._known = -1 if _UNKNOWN in names else count
        culprits = [name for name in names if UNCORRECTED in name]
        self.fault = (
            f"{self._topic} is published by {', '.join(culprits)}: {self._why}" if culprits else ""
        )
