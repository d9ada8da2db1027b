"""Topics that are recorded: found by name, subscribed as they are offered, taken serialized."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from robocal_ros.bags.bag_types import definition
from robocal_ros.bags.recorded_names import recorded_name
from robocal_ros.bags.replay_topics import message_class
from robocal_ros.ground.errors import InputError

DEPTH = 1000
DIAGNOSTICS = "/diagnostics"
TOPICS = (
    "joint_states",
    "beam_events",
    "sphere_cloud",
    "sphere_center",
    "reference_sphere_center",
    "measured_point",
    "measured_pose",
    "motor_temperatures",
    "profile",
    "target_pose",
    "gap_open",
    "motion_lease",
    "controller_state",
    "speed_scaling",
    "joint_trajectory",
    "joint_targets",
    "joint_commands",
    "joint_correction_node/joint_trajectory",
    "joint_correction_node/joint_targets",
    "joint_correction_node/joint_commands",
    "maintenance_node/joint_trajectory",
    "tcf_node/joint_trajectory",
    "tcf_node/next_step",
    "joint_trajectory_controller/joint_trajectory",
    "accuracy_state",
    "thermal_node/session_events",
    "thermal_node/model",
    "thermal_node/quality",
    "thermal_node/accuracy",
    "tcf_node/session_events",
    "tcf_node/tool",
    "tcf_node/quality",
    "hand_eye_node/session_events",
    "joint_correction_node/correction",
    "joint_correction_node/status",
    "maintenance_node/status",
    "maintenance_node/session_events",
    "/tf_static",
    DIAGNOSTICS,
)


@dataclass
class RecordedTopic:
    """A topic that is subscribed, and its name in the recording."""

    topic: str
    name: str
    msgtype: str
    reliable: bool
    latched: bool
    messages: int = 0
    subscription: Any = None


class RecordedTopics:
    """Subscriptions of the wanted topics, as they appear.

    Parameters
    ----------
    wanted : topics; relative ones are in the node's namespace, ``~/`` is the node's own.
    take : is given topic, type and serialized message.

    Attributes
    ----------
    found : by resolved name.
    latched : those that are offered latched, by both their names; grows.
    unknown : topics whose type cannot be recorded, and why.
    """

    def __init__(
        self, node: Node, wanted: Collection[str], take: Callable[[RecordedTopic, bytes], None]
    ) -> None:
        self._node, self._take = node, take
        # Two of them may be remapped to one.
        self._wanted = list(dict.fromkeys(node.resolve_topic_name(topic) for topic in wanted))
        self.found: dict[str, RecordedTopic] = {}
        self.latched: set[str] = set()
        self.unknown: dict[str, str] = {}

    @property
    def missing(self) -> list[str]:
        """Wanted topics that nobody has offered yet."""
        return [t for t in self._wanted if t not in self.found and t not in self.unknown]

    def look(self) -> None:
        """Subscribe what is offered by now; afresh, where less is offered than was asked for."""
        for topic, recorded in list(self.found.items()):
            reliable, latched = self._offered(topic)
            if (recorded.reliable and not reliable) or (recorded.latched and not latched):
                self._drop(topic)
        if not (missing := self.missing):
            return
        offered = dict(self._node.get_topic_names_and_types())
        for topic in missing:
            if topic in offered and self._node.count_publishers(topic):
                self._add(topic, offered[topic][0])

    def _add(self, topic: str, msgtype: str) -> None:
        try:
            kind = message_class(msgtype)
            definition(msgtype)
        except InputError as error:
            self.unknown[topic] = str(error)
            return
        reliable, latched = self._offered(topic)
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        recorded = self.found[topic] = RecordedTopic(
            topic, recorded_name(topic, msgtype), msgtype, reliable, latched
        )
        if latched:
            self.latched |= {topic, recorded.name}

        def receive(data: bytes) -> None:
            recorded.messages += 1
            self._take(recorded, data)

        recorded.subscription = self._node.create_subscription(
            kind, topic, receive, profile, raw=True
        )

    def _offered(self, topic: str) -> tuple[bool, bool]:
        """Whether all its publishers are reliable, and whether all are latched."""
        offers = [info.qos_profile for info in self._node.get_publishers_info_by_topic(topic)]
        reliable = all(o.reliability == ReliabilityPolicy.RELIABLE for o in offers)
        return reliable, all(o.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offers)

    def _drop(self, topic: str) -> None:
        self._node.destroy_subscription(self.found.pop(topic).subscription)

    def renew_latched(self) -> None:
        """Subscribe latched topics afresh: their publishers send what is in force once more."""
        for topic in self.latched & set(self.found):
            self._drop(topic)
        self.look()

    def close(self) -> None:
        """Take the subscriptions down."""
        for topic in list(self.found):
            self._drop(topic)
