# SPDX-License-Identifier: Apache-2.0
"""What reaches the joint correction node while it is inactive, and what its activation tells."""

from typing import Any

import numpy as np
from correction_robot import good_here_only
from joint_correction_live import (
    NODE,
    NOMINAL,
    Line,
    drifted,
    model_message,
    tool_message,
)
from robocal_msgs.msg import CorrectionStatus, KinematicModel, MotionLease, ToolFrame
from test_joint_correction_history import after

from robocal_ros.correction.graph import LEASE_S
from robocal_ros.correction.node import JointCorrectionNode
from robocal_ros.ground import frames
from robocal_ros.ros import endpoints

BENT = NOMINAL.T_flange_tool @ frames.transform(np.eye(3), [2e-3, 0.0, 0.0])


def lease(*, held: bool) -> MotionLease:
    return MotionLease(
        robot=NOMINAL.name, serial="s1", holder="/some_name", held=held, purpose="tool"
    )


def test_what_comes_while_it_is_inactive_is_corrected_with_once_it_is_active(graph: Any) -> None:
    """Model and tool are latched, and said once; of several the last one counts."""
    line = Line(graph)
    line.node.trigger_deactivate()
    for revision in (3, 4):
        line.take(model_message(drifted(), revision), line.to_model, "kinematic_model")
        line.take(tool_message(BENT, revision), line.to_tool, "tool")
    assert line.node._session.status().revision is None  # while it does not act
    line.node.trigger_activate()
    told = line.told(model_revision=4, tool_revision=4)
    assert not told.model_waits
    assert line.node.inputs["kinematic_model"].ignored == 0


def test_a_good_model_and_tool_are_not_lost_behind_refused_ones(graph: Any) -> None:
    line = Line(graph, tool_child_frame="tool")
    line.node.trigger_deactivate()
    for revision, size in ((5, 1.0), (4, 2.0)):
        line.take(model_message(drifted(size), revision), line.to_model, "kinematic_model")
    line.take(tool_message(BENT, 5), line.to_tool, "tool")
    line.take(tool_message(BENT, 6, child_frame_id="gripper"), line.to_tool, "tool")
    line.node.trigger_activate()
    told = line.told(model_revision=5, tool_revision=5, model_waits=True)
    assert told.waiting_model_revision == 4
    assert [line.node.inputs[topic].invalid for topic in ("kinematic_model", "tool")] == [1, 1]


def test_a_kept_model_is_not_judged_where_the_robot_was_before(graph: Any) -> None:
    """It stood, and was sent, where the model is too large; others moved it meanwhile."""
    age_s = 1.0
    line = Line(graph, taught_xyz_mm=[20.0, 0.0, 200.0], joint_state_age_s=age_s)
    arm, far = good_here_only()
    line.at = far
    line.rest()
    line.target(far)
    line.node.trigger_deactivate()
    graph.spin_for(1.1 * age_s)
    model = model_message(NOMINAL.with_mdh(arm.mdh))
    line.take(model, line.to_model, "kinematic_model")
    line.node.trigger_activate()
    assert not line.told(model_revision=1).model_waits


def test_an_activation_tells_of_what_was_kept_and_of_nothing_before_it(
    graph: Any, capfd: Any
) -> None:
    """Finding: status, log and history said first that there is no model and no tool."""
    settings = {"serial": "s1", "autostart": False, "enable_on_start": True}
    node = graph.add(JointCorrectionNode, settings)
    node.trigger_configure()
    statuses = graph.collect(CorrectionStatus, f"{NODE}/status", endpoints.LATCHED)
    for kind, topic, message in (
        (KinematicModel, "kinematic_model", model_message(drifted(), 4)),
        (ToolFrame, "tool", tool_message(BENT, 5)),
    ):
        graph.publisher(kind, topic, endpoints.LATCHED).publish(message)
        graph.spin_until(lambda topic=topic: node.inputs[topic].received, f"{topic} is received")
    capfd.readouterr()
    node.trigger_activate()
    log = capfd.readouterr().err
    assert "model revision 4" in log
    assert "no model and no tool" not in log
    graph.spin_until(lambda: statuses, "a status")
    assert (statuses[0].model_revision, statuses[0].tool_revision) == (4, 5)
    first = after(graph, 1)[0]
    assert (first.enabled, first.model_revision, first.tool_revision) == (True, 4, 5)


def test_a_lease_that_ends_while_it_is_inactive_is_over(graph: Any) -> None:
    """Finding: it was held again at the activation, by one that would not renew it."""
    line = Line(graph)
    says = graph.publisher(MotionLease, "motion_lease", endpoints.LATCHED)
    line.take(lease(held=True), says, "motion_lease")
    line.told(state=CorrectionStatus.LEASED)
    line.node.trigger_deactivate()
    line.take(lease(held=False), says, "motion_lease")
    line.statuses.clear()
    line.node.trigger_activate()
    assert not line.node._graph.lease
    line.told(state=CorrectionStatus.OFF, lease="")
    assert line.node.inputs["motion_lease"].ignored == 0


def test_a_lease_that_began_while_it_was_inactive_holds_from_the_activation_on(graph: Any) -> None:
    """Also one whose holder died since, until the robot stands."""
    line = Line(graph)
    says = graph.publisher(MotionLease, "motion_lease", endpoints.LATCHED)
    line.node.trigger_deactivate()
    line.take(lease(held=True), says, "motion_lease")
    assert not line.node._session.status().held  # while it does not act
    line.node.trigger_activate()
    assert line.node._graph.lease == "/some_name: tool"
    assert line.node._session.status().held
    line.node.trigger_deactivate()
    graph.spin_for(1.1 * LEASE_S)
    line.node.trigger_activate()
    assert "/some_name: tool: it has not renewed its lease" in line.node._graph.lost
    assert line.node._session.status().held

    def is_over() -> bool:
        line.stand()
        return not line.node._graph.lease

    graph.spin_until(is_over, "the robot has stood")
    assert not line.node._session.status().held
