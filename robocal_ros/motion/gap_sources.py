"""``gap_open`` on the graph: its messages, and who publishes them."""

from collections.abc import Callable
from typing import Any

from rclpy.qos import ReliabilityPolicy
from robocal_msgs.msg import GapOpen
from std_msgs.msg import Bool

from robocal_ros.ros import qos
from robocal_ros.ros.endpoints import EndpointNode
from robocal_ros.ros.parameters import Setting

GAP_OPEN = "gap_open"
STATUS = "maintenance_node/status"
GAP_BOOL = Setting(
    "gap_bool",
    False,
    "Deprecated, for one release: gap_open is std_msgs/Bool, without an echo; a bridge that "
    "repeats an old value, and a network that delays, then open the gap",
)
SHORTEST_STALE_S = 0.25  # longer than a beat
TYPES = {False: "robocal_msgs/msg/GapOpen", True: "std_msgs/msg/Bool"}


class GapSources:
    """Subscribes the heartbeat, and looks at its publishers.

    Parameters
    ----------
    is_bool : whether it is a ``std_msgs/Bool``.
    heard : takes what it says, and its echo; None where it has none.
    """

    def __init__(
        self, node: EndpointNode, is_bool: bool, heard: Callable[[bool, int | None], None]
    ) -> None:
        self._node, self._type = node, TYPES[is_bool]

        def take(message: Any) -> None:
            if is_bool:
                heard(message.data, None)
            else:
                heard(message.open, message.echo)

        heartbeat = node.add_input(Bool if is_bool else GapOpen, GAP_OPEN, take, qos.HEARTBEAT)
        self._topic = heartbeat.topic_name
        self._reliable = heartbeat.qos_profile.reliability is ReliabilityPolicy.RELIABLE
        if is_bool:
            node.get_logger().warning(
                "gap_bool: gap_open is taken as std_msgs/Bool, which bears no echo: a bridge that "
                "repeats an old value opens the gap. It goes with the next release: let the PLC "
                "publish robocal_msgs/GapOpen (docs/plc.md)"
            )

    def doubt(self) -> str:
        """Why the heartbeats must not be counted; empty when they may."""
        found = self._node.get_publishers_info_by_topic(self._topic)
        names = ", ".join(sorted(info.node_name for info in found))
        if len(found) > 1:
            return f"gap_open has {len(found)} publishers ({names}): let one alone publish it"
        for info in found:
            if info.topic_type != self._type:
                return (
                    f"gap_open of {names} is {info.topic_type} and not heard: publish {self._type}"
                )
        effort = [info.qos_profile.reliability for info in found]
        if self._reliable and ReliabilityPolicy.BEST_EFFORT in effort:
            return f"gap_open of {names} is BEST_EFFORT and not heard: publish it RELIABLE"
        return ""
