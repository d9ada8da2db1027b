# SPDX-License-Identifier: Apache-2.0
"""Who else commands the robot, or publishes its joints: by who serves and publishes on the graph.

A publisher numbers its messages, those of one publisher increase (rmw_fastrtps); what else is used
of the graph stands in `ros.graph`.
"""

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState

from robocal_ros.correction.interface import Reason
from robocal_ros.correction.messages import joint_names
from robocal_ros.ros.graph import (
    ACTION,
    KILLED,
    TRAJECTORY,
    beside,
    commanding,
    own_endpoint,
    publishers,
)

LEASE_S = 1.0  # a lease that was not renewed for so long is lost: its holder died, or hangs
STOOD_S = 1.0  # a lost one is over when the robot has stood for so long
MOST_TAKEN = 100  # joint states of a look
STEPS_BACK = 2  # of message numbers within `MEMORY_S`: one comes of a driver that was restarted
MEMORY_S = 5.0


class GraphViolation(NamedTuple):
    """Why the program must not move the robot now; as `CorrectionSession.hold` takes it."""

    reason: Reason
    detail: str


@dataclass
class _Lease:
    """What a holder said last, and when (steady clock)."""

    held: bool
    purpose: str
    heard_s: float


@dataclass
class Leases:
    """Leases of this robot (``robocal_msgs/MotionLease``), and whose motions are the cell's own."""

    robot: str
    serial: str
    others: set[str] = field(default_factory=set)  # holders that spoke of another robot only
    _held: dict[str, _Lease] = field(default_factory=dict)

    def hear(self, message: Any, now_s: float) -> None:
        """Take a message."""
        holder = str(message.holder)
        if (message.robot, message.serial) != (self.robot, self.serial):
            if holder not in self._held:
                self.others.add(holder)
            return
        self.others.discard(holder)
        self._held[holder] = _Lease(bool(message.held), str(message.purpose), now_s)

    def look(self, now_s: float, stood_s: float) -> None:
        """End what was lost, for a robot that has stood for ``stood_s``.

        What a holder that died sent is still driven: its lease lasts until the robot stands.
        """
        for lease in self._held.values():
            lost_s = now_s - lease.heard_s - LEASE_S
            if lease.held and min(lost_s, stood_s) >= STOOD_S:
                lease.held = False

    def words(self, now_s: float) -> str:
        """Who holds one, and what for; empty when nobody does."""
        return "; ".join([*self._holders(now_s, lost=False), *filter(None, [self.lost(now_s)])])

    def lost(self, now_s: float) -> str:
        """Whose lease ended by silence while the robot may still move by it; empty: nobody's."""
        return "; ".join(
            f"{holder}: it has not renewed its lease for {LEASE_S:g} s, it died or hangs, and the "
            "robot may still move by it: the lease lasts until the robot has stood for "
            f"{STOOD_S:g} s"
            for holder in self._holders(now_s, lost=True)
        )

    def _holders(self, now_s: float, *, lost: bool) -> list[str]:
        return [
            f"{holder}: {lease.purpose or 'no purpose told'}"
            for holder, lease in self._held.items()
            if lease.held and (now_s - lease.heard_s > LEASE_S) is lost
        ]


class JointSources:
    """Whether the arm's joint states come of one publisher, told by the numbers of messages.

    A second publisher of other joints (a gripper) is legitimate, and so is one that is silent. As
    long as a topic has one publisher nothing is read; else a subscription of its own, beside the
    executor, tells the number that the publisher gave each message, which rclpy's events executor
    does not.
    """

    def __init__(self, node: Node, topic: str, joints: Iterable[str]) -> None:
        self._node, self._topic = node, topic
        self._joints = frozenset(joints)
        self._last: dict[str, int] = {}  # number of the last message with a joint
        self._back: deque[float] = deque()
        self._culprits: set[str] = set()
        self._reader: Node | None = None
        self._subscription: Any = None

    def look(self, now_s: float) -> str:
        """Which joints come of several publishers; empty while one publishes each."""
        found = publishers(self._node, self._topic)
        if len(found) < 2:
            self.close()
            return ""
        if self._reader is None:
            self._open()
        self._take(now_s)
        while self._back and now_s - self._back[0] > MEMORY_S:
            self._back.popleft()
        if len(self._back) < STEPS_BACK:
            self._culprits.clear()
            return ""
        who = ", ".join(sorted(one.name for one in found))
        return (
            f"{self._topic}: {', '.join(sorted(self._culprits))} by two of {who}: end all but one"
        )

    def close(self) -> None:
        """Read no more."""
        if self._reader is not None:
            self._reader.destroy_node()
            self._reader = self._subscription = None
        self._last.clear()
        self._back.clear()
        self._culprits.clear()

    def _open(self) -> None:
        self._reader = Node(
            f"{self._node.get_name()}_joint_sources",
            context=self._node.context,
            namespace=self._node.get_namespace(),
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=MOST_TAKEN,
            reliability=ReliabilityPolicy.BEST_EFFORT,
        )
        self._subscription = self._reader.create_subscription(
            JointState, self._topic, lambda message: None, profile, raw=True
        )

    def _take(self, now_s: float) -> None:
        for _ in range(MOST_TAKEN):
            with self._subscription.handle:
                taken = self._subscription.handle.take_message(JointState, True)
            if taken is None:
                return
            data, info = taken
            number = info["publication_sequence_number"]
            names = self._joints.intersection(joint_names(data))
            if number is None or not names:
                continue
            again = {name for name in names if number <= self._last.get(name, -1)}
            if again:
                self._back.append(now_s)
                self._culprits |= again
            self._last.update(dict.fromkeys(names, number))


def commanded_by(
    node: Node, own: Sequence[str], clients: Mapping[str, int], *, by_action: bool
) -> tuple[dict[str, int], dict[str, int]]:
    """Topics and actions by which the node's controllers are commanded, as `GraphWatch` takes them.

    ``own``: resolved topics that the node publishes, the one of trajectories first; ``clients``: by
    resolved actions, how many it has. ``by_action``: whether it takes goals.
    """
    # A controller takes trajectories beside its action, on a topic that nobody here publishes.
    topics = {beside(name, TRAJECTORY): 0 for name in clients}
    topics.pop(node.resolve_topic_name(TRAJECTORY), None)  # the program's, which comes in here
    topics |= dict.fromkeys(own, 1)
    actions = dict(clients)
    if not by_action:  # and beside its topic by an action, of which none is ours
        name = beside(own[0], ACTION)
        if name != node.resolve_topic_name(f"~/{ACTION}"):
            actions[name] = 0
    return topics, actions


class GraphWatch:
    """Looks at who commands the robot and who publishes its joints.

    ``commands``: resolved topics that this node commands the robot by, and how many publishers of
    its own each has.
    ``actions``: likewise resolved names of the controller's action, and its own clients.
    ``leases``: of this robot; the managed nodes that publish on ``lease_topic`` move the robot for
    the cell, with a lease; the others of their processes do not.
    ``state_topic``: where the robot's controller, and nobody else, says where it is.
    """

    def __init__(
        self,
        node: Node,
        commands: Mapping[str, int],
        actions: Mapping[str, int],
        sources: JointSources,
        leases: Leases,
        lease_topic: str,
        state_topic: str,
    ) -> None:
        self._node, self._sources, self.leases = node, sources, leases
        self._lease_topic, self._state_topic = lease_topic, state_topic
        self._commands, self._actions = dict(commands), dict(actions)
        self._own = own_endpoint(node)
        self.commanders = ""  # who else commands the robot, or publishes its joints
        self.lease = ""  # who holds one
        self.lost = ""  # whose was not renewed while the robot may still move by it

    def look(self, now_s: float, stood_s: float = 0.0) -> GraphViolation | None:
        """Look at the graph (steady clock); why nothing may go out now, None when it may.

        ``stood_s``: how long the robot has stood, as far as that is known.
        """
        node = self._node
        leasing = publishers(node, self._lease_topic)
        cell = [one for one in leasing if one.name not in self.leases.others]
        found = commanding(node, self._own, self._commands, self._actions, cell)
        joints = self._sources.look(now_s)
        if len(controllers := publishers(node, self._state_topic)) > 1:
            who = ", ".join(sorted(one.name for one in controllers))
            found.append(f"{self._state_topic} has several publishers: {who}")
        self.commanders = "; ".join([*found, *filter(None, [joints])])
        self.leases.look(now_s, stood_s)
        self.lease, self.lost = self.leases.words(now_s), self.leases.lost(now_s)
        if self.commanders:
            return GraphViolation(Reason.OTHER_COMMANDER, f"{self.commanders}. End it; {KILLED}")
        return GraphViolation(Reason.LEASED, self.lease) if self.lease else None


class CommandSources:
    """Tells when one kind of command comes from several sources at once.

    A message does not tell who sent it. So commands that follow each other within a short time,
    while their topic has several publishers or on several topics, count as commands of several
    sources, and none of them is believed: the publishers that merely wait cannot be told apart.

    The short time is ``at_once_s``.
    """

    def __init__(self, at_once_s: float) -> None:
        self.inputs: dict[str, Subscription] = {}  # by topic
        self._at_once_s = at_once_s
        self._topic = ""
        self._heard_s = -math.inf
        self._rivals = ""
        self._rivals_s = -math.inf
        self._gone = ""

    def hear(self, topic: str, now_s: float) -> str:
        """Note a command; why it must not be acted on, empty when it may."""
        last, before_s = self._topic, self._heard_s
        self._topic, self._heard_s, self._gone = topic, now_s, ""
        if now_s - before_s <= self._at_once_s:
            # asked for each: an events executor tells of a publisher after its first message;
            # by the handle in half of the time, as nobody else can destroy the input meanwhile
            count = self.inputs[topic].handle.get_publisher_count()
            if topic != last:
                self._rivals = f"commands come on {last} and {topic} at once: stop one of them"
                self._rivals_s = now_s
            elif count > 1:
                self._rivals = f"{topic} has {count} publishers: stop all but one"
                self._rivals_s = now_s
        return self._rivals if now_s - self._rivals_s <= self._at_once_s else ""

    def look(self) -> None:
        """Notice that the publisher of a stream has gone; to be called now and then."""
        if self._topic and not self.inputs[self._topic].get_publisher_count():
            self._gone = f"nobody publishes {self._topic} any more"

    def words(self, now_s: float) -> str:
        """What is wrong; empty when all is well."""
        lately = now_s - self._rivals_s <= self._at_once_s
        return (self._rivals if lately else "") or self._gone
