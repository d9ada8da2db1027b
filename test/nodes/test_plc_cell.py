# SPDX-License-Identifier: Apache-2.0
"""A gap of a whole cell by OPC UA alone: the PLC runs it, its bridge is killed in a motion."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from maintenance_live import HOME_DEG, LiveCell
from robocal_msgs.msg import MaintenanceStatus, ToolFrame
from test_plc_bridge import DISAPPEARS_S, refused

from bench.live.opc_ua import PlcClient, free_port, security_folder
from robocal_ros.ground.errors import Code
from robocal_ros.ros import endpoints

pytestmark = pytest.mark.cell
GAP_S = 150.0


def test_a_whole_gap_by_opc_ua_and_a_bridge_that_dies_while_the_robot_moves(
    graph: Any, tmp_path: Path
) -> None:
    cell = LiveCell(graph, tmp_path)
    cell._stop_beats()
    graph.probe.destroy_publisher(cell.gap)  # the bridge's PLC alone gives the gap
    folder, port = security_folder(tmp_path / "plc"), free_port()
    settings = {"security_dir": str(folder), "host": "127.0.0.1", "port": port}
    bridge = graph.start("plc_bridge_node", settings)
    plc, ada = PlcClient(folder, port), PlcClient(folder, port, "ada", "panel")
    graph.at_close += [plc.close, ada.close]

    def do(client: PlcClient, work: Any, within_s: float = 70.0) -> Any:
        done = client.start(work)
        graph.spin_until(done.done, "the PLC's request", within_s)
        return done.result()

    def opens() -> None:
        do(plc, plc.connect_once_there())
        do(ada, ada.connect_once_there())
        plc.beating = True
        graph.spin_until(lambda: not cell.statuses[-1].doing, "the gap is open", DISAPPEARS_S)

    def ended(cycle: str) -> bool:
        last = cell.statuses[-1].last
        return last.cycle_id == cycle and last.code != Code.NONE

    def begins(name: str) -> str:
        """A cycle comes to its first circle; one that a busy machine broke off is called again."""
        for again in range(3):
            before, cycle = len(cell.goals), f"{name}{'+' * again}"
            begun = do(plc, plc.call("Run", cycle, GAP_S))
            assert begun[:2] == [True, Code.ACCEPT], begun[2]
            graph.spin_until(
                lambda n=before, c=cycle: len(cell.goals) == n + 2 or ended(c), "a circle"
            )
            if len(cell.goals) == before + 2:
                return cycle
        raise AssertionError(cell.statuses[-1])

    plc.start(plc.program())
    opens()
    begins("c1")
    bridge.kill()
    sent = len(cell.goals)
    graph.spin_until(lambda: len(cell.goals) > sent, "the stop", within_s=1.5)
    graph.spin_until(lambda: cell.stands(1.0), "it stands", within_s=4.0)
    status: MaintenanceStatus = cell.statuses[-1]
    assert (status.state, status.disarmed, status.at_home) == (MaintenanceStatus.FAULT, True, False)

    bridge = graph.start("plc_bridge_node", settings)
    do(plc, plc.connect_once_there())
    do(ada, ada.connect_once_there())
    graph.spin_until(
        lambda: do(plc, plc.read("Maintenance.State")) == MaintenanceStatus.FAULT, "it is shown"
    )
    assert do(plc, plc.read("Maintenance.Fault")) == cell.statuses[-1].fault
    away = do(ada, ada.call("Acknowledge"))
    assert away[:2] == [False, Code.LIMIT_EXCEEDED]
    assert "robot is not at home: " in away[2]
    assert refused(lambda: do(plc, plc.call("Acknowledge"))) == "BadUserAccessDenied"
    cell.drive_between(cell.q, np.radians(HOME_DEG))
    graph.spin_until(cell.at_home, "at home")
    graph.spin_until(lambda: do(ada, ada.call("Acknowledge"))[0], "the fault ends")

    opens()
    cycle = begins("c2")
    graph.spin_until(
        lambda: do(plc, plc.call("Status", cycle))[4] != Code.NONE, "it ends", within_s=GAP_S
    )
    success, code, words, state, result, *_ = do(plc, plc.call("Status", cycle))
    assert (success, code, result) == (True, Code.ACCEPT, Code.ACCEPT), words
    assert state == MaintenanceStatus.IDLE
    assert cell.at_home()
    graph.spin_until(lambda: ended(cycle), "the status that tells so")
    graph.spin_until(
        lambda: do(plc, plc.read_all(["LastCycle.CycleId", "LastCycle.Code"])) == [cycle, result],
        "it is shown",
    )
    last = cell.statuses[-1].last
    shown = [do(plc, plc.read(f"LastCycle.{n}")) for n in ("CycleId", "ToolCode", "ToolId", "Left")]
    assert shown == [cycle, last.tool_code, last.tool_id, list(last.left)]
    tools = graph.collect(ToolFrame, "/tcf_node/tool", endpoints.LATCHED)
    graph.spin_until(lambda: tools, "the tool in force")
    assert do(plc, plc.read("Tool.Name")) == tools[-1].child_frame_id != ""
    assert bridge.stop() == 0
