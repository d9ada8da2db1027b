"""Joints must come from the controller or the planner, not from a node that corrected them."""

from rclpy.node import Node

from robocal_ros.ground.samples import JOINTS, UNCORRECTED
from robocal_ros.motion.graph import UNKNOWN, publishers

_STATUS = "robocal_msgs/msg/CorrectionStatus"  # who publishes it is a correction node


class SourceGuard:
    """Looks at who publishes a topic: a correction node, whatever its name, must not.

    Attributes
    ----------
    fault : why the readings must not be used; empty when they may.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self._topic = node.resolve_topic_name(topic)
        self._why = (
            "its joint states are un-corrected, subscribe the robot's"
            if topic.rsplit("/", 1)[-1] == JOINTS
            else "it is corrected already, subscribe what the planner publishes"
        )
        self.fault = ""
        self._hinted = UNCORRECTED in self._topic
        if self._hinted:
            self.fault = f"{self._topic} comes from a correction node: {self._why}"

    def fault_at(self, received: int) -> str:
        """The fault, when so many readings were received; before the first one it looks."""
        if not received:
            self.look()
        return self.fault

    def look(self) -> None:
        """Look again; before its publishers are discovered the topic's name is a hint."""
        found = set(publishers(self._node, self._topic))
        if self._hinted and (not found or any(one.name.endswith(UNKNOWN) for one in found)):
            return
        correcting = {
            who
            for topic, kinds in self._node.get_topic_names_and_types()
            if _STATUS in kinds
            for who in publishers(self._node, topic)
        }
        culprits = sorted({one.name for one in found & correcting})
        self.fault = (
            f"{self._topic} is published by {', '.join(culprits)}: {self._why}" if culprits else ""
        )
