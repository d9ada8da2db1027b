# SPDX-License-Identifier: Apache-2.0
"""What other nodes do on the graph: who commands the robot, opens the gap, shows a frame on tf.

Who publishes and serves is the fact, never a name: names only make the messages readable. Facts
used, of rmw_fastrtps and Fast DDS:

- The first 12 bytes of an endpoint's gid are its participant's prefix, one per ROS context: what a
  process publishes and serves shares them (a process of two contexts has two).
- A client of an action is a publisher of the DDS topic ``rq/<action>/_action/send_goalRequest``.
- The actions of a node whose name is not discovered yet are not known (RCLError).
"""

import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rclpy._rclpy_pybind11 import RCLError
from rclpy.action import get_action_server_names_and_types_by_node
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from robocal_msgs.msg import GapOpen
from std_msgs.msg import Bool, Empty

from robocal_ros.ground import frames
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import JOINTS, RECORDED, UNCORRECTED
from robocal_ros.ros import endpoints
from robocal_ros.ros.endpoints import EndpointNode, NotActiveError
from robocal_ros.ros.parameters import Setting

PREFIX = 12  # bytes of a gid
TRAJECTORY, ACTION = "joint_trajectory", "follow_joint_trajectory"  # a controller's two inputs
_FOLLOWS = "control_msgs/action/FollowJointTrajectory"
_LIFECYCLE = "lifecycle_msgs/srv/GetState"
UNKNOWN = "_NODE_NAME_UNKNOWN_"  # of a node that is not yet, or no longer, discovered
KILLED = "one that was killed counts until DDS gives it up, after up to 20 s"


class Endpoint(NamedTuple):
    """Who publishes something: DDS participant, and fully qualified name of the node."""

    participant: bytes
    name: str

    def may_be_node_of(self, other: "Endpoint") -> bool:
        """Whether it is of the same node, as far as the nodes' names are discovered.

        Another node of the same process is not: programs are composed of many.
        """
        return self.participant == other.participant and (
            self.name == other.name or any(one.name.endswith(UNKNOWN) for one in (self, other))
        )


def publishers(node: Node, topic: str) -> list[Endpoint]:
    """Who publishes a resolved ROS topic."""
    return _endpoints(node.get_publishers_info_by_topic(topic))


def clients(node: Node, action: str) -> list[Endpoint]:
    """Who sends goals to an action of that resolved name."""
    topic = f"rq{action}/_action/send_goalRequest"
    return _endpoints(node.get_publishers_info_by_topic(topic, no_mangle=True))


def actions_beside(node: Node, topic: str) -> list[str]:
    """FollowJointTrajectory actions of the nodes that take trajectories by a resolved topic.

    joint_trajectory_controller serves ``~/follow_joint_trajectory`` beside ``~/joint_trajectory``.
    """
    found = set()
    for taker in _endpoints(node.get_subscriptions_info_by_topic(topic)):
        namespace, _, name = taker.name.rpartition("/")
        try:
            served = get_action_server_names_and_types_by_node(node, name, namespace or "/")
        except RCLError:
            continue
        found |= {action for action, kinds in served if _FOLLOWS in kinds}
    return sorted(found)


def _endpoints(found: Iterable[Any]) -> list[Endpoint]:
    return [
        Endpoint(
            bytes(info.endpoint_gid)[:PREFIX], f"{info.node_namespace.rstrip('/')}/{info.node_name}"
        )
        for info in found
    ]


def own_endpoint(node: Node) -> Endpoint:
    """What endpoints of ``node`` look like: those of a topic that nobody else can know."""
    topic = f"{node.get_fully_qualified_name()}/identity_{uuid.uuid4().hex}"
    publisher = node.create_publisher(Empty, topic, 1)
    try:
        (own,) = publishers(node, topic)  # an own endpoint is known at once
    finally:
        node.destroy_publisher(publisher)
    return own


def strangers(
    who: Iterable[Endpoint], own: Endpoint, count: int, cell: Sequence[Endpoint]
) -> list[str]:
    """Names of who neither is this node, with ``count`` endpoints, nor one of the cell's."""
    who = list(who)
    rest = [
        one for one in who if one != own and not any(one.may_be_node_of(holder) for holder in cell)
    ]
    names = [
        "a node that is not discovered yet" if one.name.endswith(UNKNOWN)
        else f"a second {own.name}" if one.name == own.name
        else one.name
        for one in rest
    ]  # fmt: skip
    if who.count(own) > count:
        names.append(f"a second {own.name} in this process")
    return sorted(names)


def _is_managed(node: Node, who: Endpoint) -> bool:
    """Whether a node serves a lifecycle, as all of the cell's do and no player of a bag does.

    One may whose name or services are not discovered yet.
    """
    if who.name.endswith(UNKNOWN):
        return True
    namespace, _, name = who.name.rpartition("/")
    try:
        served = node.get_service_names_and_types_by_node(name, namespace or "/")
    except NodeNameNonExistentError:
        return True
    return not served or any(_LIFECYCLE in kinds for _, kinds in served)


def beside(name: str, other: str) -> str:
    """The topic, or action, of a controller that takes trajectories by ``name`` too."""
    return f"{name.rpartition('/')[0]}/{other}"


def commanding(
    node: Node,
    own: Endpoint,
    topics: Mapping[str, int],
    actions: Mapping[str, int],
    cell: Sequence[Endpoint],
) -> list[str]:
    """Who else publishes a topic, or is a client of an action, in words; see `strangers`.

    By resolved names, each with how many endpoints of its own this node has there. ``cell``: who
    publishes what only the cell's nodes do; a bag's player may.
    """
    found, cell = [], [one for one in cell if _is_managed(node, one)]
    for topic, count in topics.items():
        others = strangers(publishers(node, topic), own, count, cell)
        found += [f"{who} publishes {topic}" for who in others]
    for action, count in actions.items():
        others = strangers(clients(node, action), own, count, cell)
        found += [f"{who} is a client of {action}" for who in others]
    return found


class CommandPath:
    """Looks at who commands a robot.

    ``topic``: resolved name by which this node commands it.
    ``cell``: topics whose publishers may command it too: each waits while another holds the lease.
    ``mine``: topic that one node of this kind publishes for each robot; empty: `cell` tells all.
    ``violation``: who else commands the robot, or that it is another; empty: it may be moved.
    ``other_robot``: why the robot in use is another than the one on the graph; empty: it is that.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        cell: Sequence[str],
        mine: str = "",
        other_robot: Callable[[], str] = str,
    ) -> None:
        self._node, self._topic, self._mine = node, topic, mine
        self._other_robot = other_robot
        self._cell = [node.resolve_topic_name(each) for each in cell]
        self._own = own_endpoint(node)
        self.violation = ""

    def look(self, action: str) -> str:
        """Look now, before anything begins to move and twice a second; the violation.

        ``action``: resolved name by which this node commands the robot too; empty: none.
        """
        node, found = self._node, []
        # A controller takes trajectories on the topic beside its action, and the other way round.
        topics = {self._topic, beside(action, TRAJECTORY)} if action else {self._topic}
        actions = {action: 1} if action else {beside(self._topic, ACTION): 0}
        same = publishers(node, self._mine) if self._mine else []
        if len(same) > 1:
            who = ", ".join(sorted(f"{one.name} [{one.participant.hex()}]" for one in same))
            found.append(
                f"{self._mine} has {len(same)} publishers ({who}): one node of this kind for each "
                "robot; end the others"
            )
        cell = [one for each in self._cell for one in publishers(node, each)]
        found += commanding(node, self._own, dict.fromkeys(sorted(topics), 1), actions, cell)
        others = "; ".join(found)
        if found:
            others += f": nobody else may command the robot while the cell moves it; {KILLED}"
        self.violation = "; ".join(filter(None, (self._other_robot(), others)))
        return self.violation


_STATUS = "robocal_msgs/msg/CorrectionStatus"  # who publishes it is a correction node


class SourceGuard:
    """Looks at who publishes a topic: a correction node, whatever its name, must not.

    ``fault``: why the readings must not be used; empty when they may.
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
            if _STATUS in kinds and not topic.startswith(f"{RECORDED}/")  # a player's
            for who in publishers(self._node, topic)
        }
        culprits = sorted({one.name for one in found & correcting})
        self.fault = (
            f"{self._topic} is published by {', '.join(culprits)}: {self._why}" if culprits else ""
        )


GAP_OPEN = "gap_open"
STATUS = "maintenance_node/status"
GAP_BOOL = Setting(
    "gap_bool",
    False,
    "Deprecated, for one release: gap_open is std_msgs/Bool, without an echo; a bridge that "
    "repeats an old value, and a network that delays, then open the gap",
    advanced=True,
)
SHORTEST_STALE_S = 0.25  # longer than a beat
TYPES = {False: "robocal_msgs/msg/GapOpen", True: "std_msgs/msg/Bool"}


class GapSources:
    """Subscribes the heartbeat, and looks at its publishers.

    ``is_bool``: whether it is a ``std_msgs/Bool``. ``heard``: takes what it says, and its echo;
    None where it has none.
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

        heartbeat = node.add_input(
            Bool if is_bool else GapOpen, GAP_OPEN, take, endpoints.HEARTBEAT
        )
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


MANY_LATCHED = QoSProfile(
    depth=100, reliability=endpoints.LATCHED.reliability, durability=endpoints.LATCHED.durability
)

STATIC, MOVING = "/tf_static", "/tf"
SETTLE_S = 2.0  # until what others have latched, or publish again and again, has arrived
FRESH_S = 5.0  # what was heard so lately is not listened for again
SAME_M, SAME_RAD = 1e-6, 1e-6  # a pose that was written as text and read again


class FrameWatch:
    """Listens to tf for one child frame: all the time to what is latched on ``/tf_static``, to
    ``/tf``, which is many messages, for `SETTLE_S` when it is asked to. Without tf2_msgs it hears
    nothing.

    ``own``: the transforms that the node itself has published, which grow as it publishes more.

    ``settled``: whether it has listened for so long that what others put onto tf was heard.
    """

    def __init__(self, node: LifecycleNode, child: str, own: Sequence[Any]) -> None:
        self._node, self._child, self._own = node, child, own
        self._seen: dict[str, Any] = {}
        self._publishers = 0
        self._subscriptions: dict[str, Any] = {}
        self._waiting: deque[Future] = deque()
        self._since = self._ended = 0.0
        self._listen_anew()

    def _listen_anew(self) -> None:
        self.settled, self._since = False, time.monotonic()
        self._subscribe(STATIC, MANY_LATCHED)
        self._subscribe(MOVING, endpoints.SENSOR)

    def _subscribe(self, topic: str, profile: QoSProfile) -> None:
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            return
        if topic not in self._subscriptions:
            made = self._node.create_subscription(
                TFMessage, topic, self._take, endpoints.own(profile)
            )
            self._subscriptions[topic] = made

    def _unsubscribe(self, topic: str) -> None:
        if topic in self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop(topic))

    def listen(self) -> None:
        """Listen to all again, unless it has just done so."""
        if self.settled and time.monotonic() - self._ended > FRESH_S:
            self._listen_anew()

    def heard(self) -> Future:
        """Listen; the future is done once all was heard."""
        self.listen()
        future: Future = Future()
        self._waiting.append(future)
        self.tick()
        return future

    def tick(self) -> None:
        """End what it listens to ``/tf`` when it was long enough."""
        now = time.monotonic()
        if not self.settled and now - self._since >= SETTLE_S:
            self._unsubscribe(MOVING)
            self.settled, self._ended = True, now
        while self.settled and self._waiting:
            self._waiting.popleft().set_result(None)

    def look(self) -> None:
        """Listen anew when a publisher has come; or gone: what it said holds no more."""
        publishers = sum(self._node.count_publishers(topic) for topic in (STATIC, MOVING))
        if publishers < self._publishers:
            self._unsubscribe(STATIC)
            self._unsubscribe(MOVING)
            self._seen.clear()
            self._listen_anew()
        elif publishers > self._publishers and self.settled:
            self._listen_anew()
        elif publishers > self._publishers:  # one that came while it listens is heard as long
            self._since = time.monotonic()
        self._publishers = publishers

    def _take(self, message: Any) -> None:
        for transform in message.transforms:
            if transform.child_frame_id == self._child and transform not in self._own:
                self._seen[transform.header.frame_id] = transform.transform

    def conflict(self, parent: str, T_parent_child: Array) -> str:
        """Why the frame cannot stand below a parent with this pose (4, 4); empty when it can."""
        others = sorted(set(self._seen) - {parent})
        if others:
            return (
                f"tf shows '{self._child}' below '{', '.join(others)}' already, it cannot stand "
                f"below '{parent}' too: stop the node that publishes it, or rename one of them"
            )
        if parent not in self._seen:
            return ""
        step_m, turn_rad = _apart(T_parent_child, self._seen[parent])
        if step_m <= SAME_M and turn_rad <= SAME_RAD:
            return ""
        return (
            f"tf shows '{parent}' to '{self._child}' from another node already, "
            f"{step_m * 1e3:.3f} mm and {np.degrees(turn_rad):.3f} deg apart: take the joint out "
            "of the URDF (robot_state_publisher), or give the frame another name there"
        )

    def close(self) -> None:
        """Hear no more; who waits is answered."""
        self._unsubscribe(STATIC)
        self._unsubscribe(MOVING)
        while self._waiting:
            error = NotActiveError("deactivated while it listened to tf: nothing was done")
            self._waiting.popleft().set_exception(error)


def _apart(T: Array, transform: Any) -> tuple[float, float]:
    """Distance (m) and angle (rad) of a transform from T; infinite where it has no rotation."""
    t, r = transform.translation, transform.rotation
    quat = np.array([r.x, r.y, r.z, r.w])
    norm = float(np.linalg.norm(quat))
    place = np.array([t.x, t.y, t.z])
    if not (norm > 0.5 and np.all(np.isfinite(place))):
        return np.inf, np.inf
    return frames.apart(frames.transform_from_quat(place, quat / norm), T)
