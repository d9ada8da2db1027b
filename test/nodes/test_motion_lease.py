# SPDX-License-Identifier: Apache-2.0
"""Who may move the robot, over DDS: one node of a kind, and no program while it measures."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from maintenance_live import HOME_DEG, ROBOT, SERIAL, LiveCell
from robocal_msgs.msg import CorrectionStatus, MaintenanceStatus
from robocal_msgs.srv import Acknowledge, Decide, GetMaintenance, RunMaintenanceCycle
from std_srvs.srv import SetBool, Trigger
from test_maintenance_calls import HOME_DEG as STANDING_DEG
from test_maintenance_calls import Plc, process
from tool_cell_live import LiveCell as ToolCell
from tool_driver import TRUTH
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.ground.errors import Code
from robocal_ros.ros import endpoints

PROGRAM = "/program/joint_trajectory"
GAP_S = 150.0
STRANGER = f"/planner publishes {ROBOT}"


def test_two_maintenance_nodes_of_two_hosts_refuse_until_one_is_gone(
    graph: Any, tmp_path: Path
) -> None:
    """Each has a history of its own, so that no file tells of the other."""
    plc = Plc(graph, lambda: process(graph))
    settings = {"serial": "K7", "home_deg": str(STANDING_DEG), "state_dir": str(tmp_path / "b")}
    second = graph.start("maintenance_node", settings, {"__node": "another_name"})
    said = graph.collect(DiagnosticArray, "/diagnostics")
    words = "accuracy_state has 2 publishers"
    for node in ("another_name", "maintenance_node"):
        graph.spin_until(
            lambda n=node: any(n in s.name and words in s.message for a in said for s in a.status),
            f"{node} says so",
            30.0,
        )
    answer = graph.call(RunMaintenanceCycle, "/another_name/run", cycle_id="c1", gap_s=30.0)
    assert (answer.success, answer.status) == (False, Code.CONFLICT), answer.message
    answer = plc.run("c1")
    assert (answer.success, answer.status) == (False, Code.CONFLICT), answer.message
    assert second.stop() == 0
    graph.spin_until(lambda: plc.run("c2").success, "the one that is left works")


def test_two_tool_nodes_of_two_hosts_arm_nothing_until_one_is_gone(
    graph: Any, tmp_path: Path
) -> None:
    """Each has a history of its own, so that no file tells of the other."""
    own = {"motion": "trajectory", "gap_stale_s": 0.0}
    cell = ToolCell(graph, tmp_path, TRUTH, **own)
    why = ""

    def armed() -> bool:
        nonlocal why
        cell.rest(0.1)
        answer = graph.call(SetBool, "/tcf_node/arm", data=True)
        why = answer.message
        return bool(answer.success)

    graph.spin_until(armed, "it is armed")
    laser = str(tmp_path / "laser.yaml")
    files = {"laser": laser, "serial": "K7", "state_dir": str(tmp_path / "other")}
    wired = {"__node": "another_name", "~/joint_trajectory": "/tcf_node/joint_trajectory"}
    second = graph.start("tcf_node", own | files, wired)
    graph.spin_until(lambda: "another_name" in cell.node.health().message, "it says so", 30.0)
    health = cell.node.health()
    assert health.level == b"\x02"
    assert health.values["motion"].startswith("disarmed")
    assert not armed()
    assert "another_name" in why
    assert second.stop() == 0
    graph.spin_until(armed, "the one that is left works")


CALLS = {
    "run": (RunMaintenanceCycle, {"cycle_id": "c1", "gap_s": GAP_S}, Code.ACCEPT),
    "accept": (Decide, {"id": 99}, Code.BAD_INPUT),
    "reject": (Decide, {"id": 99}, Code.BAD_INPUT),
    "rollback": (Decide, {"id": 99}, Code.BAD_INPUT),
    "acknowledge": (Acknowledge, {"by": "plc"}, Code.ACCEPT),
}
TRIGGERS = {
    "run_trigger": "0 ACCEPT cycle 'c1' runs already",
    "status_trigger": "0 NONE ",
    "accept_trigger": "0 CONFLICT one candidate must wait",
    "rollback_trigger": "0 BAD_INPUT nothing was accepted",
    "acknowledge_trigger": "0 ACCEPT there is no fault",
}


@pytest.mark.cell
def test_the_program_waits_while_the_cell_measures_and_calls_do_not(
    graph: Any, tmp_path: Path
) -> None:
    cell = LiveCell(graph, tmp_path)
    settings = {"robot": "ur10", "serial": SERIAL}
    graph.start(
        "joint_correction_node",
        settings,
        {"joint_trajectory": PROGRAM, "~/joint_trajectory": ROBOT},
    )
    said = graph.collect(CorrectionStatus, "/joint_correction_node/status", endpoints.LATCHED)
    target = np.radians(HOME_DEG) + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.1])
    motion = JointTrajectory(
        joint_names=cell.arm.joint_names,
        points=[JointTrajectoryPoint(positions=target, time_from_start=Duration(sec=2))],
    )

    def becomes(state: int, within_s: float = 10.0) -> None:
        graph.spin_until(
            lambda: said and said[-1].state == state, f"{state}: {said[-1:]}", within_s
        )

    becomes(CorrectionStatus.OFF, 30.0)
    to_program = graph.publisher(JointTrajectory, PROGRAM)
    kinds = {name: kind for name, (kind, _, _) in CALLS.items()} | dict.fromkeys(TRIGGERS, Trigger)
    kinds |= {"status": GetMaintenance, "cancel_trigger": Trigger}
    graph.discover({f"/maintenance_node/{name}": kind for name, kind in kinds.items()})
    cell.begin("c1", GAP_S)
    becomes(CorrectionStatus.LEASED)
    graph.spin_until(lambda: "/maintenance_node: cycle 'c1'" in said[-1].lease, "who holds it")
    graph.spin_until(lambda: len(cell.goals) == 2, "the first circle", within_s=30.0)
    to_program.publish(motion)
    graph.spin_until(lambda: sum(said[-1].refused) == 1, "it is refused")
    assert said[-1].refused_reasons == ["the robot is leased for a measurement"]
    assert cell.on_topic == []
    for name, (kind, fields, code) in CALLS.items():
        answer = graph.call(kind, f"/maintenance_node/{name}", **fields)
        assert answer.status == code, (name, answer.message)
    for name, words in TRIGGERS.items():
        answer = graph.call(Trigger, f"/maintenance_node/{name}")
        assert answer.message.startswith(words), answer.message
    running = graph.call(GetMaintenance, "/maintenance_node/status", cycle_id="c1")
    assert running.result.code == Code.NONE  # it measures on: the calls waited for nothing
    assert graph.call(Trigger, "/maintenance_node/cancel_trigger").success
    becomes(CorrectionStatus.OFF, 60.0)
    assert not said[-1].lease
    graph.spin_until(cell.at_home, "readings at home, which may come after the status", 2.0)
    graph.spin_until(lambda: cell.statuses[-1].state == MaintenanceStatus.IDLE, "it has ended")
    assert cell.statuses[-1].last.code == Code.CONFLICT
    to_program.publish(motion)
    graph.spin_until(lambda: len(cell.on_topic) == 1, "the program's motion goes out")
    graph.spin_until(lambda: np.max(np.abs(cell.q - target)) < 1e-3, "the robot is there")


def error(said: list[DiagnosticArray], node: str, words: str) -> bool:
    """Whether a node's diagnostics are ERROR with these words."""
    return any(
        node in status.name and status.level == b"\x02" and words in status.message
        for array in said
        for status in array.status
    )


@pytest.mark.cell
def test_who_else_commands_the_robot_stops_what_moves_it_and_lets_nothing_begin(
    graph: Any, tmp_path: Path
) -> None:
    """The tool node's motion; then one of the maintenance node, on its way home."""
    cell = LiveCell(graph, tmp_path)
    said = graph.collect(DiagnosticArray, "/diagnostics")
    ended = cell.measures("c1", GAP_S)
    stopped_by_planner(cell, ended, said)
    cell.drive_home()
    ended = cell.measures("c2", GAP_S)
    assert graph.call(Trigger, "/maintenance_node/cancel_trigger").success
    graph.spin_until(lambda: cell.statuses[-1].doing == "on its way home", "its way", 30.0)
    graph.spin_until(lambda: not cell.stands(0.1), "the robot moves")
    stopped_by_planner(cell, ended, said)


def stopped_by_planner(cell: LiveCell, ended: Any, said: list[DiagnosticArray]) -> None:
    """A planner that can command the robot ends the motion; it is gone at the end."""
    graph, before = cell.graph, len(cell.goals)
    said.clear()
    planner = graph.other("planner")
    planner.create_publisher(JointTrajectory, ROBOT, 10)
    graph.spin_until(lambda: len(cell.goals) > before, "the stop", within_s=2.0)
    result = graph.awaited(ended, "the result").result
    assert not result.success
    assert f"publishes {ROBOT}" in result.message  # its name may be discovered later
    graph.spin_until(lambda: cell.stands(0.2), "it has stopped")
    assert cell.stands(1.0)
    assert not cell.at_home()
    assert cell.statuses[-1].state == MaintenanceStatus.FAULT
    for node in ("tcf_node", "maintenance_node"):
        graph.spin_until(lambda n=node: error(said, n, STRANGER), f"{node} says so")
    answer = graph.call(SetBool, "/tcf_node/arm", data=True)
    assert not answer.success
    assert STRANGER in answer.message
    graph.end(planner)


def test_no_cycle_begins_while_somebody_else_commands_the_robot(graph: Any) -> None:
    plc = Plc(graph, lambda: process(graph))
    said = graph.collect(DiagnosticArray, "/diagnostics")
    path = "/maintenance_node/joint_trajectory"
    planner = graph.other("planner")
    planner.create_publisher(JointTrajectory, path, 10)
    words = f"/planner publishes {path}"
    graph.spin_until(lambda: error(said, "maintenance_node", words), "it says so")
    answer = plc.run("c1")
    assert (answer.success, answer.status) == (False, Code.CONFLICT)
    assert words in answer.message
    assert words in plc.trigger("run")
    graph.end(planner)
    graph.spin_until(lambda: plc.run("c2").success, "it works again")
