# SPDX-License-Identifier: Apache-2.0
"""Two robots that measure in one place, their gaps by OPC UA: one has it, the other waits.

What two_robots.launch.py starts with plc:=true and shared:=true and a gap passes: two bridges,
sharing_node, each robot's maintenance_node, all processes. The robots stand.
"""

from collections.abc import Coroutine, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robocal_msgs.msg import GapOpen, MaintenanceStatus
from sensor_msgs.msg import JointState
from test_maintenance_calls import HOME_DEG, PERIOD_S, SETTINGS

from bench.live.opc_ua import PlcClient, free_port, security_folder
from robocal_ros.ground.errors import Code
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros import endpoints

ROOT = Path(__file__).parents[2]
ROBOTS = ("left", "right")
ASKS = {"gap_open": "gap_wanted"}  # of plc_bridge_node; test_launch_files.py has it of launch
UP_S = 60.0  # seven processes start at once


def files(*names: str) -> list[str]:
    """Parameter files as launch gives them."""
    given = (("--params-file", str(ROOT / "config" / name)) for name in names)
    return ["--ros-args", *(word for pair in given for word in pair)]


class SharedCell:
    """One of the robots: its nodes, and its own PLC."""

    def __init__(self, graph: Any, name: str, folder: Path) -> None:
        self.graph, self.name, port = graph, name, free_port()
        namespace = {"__ns": f"/{name}"}
        status, gap = f"/{name}/maintenance_node/status", f"/{name}/gap_open"
        self.statuses = graph.collect(MaintenanceStatus, status, endpoints.LATCHED)
        self.gaps = graph.collect(GapOpen, gap, endpoints.HEARTBEAT)
        self._joints = graph.probe.create_publisher(JointState, f"/{name}/joint_states", 10)
        graph.probe.create_timer(PERIOD_S, self._stand)
        serial = {"serial": f"SIM-{name.upper()}"}
        graph.start("maintenance_node", SETTINGS | serial, namespace)
        graph.start(
            "plc_bridge_node",
            {"security_dir": str(folder), "host": "127.0.0.1", "port": port},
            namespace | ASKS,
            *files("plc_bridge_node.yaml", f"cells/{name}.yaml"),
        )
        self.plc = PlcClient(folder, port)
        self.plc.is_open, self.plc.beating = False, True

    def _stand(self) -> None:
        message = JointState(name=[*load_robot("ur10").joint_names])
        message.position = np.radians(HOME_DEG).tolist()
        message.header.stamp = self.graph.probe.get_clock().now().to_msg()
        self._joints.publish(message)

    def begin(self) -> None:
        self.do(self.plc.connect_once_there(UP_S))
        self.plc.start(self.plc.program())
        self.graph.spin_until(self._is_at_home, f"{self.name} is at home", UP_S)

    def _is_at_home(self) -> bool:
        return bool(self.statuses and self.statuses[-1].at_home)

    def do(self, work: Coroutine[Any, Any, Any]) -> Any:
        return self.graph.meanwhile(self.plc, work)

    def call(self, method: str, *arguments: Any) -> list[Any]:
        return self.do(self.plc.call(method, *arguments))

    @property
    def is_open(self) -> bool:
        """Whether its maintenance_node counts the gap as open and has nothing else to do."""
        return not self.statuses[-1].doing

    def opened_s(self) -> list[float]:
        """When its bridge sent what opened its gap."""
        stamps = [gap.header.stamp for gap in self.gaps if gap.open]
        return [stamp.sec + 1e-9 * stamp.nanosec for stamp in stamps]


@pytest.fixture
def cells(graph: Any, tmp_path: Path) -> Iterator[list[SharedCell]]:
    folder = security_folder(tmp_path / "plc")
    graph.start("sharing_node", None, None, *files("sharing_node.yaml"))
    made = [SharedCell(graph, name, folder) for name in ROBOTS]
    try:
        for cell in made:
            cell.begin()
        yield made
    finally:
        for cell in made:
            cell.plc.close()


@pytest.mark.long
def test_the_gap_of_one_opens_and_the_other_waits_for_its_end(graph, cells):
    left, right = cells
    for cell in cells:
        publishers = graph.probe.get_publishers_info_by_topic(f"/{cell.name}/gap_open")
        assert [one.node_name for one in publishers] == ["sharing_node"]
    left.plc.is_open = True
    graph.spin_until(lambda: left.is_open, "the gap of the left one is open", UP_S)
    assert not right.is_open
    right.plc.is_open = True

    def refused() -> list[GapOpen]:
        return [gap for gap in right.gaps if gap.echo and not gap.open]

    graph.spin_until(lambda: len(refused()) >= 5, "what the right one's PLC asks for has come")
    assert not right.is_open
    assert not right.opened_s()
    assert right.call("Run", "1", 30.0)[:2] == [False, Code.CONFLICT]
    graph.spin_until(lambda: left.call("Run", "1", 30.0)[0], "the left one's cycle begins")
    graph.spin_until(lambda: left.call("Status", "1")[4] == Code.ACCEPT, "its cycle ends")
    assert not right.opened_s()
    left.plc.is_open = False
    graph.spin_until(lambda: right.is_open, "the gap of the right one is open")
    assert not left.is_open
    graph.spin_until(lambda: right.call("Run", "2", 30.0)[0], "the right one's cycle begins")
    assert left.call("Run", "2", 30.0)[:2] == [False, Code.CONFLICT]
    assert max(left.opened_s()) < min(right.opened_s())
