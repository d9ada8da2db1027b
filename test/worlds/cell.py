# SPDX-License-Identifier: Apache-2.0
"""The simulated shift as ROS messages, and a probe that drives the thermal node with it."""

import json
from collections.abc import Iterable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from robocal_msgs.msg import AccuracyState, CalibrationQuality, KinematicModel, SessionEvent
from robocal_msgs.srv import (
    BeginCycle,
    CaptureReference,
    Decide,
    EndCycle,
    Identify,
    ListCalibrations,
)
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from robocal_ros.ground.samples import REFERENCE_SPHERE, JointSample, PointSample
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import time_message
from robocal_ros.ros.session_node import EVENTS
from robocal_ros.thermal.node import ThermalNode

KEEP_ALL = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
DEEP = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.RELIABLE)
TOPICS = {
    "joint_states": JointState,
    "measured_point": PointStamped,
    REFERENCE_SPHERE: PointStamped,
}
LOSSLESS = {
    f"qos_overrides./{topic}.subscription.{policy}": value
    for topic in TOPICS
    for policy, value in (("reliability", "reliable"), ("history", "keep_all"))
}
SERVICES = {
    "capture_reference": CaptureReference,
    "identify": Identify,
    "accept": Decide,
    "reject": Decide,
    "rollback": Decide,
    "list": ListCalibrations,
    "begin_cycle": BeginCycle,
    "end_cycle": EndCycle,
}


def message_of(sample: JointSample | PointSample) -> JointState | PointStamped:
    if isinstance(sample, JointSample):
        message = JointState(name=list(sample.names), position=sample.position)
    else:
        message = PointStamped()
        message.header.frame_id = f"{sample.frame}/{sample.target}"
        message.point.x, message.point.y, message.point.z = sample.position_m.tolist()
    message.header.stamp = time_message(sample.stamp_ns)
    return message


class Cell:
    """A thermal node, and what it says; ``apart``: a process of its own, which can be killed."""

    def __init__(
        self, graph: Any, serial: str = "s1", *, apart: bool = False, **parameters: Any
    ) -> None:
        self.graph, self.apart = graph, apart
        self.serial = serial
        self.parameters = {"serial": serial, "command_timeout_s": 0.3} | LOSSLESS | parameters
        self.events = graph.collect(SessionEvent, "/thermal_node/session_events", EVENTS)
        self.models = graph.collect(KinematicModel, "/thermal_node/model", endpoints.LATCHED)
        self.candidates = graph.collect(
            KinematicModel, "/thermal_node/candidate", endpoints.LATCHED
        )
        self.qualities = graph.collect(
            CalibrationQuality, "/thermal_node/quality", endpoints.LATCHED
        )
        self.accuracies = graph.collect(AccuracyState, "/thermal_node/accuracy", endpoints.LATCHED)
        self.diagnostics = graph.collect(DiagnosticArray, "/diagnostics")
        probe = graph.probe
        self.joints = probe.create_publisher(JointState, "/joint_states", DEEP)
        self.points = probe.create_publisher(PointStamped, "/measured_point", DEEP)
        self.fixed = probe.create_publisher(PointStamped, f"/{REFERENCE_SPHERE}", DEEP)
        self.poses = probe.create_publisher(PoseStamped, "/measured_pose", DEEP)
        self.clients = {
            name: probe.create_client(kind, f"/thermal_node/{name}")
            for name, kind in SERVICES.items()
        } | {
            f"{name}_trigger": probe.create_client(Trigger, f"/thermal_node/{name}_trigger")
            for name in SERVICES
        }
        self.start()

    def start(self) -> None:
        """Start the node and wait until it is all there."""
        self.models.clear()
        self.sent = dict.fromkeys(TOPICS, 0)
        if self.apart:
            self.process = self.graph.start("thermal_node", self.parameters)
        else:
            self.node = self.graph.add(ThermalNode, self.parameters)
        publishers = (self.joints, self.points, self.poses, self.fixed)
        self.graph.spin_until(
            lambda: (
                self.models
                and all(p.get_subscription_count() for p in publishers)
                and all(c.service_is_ready() for c in self.clients.values())
            ),
            "the thermal node is there",
        )

    def call(self, name: str, **fields: Any) -> Any:
        client = self.clients[name]
        asked = client.call_async(client.srv_type.Request(**fields))
        return self.graph.awaited(asked, f"{name} answers")

    def play(self, samples: Iterable[Any]) -> None:
        """Publish as fast as it goes; nothing is lost, the node keeps all."""
        by_topic = dict(zip(TOPICS, (self.joints, self.points, self.fixed), strict=True))
        for sample in samples:
            topic = "joint_states" if isinstance(sample, JointSample) else sample.topic
            by_topic[topic].publish(message_of(sample))
            self.sent[topic] += 1
        self.graph.spin_until(lambda: self._received() == self.sent, "all is taken")

    def _received(self) -> dict[str, int]:
        """How many messages the node has taken; a process tells it once a second."""
        if self.apart:
            return {topic: int(self.value(f"{topic} received") or 0) for topic in TOPICS}
        return {topic: self.node.inputs[topic].received for topic in TOPICS}

    def status(self) -> Any:
        """The node's last diagnostic status, None before the first."""
        mine = [s for a in self.diagnostics for s in a.status if s.name == "thermal_node"]
        return mine[-1] if mine else None

    def value(self, key: str) -> str:
        status = self.status()
        return "" if status is None else {v.key: v.value for v in status.values}.get(key, "")


def outcomes(events: Iterable[SessionEvent]) -> list[tuple[str, dict[str, Any]]]:
    return [(e.command, json.loads(e.outcome)) for e in events if e.command != "configure"]
