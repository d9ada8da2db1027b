# SPDX-License-Identifier: Apache-2.0
"""A cell over DDS whose fixture is measured in the PLC's gaps: taught, moved, told on the page,
decided by maintenance_node. All is simulated.
"""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fixture_driver import mounted
from geometry_msgs.msg import PoseWithCovarianceStamped
from maintenance_live import BeatingPlc, yaml_list
from panel_faults import wrongly_told
from robocal_msgs.msg import AccuracyState, CalibrationQuality
from robocal_msgs.srv import Decide, RunMaintenanceCycle
from std_srvs.srv import Trigger
from transforms import matrix_of

from bench.live.cell import set_fault
from bench.measured_fixture import ARM, FRAME, LIMITS, PLATE, MeasuredFixture, fixture_poses
from robocal_ros.cell_sim.cell import poses
from robocal_ros.fixture.files import fixture_document
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_description
from robocal_ros.panel.node import SOURCES
from robocal_ros.panel.state import ACCURACY, FIXTURE, STATUS, PanelState, plain
from robocal_ros.ros import endpoints

pytestmark = pytest.mark.cell
ROBOT, SERIAL, SEED = "/robot/joint_trajectory", "F1", 3
GAP_S = 300.0
TRIES = 3  # of a gap that a busy machine breaks off
DRIVES = load_description("kr150_r3100")
SPEED = 0.95  # of what the drives reach
BRISK_DEG_S2 = [700.0] * 3 + [1500.0] * 3  # a sensor is no load for this robot
SHOWN_MM, RIGHT_M = 1.0, 1e-4


class FixtureCell(BeatingPlc):
    """Robot, sensor, fixture_node and maintenance_node as processes; the probe is the PLC."""

    def __init__(self, graph: Any, folder: Path) -> None:
        super().__init__(graph)
        with CalibrationHistory.open(
            SERIAL, model_hash=ARM.model_hash, state_dir=graph.state
        ) as history:
            mounted(history)
        file = folder / "plate.yaml"
        file.write_text(json.dumps(fixture_document(PLATE)))
        latched = endpoints.LATCHED
        self.states = graph.collect(AccuracyState, "/accuracy_state", latched)
        self.verdicts = graph.collect(CalibrationQuality, "/fixture_node/quality", latched)
        self.frames = graph.collect(PoseWithCovarianceStamped, "/fixture_node/frame", latched)
        simulated = {"cell": "kr150", "fixture": True, "seed": SEED, "cloud_points": 0}
        simulated["spindle"] = True
        graph.start("cell_sim_node", simulated, {"joint_trajectory": ROBOT})
        own = {"robot": "kr150_r3100", "serial": SERIAL}
        sigma = {"point_sigma_mm": 1e3 * LIMITS.sigma_m}
        measured = {"fixture_file": str(file), "sensor_frame": FRAME}
        graph.start("fixture_node", own | measured | sigma)
        self.settings = own | {
            "home_deg": yaml_list(np.degrees(poses("home")[0])),
            "fixture_poses_deg": yaml_list(np.degrees(fixture_poses()).ravel()),
            "fixture_visits": 2,
            "travel_speed_mm_s": 2500.0,
            "joint_velocity_deg_s": yaml_list(SPEED * np.degrees(DRIVES.max_velocity)),
            "joint_acceleration_deg_s2": yaml_list(BRISK_DEG_S2),
            "stop_deceleration_deg_s2": yaml_list(BRISK_DEG_S2),
            "motion_silence_s": 0.5,
            "motion_late_s": 0.6,
            "deviation_mm": 5.0,
            "answer_s": 3.0,
            "rest_s": 2.0,
            "correction_silent_s": 0.0,  # nothing is produced
        }
        graph.start("maintenance_node", self.settings, {"~/joint_trajectory": ROBOT})
        graph.spin_until(lambda: self.states and self.statuses and self.status.at_home, "the cell")

    def ran(self, name: str, pause_s: float = 0.0) -> Any:
        """The result of a gap that nothing has broken off; the robot's first motion pauses."""
        for again in range(TRIES):
            cycle = f"{name}{'+' * again}"
            self.graph.spin_until(lambda: not self.status.doing, "an open gap", 30.0)
            begun = self.graph.call(
                RunMaintenanceCycle, "/maintenance_node/run", cycle_id=cycle, gap_s=GAP_S
            )
            assert begun.success, begun.message
            if pause_s:
                self.graph.spin_until(lambda: not self.status.at_home, "it moves")
                set_fault(self.graph.call, "protective_stop", pause_s)
            ended = lambda c=cycle: (  # noqa: E731
                self.status.last.cycle_id == c and self.status.last.code != Code.NONE
            )
            self.graph.spin_until(ended, name, within_s=GAP_S)
            if self.status.last.code == Code.ACCEPT:
                return self.status.last
        raise AssertionError(self.status.last)

    def call(self, name: str) -> tuple[bool, str]:
        answer = self.graph.call(Trigger, f"/fixture_node/{name}_trigger")
        return answer.success, answer.message

    def page(self) -> PanelState:
        """What panel_node makes of what was said last."""
        panel = PanelState()
        said = {STATUS: self.status, ACCURACY: self.states[-1], FIXTURE: self.verdicts[-1]}
        for stamp in (1, 2):
            for source, message in said.items():
                panel.show(source, plain(message, SOURCES[source][2]), stamp, 0.0, 1e9)
        return panel


@pytest.fixture
def cell(graph: Any, tmp_path: Path) -> FixtureCell:
    return FixtureCell(graph, tmp_path)


def test_a_fixture_that_nobody_taught_is_measured_in_a_gap_and_left(cell: FixtureCell) -> None:
    untaught = cell.ran("first")
    assert untaught.left == ["fixture measurement"]
    assert "teach it first" in untaught.message


@pytest.mark.long
def test_a_fixture_that_moved_is_told_in_one_gap_and_corrected(cell: FixtureCell) -> None:
    assert cell.ran("first").left == ["fixture measurement"]
    done, words = cell.call("teach")  # of the points of that gap
    assert done, words
    assert cell.call("accept")[0]
    cell.graph.spin_until(lambda: len(cell.frames) == 1, "the taught frame")
    set_fault(cell.graph.call, "fixture_moved", SHOWN_MM)
    moved = cell.ran("moved", 10.0)
    assert moved.complete, moved.message
    assert "fixture: plate moved by " in moved.message
    verdict = cell.verdicts[-1]
    assert (moved.fixture_code, moved.fixture_id) == (verdict.code, verdict.candidate_id)
    assert (moved.station_code, moved.station_id) == (Code.NONE, 0)
    assert (verdict.code, verdict.accept) == (Code.ACCEPT, True), verdict.reason
    assert "sensor" not in verdict.reason
    assert "robot" not in verdict.reason
    assert not wrongly_told("fixture_moved", cell.page(), 0.0)
    number = verdict.candidate_id
    decided = cell.graph.call(
        Decide, "/maintenance_node/accept", id=number, by="ada", reason="clamped anew"
    )
    assert decided.success, decided.message
    cell.graph.spin_until(lambda: len(cell.frames) == 2, "the new frame")
    cell.graph.spin_until(  # once the status says so too
        lambda: "ACCEPT/fixture" not in [task.key for task in cell.page().tasks(0.0)], "decided"
    )
    before, after = (matrix_of(one.pose.pose) for one in cell.frames)
    change = SimpleNamespace(change=after @ frames.invert(before))
    world = MeasuredFixture(SEED)
    assert world.worst_m(change, "fixture_moved", 1e-3 * SHOWN_MM) < RIGHT_M
