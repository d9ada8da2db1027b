"""Recorded topics as publishers that lose nothing unseen."""

import importlib
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from robocal_ros.bags.bag_types import definition, recorded_name, withheld
from robocal_ros.ground.errors import InputError

DEPTH = 1000
LATCHED_DEPTH = 100
CLOCK = "/clock"
OWN = "a live node makes its own"
LEFT_OUT = {  # unless they are named
    "robocal_msgs/msg/SessionEvent": OWN,
    "diagnostic_msgs/msg/DiagnosticArray": OWN,
}


@dataclass
class Played:
    """What became of one topic's messages; ``unheard`` were sent while nobody subscribed."""

    topic: str
    publisher: Any
    sent: int = 0
    unheard: int = 0
    untracked: dict[tuple[int, ...], str] = field(default_factory=dict)  # name by endpoint


class ReplayTopics:
    """One reliable publisher for each topic.

    Attributes
    ----------
    played : by recorded name.
    skipped : topics that are not played, and why.
    unacknowledged : messages that a reliable subscriber did not confirm in time.
    """

    def __init__(self, node: Node, latched: Collection[str]) -> None:
        self._node = node
        self._latched = latched
        self.played: dict[str, Played] = {}
        self.skipped: dict[str, str] = {}
        self.unacknowledged = 0
        self._in_flight: dict[str, int] = {}

    def add(self, topic: str, name: str, msgtype: str) -> None:
        """Publish ``topic`` as ``name``; one of an unknown type is skipped and named."""
        try:
            kind = message_class(msgtype)
        except InputError as error:
            self.skipped[topic] = str(error)
            return
        latched = name in self._latched
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=LATCHED_DEPTH if latched else DEPTH,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=durability,
        )
        self.played[topic] = Played(name, self._node.create_publisher(kind, name, profile))

    def publish(self, topic: str, cdr: bytes) -> None:
        """Send a message; the caller calls ``settle`` before ``DEPTH`` of them are in flight."""
        played = self.played[topic]
        played.unheard += not played.publisher.get_subscription_count()
        played.publisher.publish(cdr)
        played.sent += 1
        self._in_flight[topic] = self._in_flight.get(topic, 0) + 1

    def settle(self, within_s: float) -> bool:
        """Wait until all that was sent is acknowledged; False when time ran out."""
        deadline = time.monotonic() + within_s
        for topic in list(self._in_flight):
            left = max(deadline - time.monotonic(), 0.0)
            publisher = self.played[topic].publisher
            if not publisher.wait_for_all_acked(Duration(nanoseconds=int(left * 1e9))):
                return False
            del self._in_flight[topic]
        return True

    def give_up(self) -> None:
        """Count what is in flight as not acknowledged, and go on."""
        self.unacknowledged += sum(self._in_flight.values())
        self._in_flight.clear()

    def look(self) -> None:
        """Look who listens: topics without a subscriber, subscribers that confirm nothing."""
        for played in self.played.values():
            infos = self._node.get_subscriptions_info_by_topic(played.publisher.topic_name)
            played.untracked |= {
                tuple(info.endpoint_gid): f"{info.node_namespace.rstrip('/')}/{info.node_name}"
                for info in infos
                if info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
            }

    def require(self, names: Collection[str]) -> None:
        """Refuse names that are not played: their subscribers would be waited for in vain.

        Raises
        ------
        InputError
            A name is not the played name of any topic.
        """
        played = {p.publisher.topic_name for p in self.played.values()}
        unknown = [name for name in names if self._node.resolve_topic_name(name) not in played]
        if unknown:
            raise InputError(
                f"wait_for_subscribers names {', '.join(unknown)}, which is not played; played "
                f"are {', '.join(sorted(played))}"
            )

    def unheard(self, names: Collection[str]) -> list[str]:
        """Those of these played names that have no subscriber."""
        heard = {
            p.publisher.topic_name
            for p in self.played.values()
            if p.publisher.get_subscription_count()
        }
        return [name for name in names if self._node.resolve_topic_name(name) not in heard]

    def doubt(self) -> str:
        """Why messages may have been lost: not acknowledged, or sent to best-effort inputs."""
        words = []
        if self.unacknowledged:
            words.append(f"{self.unacknowledged} messages were not acknowledged")
        words += [
            f"{played.topic} went to best-effort subscribers ({', '.join(sorted(names))}): make "
            "them reliable"
            for played in self.played.values()
            if (names := set(played.untracked.values()))
        ]
        return "; ".join(words)

    def alone(self) -> str:
        """Tell what nobody heard, to go on from a sentence; empty when all had a subscriber."""
        counts = [f"{p.unheard} of {p.topic}" for p in self.played.values() if p.unheard]
        return f"; nobody listened to {', '.join(counts)}" if counts else ""

    def close(self) -> None:
        """Take the publishers down."""
        for played in self.played.values():
            self._node.destroy_publisher(played.publisher)
        self.played.clear()

    def report(self) -> dict[str, Any]:
        """Figures for the status."""
        played = sorted(self.played.values(), key=lambda p: p.topic)
        return {
            "sent": {p.topic: p.sent for p in played},
            "unheard": {p.topic: p.unheard for p in played if p.unheard},
            "unacknowledged": self.unacknowledged,
            "best_effort": {
                p.topic: sorted(set(p.untracked.values())) for p in played if p.untracked
            },
            "skipped": self.skipped,
        }


def message_class(msgtype: str) -> type:
    """The Python class of ``package/msg/Type``.

    Raises
    ------
    InputError
        When it is not installed.
    """
    package, _, name = msgtype.replace("/msg/", "/").partition("/")
    try:
        found = getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise InputError(f"message type {msgtype} is not installed") from error
    if not isinstance(found, type):
        raise InputError(f"message type {msgtype} is not installed")
    return found


def chosen_topics(
    recorded: Mapping[str, str], wanted: Collection[str], remap: Collection[str]
) -> tuple[dict[str, str], dict[str, str]]:
    """Topics to play (recorded name to played name), and those left out with the reason.

    ``wanted`` empty means all but the clock, `LEFT_OUT` and what is `withheld` under the name that
    it is played by. ``remap`` has entries ``recorded:=played``.

    Raises
    ------
    InputError
        A wanted or remapped topic is not in the bag, or an entry is no remapping.
    """
    names = dict(_pair(entry) for entry in remap)
    missing = [topic for topic in (*wanted, *names) if topic not in recorded]
    if missing:
        raise InputError(
            f"the bag has no topic {', '.join(missing)}; it has {', '.join(sorted(recorded))}"
        )
    chosen: dict[str, str] = {}
    left: dict[str, str] = {}
    for topic, msgtype in recorded.items():
        if topic == CLOCK:
            left[topic] = "the clock is made here"
        elif wanted and topic not in wanted:
            left[topic] = "not wanted"
        elif not wanted and (
            why := LEFT_OUT.get(msgtype) or withheld(names.get(topic, topic), msgtype)
        ):
            left[topic] = f"{why}; name it in 'topics' to play it"
        else:
            chosen[topic] = names.get(topic, topic)
    return chosen, left


def _pair(entry: str) -> tuple[str, str]:
    old, mark, new = entry.partition(":=")
    if not (mark and old and new):
        raise InputError(f"'{entry}' is no remapping: write recorded:=played")
    return old, new


# ---- recorded topics ----------------------------------------------------------------------------


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
