"""The joint correction node over DDS."""

import time
from array import array
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
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
from rclpy.node import Node
from robocal_msgs.msg import KinematicModel, ToolFrame
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.core.samples import CORRECTED, TAUGHT
from robocal_ros.correction.node import JointCorrectionNode
from robocal_ros.correction.settings import SETTINGS
from robocal_ros.nodes import conversions, qos
from robocal_ros.nodes.base import AUTOSTART, SERIAL
from robocal_ros.nodes.diagnostics import OK, WARN

BUSY = 2.0  # other work on the machine


def test_off_until_enabled_then_reaches_the_taught_pose_and_back(graph: Any) -> None:
    line = Line(graph)
    actual = drifted()
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


def test_a_trajectory_keeps_its_times_and_a_stop_passes(graph: Any) -> None:
    line = Line(graph, enable_on_start=True)
    actual = drifted()
    line.take(model_message(actual), line.to_model, "kinematic_model")
    line.settle()
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
    # an empty trajectory stops the controller: as it came, whatever it carries
    stop = JointTrajectory(joint_names=["any"], header=Header(frame_id=CORRECTED))
    line.to_path.publish(stop)
    assert line.wait(line.paths, 2) == stop


def test_a_new_tool_and_a_taught_one(graph: Any) -> None:
    tool = [0.01, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0]
    line = Line(graph, enable_on_start=True, taught_tool=tool)
    T = np.eye(4)
    T[:3, 3] = tool[:3]
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
    assert not line.targets
    assert not line.paths

    report = line.report(DiagnosticStatus.WARN, "refused")
    assert report.hardware_id == "s1"
    assert {v.key for v in report.values} >= {"refused, a value is not finite", "correction"}
    assert np.all(np.isfinite(line.target().position))


def test_its_own_output_is_not_corrected_again(graph: Any) -> None:
    line = Line(graph)
    other = graph.probe.create_publisher(JointState, f"{NODE}/joint_targets", 10)
    looped = graph.add(
        JointCorrectionNode,
        {"serial": "s1"},
        namespace="second",
        cli_args=["--ros-args", "-r", f"joint_targets:={NODE}/joint_targets"],
    )
    graph.spin_until(lambda: looped._sources["joint_targets"].fault != "", "the loop is seen")
    fault = looped._sources["joint_targets"].fault
    assert "joint_correction_node" in fault
    assert "corrected already" in fault
    assert "joint states" not in fault
    count = looped.inputs["joint_targets"]
    line.target()
    graph.spin_until(lambda: count.invalid > 0, "the looped target is refused")
    graph.probe.destroy_publisher(other)


def test_a_blend_that_waits_warns(graph: Any) -> None:
    line = Line(graph, enable_on_start=True)
    chosen = NOMINAL.parameters
    grown = 2e-3 * chosen.is_length  # two millimetres in each length: beyond 1 mm at the tool
    line.to_model.publish(model_message(NOMINAL.with_mdh(chosen.add(NOMINAL.mdh, grown))))

    def waits() -> bool:
        line.target()
        return "the blend waits" in line.node._full_health().message

    graph.spin_until(waits, "the diagnostics warn")


def test_a_stop_passes_where_everything_else_is_refused(graph: Any) -> None:
    """A publisher whose name is a correction node's bars the trajectories, not the stop."""
    line = Line(graph)
    other = Node("old_joint_correction_gui", context=graph.context)
    other.create_publisher(JointTrajectory, "joint_trajectory", 10)
    guard = line.node._sources["joint_trajectory"]
    graph.spin_until(lambda: guard.fault != "", "the other publisher is seen")
    line.stand()
    still = trajectory(np.stack([HOME, HOME]), np.array([0.0, 1.0]))
    line.refused(line.to_path, still, "joint_trajectory")
    assert not line.paths
    stop = JointTrajectory(joint_names=NAMES)
    line.to_path.publish(stop)
    assert line.wait(line.paths) == stop
    other.destroy_node()
    graph.spin_until(lambda: guard.fault == "", "the other publisher is gone")
    line.to_path.publish(still)
    assert len(line.wait(line.paths, 2).points) == 2


def test_efforts_that_are_not_finite_do_not_go_out(graph: Any) -> None:
    line = Line(graph)
    line.target()
    bad = array("d", [np.nan] * 6)
    line.refused(line.to_target, joints(HOME, effort=bad), "joint_targets")
    message = trajectory(np.stack([HOME, HOME]), np.array([0.0, 1.0]))
    message.points[1].effort = bad
    line.refused(line.to_path, message, "joint_trajectory")
    line.states.clear()
    line.stand(effort=bad)  # many drivers have none: the positions are wanted all the same
    assert len(line.wait(line.states).effort) == 0
    assert len(line.targets) == 1
    assert not line.paths


def test_a_robot_that_stands_elsewhere_gets_nothing_until_the_operator_says_so(graph: Any) -> None:
    line = Line(graph, enable_on_start=True)
    line.take(model_message(drifted()), line.to_model, "kinematic_model")
    line.refused(line.to_target, joints(HOME), "joint_targets")  # no joint states yet
    line.at = HOME + 0.01
    line.stand()
    line.refused(line.to_target, joints(HOME), "joint_targets")
    report = line.report(DiagnosticStatus.ERROR, "START_MISMATCH")
    assert "joint_a1" in report.message
    line.at = HOME
    line.stand()
    line.refused(line.to_target, joints(HOME), "joint_targets")
    line.stand()
    line.refused(
        line.to_path, trajectory(np.stack([HOME, HOME]), np.array([0.0, 1.0])), "joint_trajectory"
    )
    assert not line.targets
    assert not line.paths
    stop = JointTrajectory(joint_names=NAMES)
    line.to_path.publish(stop)
    assert line.wait(line.paths) == stop
    assert line.enable().startswith("on")
    assert list(line.target().position) == HOME.tolist()
    assert distance(drifted(), line.settle().position) < 1e-9


def test_joint_states_that_are_old_by_their_stamp_are_no_place_to_start(graph: Any) -> None:
    line = Line(graph)
    past = time.time_ns() - 6_000_000_000
    line.stand(header=conversions.header(past, ""))
    line.refused(line.to_target, joints(HOME), "joint_targets")
    assert "joint states are missing or too old" in line.report(WARN, "joint_a1").message
    line.stand(header=conversions.header(time.time_ns(), ""))
    line.to_target.publish(joints(HOME))
    line.wait(line.targets)


def test_simulated_time_judges_stamps(graph: Any) -> None:
    """Joint states of a simulation are young by its clock, and old when it says so."""
    line = Line(graph, use_sim_time=True)
    clock = graph.publisher(Clock, "/clock")
    for now_s, fine in ((100, True), (107, False)):
        clock.publish(Clock(clock=Time(sec=now_s)))
        graph.spin_until(lambda now=now_s: line.node.now_ns() == now * 10**9, "the clock")
        line.stand(header=Header(stamp=Time(sec=100, nanosec=now_s)))
        if fine:
            line.to_target.publish(joints(HOME))
            line.wait(line.targets)
        else:
            part = JointState(name=NAMES[:2], position=array("d", HOME[:2]))
            line.refused(line.to_target, part, "joint_targets")


def test_a_blend_that_waits_is_a_warning(graph: Any) -> None:
    line = Line(graph)
    line.target()
    line.take(model_message(drifted()), line.to_model, "kinematic_model")
    line.enable()
    line.stand()
    line.to_target.publish(JointState(name=NAMES[:1], position=array("d", HOME[:1])))
    line.wait(line.targets, 2)
    assert "part of the joints" in line.report(WARN, "the blend waits").message


def test_the_tool_of_another_frame_is_refused(graph: Any) -> None:
    line = Line(graph, tool_child_frame="gun")
    message = tool_message(np.eye(4), child_frame_id="gripper")
    line.refused(line.to_tool, message, "tool")
    message.child_frame_id = "gun"
    line.take(message, line.to_tool, "tool")
    assert line.node._session.status().new_tool


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
    line.stand()  # the robot has arrived, else it shows the step before
    q = HOME + np.linspace(0.0, 0.1, 10_000)[:, None]
    line.to_path.publish(trajectory(q, np.arange(1, 10_001) * 1e-3))
    out = line.wait(line.paths)
    assert len(out.points) == 10_000
    assert distance(actual, out.points[0].positions) < 1e-9


@pytest.mark.parametrize("parameters", [{"taught_tool": [1.0]}, {"taught_tool": [0.1] * 7}])
def test_a_tool_that_makes_no_sense_is_named(graph: Any, parameters: dict[str, Any]) -> None:
    node = graph.add(JointCorrectionNode, parameters)
    assert not node.is_active
    assert "taught_tool" in node._full_health().message


def test_the_configuration_file_shows_every_parameter_with_its_default() -> None:
    path = Path(__file__).parents[2] / "config" / "joint_correction_node.yaml"
    (content,) = yaml.safe_load(path.read_text()).values()
    defaults = {s.name: s.default for s in (AUTOSTART, SERIAL, *SETTINGS)}
    assert content["ros__parameters"] == defaults


def test_as_a_process_it_answers_in_time_and_streams(graph: Any) -> None:
    began = time.monotonic()
    process = graph.start(
        "joint_correction_node",
        {"serial": "s1", "enable_on_start": "true", "joint_state_age_s": 5.0},
        {"kinematic_model": "/somebody/model"},
    )
    assert graph.call(SetBool, f"{NODE}/enable", data=True).success
    assert time.monotonic() - began < 1.5 * BUSY
    actual = drifted()
    outputs = graph.collect(JointState, f"{NODE}/joint_targets")
    graph.publisher(KinematicModel, "/somebody/model", qos.LATCHED).publish(model_message(actual))
    taught = graph.collect(JointState, f"{NODE}/joint_states")
    target = graph.publisher(JointState, "joint_targets")
    state = graph.publisher(JointState, "joint_states")
    for i in range(1, 1000):
        taught.clear()
        while not taught:  # the node's answers may be discovered later than its inputs
            state.publish(joints(outputs[-1].position if outputs else HOME))
            graph.spin_for(0.005)
        target.publish(joints(HOME))
        graph.spin_until(lambda count=i: len(outputs) >= count, f"output {i}")
        if distance(actual, outputs[-1].position) < 1e-9:
            break
    q = np.array([out.position for out in outputs])
    assert np.all(np.isfinite(q))
    assert np.abs(np.diff(q, axis=0)).max() <= np.radians(0.5) * 0.02 + 1e-12
    assert distance(actual, q[-1]) < 1e-9
    assert process.stop() == 0
    assert "Traceback" not in process.output
