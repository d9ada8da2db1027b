"""Joint readings must come from the controller, not from a node that un-corrected them."""

from rclpy.node import Node

from robocal_ros.sessions.replay import UNCORRECTED

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
        self.fault = ""
        if UNCORRECTED in self._topic:
            self.fault = f"{self._topic} carries un-corrected joint states: subscribe the robot's"

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
            f"{self._topic} is published by {', '.join(culprits)}: its joint states are "
            "un-corrected, subscribe the robot's"
            if culprits
            else ""
        )
