"""Who else commands the robot, or publishes its joints: by who serves and publishes on the graph.

Names of nodes only make the words readable. Facts used, of rmw_fastrtps and Fast DDS:

- The first 12 bytes of an endpoint's gid are its participant's prefix, one per ROS context: what a
  process publishes and serves shares them (a process of two contexts has two).
- A client of an action is a publisher of the DDS topic ``rq/<action>/_action/send_goalRequest``.
- A publisher numbers its messages: those of one publisher increase.
"""

import math
import uuid
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Empty

from robocal_ros.correction.refusals import Reason
from robocal_ros.correction.wire import joint_names

LEASE_S = 1.0  # a lease that was not renewed for so long is lost: its holder died, or hangs
STOOD_S = 1.0  # a lost one is over when the robot has stood for so long
PREFIX = 12  # bytes of a gid
MOST_TAKEN = 100  # joint states of a look
STEPS_BACK = 2  # of message numbers within `MEMORY_S`: one comes of a driver that was restarted
MEMORY_S = 5.0
UNKNOWN = "_NODE_NAME_UNKNOWN_"  # of a node that is not yet, or no longer, discovered


class GraphViolation(NamedTuple):
    """Why the program must not move the robot now; as `CorrectionSession.hold` takes it."""

    reason: Reason
    detail: str


class Endpoint(NamedTuple):
    """Who publishes something: DDS participant, and fully qualified name of the node."""

    participant: bytes
    name: str

    def may_be_node_of(self, other: "Endpoint") -> bool:
        """Whether it is of the same node, as far as the nodes' names are discovered."""
        return self.participant == other.participant and (
            self.name == other.name or any(one.name.endswith(UNKNOWN) for one in (self, other))
        )


def publishers(node: Node, topic: str, *, dds: bool = False) -> list[Endpoint]:
    """Who publishes a resolved ROS topic, or the DDS topic of that name."""
    found = node.get_publishers_info_by_topic(topic, no_mangle=dds)
    return [
        Endpoint(
            bytes(info.endpoint_gid)[:PREFIX], f"{info.node_namespace.rstrip('/')}/{info.node_name}"
        )
        for info in found
    ]


def own_participant(node: Node) -> bytes:
    """The participant of ``node``: of a topic that nobody else can know."""
    topic = f"{node.get_fully_qualified_name()}/identity_{uuid.uuid4().hex}"
    publisher = node.create_publisher(Empty, topic, 1)
    try:
        (own,) = publishers(node, topic)  # an own endpoint is known at once
    finally:
        node.destroy_publisher(publisher)
    return own.participant


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
        held = [
            f"{holder}: {lease.purpose or 'no purpose told'}"
            for holder, lease in self._held.items()
            if lease.held and now_s - lease.heard_s <= LEASE_S
        ]
        return "; ".join([*held, *filter(None, [self.lost(now_s)])])

    def lost(self, now_s: float) -> str:
        """Whose lease ended by silence while the robot may still move by it; empty: nobody's."""
        return "; ".join(
            f"{holder}: {lease.purpose or 'no purpose told'}: it has not renewed its lease for "
            f"{LEASE_S:g} s, it died or hangs, and the robot may still move by it: the lease "
            f"lasts until the robot has stood for {STOOD_S:g} s"
            for holder, lease in self._held.items()
            if lease.held and now_s - lease.heard_s > LEASE_S
        )


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


class GraphWatch:
    """Looks at who commands the robot and who publishes its joints.

    Parameters
    ----------
    commands : resolved topics that this node commands the robot by, and how many publishers of
        its own each has.
    actions : likewise resolved names of the controller's action, and its own clients.
    leases : of this robot; the nodes that publish on ``lease_topic`` move the robot for the cell,
        with a lease; the others of their processes do not.
    """

    def __init__(
        self,
        node: Node,
        commands: Mapping[str, int],
        actions: Mapping[str, int],
        sources: JointSources,
        leases: Leases,
        lease_topic: str,
    ) -> None:
        self._node, self._sources, self.leases = node, sources, leases
        self._lease_topic = lease_topic
        self._asked = [
            (topic, "publishes", own, topic, False) for topic, own in commands.items()
        ] + [
            (name, "is a client of", own, f"rq{name}/_action/send_goalRequest", True)
            for name, own in actions.items()
        ]
        self._own = Endpoint(own_participant(node), node.get_fully_qualified_name())
        self.commanders = ""  # who else commands the robot, or publishes its joints
        self.lease = ""  # who holds one
        self.lost = ""  # whose was not renewed while the robot may still move by it

    def look(self, now_s: float, stood_s: float = 0.0) -> GraphViolation | None:
        """Look at the graph (steady clock); why nothing may go out now, None when it may.

        ``stood_s``: how long the robot has stood, as far as that is known.
        """
        leasing = publishers(self._node, self._lease_topic)
        cell = [one for one in leasing if one.name not in self.leases.others]
        found = []
        for subject, does, own, topic, dds in self._asked:
            who = publishers(self._node, topic, dds=dds)
            found += [f"{name} {does} {subject}" for name in self._strangers(who, own, cell)]
        joints = self._sources.look(now_s)
        self.commanders = "; ".join([*found, *filter(None, [joints])])
        self.leases.look(now_s, stood_s)
        self.lease, self.lost = self.leases.words(now_s), self.leases.lost(now_s)
        if self.commanders:
            return GraphViolation(
                Reason.OTHER_COMMANDER,
                f"{self.commanders}. End it; one that was killed counts until DDS gives it up, "
                "after up to 20 s",
            )
        return GraphViolation(Reason.LEASED, self.lease) if self.lease else None

    def _strangers(self, who: list[Endpoint], own: int, cell: list[Endpoint]) -> list[str]:
        """Names of who neither is this node nor moves the robot for the cell."""
        ours = [one for one in who if one == self._own]
        rest = [
            one
            for one in who
            if one != self._own and not any(one.may_be_node_of(holder) for holder in cell)
        ]
        names = [_name(one, self._own.name) for one in rest]
        if len(ours) > own:
            names.append(f"a second {self._own.name} in this process")
        return sorted(names)

    def close(self) -> None:
        """Release what was opened."""
        self._sources.close()


def _name(one: Endpoint, own: str) -> str:
    if one.name.endswith(UNKNOWN):
        return "a node that is not discovered yet"
    return f"a second {own}" if one.name == own else one.name


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
            if topic != last:
                self._name(f"commands come on {last} and {topic} at once: stop one of them", now_s)
            elif (count := self.inputs[topic].get_publisher_count()) > 1:
                self._name(f"{topic} has {count} publishers: stop all but one", now_s)
        return self._rivals_at(now_s)

    def _name(self, rivals: str, now_s: float) -> None:
        self._rivals, self._rivals_s = rivals, now_s

    def _rivals_at(self, now_s: float) -> str:
        return self._rivals if now_s - self._rivals_s <= self._at_once_s else ""

    def look(self) -> None:
        """Notice that the publisher of a stream has gone; to be called now and then."""
        if self._topic and not self.inputs[self._topic].get_publisher_count():
            self._gone = f"nobody publishes {self._topic} any more"

    def words(self, now_s: float) -> str:
        """What is wrong; empty when all is well."""
        return self._rivals_at(now_s) or self._gone
