# SPDX-License-Identifier: Apache-2.0
"""The adapter node: what drivers and detectors publish in; beam events, profiles, poses out.

docs/adapter_node.md.
"""

from functools import partial
from typing import Any

from geometry_msgs.msg import Point, Pose, PoseStamped
from robocal_msgs.msg import BeamEvent
from sensor_msgs.msg import LaserScan, PointCloud2
from std_msgs.msg import Bool

from robocal_ros.adapter.inputs import (
    BOOL,
    GPIO,
    LEVELS,
    UR_IO,
    BeamLevel,
    InputTiming,
    changes_in,
    scan_profile,
    source_fault,
)
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import stamp_ns
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import HouseNode, run
from robocal_ros.ros.conversions import header, profile_cloud, time_message
from robocal_ros.ros.endpoints import ERROR, WARN, Health
from robocal_ros.ros.parameters import Setting, number

NONE, CLOUD, SCAN, TF = "none", "cloud", "scan", "tf"
TOPICS = {UR_IO: "io_states", GPIO: "gpio_states"}
EVENTS, PROFILE, TARGET_POSE = "beam_events", "profile", "target_pose"
MOST_CAMERAS = 10  # frames that are remembered: anybody may write on /tf
LATE_PERIODS = 10.0  # a driver that is silent for so many has stopped

SETTINGS = (
    Setting(
        "input",
        NONE,
        "What tells the beams: bool, a std_msgs/Bool for each; ur_io, ur_msgs/IOStates on "
        "io_states; gpio, of ros2_control's gpio_controllers on gpio_states",
        choices=(NONE, BOOL, UR_IO, GPIO),
    ),
    Setting("beams", ["x", "y"], "Names of the beams in beam_events"),
    Setting(
        "sources",
        ["beam_x", "beam_y"],
        "The input of each: bool, a topic; ur_io, the number of a digital input; gpio, "
        "group/interface",
    ),
    Setting(
        "blocked_level", "high", "Level of a beam that is interrupted", choices=("high", "low")
    ),
    Setting("station", "station", "Name of the station, frame_id of beam_events"),
    number(
        "latency_ms",
        0.0,
        "From an edge to the stamp of its message, of one without a stamp to its publication; it "
        "is subtracted",
        0.0,
        1000.0,
    ),
    number("jitter_ms", 1.0, "Standard deviation of that", 1e-3, 1000.0),
    number(
        "period_ms",
        0.0,
        "The driver tells the inputs so often; 0: only when one changes",
        0.0,
        1000.0,
    ),
    Setting(
        "profile_input",
        NONE,
        "What tells the profiles: cloud, sensor_msgs/PointCloud2 on cloud; scan, "
        "sensor_msgs/LaserScan on scan",
        choices=(NONE, CLOUD, SCAN),
    ),
    number(
        "profile_latency_ms",
        0.0,
        "From a profile to its stamp; it is subtracted",
        0.0,
        1000.0,
    ),
    Setting("profile_frame", "", "frame_id of profile; empty: that of a cloud; a scan needs one"),
    Setting(
        "target_frame",
        "",
        "Frame of a tag that a detector puts onto tf, such as tag36h11:0: its poses become "
        "target_pose; empty: none",
    ),
)


def io_type(kind: str) -> Any:
    """The message of an input. Raises `InputError` when its package is not installed."""
    try:
        if kind == BOOL:
            return Bool
        if kind == UR_IO:
            from ur_msgs.msg import IOStates

            return IOStates
        from control_msgs import msg

        return getattr(msg, "DynamicInterfaceGroupValues", None) or msg.DynamicJointState
    except (ImportError, AttributeError) as error:
        package = "ur-msgs" if kind == UR_IO else "control-msgs"
        raise InputError(
            f"input {kind}: its messages are not installed ({error}): apt install "
            f"ros-jazzy-{package}, and source it"
        ) from error


def tf_type() -> Any:
    """The message of ``/tf``. Raises `InputError` when its package is not installed."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError as error:
        words = "target_frame: tf2_msgs is missing: apt install ros-jazzy-tf2-msgs, and source it"
        raise InputError(words) from error
    return TFMessage


class AdapterNode(HouseNode):
    """Makes `BeamEvent`s, profiles and poses of targets of what others publish."""

    NAME = "adapter_node"
    SETTINGS = SETTINGS

    def configure(self) -> None:
        """Open what is listened to; raise where the inputs do not fit the beams."""
        settings = self.settings
        kind, looks = settings["input"], settings["profile_input"]
        if kind == looks == NONE and not settings["target_frame"]:
            raise InputError(
                "input and profile_input are none, target_frame is empty: there is nothing to adapt"
            )
        if looks == SCAN and not settings["profile_frame"]:
            raise InputError("profile_frame is empty: name the frame of the profiles of a scan")
        self._levels: dict[str, BeamLevel] = {}
        self._topics: dict[str, tuple[str, type]] = {}
        self._edges = self._profiles = self._poses = 0
        self._cameras: dict[str, int] = {}  # and the stamp of the newest pose in each
        self._simulated = bool(self.get_parameter("use_sim_time").value)
        if kind != NONE:
            self._open_beams(kind)
        if looks != NONE:
            self._profile = self.add_output(PointCloud2, PROFILE, endpoints.SENSOR)
            taken = LaserScan if looks == SCAN else PointCloud2
            act = self._take_scan if looks == SCAN else self._take_cloud
            self._listen(taken, looks, act, endpoints.SENSOR)
        if settings["target_frame"]:
            self._target = self.add_output(PoseStamped, TARGET_POSE, endpoints.SENSOR)
            self.add_input(tf_type(), "/tf", self._take_tf, endpoints.STREAM)

    def activate(self) -> None:
        """What the levels were before is not known, nor who saw the tag."""
        self._cameras = {}
        timing = InputTiming(
            *(self.settings[f"{name}_ms"] * 1e-3 for name in ("latency", "jitter", "period"))
        )
        if self.settings["input"] != NONE:
            self._levels = {beam: BeamLevel(timing) for beam in self.settings["beams"]}

    def _open_beams(self, kind: str) -> None:
        beams, sources = self.settings["beams"], self.settings["sources"]
        if fault := source_fault(kind, beams, sources):
            raise InputError(fault)
        message = io_type(kind)
        self._events = self.add_output(BeamEvent, EVENTS, endpoints.RELIABLE)
        if kind == BOOL:
            for beam, topic in zip(beams, sources, strict=True):
                take = partial(self._take_levels, kind, {beam: ""})
                self._listen(message, topic, take, endpoints.RELIABLE, timed=True)
        else:
            take = partial(self._take_levels, kind, dict(zip(beams, sources, strict=True)))
            self._listen(message, TOPICS[kind], take, endpoints.RELIABLE, timed=True)

    def _listen(self, kind: type, topic: str, act: Any, profile: Any, **how: bool) -> None:
        self._topics[topic] = self.add_input(kind, topic, act, profile, **how).topic_name, kind

    def _take_levels(self, kind: str, of: dict[str, str], message: Any, info: Any) -> None:
        beams = {beam: (self._levels[beam], source) for beam, source in of.items()}
        high_is_blocked = self.settings["blocked_level"] == "high"
        told_ns = self._told_ns(message, info)
        changes, wrong = changes_in(LEVELS[kind](message), beams, high_is_blocked, told_ns)
        for beam, change in changes.items():
            self._edges += 1
            self._events.publish(
                BeamEvent(
                    header=header(change.stamp_ns, self.settings["station"]),
                    beam=beam,
                    edge=BeamEvent.BREAK if change.blocked else BeamEvent.RESTORE,
                    stamp_sigma_s=change.sigma_s,
                )
            )
        if wrong is not None:
            raise wrong

    def _told_ns(self, message: Any, info: Any) -> int:
        """Its stamp, else when its publisher sent it, of which DDS knows the wall clock's time."""
        at_ns: int = stamp_ns(message.header.stamp) if hasattr(message, "header") else 0
        sent_ns = 0 if self._simulated else int(info["source_timestamp"])
        return at_ns or sent_ns or self.now_ns()

    def _take_cloud(self, message: Any) -> None:
        at_ns = self._profile_ns(message, 0.0)
        message.header.stamp = time_message(at_ns)
        message.header.frame_id = self.settings["profile_frame"] or message.header.frame_id
        self._show_profile(message)

    def _take_scan(self, message: Any) -> None:
        points, middle_s = scan_profile(message)
        at_ns = self._profile_ns(message, middle_s)
        self._show_profile(profile_cloud(at_ns, self.settings["profile_frame"], points))

    def _profile_ns(self, message: Any, middle_s: float) -> int:
        at_ns = stamp_ns(message.header.stamp)
        if at_ns <= 0:
            raise InputError("no time stamp: a profile is stamped where it is taken")
        latency_s: float = self.settings["profile_latency_ms"] * 1e-3
        return at_ns + round((middle_s - latency_s) * 1e9)

    def _show_profile(self, message: Any) -> None:
        self._profiles += 1
        self._profile.publish(message)

    def _take_tf(self, message: Any) -> None:
        """The tag's transforms of all on tf, each once: some publishers repeat what they told."""
        for found in message.transforms:
            if found.child_frame_id != self.settings["target_frame"]:
                continue
            camera, at_ns = found.header.frame_id, stamp_ns(found.header.stamp)
            if self._cameras.get(camera) == at_ns:
                continue
            self._cameras[camera] = at_ns
            if len(self._cameras) > MOST_CAMERAS:
                self._cameras.pop(next(iter(self._cameras)))
            self._poses += 1
            t = found.transform.translation
            place = Point(x=t.x, y=t.y, z=t.z)
            pose = Pose(position=place, orientation=found.transform.rotation)
            self._target.publish(PoseStamped(header=found.header, pose=pose))

    def health(self) -> Health:
        """Tell the latencies, which are so in each recording, the levels, and what is not heard."""
        settings, health = self.settings, Health()
        if self._levels:
            health.values |= {
                "latency subtracted ms": settings["latency_ms"],
                "jitter ms": settings["jitter_ms"],
                "period ms": settings["period_ms"],
                "edges": self._edges,
            }
        if settings["profile_input"] != NONE:
            health.values |= {
                "profile latency subtracted ms": settings["profile_latency_ms"],
                "profiles": self._profiles,
            }
        if tag := settings["target_frame"]:
            health.values |= {"target poses": self._poses, "cameras": ", ".join(self._cameras)}
            if not self._cameras:
                health.worsen(
                    WARN, f"no {tag} on /tf yet: does its detector see it, and publish it?"
                )
            elif len(self._cameras) > 1:
                told = ", ".join(sorted(self._cameras))
                health.worsen(WARN, f"{tag} is told in frames {told}: hand_eye_node takes one")
        silent_s = LATE_PERIODS * settings["period_ms"] * 1e-3
        for beam, level in self._levels.items():
            words = {None: "unknown", True: "interrupted", False: "free"}[level.blocked]
            health.values[f"beam {beam}"] = words
            age_s = (self.now_ns() - level.told_ns) * 1e-9
            if level.blocked is None:
                health.worsen(WARN, f"beam {beam}: nothing has come yet")
            elif silent_s and age_s > silent_s:
                health.worsen(ERROR, f"beam {beam}: its driver is silent for {age_s:.1f} s")
        for topic, kind in self._topics.values():
            wanted = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
            for info in self.get_publishers_info_by_topic(topic):
                if info.topic_type != wanted:
                    health.worsen(
                        ERROR, f"{topic} of {info.node_name} is {info.topic_type}, not {wanted}"
                    )
        return health


def main() -> None:
    """Run the node."""
    run(AdapterNode)
