"""Who else commands the robot: by who publishes and serves on the graph, never by name.

The first 12 bytes of an endpoint's gid are its participant's, one for each process (of one ROS
context): what a process publishes shares them. The client of an action is a publisher of the DDS
topic ``rq/<action>/_action/send_goalRequest``.
"""

from collections.abc import Sequence
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
    cell : topics whose publishers may command it too: each waits while another holds the lease.
    mine : topic that one node of this kind publishes for each robot; empty: `cell` tells all.

    Attributes
    ----------
    violation : who else commands the robot; empty: nobody.
    """

    def __init__(
        self, node: Node, topic: str, action: str, cell: Sequence[str], mine: str = ""
    ) -> None:
        self._node, self._mine = node, mine
        # A controller takes trajectories on the topic beside its action too.
        topics = {topic, *([f"{action.rpartition('/')[0]}/joint_trajectory"] if action else [])}
        self._paths = [(each, "publishes", each, False) for each in sorted(topics)]
        if action:
            dds = f"rq{action}/_action/send_goalRequest"
            self._paths.append((action, "is a client of", dds, True))
        self._cell = [node.resolve_topic_name(each) for each in cell]
        self.violation = ""

    def look(self) -> str:
        """Look now, before anything begins to move and twice a second; the violation."""
        found = []
        same = publishers(self._node, self._mine) if self._mine else {}
        if len(same) > 1:
            who = ", ".join(f"{name} [{gid.hex()[:24]}]" for gid, name in sorted(same.items()))
            found.append(
                f"{self._mine} has {len(same)} publishers ({who}): one node of this kind for each "
                "robot; end the others"
            )
        cell = {
            (gid[:PREFIX], who)
            for each in self._cell
            for gid, who in publishers(self._node, each).items()
        }
        for name, does, topic, dds in self._paths:
            found += [f"{who} {does} {name}" for who in self._strangers(topic, dds, cell)]
        self.violation = "; ".join(found)
        if found:
            self.violation += (
                ": nobody else may command the robot while the cell moves it; one that was killed "
                "counts until DDS gives it up, after up to 20 s"
            )
        return self.violation

    def _strangers(self, topic: str, dds: bool, cell: set[tuple[bytes, str]]) -> list[str]:
        """Names of who neither is this node nor one of the cell's."""
        found = publishers(self._node, topic, dds=dds)
        rest = [who for gid, who in found.items() if not _is_of((gid[:PREFIX], who), cell)]
        own = self._node.get_fully_qualified_name()
        if own in rest:
            rest.remove(own)
        return sorted(
            "a node that is not discovered yet" if who.endswith(UNKNOWN)
            else f"a second {own}" if who == own
            else who
            for who in rest
        )  # fmt: skip


def _is_of(one: tuple[bytes, str], nodes: set[tuple[bytes, str]]) -> bool:
    """Whether it is one of these nodes, as far as their names are discovered.

    Another node of the same process is not: programs are composed of many.
    """
    return any(
        one[0] == participant
        and (one[1] == name or any(each.endswith(UNKNOWN) for each in (one[1], name)))
        for participant, name in nodes
    )
