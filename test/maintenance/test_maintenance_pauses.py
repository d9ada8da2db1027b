# SPDX-License-Identifier: Apache-2.0
"""A process that stands still now and then: a write that takes its time, a busy machine."""

import numpy as np
import pytest
from maintenance_cell import (
    BEAT_S,
    DRIVING,
    LAG_S,
    LATE_S,
    LONG_S,
    SILENT,
    STALE_S,
    TICK_S,
    ToolNode,
    kinds,
    opened,
)
from maintenance_tools import automatic, straightened, until_sent

from robocal_ros.ground.errors import Code
from robocal_ros.maintenance.robot_interface import DEAF_S, Stop
from robocal_ros.maintenance.session import UNSAVED_S, MaintenanceState
from robocal_ros.motion.plan import SHORTEST_STOP_S
from robocal_ros.motion.robot_watch import DRAIN_S
from robocal_ros.tool.driving import SETTLED_S

PAUSES_S = (0.3, 0.6, 3.0)
FRESH_WITHIN_S = DRAIN_S + STALE_S  # after a pause


@pytest.mark.parametrize("pause_s", PAUSES_S)
def test_a_write_that_takes_its_time_breaks_no_cycle_off(cell, pause_s):
    cell.shelf.takes = lambda: cell.pause(pause_s)
    assert cell.run("c1", LONG_S) is Code.ACCEPT
    result = cell.finish()
    assert (result.code, result.complete) == (Code.ACCEPT, True), result.message
    assert result.tool_answer == "pass"


def test_a_motion_begins_when_it_is_sent_not_when_it_was_planned(cell):
    cell.beats_every_s = 0.5 * BEAT_S
    cell.pass_time(1.0)
    cell.planning_s = 2.0 * DRIVING.late_s
    assert cell.run("c1", LONG_S) is Code.ACCEPT
    result = cell.finish()
    assert (result.code, result.complete) == (Code.ACCEPT, True), result.message


@pytest.mark.parametrize(("beats_every_s", "pause_s"), [(0.2, 0.2), (0.1, 0.3)])
def test_a_pause_of_its_own_that_a_cycle_bears_in_a_motion(history, beats_every_s, pause_s):
    """As docs/plc.md, at any time between two heartbeats and between two beats."""
    for late_s in np.arange(0.0, 2.0 * BEAT_S, TICK_S):
        cell = opened(history)
        cell.beats_every_s = beats_every_s
        cell.pass_time(1.0)
        until_sent(cell)
        cell.pass_time(0.4 + late_s)
        assert cell.moved_s == cell.now_s
        cell.pause(pause_s)
        cell.pass_time(1.0)
        assert cell.state is MaintenanceState.RUNNING, cell.session.status(cell.now_s).fault


@pytest.mark.parametrize("pause_s", PAUSES_S)
def test_nor_does_one_between_two_measurements(history, pause_s):
    """Check, full measurement and acceptance are each kept before the tool node is armed again."""
    cell = automatic(history)
    cell.full = straightened
    cell.shelf.takes = lambda: cell.pause(pause_s)
    result = cell.ran("c1")
    assert (result.code, result.complete) == (Code.ACCEPT, True), result.message
    assert (len(result.accepted), result.tool_answer) == (1, "pass")


@pytest.mark.parametrize("dies", ["before", "after"])
def test_nothing_moves_where_the_plc_dies_while_a_cycle_is_written(cell, dies):
    """What it sent before counts for nothing, when the process goes on."""

    def takes() -> None:
        cell.shelf.takes = lambda: None
        cell.beating = dies == "after"
        cell.pause(0.6)
        cell.beating = False

    cell.shelf.takes = takes
    cell.run("c1", LONG_S)
    before_s = cell.now_s
    result = cell.finish()
    assert cell.now_s <= before_s + FRESH_WITHIN_S + 2.0 * TICK_S
    assert result.code is Code.CONFLICT
    assert "gap_open is silent for more than 0.5 s" in result.message
    assert set(kinds(cell)) <= {"Disarm", "CancelMeasure"}


def test_a_false_that_waited_ends_the_cycle_at_once(cell):
    def takes() -> None:
        cell.shelf.takes = lambda: None
        cell.is_open = False
        cell.pause(0.6)

    cell.shelf.takes = takes
    cell.run("c1", LONG_S)
    before_s = cell.now_s
    result = cell.finish()
    assert cell.now_s <= before_s + LATE_S + 2.0 * TICK_S
    assert result.code is Code.CONFLICT
    assert set(kinds(cell)) <= {"Disarm", "CancelMeasure"}


def test_a_pause_in_a_motion_stops_the_robot(cell):
    until_sent(cell)
    cell.pause(0.6)
    result = cell.finish()
    assert result.code is Code.CONFLICT
    assert cell.state is MaintenanceState.FAULT
    assert "Stop" in kinds(cell)


def test_a_stop_after_a_suspend_begins_where_the_robot_stands(cell):
    """Host and controller slept in the middle of a motion."""
    until_sent(cell)
    cell.pass_time(0.6)
    assert cell.moved_s == cell.now_s
    cell.session.slept(3600.0)
    asked = cell.session.tick(cell.now_s + 3600.0 + TICK_S, cell.wall_ns)
    (stop,) = (request.plan for request in asked if isinstance(request, Stop))
    behind_rad = DRIVING.limits.joint_velocity * (LAG_S + TICK_S)
    assert np.max(np.abs(stop.q[0] - cell.q)) <= behind_rad
    assert "gap_open is silent" in cell.session.status(cell.now_s).fault


def test_a_stop_does_not_wait_for_the_disk(cell):
    until_sent(cell)
    cell.pass_time(0.5)
    cell.shelf.takes = lambda: cell.pause(0.6)
    cell.is_open, closed_s = False, cell.now_s
    while cell.state is MaintenanceState.RUNNING:
        cell.step()
    cell.pass_time(1.0)
    assert cell.moved_s <= closed_s + BEAT_S + SHORTEST_STOP_S + LAG_S + 2.0 * TICK_S
    cell.restart()
    assert "gap_open is false" in cell.session.status(cell.now_s).fault


@pytest.mark.parametrize("pause_s", PAUSES_S)
@pytest.mark.parametrize("how", ["deaf", "new"])
def test_nor_does_the_stop_of_what_a_tool_node_left(cell, pause_s, how):
    """One that hangs, or one that was started anew and knows nothing of the motion in hand."""
    cell.run("c1", LONG_S)
    while not cell.tool.measuring:
        cell.step()
    cell.pass_time(0.6)
    assert cell.moved_s == cell.now_s
    if how == "deaf":
        cell.services |= {"disarm": SILENT, "cancel": SILENT}
    else:
        cell.tool = ToolNode()
    cell.shelf.takes = lambda: cell.pause(pause_s)
    cell.is_open, closed_s = False, cell.now_s
    waits_s = DEAF_S if how == "deaf" else DRIVING.late_s + SHORTEST_STOP_S + SETTLED_S
    cell.pass_time(6.0)
    assert kinds(cell).count("Stop") == 1
    assert cell.moved_s <= closed_s + BEAT_S + waits_s + SHORTEST_STOP_S + LAG_S + 4.0 * TICK_S
    cell.restart()
    assert "gap_open is false" in cell.session.status(cell.now_s).fault


def test_a_fault_is_written_though_nobody_says_whether_the_robot_rests(cell):
    cell.run("c1", LONG_S)
    while not cell.tool.measuring:
        cell.step()
    cell.silent, cell.is_open = True, False
    cell.pass_time(BEAT_S + UNSAVED_S + 0.1)
    cell.restart()
    assert "gap_open is false" in cell.session.status(cell.now_s).fault


def test_a_fault_that_is_not_on_the_disk_yet_outlives_a_kill(cell):
    until_sent(cell)
    cell.is_open = False
    while cell.state is MaintenanceState.RUNNING:
        cell.step()
    cell.restart()
    status = cell.session.status(cell.now_s)
    assert (status.state, status.last.code) == (MaintenanceState.FAULT, Code.CONFLICT)
