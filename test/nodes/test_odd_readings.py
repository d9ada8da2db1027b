# SPDX-License-Identifier: Apache-2.0
"""Readings and feedback with velocities of another number, and a robot's clock that begins anew."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from diagnostic_msgs.msg import DiagnosticArray
from long_form import more
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from robocal_msgs.action import MeasureTool
from robocal_msgs.msg import CorrectionStatus
from test_own_motions_on_controllers import ACTION, STEP, Own
from test_tool_cell import Cell
from trajectory_controllers import HOME, NODE, Controlled, simulated, trajectory

from bench.live.cell import set_fault
from robocal_ros.ground.errors import Code
from robocal_ros.ros import endpoints

pytestmark = pytest.mark.cell

REST = np.zeros(6)
CORRECTED = "/joint_correction_node/follow_joint_trajectory"


def reset_clock(controller: Controlled) -> None:
    """The robot's driver begins to stamp in 1970."""
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="clock_reset")
    parameters = [Parameter(name="fault", value=value)]
    controller.graph.call(SetParameters, f"/{NODE}/set_parameters", parameters=parameters)
    controller.graph.spin_until(
        lambda: controller.readings[-1].header.stamp.sec < 10**8, "it has begun anew"
    )


class Corrected:
    """joint_correction_node before the controller's action; it is off, and passes goals on."""

    def __init__(self, controller: Controlled) -> None:
        self.controller, self.graph = controller, controller.graph
        controller.action.destroy()  # nobody else commands the robot
        self.graph.probe.destroy_publisher(controller.topic)
        self.said = self.graph.collect(DiagnosticArray, "/diagnostics")
        status = self.graph.collect(
            CorrectionStatus, "/joint_correction_node/status", endpoints.LATCHED
        )
        self.node = self.graph.start(
            "joint_correction_node",
            {"robot": "ur10", "serial": "s1", "follow_joint_trajectory": ACTION},
            {"controller_state": f"{NODE}/controller_state"},
        )
        self.action = ActionClient(self.graph.probe, FollowJointTrajectory, CORRECTED)
        self.graph.spin_until(lambda: status and self.action.server_is_ready(), "it works", 30.0)
        self.feedback: list[Any] = []
        self.graph.spin_for(0.5)  # it has to discover whom it answers

    def go(self, to: np.ndarray) -> Any:
        """Send a goal of a second; its handle."""
        goal = FollowJointTrajectory.Goal(trajectory=trajectory([(1.0, to, REST)]))
        sent = self.action.send_goal_async(goal, feedback_callback=self.feedback.append)
        return self.graph.awaited(sent, "the goal is answered")

    def ends(self, handle: Any) -> int:
        """Wait for the end of a goal; its status."""
        return int(self.graph.awaited(handle.get_result_async(), "the goal ends").status)


@pytest.mark.parametrize("missing", [1.0, *more(-2.0)])
def test_velocities_of_another_number_than_positions_are_none(
    graph: Any, tmp_path: Path, missing: float
) -> None:
    """Motions of our own end where they shall and are stopped; goals that are corrected too."""
    odd = {"fault": "odd_lengths", "fault_size": missing, "lag_ms": 14.0}
    controller = simulated(graph, tmp_path, True, **odd)
    controller.wait()
    assert len(controller.readings[-1].velocity) == 6 - missing
    assert len(controller.states[-1].feedback.velocities) == 6 - missing
    own = Own(controller)
    own.arrive()
    assert controller.stands() == pytest.approx(HOME + STEP, abs=1e-6)
    own.at_speed(0.3)
    own.order(stop=True)
    assert own.stopped()["failed"] == ""
    own.arrive()


def test_feedback_without_velocities_ends_no_goal_that_is_corrected(
    graph: Any, tmp_path: Path
) -> None:
    controller = simulated(graph, tmp_path, True, fault="odd_lengths", fault_size=6.0)
    controller.wait()
    corrected = Corrected(controller)
    assert corrected.ends(corrected.go(HOME + 0.1)) == GoalStatus.STATUS_SUCCEEDED
    assert controller.stands() == pytest.approx(HOME + 0.1, abs=1e-6)
    assert corrected.feedback
    assert corrected.node.process.poll() is None


def test_a_clock_that_begins_anew_in_a_motion_of_our_own_changes_nothing(
    graph: Any, tmp_path: Path
) -> None:
    controller = simulated(graph, tmp_path, False)
    controller.wait()
    own = Own(controller)
    own.at_speed(0.1)
    reset_clock(controller)
    own.wait("arrived")
    assert controller.stands() == pytest.approx(HOME + STEP, abs=1e-6)
    own.at_speed(0.3)
    own.order(stop=True)
    assert own.stopped()["failed"] == ""


def test_a_clock_that_begins_anew_ends_no_corrected_goal_and_none_begins_by_it(
    graph: Any, tmp_path: Path
) -> None:
    """Readings of 1970 are too old to begin from, which is told."""
    controller = simulated(graph, tmp_path, False)
    controller.wait()
    corrected = Corrected(controller)
    handle = corrected.go(HOME + 0.1)
    controller.moved()
    reset_clock(controller)
    assert corrected.ends(handle) == GoalStatus.STATUS_SUCCEEDED
    assert controller.stands() == pytest.approx(HOME + 0.1, abs=1e-6)
    assert corrected.ends(corrected.go(HOME)) == GoalStatus.STATUS_ABORTED
    graph.spin_until(
        lambda: any("too old" in s.message for a in corrected.said for s in a.status), "it is told"
    )
    assert controller.stands() == pytest.approx(HOME + 0.1, abs=1e-6)


def test_a_clock_that_begins_anew_ends_a_measurement_of_the_tool(
    graph: Any, tmp_path: Path
) -> None:
    cell = Cell(graph, tmp_path, "program")
    ended = cell.begin(MeasureTool.Goal.FULL).get_result_async()
    graph.spin_until(lambda: cell.steps[-1].number == 2, "the second circle", 30.0)
    set_fault(graph.call, "clock_reset")
    result = graph.awaited(ended, "the result").result
    assert (result.success, result.status) == (False, Code.CLOCK_WRONG), result.message
    assert "the clock jumped back" in result.message
    assert cell.tcf.process.poll() is None
