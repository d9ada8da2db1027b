"""Joints must come from the controller or the planner, not from a node that corrected them."""

from rclpy.node import Node

from robocal_ros.core.samples import UNCORRECTED
from robocal_ros.sessions.observations import JOINTS

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
        if UNCORRECTED in self._topic:  # before anybody is discovered, its name is a hint
            self.fault = f"{self._topic} comes from a correction node: {self._why}"

    def fault_at(self, received: int) -> str:
        """The fault, when so many readings were received; before the first one it looks."""
        if not received:
            self.look()
        return self.fault

    def look(self) -> None:
        """Look again."""
        if UNCORRECTED in self._topic:
            return
        correcting = {
            who
            for topic, kinds in self._node.get_topic_names_and_types()
            if _STATUS in kinds
            for who in self._publishers(topic)
        }
        culprits = sorted({name for _, name in self._publishers(self._topic) & correcting})
        self.fault = (
            f"{self._topic} is published by {', '.join(culprits)}: {self._why}" if culprits else ""
        )

    def _publishers(self, topic: str) -> set[tuple[bytes, str]]:
        """DDS participant (12 bytes of the gid) and node of each publisher."""
        found = self._node.get_publishers_info_by_topic(topic)
        return {
            (
                bytes(info.endpoint_gid)[:12],
                f"{info.node_namespace.rstrip('/')}/{info.node_name}",
            )
            for info in found
        }
