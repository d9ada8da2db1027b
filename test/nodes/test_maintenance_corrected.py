# SPDX-License-Identifier: Apache-2.0
"""The line is told over DDS whether commands are corrected with what is in force."""

import time
from typing import Any

import pytest
from robocal_msgs.msg import AccuracyState, CorrectionStatus, KinematicModel
from std_msgs.msg import Header
from std_srvs.srv import SetBool
from test_maintenance_calls import HOME_DEG, proposed

from robocal_ros.correction.interface import CorrectionState
from robocal_ros.correction.node import JointCorrectionNode
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.arm import model_document
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.maintenance.node import ACCURACY, CORRECTION, MaintenanceNode
from robocal_ros.ros import conversions, endpoints

ARM = load_robot("ur10")
POSES = [angle + 10.0 for angle in HOME_DEG]
SETTINGS = {"serial": "K7", "home_deg": HOME_DEG, "measuring_poses_deg": POSES}
DRIFT = {"predicted_error_mm": 0.1, "bound_mm": 0.2, "due_in_s": 600.0}
TELLS_S = 1.0


def in_force(graph: Any) -> None:
    """A thermal model was accepted before the nodes start."""
    with CalibrationHistory.open("K7", model_hash=ARM.model_hash, state_dir=graph.state) as history:
        history.accept(proposed(history, 0), by="test", reason="", wall_ns=time.time_ns())


class Line:
    """The maintenance node with a thermal node that knows the drift, and what the line reads."""

    def __init__(self, graph: Any, **settings: Any) -> None:
        self.graph, self.node = graph, graph.add(MaintenanceNode, SETTINGS | settings)
        self.states = graph.collect(AccuracyState, "accuracy_state", endpoints.LATCHED)
        drift = graph.publisher(AccuracyState, ACCURACY, endpoints.LATCHED)
        known = AccuracyState(state=AccuracyState.OK, robot=ARM.name, serial="K7", **DRIFT)
        drift.publish(known)
        graph.probe.create_timer(TELLS_S, lambda: drift.publish(known))

    def reads(self, state: int, words: str = "") -> AccuracyState:
        def there() -> bool:
            last = self.states[-1] if self.states else None
            return last is not None and last.state == state and words in last.reason

        self.graph.spin_until(there, f"{state} '{words}': {self.states[-1:]}", 30.0)
        return self.states[-1]


def test_after_a_restart_the_line_reads_that_nothing_is_corrected(graph):
    in_force(graph)
    line = Line(graph, correction_silent_s=2.0)
    line.reads(AccuracyState.DEGRADED, "joint_correction_node is silent")
    correction = graph.add(JointCorrectionNode, {"serial": "K7", "robot": "ur10"})
    told = line.reads(AccuracyState.DEGRADED, "joint_correction_node is OFF: call ~/enable")
    assert (told.predicted_error_mm, told.bound_mm) == (-1.0, -1.0)
    answer = graph.call(SetBool, "/joint_correction_node/enable", data=True)
    assert not answer.success  # no model yet
    line.reads(AccuracyState.DEGRADED, "wire its inputs")
    models = graph.publisher(KinematicModel, "kinematic_model", endpoints.LATCHED)
    models.publish(
        conversions.kinematic_model(
            model_document(ARM),
            serial="K7",
            model_hash=ARM.model_hash,
            revision=1,
            state=KinematicModel.ACCEPTED,
            stamp=Header(frame_id="base"),
        )
    )
    assert line.reads(AccuracyState.OK).bound_mm == pytest.approx(DRIFT["bound_mm"])
    correction.trigger_deactivate()
    line.reads(AccuracyState.DEGRADED, "joint_correction_node is silent")


def test_a_cell_without_a_correction_says_so(graph):
    in_force(graph)
    Line(graph, correction_silent_s=0.0).reads(AccuracyState.OK)


def test_who_commands_past_the_correction_is_named_to_the_line(graph):
    in_force(graph)
    line = Line(graph)
    mine = {"robot": ARM.name, "serial": "K7", "enabled": True, "model_revision": 1}
    other = CorrectionStatus(
        **mine, state=CorrectionStatus.OTHER_COMMANDER, commanders="planner publishes targets"
    )
    graph.publisher(CorrectionStatus, CORRECTION, endpoints.LATCHED).publish(other)
    line.reads(AccuracyState.DEGRADED, "puts nothing out, planner publishes targets: end them")


def test_what_cannot_be_of_this_correction_does_not_count(graph):
    line = Line(graph)
    correction = graph.publisher(CorrectionStatus, CORRECTION, endpoints.LATCHED)
    mine = {"robot": ARM.name, "serial": "K7", "state": CorrectionStatus.ON}
    counted = line.node.inputs[CORRECTION]
    for count, wrong in enumerate(({"serial": "K8"}, {"robot": "bx200l"}, {"state": 0}), 1):
        correction.publish(CorrectionStatus(**(mine | wrong)))
        graph.spin_until(lambda n=count: counted.invalid == n, f"{wrong} is refused")


@pytest.mark.parametrize("state", CorrectionState, ids=lambda state: state.name)
def test_the_states_are_the_message_s(state):
    assert getattr(CorrectionStatus, state.name) == state
