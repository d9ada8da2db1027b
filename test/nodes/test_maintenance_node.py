"""The maintenance of a whole cell over DDS; the test is the PLC."""

from pathlib import Path
from typing import Any

import pytest
from maintenance_live import LiveCell
from robocal_msgs.msg import AccuracyState, MaintenanceStatus
from robocal_msgs.srv import Acknowledge, Decide, GetMaintenance, RunMaintenanceCycle
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code

GAP_S = 150.0


def test_a_gap_that_closes_stops_the_tool_node_at_once(graph: Any, tmp_path: Path) -> None:
    cell = LiveCell(graph, tmp_path)
    for name in ("c0", "c1"):  # one that a busy machine broke off at home may be asked for again
        handle = cell.begin(name, GAP_S)  # without a cold reference the tool alone is measured
        ended = handle.get_result_async()
        graph.spin_until(
            lambda e=ended: len(cell.goals) == 2 or e.done(), "the first circle", within_s=30.0
        )
        if not ended.done():
            break
    assert len(cell.goals) == 2
    graph.spin_for(0.5)
    cell.is_open = False
    graph.spin_until(lambda: len(cell.goals) >= 3, "the stop", within_s=1.0)
    graph.spin_until(lambda: cell.stands(1.0), "it stands", within_s=4.0)
    stopped = len(cell.goals)
    graph.spin_until(ended.done, "the result")
    assert not ended.result().result.success
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
    answer = graph.call(Acknowledge, "/maintenance_node/acknowledge", by="me")
    assert (answer.success, answer.status) == (False, Code.LIMIT_EXCEEDED), answer.message
    assert "robot is not at home: " in answer.message
    away = graph.call(RunMaintenanceCycle, "/maintenance_node/run", cycle_id="c2", gap_s=GAP_S)
    assert away.status == Code.CONFLICT
    assert len(cell.goals) == stopped


@pytest.mark.cell
def test_calls_are_answered_at_once_while_the_robot_moves(graph: Any, tmp_path: Path) -> None:
    cell = LiveCell(graph, tmp_path)
    begun = graph.call(RunMaintenanceCycle, "/maintenance_node/run", cycle_id="c1", gap_s=GAP_S)
    assert begun.success, begun.message
    graph.spin_until(lambda: len(cell.goals) == 2, "the first circle", within_s=30.0)
    calls = {
        "run": (RunMaintenanceCycle, {"cycle_id": "c1", "gap_s": GAP_S}, Code.ACCEPT),
        "status": (GetMaintenance, {}, Code.ACCEPT),
        "accept": (Decide, {"id": 99}, Code.BAD_INPUT),
        "reject": (Decide, {"id": 99}, Code.BAD_INPUT),
        "rollback": (Decide, {"id": 99}, Code.BAD_INPUT),
        "acknowledge": (Acknowledge, {"by": "plc"}, Code.ACCEPT),
    }
    for name, (kind, fields, code) in calls.items():
        answer, took_s = cell.timed(kind, name, **fields)
        assert answer.status == code, (name, answer.message)
        print(f"{name}: {took_s * 1e3:.1f} ms")
        assert took_s < 0.25, name
    for name, words in {
        "run_trigger": "0 ACCEPT cycle 'c1' runs already",
        "status_trigger": "0 NONE ",
        "accept_trigger": "0 CONFLICT one candidate must wait",
        "rollback_trigger": "0 BAD_INPUT nothing was accepted",
        "acknowledge_trigger": "0 ACCEPT there is no fault",
    }.items():
        answer, took_s = cell.timed(Trigger, name)
        assert answer.message.startswith(words), answer.message
        print(f"{name}: {took_s * 1e3:.1f} ms")
        assert took_s < 0.25, name
    cancelled, _ = cell.timed(Trigger, "cancel_trigger")
    assert cancelled.success
    graph.spin_until(
        lambda: cell.statuses[-1].state == MaintenanceStatus.IDLE, "it has ended", within_s=60.0
    )
    assert cell.statuses[-1].last.code == Code.CONFLICT
    assert cell.at_home()
    assert cell.on_topic == []


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


@pytest.mark.parametrize("closes", [True, False])
def test_the_tool_node_stops_without_this_node_whatever_the_plc_says(
    graph: Any, tmp_path: Path, closes: bool
) -> None:
    """The gap ends; or it stays open, but nobody counts beats any more."""
    cell = LiveCell(graph, tmp_path)
    cell.begin("c1", GAP_S)
    graph.spin_until(lambda: len(cell.goals) == 2, "the first circle", within_s=30.0)
    cell.node.kill()
    if closes:
        graph.spin_for(0.3)
        cell.is_open = False
    graph.spin_until(lambda: len(cell.goals) >= 3, "the stop", within_s=1.5)
    graph.spin_until(lambda: cell.stands(1.0), "it stands", within_s=4.0)
    cell.start_maintenance()
    assert cell.statuses[-1].state == MaintenanceStatus.FAULT
    assert "see where the robot is" in cell.statuses[-1].fault
    graph.spin_until(lambda: cell.statuses[-1].disarmed, "it is disarmed")
