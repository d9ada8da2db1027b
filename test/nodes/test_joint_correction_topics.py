# SPDX-License-Identifier: Apache-2.0
"""Joint commands, offsets, status and tools of the joint correction node, over DDS."""

import time
from array import array
from pathlib import Path
from typing import Any

import numpy as np
import pytest
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
from jumps import no_jump
from robocal_msgs.msg import CorrectionStatus, JointOffset, KinematicModel, ToolFrame
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout
from std_srvs.srv import SetBool
from tool_cell_live import written_laser
from tool_driver import noisy_cell

from robocal_ros.correction.node import JointCorrectionNode
from robocal_ros.correction.settings import session_config
from robocal_ros.ros import endpoints
from robocal_ros.tool.node import TcfNode


def test_joint_commands_reach_the_taught_pose(graph: Any) -> None:
    line = Line(graph, enable_on_start=True)
    actual = drifted()
    line.take(model_message(actual), line.to_model, "kinematic_model")
    layout = MultiArrayLayout(dim=[MultiArrayDimension(label="joints", size=6, stride=6)])
    line.rest()
    for _ in range(1000):
        line.stand()
        count = len(line.arrays)
        line.to_array.publish(Float64MultiArray(layout=layout, data=array("d", HOME)))
        out = line.wait(line.arrays, count + 1)
        line.at = out.data
        if distance(actual, out.data) < 1e-9:
            break
    assert distance(actual, HOME) > 1e-4
    assert distance(actual, line.at) < 1e-9
    assert out.layout == layout
    for bad in ([*HOME[:5], np.nan], HOME[:5], []):
        line.refused(line.to_array, Float64MultiArray(data=array("d", bad)), "joint_commands")
    assert all(len(out.data) == 6 and np.all(np.isfinite(out.data)) for out in line.arrays)


def test_wired_by_remapping_before_a_forward_command_controller(graph: Any) -> None:
    order = NAMES[::-1]
    corrected = "/forward_position_controller/commands"
    process = graph.start(
        "joint_correction_node",
        {"serial": "s1", "enable_on_start": "true", "command_joints": f"[{','.join(order)}]"},
        {
            "kinematic_model": "/thermal_node/model",
            "tool": "/tcf_node/tool",
            "joint_commands": "/servo/commands",
            "~/joint_commands": corrected,
        },
    )
    actual = drifted()
    outputs = graph.collect(Float64MultiArray, corrected)
    model = graph.publisher(KinematicModel, "/thermal_node/model", endpoints.LATCHED)
    state = graph.publisher(JointState, "joint_states")
    command = graph.publisher(Float64MultiArray, "/servo/commands")
    model.publish(model_message(actual))

    began = time.monotonic()

    def reaches() -> bool:
        at = outputs[-1].data[::-1] if outputs else HOME
        state.publish(joints(at))
        if time.monotonic() - began < 0.5:  # it must be known to stand
            graph.spin_for(0.01)
            return False
        command.publish(Float64MultiArray(data=array("d", HOME[::-1])))
        graph.spin_for(0.01)
        return distance(actual, at) < 1e-9

    graph.spin_until(reaches, "the taught pose is reached")
    assert np.all(np.isfinite([out.data for out in outputs]))
    assert process.stop() == 0
    assert "Traceback" not in process.output


def test_joint_commands_in_an_order_of_their_own(graph: Any) -> None:
    order = NAMES[::-1]
    line = Line(graph, enable_on_start=True, command_joints=order)
    actual = drifted()
    line.take(model_message(actual), line.to_model, "kinematic_model")
    line.settle()
    line.stand()
    line.to_array.publish(Float64MultiArray(data=array("d", HOME[::-1])))
    # one stream follows the other without a pause: told, and refused until it is quiet
    line.refused(line.to_array, Float64MultiArray(data=array("d", HOME[::-1])), "joint_commands")
    line.told(refused_reasons=["two publishers at once"])
    streams = line.node._streams
    graph.spin_until(lambda: not streams.words(time.monotonic()), "the other stream is over")
    q = line.at = line.targets[-1].position  # it was ended in order
    line.stand()
    line.to_array.publish(Float64MultiArray(data=array("d", HOME[::-1])))
    assert np.allclose(line.wait(line.arrays).data, q[::-1], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("names", [["joint_a1", "elbow"], ["joint_a1", "joint_a1"]])
def test_command_joints_that_the_arm_has_not_are_named(graph: Any, names: list[str]) -> None:
    node = graph.add(JointCorrectionNode, {"command_joints": names})
    assert not node.is_active
    assert "command_joints" in node._full_health().message
    assert "joint_a6" in node._full_health().message


def test_velocity_limits_of_another_arm_are_named(graph: Any) -> None:
    node = graph.add(JointCorrectionNode, {"velocity_limits": [1.0, 2.0]})
    assert not node.is_active
    assert "velocity_limits has 2 numbers, the arm 6" in node._full_health().message


def test_every_target_has_its_offset(graph: Any) -> None:
    line = Line(graph, enable_on_start=True)
    line.take(model_message(drifted(), 7), line.to_model, "kinematic_model")
    line.settle()
    count = len(line.targets)

    def streamed() -> list[JointOffset]:
        return [o for o in line.offsets if o.cause == JointOffset.STREAM]

    graph.spin_until(lambda: len(streamed()) >= count, "an offset for each target")
    assert len(streamed()) == count
    for target, told in zip(line.targets, streamed(), strict=True):
        assert told.joint_names == NAMES
        assert np.array_equal(np.array(target.position) - HOME, told.offset)
        assert told.model_revision == 7
        assert told.tool_revision == 0
        assert not told.shadow
    withheld = np.array([np.abs(o.withheld).max() for o in streamed()])
    assert withheld[0] > 1e-5
    assert withheld[-1] < 1e-9


def test_offsets_go_on_between_the_commands(graph: Any) -> None:
    """A trajectory under way blends along its time: the offsets show it ten times a second."""
    line = Line(graph)
    line.target()
    line.take(model_message(drifted()), line.to_model, "kinematic_model")
    line.enable()
    line.rest()
    line.offsets.clear()
    line.to_path.publish(trajectory(np.stack([HOME, HOME]), np.array([0.5, 3.0])))
    path = line.wait(line.paths)
    end = np.array(path.points[-1].positions) - HOME

    def arrived() -> bool:
        line.stand()
        # the robot of this test stands at the taught joints: second order of the offset
        return any(np.allclose(o.offset, end, rtol=0.0, atol=1e-7) for o in line.offsets)

    graph.spin_until(arrived, "the offset of the trajectory's end")
    assert [o.cause for o in line.offsets].count(JointOffset.TRAJECTORY) == 1
    periodic = [o for o in line.offsets if o.cause == JointOffset.PERIODIC]
    times = np.array([o.header.stamp.sec + 1e-9 * o.header.stamp.nanosec for o in periodic])
    offsets = np.array([o.offset for o in periodic])
    steps = np.abs(np.diff(offsets, axis=0)).max(axis=1)
    late = 0.05  # a stamp may be so much nearer to the one before than the instant it speaks of
    no_jump(steps <= np.radians(2.0) * (np.diff(times) + late), "the offset at rest")
    assert np.abs(end).max() > 1e-5


def test_nothing_is_told_of_offsets_before_a_command(graph: Any) -> None:
    line = Line(graph, enable_on_start=True)
    line.stand()
    graph.spin_for(0.4)
    assert not line.offsets
    line.target()
    causes = [JointOffset.STREAM, JointOffset.PERIODIC]
    graph.spin_until(lambda: [o.cause for o in line.offsets[:2]] == causes, "offsets go on")
    assert list(line.offsets[-1].offset) == [0.0] * 6


def test_offsets_are_worked_out_for_who_listens(graph: Any) -> None:
    node = graph.add(JointCorrectionNode, {"serial": "s1"})
    targets = graph.collect(JointState, f"{NODE}/joint_targets")
    state, target = (graph.publisher(JointState, t) for t in ("joint_states", "joint_targets"))
    graph.spin_until(lambda: node._outputs["joint_targets"].get_subscription_count(), "the output")
    began = time.monotonic()
    while time.monotonic() - began < 0.5:  # the robot must be known to stand
        state.publish(joints(HOME))
        graph.spin_for(0.02)
    asked: list[float] = []
    work_out = node._session.offset
    node._session.offset = lambda now_s: (asked.append(now_s), work_out(now_s))[1]
    target.publish(joints(HOME))
    graph.spin_until(lambda: targets, "a target")
    graph.spin_for(0.3)
    assert not asked
    offsets = graph.collect(JointOffset, f"{NODE}/correction")
    graph.spin_until(lambda: offsets, "an offset")
    assert asked


def test_the_status_tells_what_is_in_use(graph: Any) -> None:
    line = Line(graph, taught_xyz_mm=[0.0, 0.0, 250.0])
    first = line.told(state=CorrectionStatus.OFF)
    assert first.robot == NOMINAL.name
    assert first.serial == "s1"
    assert first.model_hash == NOMINAL.model_hash
    assert first.reference == f"nominal: {NOMINAL.name} {NOMINAL.model_hash}"
    assert first.taught_tool.translation.z == 0.25
    assert first.policy == CorrectionStatus.REFUSE
    line.enable()
    line.told(state=CorrectionStatus.WITHOUT_MODEL, enabled=True)
    line.target()
    line.take(model_message(drifted(), 4), line.to_model, "kinematic_model")
    line.told(state=CorrectionStatus.BLENDING, model_revision=4)
    line.settle()
    line.told(state=CorrectionStatus.ON, model_revision=4, tool_revision=0)
    line.refused(line.to_target, joints([np.nan] * 6), "joint_targets")
    told = line.told(refused_reasons=["a value is not finite"])
    assert list(told.refused) == [1]
    assert "finite" in told.last_refusal
    line.enable(False)
    line.settle()
    line.told(state=CorrectionStatus.OFF, model_revision=4)


def test_the_status_is_latched_and_goes_out_every_second(graph: Any) -> None:
    line = Line(graph)
    late = graph.collect(CorrectionStatus, f"{NODE}/status", endpoints.LATCHED)
    graph.spin_until(lambda: late, "the status for one who comes late")
    line.told(state=CorrectionStatus.OFF)
    line.statuses.clear()
    graph.spin_until(lambda: len(line.statuses) >= 3, "the status goes out again")
    times = [s.header.stamp.sec + 1e-9 * s.header.stamp.nanosec for s in line.statuses]
    assert np.all(np.diff(times) > 0.8)  # nothing changes: not with each look


def test_a_measured_tool_waits_for_the_robot_to_stand(graph: Any) -> None:
    patient = {"stream_gap_s": 1.0}  # a stream that waits for a core is no pause
    line = Line(graph, enable_on_start=True, taught_xyz_mm=[0.0, 0.0, 250.0], **patient)
    T = np.eye(4)
    T[:3, 3] = (0.002, 0.0, 0.25)
    line.target()
    line.take(tool_message(T, 5), line.to_tool, "tool")
    for _ in range(20):  # a stream under way is not changed
        assert list(line.target().position) == HOME.tolist()
    told = line.told(tool_waits=True, waiting_tool_revision=5)
    assert told.tool_revision == 0

    def adopted(revision: int) -> bool:
        line.stand()
        return bool(line.statuses[-1].tool_revision == revision)

    graph.spin_until(lambda: adopted(5), "the tool is taken over at standstill")
    q = np.array(line.settle().position)
    reached = NOMINAL.fk(q) @ T
    taught = NOMINAL.fk(HOME) @ (T + np.array([[0, 0, 0, -0.002]] + [[0] * 4] * 3))
    assert np.abs(reached - taught).max() < 1e-9
    # rolled back: the taught tool again
    back = tool_message(np.eye(4), 6, state=ToolFrame.NONE)
    line.take(back, line.to_tool, "tool")
    graph.spin_until(lambda: adopted(0), "the taught tool is back")
    assert np.allclose(line.settle().position, HOME, rtol=0.0, atol=1e-12)


def test_an_old_model_blends_out_and_the_status_says_so(graph: Any) -> None:
    line = Line(graph, enable_on_start=True, model_age_s=2.0)
    message = model_message(drifted())
    message.header.stamp = line.node.get_clock().now().to_msg()
    line.take(message, line.to_model, "kinematic_model")
    line.target()

    def stale() -> bool:
        line.target()
        return line.statuses[-1].stale != ""

    graph.spin_until(stale, "the model is stale")
    assert list(line.settle().position) == HOME.tolist()
    answer = graph.call(SetBool, f"{NODE}/enable", data=True)
    assert not answer.success
    assert "nothing is corrected: " in answer.message


def test_what_exceeds_a_bound_is_clamped_and_counted(graph: Any) -> None:
    line = Line(graph, enable_on_start=True, policy="clamp", thermal_tcp_mm=0.1)
    actual = drifted()  # taken over before it is known where the robot is: no place is too far
    line.take(model_message(actual), line.to_model, "kinematic_model")
    drift = distance(actual, HOME)
    assert drift > 1.2e-4
    corrected = distance(actual, line.settle().position)
    # the correction made is the bound, up to the curvature of a shift of 0.1 mm
    assert drift - corrected == pytest.approx(1e-4, rel=1e-2)
    told = line.told(clamped_reasons=["the arm's correction at the tool exceeds its bound"])
    assert told.clamped[0] > 0
    assert list(told.refused) == []
    assert "clamped, " in " ".join(line.node._full_health().values)


def test_parameters_become_the_sessions_configuration(graph: Any) -> None:
    given = {"policy": "clamp", "model_age_s": 60.0, "free_axis": True, "joint_state_age_s": 5.0}
    given["tool_child_frame"] = "gun"
    limits = [1.0, 0.0, 2.0, 0.0, 0.0, 3.0]
    line = Line(graph, velocity_limits=limits, **given)
    config = session_config(line.node.settings, line.node.robot)
    assert (config.policy.value, config.model_age_s, config.free_axis) == ("clamp", 60.0, True)
    assert config.tool_frame == "gun"
    assert config.velocity_limits is not None
    assert list(config.velocity_limits[[0, 2, 5]]) == [1.0, 2.0, 3.0]
    assert np.all(config.velocity_limits[[1, 3, 4]] > 0.0)
    line.told(policy=CorrectionStatus.CLAMP)
    out = line.target()
    assert isinstance(out, JointState)


def test_an_input_has_the_type_of_the_output_that_is_called_like_it(graph: Any, tmp_path: Path):
    """A remapping by the name alone joins what belongs together."""
    graph.add(JointCorrectionNode, {"robot": "ur10"})  # as tcf_node's: one history, one robot
    graph.add(TcfNode, {"laser": written_laser(tmp_path, noisy_cell())})

    def pairs() -> dict[str, tuple[list[str], list[str]]]:
        found = graph.probe.get_subscriber_names_and_types_by_node("joint_correction_node", "/")
        types = dict(graph.probe.get_topic_names_and_types())
        named = {topic: (kinds, types.get(f"/tcf_node{topic}")) for topic, kinds in found}
        return {topic: (kinds, other) for topic, (kinds, other) in named.items() if other}

    graph.spin_until(
        lambda: any("tool" in topic for topic in pairs()), f"the tool of both nodes: {pairs()}"
    )
    for topic, (wanted, offered) in pairs().items():
        assert wanted == offered, topic
    assert pairs()["/tool"][0] == ["robocal_msgs/msg/ToolFrame"]
