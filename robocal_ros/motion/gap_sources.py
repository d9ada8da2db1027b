"""Who publishes ``gap_open``: one PLC, and so that it is heard."""

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from rclpy.subscription import Subscription


class GapSources:
    """Looks at the publishers of the heartbeat."""

    def __init__(self, node: Node, heartbeat: Subscription) -> None:
        self._node, self._topic = node, heartbeat.topic_name
        self._reliable = heartbeat.qos_profile.reliability is ReliabilityPolicy.RELIABLE

    def doubt(self) -> str:
        """Why the heartbeats must not be counted; empty when they may."""
        found = self._node.get_publishers_info_by_topic(self._topic)
        names = ", ".join(sorted(info.node_name for info in found))
        if len(found) > 1:
            return f"gap_open has {len(found)} publishers ({names}): let one alone publish it"
        effort = [info.qos_profile.reliability for info in found]
        if self._reliable and ReliabilityPolicy.BEST_EFFORT in effort:
            return f"gap_open of {names} is BEST_EFFORT and not heard: publish it RELIABLE"
        return ""
