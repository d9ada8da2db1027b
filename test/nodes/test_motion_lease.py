"""Who may move the robot, over DDS: one maintenance node, and no program while it measures."""

from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from maintenance_live import HOME_DEG, ROBOT, SERIAL, LiveCell
from robocal_msgs.msg import CorrectionStatus
from robocal_msgs.srv import RunMaintenanceCycle
from std_srvs.srv import Trigger
from test_maintenance_calls import HOME_DEG as STANDING_DEG
from test_maintenance_calls import Plc, process
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.core.codes import Code
from robocal_ros.nodes import qos

PROGRAM = "/program/joint_trajectory"


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
            lambda n=node: any(
                n in status.name and words in status.message for a in said for status in a.status
            ),
            f"{node} says so",
            30.0,
        )
    answer = graph.call(RunMaintenanceCycle, "/another_name/run", cycle_id="c1", gap_s=30.0)
    assert (answer.success, answer.status) == (False, Code.CONFLICT), answer.message
    answer = plc.run("c1")
    assert (answer.success, answer.status) == (False, Code.CONFLICT), answer.message
    assert second.stop() == 0
    graph.spin_until(lambda: plc.run("c2").success, "the one that is left works")


def test_the_program_waits_while_the_cell_measures(graph: Any, tmp_path: Path) -> None:
    cell = LiveCell(graph, tmp_path)
    graph.probe.destroy_publisher(cell.drive)
    settings = {"robot": "ur10", "serial": SERIAL}
    graph.start(
        "joint_correction_node",
        settings,
        {"joint_trajectory": PROGRAM, "~/joint_trajectory": ROBOT},
    )
    said = graph.collect(CorrectionStatus, "/joint_correction_node/status", qos.LATCHED)
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
    cell.begin("c1", 150.0)
    becomes(CorrectionStatus.LEASED)
    graph.spin_until(lambda: "/maintenance_node: cycle 'c1'" in said[-1].lease, "who holds it")
    graph.spin_until(lambda: len(cell.sent) == 2, "the first circle", within_s=30.0)
    to_program.publish(motion)
    graph.spin_until(lambda: sum(said[-1].refused) == 1, "it is refused")
    assert said[-1].refused_reasons == ["the robot is leased for a measurement"]
    assert len(cell.sent) == 2
    assert graph.call(Trigger, "/maintenance_node/cancel_trigger").success
    becomes(CorrectionStatus.OFF, 60.0)
    assert not said[-1].lease
    assert cell.at_home()
    own = len(cell.sent)
    to_program.publish(motion)
    graph.spin_until(lambda: len(cell.sent) == own + 1, "the program's motion goes out")
    graph.spin_until(lambda: np.max(np.abs(cell.q - target)) < 1e-3, "the robot is there")
