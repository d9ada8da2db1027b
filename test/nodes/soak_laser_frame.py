# SPDX-License-Identifier: Apache-2.0
"""A cell over DDS whose beams are found again in the PLC's gaps, by the mandrel on the flange: the
first time by a person, then as a gap's own step, and after a knock. All is simulated.

Not of ``make test``, as it takes minutes: a part of ``make soak``, or

    tools/with_ros python -m pytest -s test/nodes/soak_laser_frame.py
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import robocal_json
from geometry_msgs.msg import PoseWithCovarianceStamped
from maintenance_live import (
    HOME_DEG,
    ROBOT,
    BeatingPlc,
    drive_to,
    placed_beams,
    yaml_list,
)
from rclpy.action import ActionClient
from robocal_msgs.action import MeasureTool, RunMaintenance
from robocal_msgs.msg import SessionEvent
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from transforms import away_of, matrix_of

from bench.live.cell import set_fault
from robocal_ros.bags.bag_writer import recordings
from robocal_ros.cell_sim.faults import Faults
from robocal_ros.cell_sim.node import SETTINGS, laser_pose
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import LASER_FRAME
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros import endpoints
from robocal_ros.ros.session_node import EVENTS
from robocal_ros.session.events import TOOL_STEP

pytestmark = pytest.mark.cell
SERIAL, SEED = "S1", 7
GAP_S = 240.0
BACK_S = 5
CHI2_6, ONE_IN_A_THOUSAND = 22.5, 3.3  # of six, one in a thousand; of a normal one, in sigmas
TRIES = 3  # of a gap that a busy machine breaks off
KNOCK_MM = 0.5
# Across the flange, so that the tool lies above the housing while it stands in the beams.
ACROSS = frames.exp_rotation(np.radians([-85.0, 0.0, 0.0]))
MANDREL = frames.transform(ACROSS, 0.17 * ACROSS[:, 2] + [0.0, 0.0, 0.02])
BODY = {
    "mandrel_xyz_mm": yaml_list((1e3 * MANDREL[:3, 3]).tolist()),
    "mandrel_quat_xyzw": yaml_list(frames.quat_xyzw(MANDREL).tolist()),
    "mandrel_length_mm": 80.0,
    "mandrel_radius_mm": 4.0,
}
DEFAULTS = {setting.name: setting.default for setting in SETTINGS}


class StationCell(BeatingPlc):
    """Robot, beams, tcf_node and maintenance_node as processes; the probe is the PLC."""

    def __init__(self, graph: Any, folder: Path) -> None:
        super().__init__(graph)
        self.recorded, latched = folder / "recorded", endpoints.LATCHED
        self.frames = graph.collect(PoseWithCovarianceStamped, "/tcf_node/laser_frame", latched)
        self.events = graph.collect(SessionEvent, "/tcf_node/session_events", EVENTS)
        self.joints = graph.collect(JointState, "/joint_states", endpoints.STREAM)
        csv = folder / "beams.csv"
        simulated = {"laser_csv": str(csv), "seed": SEED, "q_start_deg": yaml_list(HOME_DEG)}
        simulated["gears"] = "false"  # their model is not in force: no covariance holds them
        graph.start("cell_sim_node", simulated | BODY, {"joint_trajectory": ROBOT})
        self.recorder = graph.start("recorder_node", {"folder": str(self.recorded)})
        graph.spin_until(lambda: self.joints and csv.exists(), "the cell")
        own = BODY | {
            "robot": "ur10",
            "laser": str(placed_beams(folder, csv)),
            "taught_xyz_mm": "[0.0, 0.0, 150.0]",
            "serial": SERIAL,
            "gap_stale_s": 0.5,
            "tcp_speed_mm_s": 250.0,
            "motion_silence_s": 0.5,
            "motion_late_s": 0.6,
        }
        out = {"~/joint_trajectory": ROBOT}
        graph.start("tcf_node", own | {"motion": "trajectory"}, out)
        maintained = {
            "home_deg": yaml_list(HOME_DEG),
            "answer_s": 3.0,
            "rest_s": 2.0,
            "check_s": 30.0,
            "tool_home_s": 20.0,
            "check_every_s": 1e6,
            "laser_frame_s": 120.0,
            "laser_frame_every_s": 1.0,
            "correction_silent_s": 0.0,  # nothing is produced
        }
        graph.start("maintenance_node", own | maintained, out)
        self._measure = ActionClient(graph.probe, MeasureTool, "/tcf_node/measure")
        self._run = ActionClient(graph.probe, RunMaintenance, "/maintenance_node/run_maintenance")
        ready = lambda: self.statuses and self.status.at_home  # noqa: E731
        graph.spin_until(lambda: ready() and self._measure.server_is_ready(), "the cell", 30.0)

    def _result(self, client: ActionClient, goal: Any) -> Any:
        self.graph.spin_until(client.server_is_ready, "the action")
        handle = self.graph.awaited(client.send_goal_async(goal), "the goal is taken")
        return self.graph.awaited(handle.get_result_async(), "the result", GAP_S).result

    def drive_home(self) -> None:
        """A person drives the robot home: a run begins beside the beams."""
        target = dict(zip(load_robot("ur10").joint_names, np.radians(HOME_DEG), strict=True))
        names = self.joints[-1].name  # by alphabet, as joint_state_broadcaster has them
        home = JointState(name=names, position=[float(target[name]) for name in names])
        drive_to(self.graph, ROBOT, self.joints, home, BACK_S)
        self.graph.spin_until(lambda: self.status.at_home, "it is seen there")

    def commission(self) -> Any:
        """A person has tcf_node find the beams, and drives home."""
        for again in range(TRIES):
            self.graph.spin_for(1.0)
            armed = self.graph.call(SetBool, "/tcf_node/arm", data=True)
            assert armed.success, armed.message
            goal = MeasureTool.Goal(mode=MeasureTool.Goal.LASER_FRAME, cycle_id=f"first{again}")
            result = self._result(self._measure, goal)
            self.graph.spin_for(1.0)
            self.drive_home()
            if result.success:
                return result
            print(result.message)
        raise AssertionError(result)

    def ran(self, name: str) -> Any:
        """The result of a gap that nothing has broken off."""
        for again in range(TRIES):
            goal = RunMaintenance.Goal(cycle_id=f"{name}{'+' * again}", gap_s=GAP_S)
            ended = self._result(self._run, goal)
            if ended.success:
                return ended.result
            print(ended.message)
            self.graph.spin_until(lambda: self.status.at_home, "an end at home")
        raise AssertionError(ended)

    def replayed(self, state: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """What the recording gives anew, and what its history in a folder of its own holds."""
        self.graph.spin_for(1.0)
        assert self.recorder.stop() == 0
        (recording,) = recordings(self.recorded)
        document = robocal_json(
            "replay.tool.json", "replay", recording.folder, "--state", state,
            "--topic", "session_events:=/tcf_node/session_events",
        )  # fmt: skip
        return document, found_in(state, recording.folder.stem)  # named by the bag


def found_in(state: Path, serial: str) -> list[dict[str, Any]]:
    """Results of the laser frame in a state folder, oldest first."""
    with CalibrationHistory.open(serial, state_dir=state, create=False, owner=False) as history:
        kept = [entry for entry in history.list(100) if entry.kind == LASER_FRAME]
        return [history.document(entry.id) for entry in reversed(kept)]


@pytest.fixture
def cell(graph: Any, tmp_path: Path) -> StationCell:
    return StationCell(graph, tmp_path)


def is_true(told: PoseWithCovarianceStamped, truth: np.ndarray) -> None:
    """The frame is where the beams are (4, 4), within the covariance that is told with it."""
    away = away_of(matrix_of(told.pose.pose), truth)
    covariance = np.array(told.pose.covariance).reshape(6, 6)
    assert away @ np.linalg.solve(covariance, away) < CHI2_6, (away, covariance)


def test_the_beams_are_found_in_a_gap_and_after_a_knock_and_replayed_alike(
    cell: StationCell, tmp_path: Path
) -> None:
    graph, truth = cell.graph, laser_pose(DEFAULTS)
    first = cell.commission()
    assert (first.status, first.answer) == (Code.ACCEPT, MeasureTool.Result.PASS), first.message
    graph.spin_until(lambda: cell.frames, "the frame")
    is_true(cell.frames[-1], truth)
    due = cell.ran("due")
    assert due.complete, due.message
    assert "beam station: " in due.message
    assert "no drift is seen over 2 measurements" in due.message
    graph.spin_until(lambda: len(cell.frames) == 2, "the frame that was found again")
    is_true(cell.frames[-1], truth)
    set_fault(graph.call, "station_knocked_shift", KNOCK_MM)
    moved = cell.ran("moved")
    assert moved.tool_code == Code.STATION_MOVED, moved.message
    graph.spin_until(lambda: len(cell.frames) == 3, "the frame after the knock")
    knock = Faults({"station_knocked_shift": 1e-3 * KNOCK_MM}, SEED).T_station_knock(truth[:3, 3])
    is_true(cell.frames[-1], knock @ truth)
    found = found_in(graph.state, SERIAL)
    before, knocked = found[-2:]
    size_mm, (sigma_mm,) = knocked["change"]["tip_mm"], knocked["sigma_mm"]
    assert abs(size_mm - KNOCK_MM) < ONE_IN_A_THOUSAND * sigma_mm
    assert before["trend"]["per_day_mm"] is not None
    assert knocked["trend"] == before["trend"]  # a knock is no drift
    live = [e for e in cell.events if e.command == TOOL_STEP]
    document, again = cell.replayed(tmp_path / "replayed")
    assert (document["recorded"], document["differs"]) == (True, [])
    assert len([c for c in document["commands"] if c["command"] == TOOL_STEP]) == len(live)
    assert json.dumps(again) == json.dumps(found)  # to the last bit
