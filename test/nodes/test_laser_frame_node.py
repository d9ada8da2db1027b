# SPDX-License-Identifier: Apache-2.0
"""tcf_node finds its own beams with a mandrel, over DDS: by the action, and by its Trigger."""

from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from robocal_msgs.action import MeasureTool
from std_srvs.srv import Trigger
from tool_cell_live import LiveCell
from transforms import away_of, matrix_of

from bench.measured_runs import TAUGHT, laser_of
from robocal_ros.cell_sim.beams import RoundTool, bent
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.ros import endpoints

MANDREL = bent(TAUGHT, [-0.02, 0.01, -0.01], [0.0, 0.0, 0.0])
RADIUS_MM = 2.5
CHI2_6 = 22.5  # of six, one in a thousand


@pytest.fixture
def cell(graph: Any, tmp_path: Any) -> LiveCell:
    made = LiveCell(
        graph,
        tmp_path,
        TAUGHT,
        mandrel_xyz_mm=(1e3 * MANDREL[:3, 3]).tolist(),
        mandrel_quat_xyzw=frames.quat_xyzw(MANDREL).tolist(),
        mandrel_radius_mm=RADIUS_MM,
    )
    made.program.tool = RoundTool.cylinder(MANDREL, 1e-3 * RADIUS_MM)
    return made


def test_the_laser_frame_is_measured_and_told(graph: Any, cell: LiveCell) -> None:
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
