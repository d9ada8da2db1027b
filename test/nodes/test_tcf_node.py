# SPDX-License-Identifier: Apache-2.0
"""tcf_node over DDS: a simulated robot drives what the node announces."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from robocal_msgs.action import MeasureTool
from robocal_msgs.msg import (
    CalibrationQuality,
    GapOpen,
    MaintenanceStatus,
    SessionEvent,
    ToolFrame,
)
from robocal_msgs.srv import Decide
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage
from tool_cell_live import LiveCell
from tool_driver import TAUGHT, TRUTH, Driver, config_of, noisy_cell
from transforms import away_of, matrix_of

from bench.measured_runs import laser_of
from robocal_ros.cell_sim.beams import RoundTool, bent
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.ros import conversions, endpoints
from robocal_ros.ros.session_node import EVENTS
from robocal_ros.session.events import ACCEPT, CONFIGURE, Command
from robocal_ros.tool.node import TcfNode, session_config
from robocal_ros.tool.run import ToolConfig
from robocal_ros.tool.session import ToolSession

QUICK = MeasureTool.Goal.QUICK
MANDREL = bent(TAUGHT, [-0.02, 0.01, -0.01], [0.0, 0.0, 0.0])
RADIUS_MM = 2.5
OF_MANDREL = {
    "mandrel_xyz_mm": (1e3 * MANDREL[:3, 3]).tolist(),
    "mandrel_quat_xyzw": frames.quat_xyzw(MANDREL).tolist(),
    "mandrel_radius_mm": RADIUS_MM,
}
CHI2_6 = 22.5  # of six, one in a thousand


@pytest.fixture
def cell(graph: Any, tmp_path: Any) -> LiveCell:
    return LiveCell(graph, tmp_path, TRUTH)


def test_a_bent_tool_is_measured_accepted_and_published(graph: Any, cell: LiveCell) -> None:
    tf = graph.collect(TFMessage, "/tf_static", endpoints.LATCHED)
    frame = graph.collect(TransformStamped, "/tcf_node/tool_frame", endpoints.LATCHED)
    tools = graph.collect(ToolFrame, "/tcf_node/tool", endpoints.LATCHED)
    verdicts = graph.collect(CalibrationQuality, "/tcf_node/quality", endpoints.LATCHED)
    result = cell.measure(cycle_id="gap-7")
    assert result.success, result.message
    assert result.status == CalibrationQuality.ACCEPT
    graph.spin_until(lambda: verdicts, "the verdict")
    (verdict,) = verdicts
    assert (verdict.candidate_id, verdict.cycle_id) == (result.candidate_id, "gap-7")
    covariance = np.array(result.tool.covariance).reshape(5, 5)
    away = matrix_of(result.tool.tool)[:3, 3] - TRUTH[:3, 3]
    assert away @ np.linalg.solve(covariance[:3, :3], away) < 16.3  # chi-square, 1e-3
    names = [f.feedback.step.name for f in cell.feedback]
    assert names == ["low", "high", "upright", "plunge_1", "plunge_2", ""]
    # Nothing is in force before somebody accepts it.
    assert matrix_of(frame[-1].transform) == pytest.approx(TAUGHT, abs=1e-12)
    done = graph.call(Decide, "/tcf_node/accept", id=result.candidate_id, by="me")
    assert done.success, done.message
    graph.spin_until(lambda: tools[-1].revision == 1, "the tool is in force")
    graph.spin_until(lambda: len(tf) > 1, "the transform")
    (transform,) = tf[-1].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("tool0", "tool")
    assert transform.transform == result.tool.tool == tools[-1].tool == frame[-1].transform
    quick = cell.measure(QUICK)
    assert quick.answer == MeasureTool.Result.PASS
    cell.program.tool = RoundTool.cylinder(bent(TRUTH, [1e-3, 0.0, 0.0], [0.0, 0.0, 0.0]), 0.0025)
    quick = cell.measure(QUICK)
    assert quick.answer == MeasureTool.Result.RECALIBRATE
    assert abs(quick.deviation_mm - 1.0) < 4.0 * quick.sigma_mm


def test_a_tool_of_another_taught_one_is_told_as_none(graph: Any, tmp_path: Any) -> None:
    made = noisy_cell()
    with CalibrationHistory.open("K7", model_hash=made.arm.model_hash) as history:
        session = ToolSession(made.arm, history, config_of(made), "test")
        driver = Driver(session, made, RoundTool.cylinder(TRUTH, 0.0025))
        found = driver.measure()
        driver.command(Command(ACCEPT, {"id": found.calibration_id, "by": "me"}))
    tools = graph.collect(ToolFrame, "/tcf_node/tool", endpoints.LATCHED)
    said = graph.collect(DiagnosticArray, "/diagnostics")
    xyz_mm = [*(1e3 * TAUGHT[:2, 3]).tolist(), float(1e3 * TAUGHT[2, 3] + 6.0)]
    LiveCell(graph, tmp_path, TAUGHT, taught_xyz_mm=xyz_mm)
    graph.spin_until(lambda: tools, "the tool in force")
    assert tools[-1].state == ToolFrame.NONE
    assert matrix_of(tools[-1].tool)[:3, 3] == pytest.approx(np.array(xyz_mm) * 1e-3)
    words = "calibration 1 was measured of a tool that was taught 6.00 mm and 0.00 deg from this"
    graph.spin_until(
        lambda: any(words in s.message for array in said for s in array.status), "the error"
    )


def test_it_moves_nothing_without_a_heartbeat(graph: Any, tmp_path: Any) -> None:
    cell = LiveCell(graph, tmp_path, TRUTH, motion="trajectory")
    cell.rest(0.1)
    refused = graph.call(SetBool, "/tcf_node/arm", data=True)
    assert not refused.success
    assert refused.message.startswith("gap_open was never heard")


def test_a_hard_stop_that_nobody_serves_is_warned_of(graph: Any, tmp_path: Any) -> None:
    said = graph.collect(DiagnosticArray, "/diagnostics")
    LiveCell(graph, tmp_path, TRUTH, motion="trajectory", hard_stop_service="/hard_stop")
    words = "hard_stop_service: nobody serves /hard_stop"
    graph.spin_until(
        lambda: any(words in s.message for array in said for s in array.status), "the warning"
    )


def test_joint_states_that_come_late_are_a_warning_to_who_moves_the_robot(
    graph: Any, tmp_path: Any
) -> None:
    cell = LiveCell(graph, tmp_path, TRUTH, motion="trajectory")
    said = graph.collect(DiagnosticArray, "/diagnostics")
    message = JointState(name=list(cell.cell.arm.joint_names), position=[0.1] * 6)
    for late_s in (0.0, 0.4):
        graph.spin_for(late_s)  # it falls behind
        for _ in range(10):
            message.header = conversions.header(cell.node.now_ns() - round(late_s * 1e9), "")
            cell.joints.publish(message)
            graph.spin_for(0.01)
    graph.spin_until(
        lambda: any("joint states come up to" in s.message for m in said for s in m.status),
        "it is told",
    )


@pytest.mark.parametrize("listens", [True, False])
def test_it_moves_with_a_heartbeat_that_echoes_the_beats_of_maintenance_node(
    graph: Any, tmp_path: Any, listens: bool
) -> None:
    """Beats, and a PLC that echoes the newest it has read; then one that echoes what it latched."""
    cell = LiveCell(graph, tmp_path, TRUTH, motion="trajectory")
    status = graph.publisher(MaintenanceStatus, "/maintenance_node/status", endpoints.LATCHED)
    gap = graph.publisher(GapOpen, "/gap_open")
    beat, latched = 4_294_967_290, None if listens else 4_294_967_290

    def count() -> None:
        nonlocal beat
        beat = beat % (2**32 - 1) + 1
        status.publish(MaintenanceStatus(beat=beat))

    def echo() -> None:
        gap.publish(GapOpen(open=True, echo=beat if latched is None else latched))

    graph.probe.create_timer(0.2, count)
    graph.probe.create_timer(0.1, echo)
    why = ""

    def armed() -> bool:
        nonlocal why
        cell.rest(0.05)
        answer = graph.call(SetBool, "/tcf_node/arm", data=True)
        why = answer.message
        return bool(answer.success)

    def refused() -> bool:
        return not armed() and why.startswith(f"gap_open echoes {latched}, which is no beat")

    if listens:
        graph.spin_until(armed, "it is armed")
        assert graph.call(SetBool, "/tcf_node/arm", data=False).success
        latched = beat
    graph.spin_until(refused, "the repeated echo closes the gap")
    assert not armed()
    latched = None
    graph.spin_until(armed, "the PLC's program goes on")


def test_triggers_do_the_same_for_a_plc(graph: Any, tmp_path: Any) -> None:
    cell = LiveCell(graph, tmp_path, TRUTH, joint_silence_s=5.0)
    verdicts = graph.collect(CalibrationQuality, "/tcf_node/quality", endpoints.LATCHED)
    cell.rest(0.1)
    assert not graph.call(Trigger, "/tcf_node/cancel_trigger").success  # of no run
    nothing = graph.call(Trigger, "/tcf_node/result_trigger")
    assert (nothing.success, nothing.message) == (False, "0 CONFLICT no run has ended yet")
    begun = graph.call(Trigger, "/tcf_node/measure_trigger")
    assert begun.success, begun.message
    again = graph.call(Trigger, "/tcf_node/measure_trigger")
    assert not again.success
    assert again.message.startswith("0 CONFLICT run 1 is open")
    cell.follow(lambda: cell.steps[-1].kind == 0)
    result = graph.call(Trigger, "/tcf_node/result_trigger")
    assert result.success
    assert result.message.startswith("1 ACCEPT tip ")
    graph.spin_until(lambda: verdicts, "the verdict")
    assert [verdict.candidate_id for verdict in verdicts] == [1]
    accepted = graph.call(Trigger, "/tcf_node/accept_trigger")
    assert accepted.message == "1 ACCEPT revision 1: calibration 1 in force"
    back = graph.call(Trigger, "/tcf_node/rollback_trigger")
    assert back.message == "0 ACCEPT revision 2: the taught tool in force"


def test_a_run_is_cancelled(graph: Any, cell: LiveCell) -> None:
    handle = cell.begin()
    ended = handle.get_result_async()
    cell.graph.spin_until(lambda: cell.steps[-1].name == "low", "the first step")
    cancelled = graph.awaited(handle.cancel_goal_async(), "the cancel is answered")
    assert len(cancelled.goals_canceling) == 1
    answer = graph.awaited(ended, "the result")
    assert answer.status == 5  # STATUS_CANCELED
    assert not answer.result.success
    assert cell.steps[-1].kind == 0
    assert cell.measure().success


def test_a_second_goal_takes_nothing_from_the_first(graph: Any, cell: LiveCell) -> None:
    first = cell.begin()
    ended = first.get_result_async()
    graph.spin_until(lambda: cell.steps[-1].name == "low", "the first step")
    second = graph.awaited(cell.begin().get_result_async(), "the second is refused").result
    assert second.status == Code.CONFLICT
    assert "run 1 is open" in second.message
    cancelled = graph.awaited(first.cancel_goal_async(), "the cancel is answered")
    assert len(cancelled.goals_canceling) == 1
    graph.spin_until(ended.done, "the first one's result")


def test_nothing_of_an_old_run_is_told_while_a_new_one_is_open(graph: Any, tmp_path: Any) -> None:
    cell = LiveCell(graph, tmp_path, TRUTH, joint_silence_s=10.0)
    first = cell.measure()
    assert graph.call(Trigger, "/tcf_node/result_trigger").success
    assert not graph.call(Trigger, "/tcf_node/cancel_trigger").success
    kept = graph.call(Trigger, "/tcf_node/result_trigger")
    assert kept.message == f"{first.candidate_id} ACCEPT {first.message}"
    cell.begin()
    told = graph.call(Trigger, "/tcf_node/result_trigger")
    assert (told.success, told.message) == (False, "0 NONE run 2 is open")


def test_joint_states_that_stop_end_the_run(graph: Any, cell: LiveCell) -> None:
    ended = cell.begin().get_result_async()
    result = graph.awaited(ended, "the run is broken off", 5.0).result
    assert result.status == Code.TOO_FEW_SAMPLES
    assert "joint states are silent" in result.message


def test_a_laser_of_another_robot_is_refused(graph: Any, tmp_path: Any) -> None:
    cell = LiveCell(graph, tmp_path, TRUTH)
    other = graph.add(
        type(cell.node),
        {"laser": str(tmp_path / "laser.yaml"), "robot": "kr150_r3100"},
        namespace="other",
    )
    assert other.state == "unconfigured"


PARALLEL = {"parallel_up_mm": 400.0, "parallel_down_mm": 360.0}


def config_by(**given: Any) -> ToolConfig:
    """Of a node with these parameters."""
    settings = {setting.name: setting.default for setting in TcfNode.SETTINGS} | given
    return session_config(settings, noisy_cell().laser if settings["laser"] else None, "", TAUGHT)


@pytest.mark.parametrize(
    "named",
    [
        {"beams": ["x"]},
        {"beams": ["x", "x"]},
        {"beams": ["x", "y", "up", "down"]},  # adapter_node's, for all nodes
        {"beams": ["x", "up"]} | PARALLEL,
        {"parallel_beams": ["up"]} | PARALLEL,
    ],
)
def test_beams_that_no_names_tell_apart_are_refused(named: Any) -> None:
    with pytest.raises(InputError, match="beams"):
        config_by(laser="laser.yaml", **named)


def test_parallel_beams_alone_are_named_as_they_like() -> None:
    """Adapter_node, which `beams` is for too, has no others then."""
    names = {"beams": ["up", "down"], "parallel_beams": ["up", "down"]}
    assert config_by(**names, **PARALLEL).beam_names == {"up": "up", "down": "down"}


@pytest.mark.long
def test_a_recording_that_begins_later_knows_how_the_mandrel_measures(
    graph: Any, tmp_path: Path
) -> None:
    """Of what was commanded before it the last configuration alone is left."""
    live = graph.collect(SessionEvent, "/tcf_node/session_events", EVENTS)
    cell = LiveCell(graph, tmp_path, MANDREL, **OF_MANDREL)
    result = cell.measure(MeasureTool.Goal.WITNESS_REFERENCE)
    assert (result.success, result.status) == (True, Code.ACCEPT), result.message
    assert result.message.startswith("the mandrel measures ")

    def told() -> bool:
        last = [event for event in live if event.command == CONFIGURE][-1:]
        return any(json.loads(event.arguments)["arguments"]["mandrel"] for event in last)

    graph.spin_until(told, "the configuration with the mandrel")


def test_the_laser_frame_is_measured_and_told(graph: Any, tmp_path: Any) -> None:
    """Its own beams, with a mandrel."""
    cell = LiveCell(graph, tmp_path, MANDREL, **OF_MANDREL)
    told = graph.collect(PoseWithCovarianceStamped, "/tcf_node/laser_frame", endpoints.LATCHED)
    result = cell.measure(MeasureTool.Goal.LASER_FRAME, "commissioning")
    assert result.success, result.message
    assert (result.status, result.answer) == (Code.ACCEPT, MeasureTool.Result.PASS)
    graph.spin_until(lambda: told, "the frame")
    covariance = np.array(told[-1].pose.covariance).reshape(6, 6)
    away = away_of(matrix_of(told[-1].pose.pose), laser_of(cell.cell.station).T_base_laser)
    assert away @ np.linalg.solve(covariance, away) < CHI2_6
    assert told[-1].header.frame_id == "base"
    names = [f.feedback.step.name for f in cell.feedback]
    assert names[:4] == [f"circle_{i}" for i in range(1, 5)]
    assert len(names) == 13  # twelve steps, and the end
    again = cell.measure(MeasureTool.Goal.LASER_FRAME, "commissioning")  # nothing is driven twice
    assert (again.success, again.message) == (True, result.message)
    assert again.candidate_id == result.candidate_id
    with_trigger = graph.call(Trigger, "/tcf_node/laser_frame_trigger")
    assert with_trigger.success, with_trigger.message
