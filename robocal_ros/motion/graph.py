"""Who else commands the robot: by who publishes and serves on the graph, never by name.

The first 12 bytes of an endpoint's gid are its participant's, one for each process (of one ROS
context): what a process publishes shares them. The client of an action is a publisher of the DDS
topic ``rq/<action>/_action/send_goalRequest``.
"""

from typing import Any

from rclpy.node import Node

PREFIX = 12  # bytes of a gid
UNKNOWN = "_NODE_NAME_UNKNOWN_"  # of a node that is not yet, or no longer, discovered


def publishers(node: Node, topic: str, *, dds: bool = False) -> dict[bytes, str]:
    """Endpoints that publish a resolved topic: gid, and the node's name for people."""
    found: Any = node.get_publishers_info_by_topic(topic, no_mangle=dds)
    return {
        bytes(info.endpoint_gid): f"{info.node_namespace.rstrip('/')}/{info.node_name}"
        for info in found
    }


class CommandPath:
    """Looks at who commands a robot.

    Parameters
    ----------
    topic, action : resolved names by which this node commands it; an empty action is none.
    ours : topics that the cell's own nodes publish, who may command it too.

    Attributes
    ----------
    second : that another node does the same work, and which; empty: none does.
    strangers : who commands the robot and is none of the cell's nodes; empty: nobody.
    """

    def __init__(self, node: Node, topic: str, action: str, *ours: str) -> None:
        self._node, self._paths = node, [(topic, "publishes", topic, False)]
        if action:
            dds = f"rq{action}/_action/send_goalRequest"
            self._paths.append((action, "is a client of", dds, True))
        self._ours = [node.resolve_topic_name(each) for each in (*ours, "motion_lease")]
        self.second = self.strangers = ""

    def look(self, mine: str) -> None:
        """Look now; ``mine``: a topic that one node of this kind publishes for each robot."""
        node = self._node
        same = publishers(node, mine)
        self.second = ""
        if len(same) > 1:
            who = ", ".join(f"{name} [{gid.hex()[:24]}]" for gid, name in sorted(same.items()))
            self.second = (
                f"{mine} has {len(same)} publishers ({who}): one maintenance node for each robot; "
                "end the others. One that was killed counts until DDS gives it up, after up to 20 s"
            )
        ours = {gid[:PREFIX] for each in self._ours for gid in publishers(node, each)}
        found = []
        for name, does, topic, dds in self._paths:
            others = publishers(node, topic, dds=dds).items()
            found += [f"{who} {does} {name}" for gid, who in others if gid[:PREFIX] not in ours]
        self.strangers = ""
        if found:
            self.strangers = (
                f"{'; '.join(sorted(found))}: while a cycle runs nobody else may command the robot"
            )
