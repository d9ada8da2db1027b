# SPDX-License-Identifier: Apache-2.0
"""The joint correction node over DDS."""

import time
from array import array
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from joint_correction_live import (
    HOME,
    NAMES,
    NODE,
    NOMINAL,
    Line,
    distance,
    drifted,
    joints,
    model_message,
    tool_message,
    trajectory,
)
from joint_errors import with_joint_errors
from rclpy.node import Node
from robocal_msgs.msg import CorrectionStatus, KinematicModel, ToolFrame
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from robocal_ros.correction.interface import Reason
from robocal_ros.correction.node import MOST_TOPIC_POINTS_IN_MOTION, JointCorrectionNode
from robocal_ros.ground.samples import CORRECTED, TAUGHT
from robocal_ros.ros import conversions, endpoints
from robocal_ros.ros.endpoints import OK, WARN
from robocal_ros.ros.graph import SourceGuard

FULL = with_joint_errors(drifted(), 1)  # joint functions and compliances besides a drift


def test_off_until_enabled_then_reaches_the_taught_pose_and_back(graph: Any) -> None:
    line, actual = Line(graph, thermal_tcp_mm=5.0), FULL
    line.take(model_message(actual), line.to_model, "kinematic_model")
    out = line.target(effort=array("d", np.full(6, 3.0)))
    assert list(out.position) == HOME.tolist()
    assert out.header.frame_id == ""
    assert "revision 1" in line.enable()
    first = line.target()
    assert np.abs(np.array(first.position) - HOME).max() < 1e-3
    q = line.settle()
    assert distance(actual, HOME) > 1e-4
    assert distance(actual, q.position) < 1e-9
    assert q.header.frame_id == CORRECTED
    line.states.clear()
    line.stand(velocity=array("d", np.zeros(6)))
    taught = line.wait(line.states)
    assert np.allclose(taught.position, HOME, rtol=0.0, atol=1e-12)
    assert taught.header.frame_id == TAUGHT
    assert line.enable(False).startswith("off")
    assert list(line.settle().position) == HOME.tolist()


def test_a_trajectory_keeps_its_times(graph: Any) -> None:
    line, actual = Line(graph, enable_on_start=True, thermal_tcp_mm=5.0), FULL
    line.take(model_message(actual), line.to_model, "kinematic_model")
    line.settle()
    line.rest()  # the offset that came in stands
    times = np.array([0.0, 0.5, 1.25])
    message = trajectory(np.stack([HOME, HOME + 0.1, HOME]), times)
    line.to_path.publish(message)
    out = line.wait(line.paths)
    assert [p.time_from_start for p in out.points] == [p.time_from_start for p in message.points]
    assert out.joint_names == NAMES
    assert distance(actual, out.points[-1].positions) < 1e-9
    assert list(out.points[0].velocities) == [0.0] * 6
    assert list(out.points[0].effort) == [7.0] * 6
    assert out.header.frame_id == CORRECTED


def test_a_new_tool_and_a_taught_one(graph: Any) -> None:
    line = Line(graph, enable_on_start=True, taught_xyz_mm=[10.0, 0.0, 250.0])
    T = np.eye(4)
    T[:3, 3] = [0.01, 0.0, 0.25]
    new = T.copy()
    new[0, 3] = 0.012
    line.take(tool_message(new), line.to_tool, "tool")
    q = line.settle()
    miss = NOMINAL.fk(np.array(q.position)) @ new - NOMINAL.fk(HOME) @ T
    assert np.abs(miss).max() < 1e-9
    turned = tool_message(new, 2)
    turned.tool.rotation.w = 0.5
    line.refused(line.to_tool, turned, "tool")
    for change in ({"serial": "s2"}, {"state": ToolFrame.CANDIDATE}, {"model_hash": "other"}):
        line.refused(line.to_tool, tool_message(new, 2, **change), "tool")


def test_hostile_messages_are_refused_and_named(graph: Any) -> None:
    line = Line(graph, enable_on_start=True)
    line.take(model_message(drifted()), line.to_model, "kinematic_model")
    line.settle()
    line.targets.clear()
    bad = HOME.copy()
    bad[2] = np.nan
    line.refused(line.to_target, joints(bad), "joint_targets")
    line.refused(line.to_target, JointState(name=NAMES[:3], position=[0.0]), "joint_targets")
    line.refused(line.to_target, JointState(name=["x"], position=[0.0]), "joint_targets")
    line.refused(line.to_target, joints(HOME, header=Header(frame_id=CORRECTED)), "joint_targets")
    line.refused(line.to_states, joints(bad), "joint_states")
    times = np.array([0.0, 1.0])
    line.refused(line.to_path, trajectory(np.stack([HOME, bad]), times), "joint_trajectory")
    line.refused(line.to_path, trajectory(np.stack([HOME] * 2), times[::-1]), "joint_trajectory")
    for change in ({"serial": "s2"}, {"state": KinematicModel.CANDIDATE}, {"model_hash": "other"}):
        message = model_message(drifted(), 9, **change)
        line.refused(line.to_model, message, "kinematic_model")
    assert all(np.abs(np.array(out.position) - HOME).max() < 1e-3 for out in line.targets)
    assert not line.paths

    report = line.report(DiagnosticStatus.WARN, "refused")
    assert report.hardware_id == "s1"
    assert {v.key for v in report.values} >= {"refused, a value is not finite", "correction"}
    line.rest()  # what was refused ended the stream
    assert np.all(np.isfinite(line.target().position))


def test_the_output_of_a_renamed_correction_node_is_not_corrected_again(graph: Any) -> None:
    def add(name: str, source: str, end: str) -> Any:
        wires = [f"__node:={name}", f"joint_targets:={source}", f"~/joint_targets:={end}"]
        arguments = ["--ros-args", *(part for wire in wires for part in ("-r", wire))]
        return graph.add(JointCorrectionNode, {"serial": "s1"}, cli_args=arguments)

    add("first", "/planner", "/between")
    looped = add("second", "/between", "/controller")
    guard = looped._sources["joint_targets"]
    graph.spin_until(lambda: guard.fault != "", "the loop is seen")
    assert "/between is published by /first: it is corrected already" in guard.fault
    assert "joint states" not in guard.fault
    states = SourceGuard(graph.probe, "/second/joint_states")
    graph.spin_until(lambda: states.look() or states.fault, "un-corrected readings are seen")
    assert "/second: its joint states are un-corrected" in states.fault
    count = looped.inputs["joint_targets"]
    planner = graph.publisher(JointState, "/between", subscribers=1)
    planner.publish(joints(HOME))
    graph.spin_until(lambda: count.invalid > 0, "the target is refused")


def test_a_player_of_a_recording_is_no_correction_node(graph: Any) -> None:
    graph.publisher(CorrectionStatus, "/recorded/joint_correction_node/status", subscribers=0)
    graph.publisher(JointState, "/joint_states", subscribers=0)
    guard = SourceGuard(graph.probe, "/joint_states")
    graph.spin_until(
        lambda: graph.probe.count_publishers("/recorded/joint_correction_node/status"), "it plays"
    )
    guard.look()
    assert guard.fault == ""


def test_a_robot_in_a_namespace_named_like_a_correction_node_is_heard(graph: Any) -> None:
    """The name is a hint as long as nobody is discovered; then who publishes decides."""
    topic = "/joint_correction_cell/joint_states"
    guard = SourceGuard(graph.probe, topic)
    guard.look()
    assert f"{topic} comes from a correction node" in guard.fault
    correcting = graph.add(JointCorrectionNode, {"serial": "s1"})
    # of one process, and so of one DDS participant
    node = Node("driver", namespace="joint_correction_cell", context=correcting.context)
    node.create_publisher(JointState, "joint_states", 1)
    graph.spin_until(lambda: guard.look() or not guard.fault, "the robot's driver is heard")
    node.destroy_node()
    own = SourceGuard(graph.probe, "/joint_correction_node/joint_states")
    said = "/joint_correction_node: its joint states are un-corrected"
    graph.spin_until(lambda: own.look() or said in own.fault, "the correction node is not")


def test_what_its_services_answer_is_so(graph: Any) -> None:
    """Finding: true was answered where nothing is corrected; enabling also acknowledged."""
    line = Line(graph)

    def call(name: str, kind: type = Trigger, **fields: Any) -> tuple[bool, str]:
        answer = graph.call(kind, f"{NODE}/{name}", **fields)
        return answer.success, answer.message

    nothing = "on, but there is no model and no tool yet: nothing is corrected"
    assert call("enable", SetBool, data=True) == (False, nothing)
    assert call("enable", SetBool, data=False) == (True, "off")
    line.take(model_message(drifted(), 5), line.to_model, "kinematic_model")
    assert call("enable", SetBool, data=True) == (True, "on: model revision 5")
    line.refused(line.to_model, model_message(drifted(2.0), 3), "kinematic_model")
    line.told(model_waits=True, waiting_model_revision=3)
    assert call("enable", SetBool, data=True)[0]
    assert line.told(model_waits=True).model_revision == 5  # enabling takes nothing over
    line.settle()
    success, words = call("take_over")
    assert success
    assert words.startswith("0 ACCEPT on, the offset changes with the next commands: model rev")
    assert call("enable", SetBool, data=True)[0] is False  # on its way only
    line.settle()
    assert call("enable", SetBool, data=True) == (True, "on: model revision 3")
    assert call("enable", SetBool, data=False) == (
        False,
        "off, the offset goes to zero with the next commands",
    )
    line.settle()
    assert call("enable", SetBool, data=False) == (True, "off")


def test_velocities_that_a_driver_does_not_know_are_none(graph: Any) -> None:
    """Position-only robots: joint_state_broadcaster says NaN; some drivers give too few."""
    line = Line(graph)
    unknown = array("d", [np.nan] * 6)
    fields = {"velocity": unknown, "effort": unknown}
    for given in (fields, {"velocity": array("d", [0.0] * 3)}):
        until = time.monotonic() + 0.3
        line.states.clear()
        while time.monotonic() < until:
            line.stand(**given)
            graph.spin_for(0.02)
        told = line.wait(line.states)
        assert list(told.position) == HOME.tolist()
        assert not told.velocity
        assert not told.effort
    line.rested = True
    assert list(line.target().position) == HOME.tolist()
    assert line.node.inputs["joint_states"].invalid == 0


def test_a_spindle_without_a_position_stands_beside_the_arm(graph: Any) -> None:
    """joint_state_broadcaster says NaN of a joint that has a velocity alone."""
    line = Line(graph)

    line.to_states.publish(
        JointState(
            name=["a_spindle", *NAMES],
            position=[np.nan, *HOME],
            velocity=[300.0, *[0.1] * 6],
            effort=[np.nan] * 7,
        )
    )
    out = line.wait(line.states)
    assert (list(out.name), list(out.position)) == (list(NAMES), HOME.tolist())
    assert (list(out.velocity), list(out.effort)) == ([0.1] * 6, [])
    count, received = line.node.inputs["joint_states"], len(line.states)
    before = count.received
    alone = JointState(name=["a_spindle"], position=[np.nan], velocity=[300.0])  # its own driver
    line.to_states.publish(alone)
    graph.spin_until(lambda: count.received > before, "it is heard")
    assert (count.invalid, len(line.states)) == (0, received)
    of_the_arm = joints(np.array([np.nan, *HOME[1:]]))
    line.refused(line.to_states, of_the_arm, "joint_states")
    line.told(refused_reasons=["a value is not finite"])


def test_a_robot_that_stands_elsewhere_gets_nothing_until_the_operator_says_so(graph: Any) -> None:
    line = Line(graph, enable_on_start=True)
    line.take(model_message(drifted()), line.to_model, "kinematic_model")
    line.refused(line.to_target, joints(HOME), "joint_targets")  # no joint states yet
    line.at = HOME + 0.5
    line.rest()
    line.refused(line.to_target, joints(HOME), "joint_targets")
    report = line.report(DiagnosticStatus.ERROR, "START_MISMATCH")
    assert "joint_a1" in report.message
    told = line.told(state=CorrectionStatus.MISMATCH)
    assert "joint_a1" in told.mismatch
    assert "START_MISMATCH" in told.reason
    line.at = HOME
    line.rest()
    line.refused(line.to_target, joints(HOME), "joint_targets")
    line.stand()
    line.refused(
        line.to_path, trajectory(np.stack([HOME, HOME]), np.array([0.0, 1.0])), "joint_trajectory"
    )
    assert not line.targets
    assert not line.paths
    assert "START_MISMATCH" in line.enable()  # it says what is, and ends nothing
    line.refused(line.to_target, joints(HOME), "joint_targets")
    answer = graph.call(Trigger, f"{NODE}/acknowledge")
    assert answer.success
    assert answer.message.startswith("0 ACCEPT on")
    line.rest()
    line.target()
    assert distance(drifted(), line.settle().position) < 1e-9


def test_joint_states_that_are_old_by_their_stamp_are_no_place_to_start(graph: Any) -> None:
    line = Line(graph)
    past = time.time_ns() - 6_000_000_000
    line.stand(header=conversions.header(past, ""))
    line.refused(line.to_target, joints(HOME), "joint_targets")
    assert "joint states are missing or too old" in line.report(WARN, "joint_a1").message
    until = time.monotonic() + 0.3
    while time.monotonic() < until:
        line.stand(header=conversions.header(time.time_ns(), ""))
        graph.spin_for(0.02)
    line.to_target.publish(joints(HOME))
    line.wait(line.targets)


def test_simulated_time_judges_stamps(graph: Any) -> None:
    """Joint states of a simulation are young by its clock, and old when it says so."""
    line = Line(graph, use_sim_time=True)
    clock = graph.publisher(Clock, "/clock")
    for now_s, fine in ((100, True), (107, False)):
        clock.publish(Clock(clock=Time(sec=now_s)))
        graph.spin_until(lambda now=now_s: line.node.now_ns() == now * 10**9, "the clock")
        for i in range(30):
            line.stand(header=Header(stamp=Time(sec=100, nanosec=now_s + i)))
            graph.spin_for(0.01)
        if fine:
            line.to_target.publish(joints(HOME))
            line.wait(line.targets)
        else:
            part = JointState(name=NAMES[:2], position=array("d", HOME[:2]))
            line.refused(line.to_target, part, "joint_targets")


def test_without_a_serial_the_diagnostics_name_the_robot(graph: Any) -> None:
    line = Line(graph, serial="")
    assert line.report(OK, "ok").hardware_id == "kr150_r3100"
    line.take(model_message(drifted(), serial="unset"), line.to_model, "kinematic_model")
    assert line.report(OK, "ok").hardware_id == "unset"


def test_a_burst_of_ten_thousand_points(graph: Any) -> None:
    line = Line(graph, enable_on_start=True)
    actual = drifted()
    line.take(model_message(actual), line.to_model, "kinematic_model")
    line.settle()
    session = line.node._session
    graph.spin_until(lambda: not session.moves(time.monotonic()), "the end of that stream")
    line.stand()  # the robot has arrived, else it shows the step before
    q = HOME + np.linspace(0.0, 0.1, 10_000)[:, None]
    line.to_path.publish(trajectory(q, np.arange(1, 10_001) * 1e-3))
    out = line.wait(line.paths)
    assert len(out.points) == 10_000
    for many in (MOST_TOPIC_POINTS_IN_MOTION + 1, 10_001):  # they would hold a stop up
        q = HOME + np.linspace(0.0, 0.1, many)[:, None]
        line.refused(line.to_path, trajectory(q, np.arange(1, many + 1) * 1e-3), "joint_trajectory")
        told = session.status().last_refusal
        assert f"{Reason.BURST.value}: {many}, allowed" in told
    assert distance(actual, out.points[0].positions) < 1e-9


@pytest.mark.parametrize(("name", "value"), [("xyz_mm", [1.0]), ("quat_xyzw", [0.1] * 4)])
def test_a_tool_that_makes_no_sense_is_named(graph: Any, name: str, value: list[float]) -> None:
    node = graph.add(JointCorrectionNode, {f"taught_{name}": value})
    assert not node.is_active
    assert f"taught_{name}" in node._full_health().message


def test_as_a_process_it_answers_and_streams(graph: Any) -> None:
    process = graph.start(
        "joint_correction_node",
        {"serial": "s1", "joint_state_age_s": 5.0},
        {"kinematic_model": "/somebody/model"},
    )
    actual = drifted()
    outputs = graph.collect(JointState, f"{NODE}/joint_targets")
    graph.publisher(KinematicModel, "/somebody/model", endpoints.LATCHED).publish(
        model_message(actual)
    )
    taught = graph.collect(JointState, f"{NODE}/joint_states")
    target = graph.publisher(JointState, "joint_targets")
    state = graph.publisher(JointState, "joint_states")
    graph.spin_until(
        lambda: graph.call(SetBool, f"{NODE}/enable", data=True).success, "model and correction"
    )
    sent = time.monotonic()
    times: list[float] = []
    while True:
        taught.clear()
        while not taught or (not times and time.monotonic() - sent < 1.0):
            state.publish(joints(outputs[-1].position if outputs else HOME))
            graph.spin_for(0.005)
        target.publish(joints(HOME))
        count = len(times)
        graph.spin_until(lambda count=count: len(outputs) > count, f"output {count + 1}")
        times.append(time.monotonic())
        if distance(actual, outputs[-1].position) < 1e-9:
            break
        assert len(times) < 1000
    q = np.array([out.position for out in outputs[: len(times)]])
    assert np.all(np.isfinite(q))
    steps, elapsed = np.abs(np.diff(q, axis=0)).max(axis=1), np.diff(times)
    assert np.all(np.cumsum(steps) <= np.radians(2.0) * (np.cumsum(elapsed) + 0.1))
    assert distance(actual, q[-1]) < 1e-9
    assert process.stop() == 0
    assert "Traceback" not in process.output
