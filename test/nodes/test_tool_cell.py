# SPDX-License-Identifier: Apache-2.0
"""tcf_node and cell_sim_node as processes: the simulated robot moves, in real time."""

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from long_form import more
from maintenance_live import drive_to, placed_beams
from rclpy.action import ActionClient
from robocal_msgs.action import MeasureTool
from robocal_msgs.msg import ToolStep
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_controllers import accepted_goals

from bench.live.cell import set_fault
from robocal_ros.cell_sim.trajectory_controller import LAG_S
from robocal_ros.ground.errors import Code
from robocal_ros.motion.plan import SHORTEST_STOP_S, MotionLimits
from robocal_ros.ros import endpoints

pytestmark = pytest.mark.cell

RUN_S = 60.0
BACK_S = 2
RESTS = 75  # readings: 0.6 s
CHANGE_STATE = "/tcf_node/change_state"
ACTIVATE, DEACTIVATE = Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE
BUSY = {"motion_silence_s": 0.5}  # the machine of the tests has other work: readings come late
BEND_MM = [2.0, -1.0, 0.5]


def tip(transform: Any) -> np.ndarray:
    t = transform.translation
    return np.array([t.x, t.y, t.z])


class Cell:
    """Both nodes; the laser file is made of the cell's own calibration."""

    def __init__(self, graph: Any, folder: Path, motion: str, **faults: Any) -> None:
        self.graph, csv = graph, folder / "beams.csv"
        bend = ", ".join(map(str, BEND_MM))
        simulated = {"laser_csv": str(csv), "tool_bend_mm": f"[{bend}]", "seed": 7} | faults
        simulated["gears"] = "false"  # their model is not in force: no covariance holds them
        simulated["run_program"] = str(motion == "program").lower()
        remap = {
            "next_step": "/tcf_node/next_step",
            "joint_trajectory": "/tcf_node/joint_trajectory",
        }
        self.truth = graph.collect(TransformStamped, "/cell_sim_node/truth", endpoints.LATCHED)
        self.joints = graph.collect(JointState, "joint_states")
        self.goals = accepted_goals(graph, "/cell_sim_node/follow_joint_trajectory")
        self.steps = graph.collect(ToolStep, "/tcf_node/next_step", endpoints.LATCHED)
        graph.start("cell_sim_node", simulated, remap)
        graph.spin_until(lambda: self.truth and csv.exists(), "the cell")
        laser = str(placed_beams(folder, csv))
        settings = {"laser": laser, "taught_xyz_mm": "[0.0, 0.0, 150.0]", "motion": motion}
        settings["gap_stale_s"] = 0.0  # a station of its own, without a PLC
        settings |= BUSY
        self.tcf = graph.start("tcf_node", settings)
        self.client = ActionClient(graph.probe, MeasureTool, "/tcf_node/measure")
        graph.spin_until(self.client.server_is_ready, "the action appears")
        graph.spin_until(lambda: self.steps and self.joints, "both nodes are at work")
        graph.spin_for(0.3)

    def begin(self, mode: int) -> Any:
        return self.graph.awaited(self.client.send_goal_async(MeasureTool.Goal(mode=mode)))

    def measure(self, mode: int = MeasureTool.Goal.FULL) -> Any:
        ended = self.begin(mode).get_result_async()
        return self.graph.awaited(ended, "the result", RUN_S).result

    def arm(self) -> None:
        """Arm, once the last motion is over."""
        for _ in range(20):
            answer = self.graph.call(SetBool, "/tcf_node/arm", data=True)
            if answer.success:
                assert answer.message.endswith("gap_open is not listened to: gap_stale_s is 0")
                return
            self.graph.spin_for(0.2)
        raise AssertionError(answer.message)

    def rests(self) -> None:
        """Until the robot's program has driven its motion to the end."""

        def still() -> bool:
            lately = [message.position for message in self.joints[-RESTS:]]
            return float(np.ptp(lately, axis=0).max()) < 1e-9

        self.graph.spin_for(0.2)
        self.graph.spin_until(still, "the robot rests")

    def drive_back(self) -> None:
        """A person drives the robot to where it stood at first."""
        topic, joints = "/tcf_node/joint_trajectory", self.joints
        drive_to(self.graph, topic, joints, joints[0], BACK_S)
        self.graph.spin_for(0.5)


def found(cell: Cell, result: Any) -> None:
    """The true tool was found, to what the run knows of itself."""
    assert result.status == Code.ACCEPT, result.message
    covariance = np.array(result.tool.covariance).reshape(5, 5)[:3, :3]
    away = tip(result.tool.tool) - tip(cell.truth[-1].transform)
    assert away @ np.linalg.solve(covariance, away) < 16.3  # chi-square of 3, 1e-3


def test_the_node_drives_a_whole_run_and_a_quick_check(graph: Any, tmp_path: Path) -> None:
    cell = Cell(graph, tmp_path, "trajectory")
    refused = cell.measure()
    assert refused.status == Code.CONFLICT
    assert "not armed" in refused.message
    assert cell.goals == []
    cell.arm()
    result = cell.measure()
    found(cell, result)
    assert len(cell.goals) == 10
    accepted = graph.call(Trigger, "/tcf_node/accept_trigger")
    assert accepted.success, accepted.message
    again = cell.measure(MeasureTool.Goal.QUICK)
    assert "not armed (the run has ended)" in again.message
    for _ in range(2):  # a check that cannot tell, within its noise, asks to be repeated
        cell.arm()
        quick = cell.measure(MeasureTool.Goal.QUICK)
        if quick.answer != MeasureTool.Result.CANNOT_TELL:
            break
    assert quick.answer == MeasureTool.Result.PASS, quick.message


def rest_after(joints: list[JointState]) -> float:
    """Seconds of joint stamps from the last motion to the end."""
    position = np.array([m.position for m in joints])
    stamp = np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in joints])
    moving = np.flatnonzero(np.max(np.abs(np.diff(position, axis=0)), axis=1) > 1e-9)
    return float(stamp[-1] - stamp[moving[-1] + 1])


# The last one ends the node. A stop that is lost is sent again, by a node that goes too.
HOW = ("cancel", *more("disarm"), "silent", "deactivate", "deactivate, lost", "kill, lost")


def test_the_robot_stands_still_after_a_stop(graph: Any, tmp_path: Path) -> None:
    """One after the other, in one cell."""
    cell = Cell(graph, tmp_path, "trajectory")
    for how in HOW:
        print(how)
        cell.arm()
        stops(cell, how)
        if how == "silent":
            set_fault(graph.call, "none")
        elif how.startswith("deactivate"):
            graph.call(ChangeState, CHANGE_STATE, transition=Transition(id=ACTIVATE))
        cell.drive_back()


def stops(cell: Cell, how: str) -> None:
    """A run is stopped in the middle of its first circle."""
    graph, sent, stood = cell.graph, len(cell.goals), len(cell.joints)
    handle = cell.begin(MeasureTool.Goal.FULL)
    ended = handle.get_result_async()
    if how == "silent":  # with the next motion
        graph.spin_until(lambda: len(cell.goals) == sent + 1, "the way to it", within_s=RUN_S)
        set_fault(graph.call, "joints_silent")
    graph.spin_until(lambda: len(cell.goals) == sent + 2, "the first circle", within_s=RUN_S)
    graph.spin_for(0.6 if how != "silent" else 0.0)  # in the middle of it
    before, waits = len(cell.joints), graph.waits
    if how.endswith("lost"):
        set_fault(graph.call, "commands_lost", 3.0)  # all copies of the first one
    if how == "cancel":
        handle.cancel_goal_async()
    elif how == "disarm":
        graph.call(SetBool, "/tcf_node/arm", data=False)
    elif how.startswith("kill"):
        assert cell.tcf.stop(signal.SIGTERM) == 0
    elif how.startswith("deactivate"):
        graph.call(ChangeState, CHANGE_STATE, transition=Transition(id=DEACTIVATE))
        disarmed = graph.call(SetBool, "/tcf_node/arm", data=False)
        assert disarmed.success, disarmed.message
        assert disarmed.message == "disarmed: the node is not active"
        armed = graph.call(SetBool, "/tcf_node/arm", data=True)
        assert not armed.success
        assert armed.message == "the node is inactive: activate it to arm"
    graph.spin_until(lambda: len(cell.goals) >= sent + 3, "the stop", within_s=3.0)
    limits = MotionLimits()
    hardest = np.max(np.asarray(limits.joint_velocity) / limits.stop_deceleration)
    longest_s = max(float(hardest), SHORTEST_STOP_S)
    graph.spin_for(1.0)
    starved_s = graph.starved_s(waits)
    if not how.startswith("kill"):
        assert not graph.awaited(ended, "the result").result.success
    if how != "silent":
        # From the stop's arrival, a tick of the cell and the stop's own time later it stands.
        late_s = 0.1 + 2.0 * LAG_S  # until it is sent, and until the drives are where it ends
        assert rest_after(cell.joints[stood:]) > 1.0 - longest_s - late_s - starved_s
        assert len(cell.joints) > before
    if how in ("cancel", "disarm", "silent"):
        graph.spin_until(lambda: cell.steps[-1].kind == ToolStep.NONE, "nothing is awaited")


@pytest.mark.long
def test_the_robots_program_drives_what_is_announced_and_a_fault_is_refused_in_its_words(
    graph: Any, tmp_path: Path
) -> None:
    cell = Cell(graph, tmp_path, "program")
    found(cell, cell.measure())
    names = [s.name for s in cell.steps if s.kind]
    assert names == ["low", "high", "upright", "plunge_1", "plunge_2"]
    cell.rests()
    set_fault(graph.call, "lost_edge")
    result = cell.measure()
    assert not result.success
    assert "an edge between was lost" in result.message
    graph.spin_until(lambda: cell.steps[-1].kind == ToolStep.NONE, "nothing is awaited")
    cell.rests()
    set_fault(graph.call, "none")
    graph.spin_for(1.0)
    ended = cell.begin(MeasureTool.Goal.FULL).get_result_async()
    graph.spin_until(lambda: cell.steps[-1].name == "high", "a circle", within_s=RUN_S)
    set_fault(graph.call, "moved_by_hand")
    result = graph.awaited(ended, "the result", RUN_S).result
    assert result.status == Code.RESIDUAL_TOO_LARGE
    assert "apart from the other steps" in result.message
    assert cell.goals == []
