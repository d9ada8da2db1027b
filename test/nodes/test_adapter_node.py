# SPDX-License-Identifier: Apache-2.0
"""adapter_node over DDS: inputs and scanners as drivers publish them, and the nodes behind it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from hand_eye_driver import Recorded
from hand_eye_live import SHOTS, STREAM, LiveSensor
from robocal_msgs.msg import BeamEvent, CalibrationQuality, HandEyeSample
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, LaserScan, PointCloud2
from std_msgs.msg import Bool
from tool_cell_live import LiveCell
from tool_driver import TRUTH

from robocal_ros.adapter.node import AdapterNode
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import JointSample, cloud_columns, stamp_ns
from robocal_ros.hand_eye.data import PROFILE
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import time_message
from robocal_ros.ros.endpoints import ERROR, OK, WARN

LATE_MS = 40.0


def events_heard(node: Any) -> bool:
    """Whether somebody listens to its events."""
    return bool(node.count_subscribers("/beam_events"))


def test_each_change_of_a_bool_is_an_edge_at_its_time(graph: Any) -> None:
    """By when it was published, which DDS knows: between the clock before and after that."""
    settings = {"input": "bool", "latency_ms": LATE_MS, "jitter_ms": 0.5, "blocked_level": "low"}
    node = graph.add(AdapterNode, settings | {"station": "north"})
    assert node.health().level == WARN
    events = graph.collect(BeamEvent, "/beam_events")
    beam = graph.publisher(Bool, "/beam_y", endpoints.RELIABLE)
    graph.spin_until(lambda: beam.get_subscription_count() and events_heard(node), "each other")
    sent = []
    for high in (True, True, False, False, True):
        before = graph.probe.get_clock().now().nanoseconds
        beam.publish(Bool(data=high))
        sent.append((high, before, graph.probe.get_clock().now().nanoseconds))
        graph.spin_for(0.05)
    graph.spin_until(lambda: len(events) == 2, "both edges")
    assert [event.edge for event in events] == [BeamEvent.BREAK, BeamEvent.RESTORE]
    for event, (_, before, after) in zip(events, (sent[2], sent[4]), strict=True):
        assert (event.beam, event.header.frame_id, event.stamp_sigma_s) == ("y", "north", 5e-4)
        assert before <= stamp_ns(event.header.stamp) + round(LATE_MS * 1e6) <= after
    health = node.health()
    assert health.values["latency subtracted ms"] == LATE_MS  # recorded once a second
    assert (health.values["beam y"], health.values["edges"]) == ("free", 2)
    assert health.level == WARN  # of x nothing has come yet


class CellOfBools(LiveCell):
    """Its beams are two Bools that are told late; what the adapter takes for now is the clock's."""

    def __init__(self, graph: Any, folder: Path) -> None:
        super().__init__(graph, folder, TRUTH)
        graph.probe.destroy_publisher(self.edges)
        settings = {"input": "bool", "latency_ms": LATE_MS, "use_sim_time": True}
        self.adapter = graph.add(AdapterNode, settings | {"station": self.station})
        self.clock = graph.publisher(Clock, "/clock", endpoints.RELIABLE)
        self.beams = {beam: graph.publisher(Bool, f"/beam_{beam}") for beam in "xy"}
        ends = [self.clock, *self.beams.values()]
        graph.spin_until(lambda: all(end.get_subscription_count() for end in ends), "the adapter")
        for beam in self.beams:
            self.tell(1, beam, False)

    def tell(self, told_ns: int, beam: str, blocked: bool) -> None:
        """Publish a level when the clock says so, and let the adapter take it."""
        self.clock.publish(Clock(clock=Time(sec=told_ns // 10**9, nanosec=told_ns % 10**9)))
        self.graph.spin_until(lambda: self.adapter.now_ns() == told_ns, "the clock")
        count = self.adapter.inputs[f"beam_{beam}"]
        taken = count.received
        self.beams[beam].publish(Bool(data=blocked))
        self.graph.spin_until(lambda: count.received > taken, "the level")

    def give(self, sample: Any) -> None:
        if isinstance(sample, JointSample):
            super().give(sample)
            return
        self.tell(sample.stamp_ns + round(LATE_MS * 1e6), sample.beam, sample.blocked)
        self._taken(2)


def test_a_tool_is_measured_with_beams_that_are_bools(graph: Any, tmp_path: Path) -> None:
    result = CellOfBools(graph, tmp_path).measure()
    assert result.success, result.message
    assert result.status == CalibrationQuality.ACCEPT
    t = result.tool.tool.translation
    away = np.array([t.x, t.y, t.z]) - TRUTH[:3, 3]
    covariance = np.array(result.tool.covariance).reshape(5, 5)[:3, :3]
    assert away @ np.linalg.solve(covariance, away) < 16.3  # chi-square, 1e-3


class SensorOfClouds(LiveSensor):
    """Its driver stamps a cloud when it sends it, half a second after it was taken."""

    LATE_NS = 500_000_000

    def __init__(self, graph: Any, folder: Path) -> None:
        late = {"profile_input": "cloud", "profile_latency_ms": self.LATE_NS * 1e-6}
        self.adapter = graph.add(AdapterNode, late)
        super().__init__(graph, folder)
        graph.probe.destroy_publisher(self._publishers[PROFILE])
        cloud = self._publishers[PROFILE] = graph.publisher(PointCloud2, "cloud", STREAM)
        graph.spin_until(cloud.get_subscription_count, "the adapter")

    def publish(self, message: Recorded) -> None:
        if message.kind == PROFILE:
            at_ns = message.stamp_ns + self.LATE_NS
            stamp = {"sec": at_ns // 10**9, "nanosec": at_ns % 10**9}
            fields = message.fields | {"header": message.fields["header"] | {"stamp": stamp}}
            message = Recorded(message.kind, message.stamp_ns, fields)
        super().publish(message)


def test_profiles_that_are_stamped_late_are_of_when_the_robot_stood(
    graph: Any, tmp_path: Path
) -> None:
    """What is captured has the stamp of the shot, not of the message."""
    sensor = SensorOfClouds(graph, tmp_path)
    assert sensor.start().success
    for q, shot in SHOTS[:2]:
        sensor.robot.move(q, 0.2)
        captured = sensor.capture(shot)
        assert captured.state == HandEyeSample.CAPTURED, captured.reason
        shots = {sent.stamp_ns for sent in sensor.sent if sent.kind == PROFILE}
        assert stamp_ns(captured.stamp) in shots
    health = sensor.adapter.health()
    assert (health.level, health.values["profile latency subtracted ms"]) == (OK, 500.0)
    assert health.values["profiles"] > 0


def test_a_scan_becomes_a_profile_of_its_middle(graph: Any) -> None:
    frame = {"profile_frame": "line", "profile_latency_ms": LATE_MS}
    graph.add(AdapterNode, {"profile_input": "scan"} | frame)
    profiles = graph.collect(PointCloud2, "/profile", endpoints.SENSOR)
    scans = graph.publisher(LaserScan, "/scan", endpoints.SENSOR)
    at_ns = 1_700_000_000 * 10**9
    scan = LaserScan(angle_min=-0.1, angle_increment=0.05, time_increment=1e-3, range_max=2.0)
    scan.header.stamp, scan.header.frame_id = time_message(at_ns), "scanner"
    scan.ranges = [0.5, 0.5, 0.5, float("inf"), 0.5]

    def seen() -> bool:
        scans.publish(scan)
        graph.spin_for(0.02)
        return bool(profiles)

    graph.spin_until(seen, "a profile")
    found = cloud_columns(profiles[0], ("x", "y", "z"))
    angle = np.array([-0.1, -0.05, 0.0, np.nan, 0.1])
    expected = 0.5 * np.column_stack([np.sin(angle), 0.0 * angle, np.cos(angle)])
    expected[3, 1] = 0.0
    assert found == pytest.approx(expected, abs=1e-7, nan_ok=True)  # float32
    assert profiles[0].header.frame_id == "line"
    # the rays take 4 ms
    assert stamp_ns(profiles[0].header.stamp) == at_ns + 2_000_000 - round(LATE_MS * 1e6)


def test_a_driver_that_falls_silent_and_one_of_another_type_are_errors(graph: Any) -> None:
    node = graph.add(AdapterNode, {"input": "bool", "period_ms": 10.0})
    beam = graph.publisher(Bool, "/beam_x", endpoints.RELIABLE)
    graph.other("other").create_publisher(JointState, "/beam_y", endpoints.RELIABLE)
    beam.publish(Bool(data=True))
    graph.spin_until(lambda: node.health().values["beam x"] == "interrupted", "its level")
    graph.spin_until(lambda: "beam x: its driver is silent for" in node.health().message, "silence")
    words = "/beam_y of other is sensor_msgs/msg/JointState, not std_msgs/msg/Bool"
    graph.spin_until(lambda: words in node.health().message, "the wrong type")
    assert node.health().level == ERROR


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, "there is nothing to adapt"),
        ({"profile_input": "scan"}, "profile_frame is empty"),
        ({"input": "bool", "sources": ["/a"]}, "2 beams (x, y) and 1 sources"),
        ({"input": "ur_io"}, "'beam_x' is no number of a digital input"),
    ],
)
def test_what_cannot_work_is_refused_in_words(
    graph: Any, settings: dict[str, Any], words: str
) -> None:
    node = graph.add(AdapterNode, settings)
    assert node.state == "unconfigured"
    assert words in node._full_health().message


def test_messages_that_are_not_installed_are_named(graph: Any) -> None:
    try:
        import ur_msgs.msg  # noqa: F401
    except ImportError:
        node = graph.add(AdapterNode, {"input": "ur_io", "sources": ["0", "1"]})
        assert "apt install ros-jazzy-ur-msgs" in node._full_health().message
        with pytest.raises(InputError, match="ur_msgs"):
            node.configure()
    else:
        pytest.skip("they are installed")
