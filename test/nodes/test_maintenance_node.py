# SPDX-License-Identifier: Apache-2.0
"""The maintenance of a whole cell over DDS; the test is the PLC."""

from pathlib import Path
from typing import Any

import pytest
from maintenance_live import LiveCell
from robocal_msgs.msg import AccuracyState, MaintenanceStatus
from robocal_msgs.srv import Acknowledge, GetMaintenance, RunMaintenanceCycle

from robocal_ros.ground.errors import Code

pytestmark = pytest.mark.cell
GAP_S = 150.0


def test_a_gap_that_closes_stops_the_tool_node_at_once_and_so_does_the_end_of_this_node(
    graph: Any, tmp_path: Path
) -> None:
    cell = LiveCell(graph, tmp_path)
    ended = cell.measures("c1", GAP_S)  # without a cold reference the tool alone is measured
    graph.spin_for(0.5)
    cell.is_open = False
    graph.spin_until(lambda: len(cell.goals) >= 3, "the stop", within_s=1.0)
    graph.spin_until(lambda: cell.stands(1.0), "it stands", within_s=4.0)
    stopped = len(cell.goals)
    assert not graph.awaited(ended, "the result").result.success
    status = graph.call(GetMaintenance, "/maintenance_node/status")
    assert status.state.state == MaintenanceStatus.FAULT
    assert status.state.disarmed
    assert not status.state.at_home
    cell.state(AccuracyState.FAULT)
    cell.is_open = True
    graph.spin_for(0.5)
    refused = graph.call(RunMaintenanceCycle, "/maintenance_node/run", cycle_id="c2", gap_s=GAP_S)
    assert (refused.success, refused.status) == (False, Code.CONFLICT)
    cell.node.kill()
    cell.start_maintenance()  # a fault outlives its node
    assert cell.statuses[-1].state == MaintenanceStatus.FAULT
    graph.spin_until(lambda: cell.statuses[-1].disarmed, "the tool node confirms it")
    answer = graph.call(Acknowledge, "/maintenance_node/acknowledge", by="me")
    assert (answer.success, answer.status) == (False, Code.LIMIT_EXCEEDED), answer.message
    assert "robot is not at home: " in answer.message
    away = graph.call(RunMaintenanceCycle, "/maintenance_node/run", cycle_id="c2", gap_s=GAP_S)
    assert away.status == Code.CONFLICT
    assert len(cell.goals) == stopped

    cell.drive_home()
    cell.measures("c3", GAP_S)
    cell.node.kill()  # the gap stays open, but nobody counts beats any more
    sent = len(cell.goals)
    graph.spin_until(lambda: len(cell.goals) > sent, "the stop", within_s=1.5)
    graph.spin_until(lambda: cell.stands(1.0), "it stands", within_s=4.0)
    cell.start_maintenance()
    assert cell.statuses[-1].state == MaintenanceStatus.FAULT
    assert "see where the robot is" in cell.statuses[-1].fault
    graph.spin_until(lambda: cell.statuses[-1].disarmed, "it is disarmed")


def test_a_driver_that_would_not_stop_at_the_gaps_end_measures_nothing(
    graph: Any, tmp_path: Path
) -> None:
    cell = LiveCell(graph, tmp_path, listens=False)
    for name in ("c0", "c1"):  # one that a busy machine broke off at home may be asked for again
        ended = cell.run(name, GAP_S)
        if ended.success:
            break
    assert ended.success, ended.message
    result = ended.result
    assert result.tool_code == Code.CONFLICT
    # There is no cold reference either, without which nothing thermal is measured.
    assert result.left == ["thermal measurement", "tool measurement (quick)"]
    assert "tcf_node: gap_open is not listened to: gap_stale_s is 0; set it to 0.5" in ended.message
    assert cell.goals == cell.on_topic == []
    graph.spin_until(lambda: cell.statuses[-1].disarmed, "the tool node is disarmed")
