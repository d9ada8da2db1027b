# SPDX-License-Identifier: Apache-2.0
"""Touches of one point by the Triggers of tcf_node, over DDS."""

from typing import Any

import numpy as np
from robocal_msgs.msg import CalibrationQuality, ToolFrame
from robocal_msgs.srv import Decide
from std_srvs.srv import Trigger
from tool_cell_live import LiveCell
from tool_driver import TRUTH

from bench.measured_runs import touching
from robocal_ros.ros import endpoints

COUNT = 6


def test_a_tip_is_touched_solved_and_accepted(graph: Any, tmp_path: Any) -> None:
    cell = LiveCell(graph, tmp_path, TRUTH)
    tools = graph.collect(ToolFrame, "/tcf_node/tool", endpoints.LATCHED)
    candidates = graph.collect(ToolFrame, "/tcf_node/candidate", endpoints.LATCHED)
    qualities = graph.collect(CalibrationQuality, "/tcf_node/quality", endpoints.LATCHED)
    arm, near = cell.cell.arm, cell.cell.q_near
    for q in touching(arm, TRUTH, near, COUNT):
        cell.program.q = q
        cell.rest(0.45)
        taken = graph.call(Trigger, "/tcf_node/touch_trigger")
        assert taken.success, taken.message
    solved = graph.call(Trigger, "/tcf_node/solve_touches_trigger")
    assert solved.success, solved.message
    graph.spin_until(lambda: candidates and qualities, "candidate and quality")
    number = int(solved.message.split()[0])
    assert qualities[-1].candidate_id == number
    assert graph.call(Decide, "/tcf_node/accept", id=number, by="me").success
    graph.spin_until(lambda: tools[-1].revision == 1, "the tool is in force")
    t = tools[-1].tool.translation
    # Exact touches of an exact robot: what is left is the readings' rounding.
    assert np.linalg.norm(np.array([t.x, t.y, t.z]) - TRUTH[:3, 3]) < 1e-6
