# SPDX-License-Identifier: Apache-2.0
"""A simulated robot with a laser sensor over DDS, and the PLC that calls hand_eye_node."""

from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PointStamped, PoseStamped
from hand_eye_driver import FRAME, LASER, RADIUS_M, TYPE, Recorded, Robot, sphere_shots_of
from rclpy.qos import HistoryPolicy, QoSProfile
from robocal_msgs.msg import HandEyeSample, HandEyeStatus, SessionEvent
from robocal_msgs.srv import CalibrateHandEye, CaptureHandEye, StartHandEye
from sensor_msgs.msg import CompressedImage, Image, JointState, PointCloud2, PointField

from bench.hand_eye_files import write_target
from robocal_ros.bags.bags import BagWriter
from robocal_ros.ground.samples import JOINTS
from robocal_ros.hand_eye.data import COMPRESSED, IMAGE, PROFILE, TARGET_POSE, TRACKER_POINT
from robocal_ros.hand_eye.node import HandEyeNode
from robocal_ros.hand_eye.targets import SphereTarget
from robocal_ros.ros import endpoints

STREAM = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=2000)
TYPES = {
    JOINTS: JointState, PROFILE: PointCloud2, TARGET_POSE: PoseStamped, IMAGE: Image,
    TRACKER_POINT: PointStamped, COMPRESSED: CompressedImage,
}  # fmt: skip
NAME = "/hand_eye_node"
SHOTS = list(sphere_shots_of(14))


def filled(message: Any, fields: dict[str, Any]) -> Any:
    """A message of rclpy with these fields."""
    for name, value in fields.items():
        if isinstance(value, dict):
            filled(getattr(message, name), value)
        elif name == "fields":
            message.fields = [PointField(**field) for field in value]
        else:
            setattr(message, name, array("B", value) if isinstance(value, bytes) else value)
    return message


def settings_of(folder: Path, **parameters: Any) -> dict[str, Any]:
    """Parameters of a node that calibrates on the sphere."""
    file = folder / "sphere.yaml"
    write_target(file, SphereTarget(RADIUS_M))
    told = {"serial": "K7", "sensor_frame": FRAME, "target_file": str(file)}
    return told | {"z_grows": LASER.z_grows} | parameters


def recorded(folder: Path, sent: list[Recorded], live: list[SessionEvent]) -> Path:
    """A recording of what was published, and of the session's events."""
    path, now_ns = folder / "live.mcap", 0
    with BagWriter(path, latched=[f"{NAME}/session_events"]) as bag:
        for message in sent:
            now_ns = max(now_ns, message.stamp_ns)
            bag.write(f"/{message.kind}", TYPE[message.kind], message.fields, now_ns)
        for event in live:
            bag.write(f"{NAME}/session_events", "robocal_msgs/msg/SessionEvent", event, now_ns)
    return path


class LiveSensor:
    """Robot, sensor and PLC of one hand_eye_node."""

    def __init__(self, graph: Any, folder: Path, **parameters: Any) -> None:
        self.graph = graph
        self.status = graph.collect(HandEyeStatus, f"{NAME}/status", endpoints.LATCHED)
        self.node = graph.add(HandEyeNode, settings_of(folder, **parameters))
        self._publishers = {
            kind: graph.publisher(message, kind, STREAM) for kind, message in TYPES.items()
        }
        graph.spin_for(0.2)
        self.robot = Robot(self.give)
        self.robot.q = SHOTS[0][0]
        self.sent: list[Recorded] = []
        self._count = 0

    def publish(self, message: Recorded) -> None:
        """Publish a message, whether or not it is taken."""
        self.sent.append(message)
        self._count += 1
        self._publishers[message.kind].publish(filled(TYPES[message.kind](), message.fields))

    def give(self, message: Recorded) -> None:
        """Publish a message; at most two are on their way, so that topics stay in step."""
        self.publish(message)
        inputs = self.node.inputs

        def near() -> bool:
            return sum(count.received for count in inputs.values()) >= self._count - 2

        self.graph.spin_until(near, "the messages arrive")

    def start(self, **request: Any) -> Any:
        self.robot.rest(0.1)
        return self.graph.call(StartHandEye, f"{NAME}/start", **request)

    def ask_capture(self, mark: str = "") -> Any:
        """Ask for a capture; the answer comes at once."""
        return self.graph.call(CaptureHandEye, f"{NAME}/capture", mark=mark)

    def capture(
        self,
        shot: Callable[[int], Recorded] | None,
        seconds: float = 0.7,
        mark: str = "",
        hz: int = 10,
    ) -> Any:
        """A capture at rest, and how it ended."""
        self.robot.rest(0.1)
        asked = self.ask_capture(mark)
        assert asked.success, asked.message
        self.robot.rest(seconds, shot, hz)
        return self.ended(asked.handle)

    def ended(self, handle: int) -> Any:
        """The status of a capture that has ended."""
        self.graph.spin_until(
            lambda: self.of(handle).state not in (0, HandEyeSample.WAITING), f"capture {handle}"
        )
        return self.of(handle)

    def of(self, handle: int) -> Any:
        """A capture as the status tells it."""
        found = [s for s in self.status[-1].samples if s.handle == handle]
        return found[0] if found else HandEyeSample()

    def sphere(self, count: int = 10) -> None:
        """Start, and capture the sphere from each pose."""
        assert self.start().success
        for q, shot in SHOTS[:count]:
            self.robot.move(q, 0.2)
            assert self.capture(shot).state == HandEyeSample.CAPTURED

    def calibrate(self, **request: Any) -> Any:
        return self.graph.call(CalibrateHandEye, f"{NAME}/calibrate", within_s=30.0, **request)
