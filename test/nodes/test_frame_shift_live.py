# SPDX-License-Identifier: Apache-2.0
"""The shift of frames by thermal_node over DDS: found, accepted, told, rolled back."""

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from std_srvs.srv import Trigger
from transforms import matrix_of

from bench.robot_programs import NOMINAL, T_FLANGE_TOOL, drifted, postures
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL
from robocal_ros.kinematics.arm import model_document
from robocal_ros.programs.frame_shift import PARTS, best_shift
from robocal_ros.programs.postures import CorrectionModels
from robocal_ros.ros import endpoints
from robocal_ros.session.events import bring_into_force
from robocal_ros.thermal.node import ThermalNode

ACTUAL, WORK = drifted(NOMINAL, 1), postures(8, 7)
TIP = T_FLANGE_TOOL[:3, 3]


@pytest.mark.parametrize("poses", [True, False])
def test_a_shift_is_found_accepted_told_and_rolled_back(graph, tmp_path, poses):
    with CalibrationHistory.open("S1", model_hash=NOMINAL.model_hash, state_dir=tmp_path) as kept:
        bring_into_force(kept, THERMAL, NOMINAL, model_document(ACTUAL), "test")
    told = {
        part: graph.collect(TransformStamped, f"/thermal_node/{part}_shift", endpoints.LATCHED)
        for part in PARTS
    }
    work = np.degrees(WORK).ravel().tolist()
    settings = {"serial": "S1", "state_dir": str(tmp_path), "tip_mm": (1e3 * TIP).tolist()}
    graph.add(ThermalNode, settings | ({"work_poses_deg": work} if poses else {}))
    graph.spin_until(lambda: all(told[part] for part in PARTS))
    assert all(np.array_equal(matrix_of(told[part][-1].transform), np.eye(4)) for part in PARTS)

    def call(name):
        done = graph.call(Trigger, f"/thermal_node/{name}_trigger")
        return done.success, done.message.split()[1]

    if not poses:
        assert call("shift_frames") == (False, "CONFLICT")
        return
    assert call("accept_shift") == (False, "CONFLICT"), "nothing is pending"
    assert call("shift_frames") == (True, "ACCEPT")
    assert call("accept_shift")[0]
    graph.spin_until(lambda: all(len(told[part]) == 2 for part in PARTS))
    T = NOMINAL.T_flange_tool.copy()
    T[:3, 3] = TIP
    best = best_shift(CorrectionModels(NOMINAL, ACTUAL, NOMINAL), WORK, T)
    np.testing.assert_allclose(matrix_of(told["base"][-1].transform), best.T_base_shift, atol=1e-9)
    np.testing.assert_allclose(matrix_of(told["tool"][-1].transform), best.T_tool_shift, atol=1e-9)
    # with the same model a new one gains nothing over what is in force
    assert call("shift_frames") == (False, "NO_SIGNIFICANT_GAIN")
    assert call("rollback_shift")[0]
    graph.spin_until(lambda: all(len(told[part]) == 3 for part in PARTS))
    assert np.array_equal(matrix_of(told["base"][-1].transform), np.eye(4))


def test_a_shift_that_was_found_for_the_model_before_is_stale(graph, tmp_path):
    """Another model came into force, and the node has not looked yet."""
    work = np.degrees(WORK).ravel().tolist()
    settings = {"serial": "S1", "state_dir": str(tmp_path), "tip_mm": (1e3 * TIP).tolist()}
    with CalibrationHistory.open("S1", model_hash=NOMINAL.model_hash, state_dir=tmp_path) as kept:
        bring_into_force(kept, THERMAL, NOMINAL, model_document(ACTUAL), "test")
        node = graph.add(ThermalNode, settings | {"work_poses_deg": work})
        other = model_document(drifted(NOMINAL, 2))
        bring_into_force(kept, THERMAL, NOMINAL, other, "test")
        found = node._shifts._find(Trigger.Request(), Trigger.Response())
        assert found.success, found.message
    accepted = graph.call(Trigger, "/thermal_node/accept_shift_trigger")
    assert (accepted.success, accepted.message.split()[1]) == (False, "STALE"), accepted.message
