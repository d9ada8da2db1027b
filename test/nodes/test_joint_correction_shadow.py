# SPDX-License-Identifier: Apache-2.0
"""Shadow mode of the joint correction node: it tells what it would do, and changes nothing."""

import copy
import time
from array import array
from typing import Any

import numpy as np
import pytest
from joint_correction_live import (
    HOME,
    NAMES,
    NODE,
    Line,
    distance,
    drifted,
    joints,
    model_message,
    trajectory,
)
from robocal_msgs.msg import CorrectionStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.correction.node import ONE_SOURCE_S, JointCorrectionNode
from robocal_ros.ground.samples import CORRECTED
from robocal_ros.ros import conversions


@pytest.fixture
def shadow(graph: Any) -> Line:
    line = Line(graph, shadow=True, enable_on_start=True)
    line.take(model_message(drifted(), 3), line.to_model, "kinematic_model")
    return line


def test_what_goes_out_is_what_came_in(shadow: Line) -> None:
    stamp = conversions.header(time.time_ns(), "planner")
    fields = {"velocity": array("d", [0.1] * 6), "effort": array("d", [3.0] * 6)}
    state = joints(HOME, header=stamp, **fields)
    path = trajectory(np.stack([HOME, HOME + 0.01]), np.array([0.5, 1.0]), header=stamp)
    messages = {
        "joint_states": (shadow.to_states, state, shadow.states),
        "joint_targets": (shadow.to_target, joints(HOME, header=stamp, **fields), shadow.targets),
        "joint_trajectory": (shadow.to_path, path, shadow.paths),
    }
    for publisher, message, inbox in messages.values():
        before = copy.deepcopy(message)
        publisher.publish(message)
        assert shadow.wait(inbox) == before
    shadow.graph.spin_for(ONE_SOURCE_S + 0.1)  # the stream of targets is over
    command = Float64MultiArray(data=array("d", HOME))
    shadow.to_array.publish(command)
    assert shadow.wait(shadow.arrays) == command
    assert not shadow.node._session.status().refused


def test_it_tells_what_it_would_do(shadow: Line) -> None:
    actual = drifted()

    def done() -> bool:
        shadow.at = HOME  # nothing moves the robot elsewhere
        assert list(shadow.target().position) == HOME.tolist()
        return bool(shadow.offsets) and any(shadow.offsets[-1].offset)

    shadow.graph.spin_until(done, "the offset that would be added")
    offset = np.array(shadow.offsets[-1].offset)
    assert shadow.offsets[-1].shadow
    assert shadow.offsets[-1].model_revision == 3
    assert distance(actual, HOME) > 1e-4
    # the offset holds where the robot is, which it did not move: second order
    assert distance(actual, HOME + offset) < 1e-7
    shadow.graph.spin_until(lambda: shadow.statuses[-1].tool_shift_mm > 0.0, "a status of it")
    told = shadow.told(state=CorrectionStatus.ON)
    assert told.shadow
    assert told.reason.startswith("shadow, nothing is changed")
    assert told.tool_shift_mm == pytest.approx(distance(actual, HOME) * 1e3, rel=1e-3)
    assert "shadow" in shadow.enable(False)


def test_what_would_be_refused_goes_out_and_is_counted(shadow: Line) -> None:
    """A joint that is not the arm's, and a command that is marked as corrected already."""
    marked = joints(HOME, header=Header(frame_id=CORRECTED))
    for count, message in enumerate((marked, JointState(name=["x"], position=[0.5])), 1):
        shadow.refused(shadow.to_target, message, "joint_targets")
        assert shadow.wait(shadow.targets, count) == message
    told = shadow.told(
        shadow=True, refused_reasons=["comes from a joint correction already", "a joint is unknown"]
    )
    assert list(told.refused) == [1, 1]


def test_a_stop_goes_out_once(shadow: Line) -> None:
    stop = JointTrajectory(joint_names=NAMES, header=Header(frame_id=CORRECTED))
    shadow.to_path.publish(stop)
    assert shadow.wait(shadow.paths) == stop
    shadow.graph.spin_for(0.2)
    assert len(shadow.paths) == 1


def test_a_number_that_is_not_finite_does_not_go_out(shadow: Line) -> None:
    bad = HOME.copy()
    bad[2] = np.nan
    shadow.refused(shadow.to_target, joints(bad), "joint_targets")
    shadow.refused(shadow.to_array, Float64MultiArray(data=array("d", bad)), "joint_commands")
    shadow.refused(shadow.to_states, joints(bad), "joint_states")
    path = trajectory(np.stack([HOME, HOME]), np.array([0.0, 1.0]))
    path.points[1].effort[0] = np.inf
    shadow.refused(shadow.to_path, path, "joint_trajectory")
    shadow.graph.spin_for(0.2)
    for inbox in (shadow.targets, shadow.arrays, shadow.states, shadow.paths):
        assert not inbox
    # many drivers have no efforts: their joint states are wanted all the same
    shadow.stand(effort=array("d", [np.nan] * 6))
    out = shadow.wait(shadow.states)
    assert list(out.position) == HOME.tolist()
    assert len(out.effort) == 0


def test_its_own_output_is_not_passed_round(graph: Any) -> None:
    loop = graph.add(
        JointCorrectionNode,
        {"serial": "s1", "shadow": True},
        cli_args=["--ros-args", "-r", f"joint_targets:={NODE}/joint_targets"],
    )
    graph.spin_until(lambda: loop._sources["joint_targets"].fault != "", "the loop is seen")
    outside = graph.publisher(JointState, f"{NODE}/joint_targets")
    count = loop.inputs["joint_targets"]
    outside.publish(joints(HOME))
    graph.spin_until(lambda: count.invalid == 1, "it is refused")
    graph.spin_for(0.2)
    assert count.received == 1


def test_as_a_process_it_passes_a_stream_on(graph: Any) -> None:
    process = graph.start("joint_correction_node", {"shadow": "true", "enable_on_start": "true"})
    answer = graph.call(SetBool, f"{NODE}/enable", data=True)
    assert not answer.success  # nothing is corrected
    assert answer.message.startswith("shadow, nothing is changed")
    outputs = graph.collect(JointState, f"{NODE}/joint_targets")
    target = graph.publisher(JointState, "joint_targets")
    sent: list[JointState] = []

    def arrives() -> bool:
        sent.append(joints(HOME + 1e-3 * len(sent)))
        target.publish(sent[-1])
        graph.spin_for(0.005)
        return len(outputs) > 20

    graph.spin_until(arrives, "the stream")
    rest = iter(sent)  # each once, in order; what waited while the machine was busy is dropped
    assert all(output in rest for output in outputs)
    assert process.stop() == 0
    assert "Traceback" not in process.output
