"""The line is told where nothing is corrected: what is in force is not what the robot does."""

from dataclasses import replace

import pytest
from maintenance_cell import (
    KNOWN,
    LONG_S,
    Cell,
    bent,
    config_of,
    new_tool,
    opened,
    passed,
    proposed,
)

from robocal_ros.correction.interface import CorrectionState, ToldCorrection
from robocal_ros.history.history_records import TOOL
from robocal_ros.maintenance import AcceptBounds
from robocal_ros.thermal.accuracy import AccuracyLevel

SILENT_S = 5.0
OFF = ToldCorrection(state=CorrectionState.OFF, enabled=False)
ON = ToldCorrection(state=CorrectionState.ON, enabled=True, tool_revision=1)


@pytest.fixture
def cell(history) -> Cell:
    """A bent tool was measured, accepted and checked; the line asked before it was."""
    config = config_of(bounds=AcceptBounds(automatic=True), correction_silent_s=SILENT_S)
    cell = opened(history, config=config, check=bent(), drift=KNOWN)
    line(cell)

    def full(cell: Cell):
        cell.check = passed()
        return new_tool(proposed(cell.history))

    cell.full = full
    cell.run("c1", LONG_S)
    assert cell.finish().accepted
    assert cell.history.head(TOOL).revision == 1
    return cell


def line(cell: Cell, told: ToldCorrection | None = None):
    """What it reads, when the correction has just said so."""
    if told is not None:
        cell.session.correction(told, cell.now_s)
    return cell.session.accuracy(cell.now_s, cell.wall_ns)


def test_a_power_cut_that_leaves_the_correction_off_is_told_at_once(cell):
    assert line(cell, ON).level is AccuracyLevel.OK
    cell.restart()
    cell.session.drift(KNOWN, cell.now_s)
    found = line(cell, OFF)
    assert found.level is AccuracyLevel.DEGRADED
    assert found.reason == "correction: joint_correction_node is OFF: call ~/enable"
    assert found.error is None  # what is known of model and tool is not what the robot does
    assert line(cell, ON).level is AccuracyLevel.OK


def test_a_correction_that_falls_silent_is_told(cell):
    line(cell, ON)
    cell.pass_time(SILENT_S - 0.1)
    assert line(cell).level is AccuracyLevel.OK
    cell.pass_time(0.2)
    found = line(cell)
    assert (found.level, "is silent" in found.reason) == (AccuracyLevel.DEGRADED, True)


def test_a_tool_that_the_correction_refused_is_told_once_it_must_have_heard_of_it(cell):
    refused = replace(ON, tool_revision=0, last_refusal="4.0 deg from the taught tool")
    assert line(cell, refused).level is AccuracyLevel.OK  # tcf_node follows within a second
    cell.pass_time(SILENT_S + 0.1)
    found = line(cell, refused)
    assert found.level is AccuracyLevel.DEGRADED
    assert "corrects with tool revision 0, in force is revision 1" in found.reason
    assert "4.0 deg from the taught tool" in found.reason
