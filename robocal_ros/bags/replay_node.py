# SPDX-License-Identifier: Apache-2.0
"""Plays a bag into the graph with /clock; tells what was not received (docs/bags.md)."""

import json
import os
import time
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger

from robocal_ros.bags.bags import BagMessage, BagReader
from robocal_ros.bags.mcap_files import message_class, withheld
from robocal_ros.ground.errors import ConflictError, InputError, RobocalError
from robocal_ros.ground.files import share_folders
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import HouseNode, run
from robocal_ros.ros.conversions import time_message
from robocal_ros.ros.endpoints import ERROR, LOG_EVERY_S, WARN, Health
from robocal_ros.ros.parameters import Setting, number

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


@dataclass(frozen=True)
class BagLoss:
    """What of the bag did not come to who listens, or perhaps not; ``level`` in diagnostics."""

    level: bytes
    words: str


class ReplayTopics:
    """One reliable publisher for each topic.

    ``played``: by recorded name. ``skipped``: topics that are not played, and why.
    ``unacknowledged``: messages that a reliable subscriber did not confirm in time.
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

    def begin(self) -> None:
        """Count from here on: the bag is played from its start."""
        self.unacknowledged = 0
        self._in_flight.clear()
        for played in self.played.values():
            played.sent = played.unheard = 0
            played.untracked.clear()

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

        Raises `InputError`: a name is not the played name of any topic.
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

    def losses(self) -> list[BagLoss]:
        """What may have been lost on its way: not acknowledged, or sent to best-effort inputs."""
        found = []
        if self.unacknowledged:
            words = f"perhaps lost: {self.unacknowledged} messages that were not acknowledged"
            found.append(BagLoss(ERROR, words))
        return found + [
            BagLoss(
                WARN,
                f"perhaps lost: messages of {played.topic} to best-effort subscribers "
                f"({', '.join(sorted(names))}): make them reliable",
            )
            for played in self.played.values()
            if (names := set(played.untracked.values()))
        ]

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


def chosen_topics(
    recorded: Mapping[str, str], wanted: Collection[str], remap: Collection[str]
) -> tuple[dict[str, str], dict[str, str]]:
    """Topics to play (recorded name to played name), and those left out with the reason.

    ``wanted`` empty means all but the clock, `LEFT_OUT` and what is `withheld` under the name that
    it is played by. ``remap`` has entries ``recorded:=played``.

    Raises `InputError`: a wanted or remapped topic is not in the bag, or an entry is no remapping.
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


TICK_S = 0.002
BATCH = 200
STATUS_S = 1.0
PATIENCE_S = 0.05  # a tick waits at most so long for acknowledgements
EXIT_LOSS, EXIT_CANNOT = 3, 2
DDS_PROFILE = "replay_dds.xml"
WAITING, PLAYING, PAUSED, DONE, FAILED = "waiting", "playing", "paused", "done", "failed"
NO_BAG = "no bag"
GIVE_BAG = "no bag: set the parameter 'bag' to an MCAP file or a recording's folder"
SETTINGS = (
    Setting("bag", "", "MCAP file, or folder of a recording; empty: nothing to play yet"),
    number(
        "rate", 1.0, "Speed of the recorded time; 0: as fast as it is acknowledged", 0.0, 1000.0
    ),
    Setting("topics", [""], "What to play; empty: all that moves nothing"),
    Setting("remap", [""], "Entries recorded:=played"),
    Setting("latched", ["/tf_static"], "Played topics whose last messages are kept for latecomers"),
    Setting("wait_for_subscribers", [""], "Played topics that must have a subscriber first"),
    number("start_delay_s", 0.0, "Pause before the first message", 0.0, 600.0),
    Setting("start_paused", False, "Wait for ~/play"),
    number(
        "acknowledge_timeout_s",
        5.0,
        "Longest wait for a subscriber's acknowledgement before it is reported",
        0.1,
        600.0,
    ),
    Setting(
        "exit_at_end",
        False,
        "End the process: status 0, 3 when anything was lost or perhaps, 2 when it cannot play",
    ),
)


class ReplayNode(HouseNode):
    """Plays a bag."""

    NAME = "replay_node"
    SETTINGS = SETTINGS

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._reader: BagReader | None = None
        self._topics: ReplayTopics | None = None
        self._play_state, self._fault = WAITING, ""

    def configure(self) -> None:
        """Open the bag and make the publishers."""
        self._status = self.add_output(String, "~/status", endpoints.LATCHED)
        self.add_service(Trigger, "~/play", self._play)
        self.add_service(Trigger, "~/pause", self._pause)
        if self.settings["bag"]:
            self._open(Path(self.settings["bag"]).expanduser())
        else:
            self.get_logger().warning(GIVE_BAG)

    def _open(self, bag: Path) -> None:
        settings = self.settings
        self._reader = BagReader(bag)
        self._info = self._reader.info
        recorded = {name: topic.msgtype for name, topic in self._info.topics.items()}
        chosen, left = chosen_topics(recorded, settings["topics"], settings["remap"])
        self._topics = ReplayTopics(self, settings["latched"])
        for topic, name in chosen.items():
            self._topics.add(topic, name, recorded[topic])
        self._topics.skipped |= left
        self._topics.require(settings["wait_for_subscribers"])
        # A clock that nothing drives would hold up every node on simulated time.
        self._clock_out = self.add_output(
            Clock, CLOCK, QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        )
        self.add_timer(TICK_S, self._tick, steady=True)
        self.add_timer(STATUS_S, self._report, steady=True)
        self.add_timer(LOG_EVERY_S, self._tell_waiting, steady=True)

    def autostart(self) -> None:
        """As `HouseNode.autostart`; who waits for the end is not left waiting for a beginning."""
        super().autostart()
        begun = self.is_active and self._topics is not None
        asked = self.get_parameter("autostart").value and self.get_parameter("exit_at_end").value
        if asked and not begun:
            raise SystemExit(EXIT_CANNOT)

    def activate(self) -> None:
        """Begin at the start of the bag."""
        if self._reader is None or self._topics is None:
            self._set_state(NO_BAG)
            return
        self._topics.begin()
        self._messages: Iterator[BagMessage] = self._reader.messages(
            list(self._topics.played), raw=True
        )
        self._next = next(self._messages, None)
        self._first_ns = self._position_ns = 0 if self._next is None else self._next.log_time_ns
        self._begin = time.monotonic() + self.settings["start_delay_s"]
        self._unsettled_since: float | None = None
        self._fault = ""
        self._set_state(PAUSED if self.settings["start_paused"] else WAITING)

    def deactivate(self) -> None:
        """Stop where it is; a bag that has ended stays so, at the end of the process too."""
        plays = self._play_state in (WAITING, PLAYING)
        self._set_state(PAUSED if plays else self._play_state)

    def cleanup(self) -> None:
        """Close the bag."""
        if self._topics is not None:
            self._topics.close()
        if self._reader is not None:
            self._reader.__exit__(None, None, None)
        self._topics = self._reader = None

    # ---- playing --------------------------------------------------------------------------------

    def _tick(self) -> None:
        topics = self._topics
        if topics is None or self._play_state not in (WAITING, PLAYING):
            return
        now = time.monotonic()
        if self._play_state == WAITING:
            if now < self._begin or topics.unheard(self.settings["wait_for_subscribers"]):
                return
            self._start(now)
        if not self._settled(topics, now):
            return
        try:
            self._send(topics, now)
        except RobocalError as error:
            self._fault = str(error)
            self._end(topics, FAILED)

    def _send(self, topics: ReplayTopics, now: float) -> None:
        rate, sent = self.settings["rate"], 0
        while self._next is not None and sent < BATCH:
            if rate and self._next.log_time_ns > self._due_ns(now, rate):
                break
            self._position_ns = max(self._position_ns, self._next.log_time_ns)
            topics.publish(self._next.topic, self._next.message)
            self._next = next(self._messages, None)
            sent += 1
        if sent or rate:
            if rate and self._next is not None:  # on between messages, never beyond the next one
                self._position_ns = max(self._position_ns, self._due_ns(now, rate))
            self._clock_out.publish(Clock(clock=time_message(self._position_ns)))
        self._unsettled_since = now if sent else self._unsettled_since
        if self._next is None and self._settled(topics, time.monotonic()):
            self._end(topics, DONE)

    def _due_ns(self, now: float, rate: float) -> int:
        return self._from_ns + int((now - self._since) * rate * 1e9)

    def _settled(self, topics: ReplayTopics, now: float) -> bool:
        """Whether everything sent was acknowledged, or given up and reported."""
        if self._unsettled_since is None:
            return True
        if not topics.settle(PATIENCE_S):
            if now - self._unsettled_since < self.settings["acknowledge_timeout_s"]:
                return False
            topics.give_up()
            self.get_logger().error(topics.losses()[0].words)
        self._unsettled_since = None
        return True

    def _start(self, now: float) -> None:
        self._since, self._from_ns = now, self._position_ns
        self._set_state(PLAYING)

    def _tell_waiting(self) -> None:
        if self._topics is None or self._play_state != WAITING:
            return
        missing = self._topics.unheard(self.settings["wait_for_subscribers"])
        if missing:
            self.get_logger().info(f"waiting for subscribers of {', '.join(missing)}")

    def _end(self, topics: ReplayTopics, state: str) -> None:
        self._set_state(state)
        lost = "; ".join(loss.words for loss in self._losses(topics))
        if lost:
            self.get_logger().error(f"{state}: {lost}")
        else:
            self.get_logger().info(f"{state}: nothing was lost{topics.alone()}")
        if self.settings["exit_at_end"]:
            self._status.wait_for_all_acked(Duration(seconds=5))  # it ends with the node
            raise SystemExit(EXIT_LOSS if lost else 0)

    def _losses(self, topics: ReplayTopics) -> list[BagLoss]:
        """What was lost so far, or perhaps: by it go log, status, diagnostics and exit status."""
        found = []
        if self._fault:
            found.append(BagLoss(ERROR, f"lost: the rest of the bag: {self._fault}"))
        if chunks := 0 if self._reader is None else len(self._reader.info.lost):
            found.append(BagLoss(ERROR, f"lost: damaged chunks of the bag: {chunks}"))
        return found + topics.losses()

    # ---- services and status --------------------------------------------------------------------

    def _play(self, request: Any, response: Any) -> Any:
        if self._topics is None:
            raise InputError(GIVE_BAG)
        if self._play_state in (DONE, FAILED):
            raise ConflictError(f"the bag is {self._play_state}: activate the node anew to repeat")
        if self._play_state == PAUSED:
            if self._topics.unheard(self.settings["wait_for_subscribers"]):
                self._set_state(WAITING)
            else:
                self._start(time.monotonic())
        response.success, response.message = True, self._play_state
        return response

    def _pause(self, request: Any, response: Any) -> Any:
        if self._play_state in (WAITING, PLAYING):
            self._set_state(PAUSED)
        response.success, response.message = True, self._play_state
        return response

    def _set_state(self, state: str) -> None:
        self._play_state = state
        self._report()

    def _report(self) -> None:
        if self._topics is None or self._reader is None:
            self._status.publish(String(data=json.dumps({"state": self._play_state})))
            return
        self._topics.look()
        status = {
            "state": self._play_state,
            "bag": self._info.path,
            "position_s": (self._position_ns - self._first_ns) * 1e-9,
            "notes": list(self._reader.info.notes),
            "fault": self._fault,
            "lost": [loss.words for loss in self._losses(self._topics)],
            **self._topics.report(),
        }
        self._status.publish(String(data=json.dumps(status, sort_keys=True)))

    def health(self) -> Health:
        """Tell how far it is and what was lost."""
        health, topics = Health(message=self._play_state), self._topics
        if topics is None:
            return health
        for loss in self._losses(topics):
            health.worsen(loss.level, loss.words)
        sent = topics.report()["sent"]
        health.values = {f"{topic} sent": count for topic, count in sent.items()}
        return health


def ask_for_acknowledgements() -> None:
    """Make Fast DDS ask for them every few ms; by default a batch would take up to 3 s."""
    for folder in share_folders("robocal_ros", "config", "config"):
        if (folder / DDS_PROFILE).is_file():
            os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(folder / DDS_PROFILE))
            return


def main() -> None:
    """Run the node."""
    ask_for_acknowledgements()
    run(ReplayNode)
