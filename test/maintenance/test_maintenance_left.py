"""What a gap leaves undone of the thermal measurement is told: the PLC reads ``complete``."""

from dataclasses import replace

import numpy as np
import pytest
from maintenance_cell import LONG_S, POSES, REFUSED, SILENT, Cell, config_of, kinds, opened

from robocal_ros.ground.errors import Code
from robocal_ros.maintenance import MaintenanceState
from robocal_ros.maintenance import robot_interface as ask
from robocal_ros.maintenance.robot_interface import DriverAnswer

UNKNOWN = set(Code) - {
    Code.NONE,
    Code.ACCEPT,
    Code.NO_SIGNIFICANT_GAIN,
    Code.WORSE_THAN_CURRENT,
}


@pytest.fixture
def cell(history) -> Cell:
    return opened(history)


@pytest.mark.parametrize("how", [REFUSED, SILENT])
def test_a_thermal_node_that_fails_leaves_the_measurement(cell, how):
    cell.services["thermal"] = how
    cell.run("c1", LONG_S)
    result = cell.finish()
    assert (result.code, result.complete, result.left) == (
        Code.ACCEPT,
        False,
        ("thermal measurement",),
    )
    assert "thermal: " in result.message
    assert result.tool_answer == "pass"


@pytest.mark.parametrize("code", sorted(UNKNOWN), ids=lambda code: code.name)
def test_a_verdict_that_does_not_tell_the_drift_leaves_it(cell, code):
    cell.thermal = DriverAnswer(code, "why")
    cell.run("c1", LONG_S)
    result = cell.finish()
    assert (result.complete, result.left) == (False, ("thermal measurement",))
    assert result.thermal_code is code


def test_a_pose_that_was_not_measured_is_left_by_its_number(cell):
    cell.run("c1", LONG_S)
    while cell.state is MaintenanceState.RUNNING:
        at_second = "measuring pose 2 of" in cell.session.status(cell.now_s).doing
        cell.services["sensor"] = SILENT if at_second else "ok"
        cell.step()
    result = cell.session.result("c1")
    assert (result.complete, result.left) == (False, ("thermal measurement at pose 2",))
    assert result.thermal_code is Code.NO_SIGNIFICANT_GAIN  # the others told enough
    cell.open_gap()
    cell.run("c2", LONG_S)
    assert cell.finish().complete


def test_a_pose_that_an_earlier_gap_missed_is_still_named(cell):
    cell.services["sensor"] = SILENT
    cell.run("c1", 15.0)
    assert "poses" in cell.finish().left[0]
    cell.services["sensor"] = "ok"
    cell.open_gap()
    cell.run("c2", LONG_S)
    assert cell.finish().left == ("thermal measurement at pose 1",)


def test_cold_poses_that_were_not_measured_are_named(cell):
    cell.thermal = replace(cell.thermal, missing=(2, 7))
    cell.run("c1", LONG_S)
    assert "without pose 2, 7 of the cold reference" in cell.finish().message


def test_poses_that_the_thermal_node_lost_are_left(cell):
    """Started anew between two gaps it opens the same cycle, without what was measured before."""
    cell.run("c1", 15.0)
    assert "poses" in cell.finish().left[0]
    first = kinds(cell).count("Move") - 1
    cell.open_gap()
    cell.thermal = replace(cell.thermal, visited=len(POSES) - first)
    cell.run("c2", LONG_S)
    result = cell.finish()
    words = f"thermal measurement at 3 poses, of which the thermal node has {len(POSES) - first}"
    assert (result.complete, result.left) == (False, (words,))
    cell.open_gap()
    cell.thermal = replace(cell.thermal, visited=len(POSES))
    cell.log.clear()
    cell.run("c3", LONG_S)
    assert cell.finish().complete
    assert [each.cycle_id for each in cell.log if isinstance(each, ask.BeginCycle)] == ["c3"]


def test_a_pose_that_was_taught_twice_is_one_to_the_thermal_node(history):
    """Past an obstacle, there and back."""
    config = config_of(poses=np.vstack([POSES, POSES[1]]), T_base_laser=None)
    cell = Cell(history, config=config)
    cell.open_gap()
    cell.thermal = replace(cell.thermal, visited=len(POSES))
    cell.run("c1", LONG_S)
    assert cell.finish().complete


@pytest.mark.parametrize("every", [1, 2])
def test_a_sensor_that_measures_often_does_not_hold_the_robot(history, every):
    """The measurements that a pose takes must be stood through, not also those that follow."""
    config = config_of(T_base_laser=None)
    taken_s = []
    for ticks in (10, every):
        cell = Cell(history, config=config, measures_every=ticks)
        cell.open_gap()
        begin_s = cell.now_s
        cell.run("c1", LONG_S)
        assert cell.finish().complete
        taken_s.append(cell.now_s - begin_s)
    assert taken_s[1] <= taken_s[0]
