# SPDX-License-Identifier: Apache-2.0
"""Records what a dispute needs, for as long as there is room (docs/bags.md)."""

import socket
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from robocal_ros.bags.bag_writer import (
    MB,
    BagRecording,
    Maker,
    keep,
    make_room,
    new_folder,
    size_bytes,
)
from robocal_ros.bags.mcap_files import definition, message_class, recorded_name
from robocal_ros.ground.errors import Code, ConflictError, InputError, StorageError
from robocal_ros.history.history_file import state_folder
from robocal_ros.ros.base import HouseNode, run
from robocal_ros.ros.endpoints import ERROR, WARN, Health, trigger_text
from robocal_ros.ros.parameters import Setting, advanced, number

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
    "tracker_point",
    "camera_info",
    "fixture_point",
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
    "fixture_node/session_events",
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

    ``wanted``: topics; relative ones are in the node's namespace, ``~/`` is the node's own.
    ``take``: is given topic, type and serialized message.

    ``found``: by resolved name. ``latched``: those that are offered latched, by both their names;
    grows. ``unknown``: topics whose type cannot be recorded, and why.
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


LOOK_S = 0.5
ROOM_S = 5.0
SHARES = 4  # a recording takes so much of the room at the most: three before it are kept
AGAIN_S = 10.0  # after a recording broke off
HOUR_S = 3600.0
SETTINGS = (
    Setting("topics", list(TOPICS), "What is recorded; relative names are in the namespace"),
    Setting("folder", "", "Where recordings are kept; empty: recordings/ in the state folder"),
    Setting("hours", 8.0, "A recording is no longer than this", unit="h", low=1e-3, high=168.0),
    number("keep_mb", 20000.0, "All its recordings together", 1.0, 1e7),
    number("free_mb", 500.0, "So much of the disk stays free", 0.0, 1e7),
    *advanced(
        number("file_mb", 50.0, "A file is this large", 0.1, 10000.0),
        number("flush_s", 1.0, "A crash loses no more than this", 0.1, 60.0),
    ),
)


def utc() -> str:
    """The time now."""
    return time.strftime("%Y-%m-%d %H:%M:%SZ", time.gmtime())


class RecorderNode(HouseNode):
    """Writes one recording after another; the oldest of its own are deleted."""

    NAME = "recorder_node"
    SETTINGS = SETTINGS

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._recording: BagRecording | None = None
        self._topics: RecordedTopics | None = None
        self._fault = ""
        self._no_room = ""  # why nothing may be recorded now
        self._gone = ""  # a recording that was removed while it was written
        self._rivals = ""  # who else says to be this recorder
        self._left: dict[str, str] = {}  # what looks like a recording and is left alone, and why

    def configure(self) -> None:
        """Find the folder; nothing is recorded before activation."""
        given = self.settings["folder"]
        self._folder = Path(given) if given else state_folder() / "recordings"
        serial, domain = self.settings["serial"], self.context.get_domain_id()
        place = "" if serial else f"{socket.gethostname()}, domain {domain}"
        self._maker = Maker(self.get_fully_qualified_name(), serial, place)
        self.add_service(Trigger, "~/keep", self._keep)
        self.add_service(Trigger, "~/split", self._split)
        self.add_timer(LOOK_S, self._look, steady=True)
        self.add_timer(self.settings["flush_s"], self._flush, steady=True)
        self.add_timer(ROOM_S, self._make_room, steady=True)

    def activate(self) -> None:
        """Begin a recording."""
        self._fault, self._lost, self._lost_since, self._deleted = "", 0, "", 0
        self._again_s: float | None = None  # when a recording that broke off is begun again
        self._no_room, self._gone, self._rivals, self._left = "", "", "", {}
        self._make_room()
        self._topics = RecordedTopics(self, self.settings["topics"], self._take)
        self._topics.look()

    def deactivate(self) -> None:
        """Complete the recording."""
        if self._topics is not None:
            self._topics.close()
        self._topics = None
        self._complete()

    # ---- what comes in --------------------------------------------------------------------------

    def _take(self, recorded: RecordedTopic, data: bytes) -> None:
        if not self.is_active:
            return
        try:
            recording = self._recording or self._begin()
            recording.write(recorded.name, recorded.msgtype, data, self.now_ns())
        except StorageError as error:
            self._lose(1)
            self._break_off(error)

    def _lose(self, messages: int) -> None:
        """Count what is not recorded."""
        if messages:
            self._lost += messages
            self._lost_since = self._lost_since or utc()

    def _begin(self) -> BagRecording:
        if self._again_s is not None:
            raise StorageError(self._fault)
        if self._no_room:
            raise StorageError(self._no_room)
        latched = set() if self._topics is None else self._topics.latched
        self._recording = BagRecording(
            new_folder(self._folder, self._maker),
            latched=latched,
            file_bytes=round(self.settings["file_mb"] * MB),
        )
        self._begun_s, self._fault = time.monotonic(), ""
        return self._recording

    def _break_off(self, error: StorageError) -> None:
        recording, self._recording = self._recording, None
        if recording is not None:  # what no flush brought to the disk goes with it
            self._lose(recording.unflushed)
        if not self._fault:
            self.get_logger().error(str(error))
        if self._again_s is None:
            self._fault, self._again_s = str(error), time.monotonic() + AGAIN_S

    # ---- time -----------------------------------------------------------------------------------

    def _look(self) -> None:
        topics = self._topics
        if topics is None:
            return
        topics.look()
        try:
            if self._recording is not None:
                self._recording.look()
        except StorageError as error:
            self._gone = str(error)
            self._break_off(error)
        over_s = self.settings["hours"] * HOUR_S
        now = time.monotonic()
        if self._recording is not None and now - self._begun_s >= over_s:
            self._next()
        elif self._again_s is not None and now >= self._again_s:
            self._again_s = None
            self._next()

    def _make_room(self) -> None:
        recording, most = self._recording, round(self.settings["keep_mb"] * MB)
        least_free = round(self.settings["free_mb"] * MB)
        with suppress(OSError):  # `_look` tells of it, and room is made all the same
            if recording is not None and size_bytes(recording.folder) >= most // SHARES:
                self._next()
        try:
            room = make_room(self._folder, self._maker, most, least_free)
        except OSError as error:
            self._tell_left(self._left | {str(self._folder): str(error)})
            return
        self._deleted += len(room.deleted)
        self._tell_left(room.left)
        self._rivals = ", ".join(str(folder) for folder in room.rivals)
        was, self._no_room = self._no_room, ""
        if room.short_bytes:
            free_mb = self.settings["free_mb"] - room.short_bytes / MB
            self._no_room = (
                f"{free_mb:.0f} MB are free on the disk of {self._folder}, free_mb is "
                f"{self.settings['free_mb']:g}, and deleting its recordings would not bring that: "
                "none is deleted, and nothing recorded until there is room"
            )
            self._complete()
            if not was:
                self.get_logger().error(self._no_room)

    def _tell_left(self, left: dict[str, str]) -> None:
        """What is left alone, once in the log."""
        for name, why in left.items():
            if self._left.get(name) != why:
                self.get_logger().warning(f"{name} in {self._folder} is left alone: it {why}")
        self._left = left

    def _next(self) -> None:
        """Begin another recording, which opens with all that is in force."""
        self._complete()
        if self._topics is not None:
            self._topics.renew_latched()

    def _flush(self) -> None:
        try:
            if self._recording is not None:
                self._recording.flush()
        except StorageError as error:
            self._break_off(error)

    def _complete(self) -> None:
        try:
            if self._recording is not None:
                self._recording.close()
        except StorageError as error:
            self._break_off(error)
        self._recording = None

    # ---- services -------------------------------------------------------------------------------

    def _keep(self, request: Any, response: Any) -> Any:
        recording = self._recording
        if recording is None:
            raise ConflictError("nothing is being recorded: there is nothing to keep")
        keep(recording.folder, f"kept at {utc()}")
        response.success = True
        response.message = trigger_text(0, Code.ACCEPT, f"{recording.folder} is kept for good")
        return response

    def _split(self, request: Any, response: Any) -> Any:
        recording = self._recording
        if recording is None:
            raise ConflictError("nothing is being recorded: there is nothing to complete")
        self._next()
        if self._again_s is not None:  # it broke off
            raise StorageError(self._fault)
        response.success = True
        response.message = trigger_text(0, Code.ACCEPT, f"{recording.folder} is complete")
        return response

    def health(self) -> Health:
        """Tell what is recorded, and what is not."""
        health, topics, recording = Health(), self._topics, self._recording
        if self._lost:
            health.worsen(WARN, f"{self._lost} messages since {self._lost_since} are not recorded")
        for fault in dict.fromkeys((self._fault, self._no_room)):
            if fault:
                health.worsen(ERROR, fault)
        if self._gone and self._gone != self._fault:
            health.worsen(WARN, self._gone)
        if self._rivals:
            health.worsen(
                WARN,
                f"another recorder of this name writes {self._rivals}: of what earlier runs made "
                "nothing is deleted; give each its serial, a name or a folder of its own",
            )
        if topics is None:
            return health
        if topics.unknown:
            told = "; ".join(f"{topic}: {why}" for topic, why in topics.unknown.items())
            health.worsen(WARN, f"not recorded: {told}")
        if not topics.found.keys() - {DIAGNOSTICS}:  # which is its own, too
            health.worsen(WARN, "none of the topics is there yet")
        counts: dict[str, object] = {
            f"{r.topic} recorded": r.messages for r in topics.found.values()
        }
        health.values = counts | {
            "folder": "" if recording is None else recording.folder,
            "messages": 0 if recording is None else recording.messages,
            "not there": ", ".join(topics.missing),
            "recordings deleted": self._deleted,
            "left alone": "; ".join(f"{name} {why}" for name, why in self._left.items()),
            "messages not recorded": self._lost,
        }
        return health


def main() -> None:
    """Run the node."""
    run(RecorderNode, events=True)
