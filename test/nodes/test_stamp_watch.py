# SPDX-License-Identifier: Apache-2.0
"""Readings against this host's clock; robots that nothing but their file or serial tells apart."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import JointState

from robocal_ros.ground.errors import WrongRobotError
from robocal_ros.kinematics.robots import find_robot, load_description
from robocal_ros.maintenance.node import MaintenanceNode
from robocal_ros.ros import session_node
from robocal_ros.ros.conversions import time_message
from robocal_ros.ros.session_node import open_history
from robocal_ros.thermal.node import ThermalNode

NAMES = load_description("kr150_r3100").arm.joint_names
NS = 1_000_000_000


class Reader:
    """A thermal node, a controller that stamps as it is told, and what the diagnostics say."""

    def __init__(self, graph: Any) -> None:
        self.graph = graph
        self.node = graph.add(ThermalNode, {"serial": "s1"})
        self.said = graph.collect(DiagnosticArray, "/diagnostics")
        self.joints = graph.publisher(JointState, "/joint_states")

    def publish(self, ahead_ns: int, **fields: Any) -> None:
        message = JointState(name=list(NAMES), position=np.zeros(6), **fields)
        message.header.stamp = time_message(self.node.now_ns() + ahead_ns)
        self.joints.publish(message)

    def until(self, words: str, ahead_ns: int | None = None) -> DiagnosticStatus:
        """Publish until the newest diagnostics say so."""

        def said() -> bool:
            if ahead_ns is not None:
                self.publish(ahead_ns)
            return bool(self.said) and words in self.said[-1].status[0].message

        self.graph.spin_until(said, words)
        return self.said[-1].status[0]


def test_a_stamp_ahead_of_now_is_a_fault_until_the_clocks_are_right(graph: Any) -> None:
    reader = Reader(graph)
    status = reader.until("s ahead of this host's clock", 3 * NS)
    assert "joint_states is stamped" in status.message
    assert status.level == DiagnosticStatus.ERROR
    assert "NTP" in status.message
    status = reader.until("ok", 0)
    assert status.level == DiagnosticStatus.OK


def test_one_wrong_stamp_among_right_ones_is_no_fault_of_the_clock(graph: Any) -> None:
    reader = Reader(graph)
    watch = reader.node._stamps
    for ahead_ns in (0, 3600 * NS, 0):
        message = JointState()
        message.header.stamp = time_message(reader.node.now_ns() + ahead_ns)
        watch.note("joint_states", message)
    health = session_node.Health()
    watch.judge(health)
    assert health.message == "ok"


def test_silence_is_counted_by_receive_time(graph: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stamps that lie in the future do not keep a dead controller alive."""
    monkeypatch.setattr(session_node, "SILENT_S", 0.5)
    reader = Reader(graph)
    reader.until("ok", 0)
    status = reader.until("joint_states is silent")
    assert status.level == DiagnosticStatus.WARN


def test_velocities_and_efforts_that_are_no_numbers_are_absent_ones(graph: Any) -> None:
    """As joint_state_broadcaster writes them for hardware with positions alone."""
    reader = Reader(graph)
    nothing = np.full(6, np.nan)
    graph.spin_until(
        lambda: (
            reader.publish(0, velocity=nothing, effort=nothing[:5])
            or reader.node._session.newest_joints_ns
        ),
        "the readings are taken",
    )
    assert not reader.node._session.desk.ignored


def test_two_nameless_robots_of_one_type_share_no_history(tmp_path: Path) -> None:
    """Same geometry, so the same model hash; the files differ in a speed."""
    own, other = tmp_path / "left.yaml", tmp_path / "right.yaml"
    text = find_robot("ur10").read_text()
    own.write_text(text)
    other.write_text(text.replace("max_velocity_deg_s: 120", "max_velocity_deg_s: 119"))
    robot, second = load_description(own), load_description(other)
    assert second.arm.model_hash == robot.arm.model_hash
    settings = {"serial": "", "state_dir": str(tmp_path / "state")}
    for _ in range(2):  # the same robot comes back
        serial, history = open_history(settings, robot)
        history.close()
        assert serial == "unset"
    with pytest.raises(WrongRobotError, match="set the serial of each robot"):
        open_history(settings, second)
    open_history(settings | {"serial": "right"}, second)[1].close()


@pytest.mark.parametrize("kind", [ThermalNode, MaintenanceNode])
def test_the_second_node_of_a_kind_for_a_serial_refuses_to_work(graph: Any, kind: type) -> None:
    values = {} if kind is ThermalNode else {"home_deg": [0.0, -90.0, 90.0, 0.0, 90.0, 0.0]}
    left = graph.add(kind, values, namespace="left")
    assert left.is_active
    said = graph.collect(DiagnosticArray, "/diagnostics")
    right = graph.add(kind, values, namespace="right")
    assert not right.is_active
    why = f"another {kind.NAME} (process {os.getpid()}) keeps the calibrations of robot 'unset'"
    graph.spin_until(
        lambda: any(why in status.message for array in said for status in array.status),
        "it says why",
    )
    other = graph.add(kind, values | {"serial": "K8"}, namespace="other")
    assert other.is_active
    left.trigger_deactivate()
    left.trigger_cleanup()
    right.autostart()
    assert right.is_active
