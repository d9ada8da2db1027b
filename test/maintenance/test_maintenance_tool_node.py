# SPDX-License-Identifier: Apache-2.0
"""A tool node that is deaf, dead, absent, or left armed by whoever ran before."""

from dataclasses import replace

import numpy as np
import pytest
from driven_robot import AheadMotion
from maintenance_cell import (
    BEAT_S,
    DRIVING,
    HOME,
    LONG_S,
    POSES,
    SILENT,
    STALE_S,
    TICK_S,
    TIMES,
    Cell,
    ToolNode,
    config_of,
    kinds,
    opened,
    over,
    until_moving,
)

from robocal_ros.ground.errors import Code, ConflictError
from robocal_ros.maintenance.robot_interface import (
    AGAIN_S,
    DEAF_S,
    MOST_ASKED,
    Disarming,
    DriverAnswer,
)
from robocal_ros.maintenance.session import MaintenanceState
from robocal_ros.motion.plan import SHORTEST_STOP_S
from robocal_ros.motion.robot_watch import VELOCITY_S
from robocal_ros.tool.driving import SETTLED_S

GONE_S = 6.0  # the tool node is looked for as long


def test_a_tool_node_that_never_confirms_is_a_fault(cell):
    cell.services["disarm"] = SILENT
    result = cell.ran("c1")
    assert "does not confirm" in result.message
    with pytest.raises(ConflictError, match="not confirmed"):
        cell.session.acknowledge("me")
    cell.services["disarm"] = "ok"
    cell.pass_time(1.0)
    cell.session.acknowledge("me")
    assert cell.state is MaintenanceState.IDLE


def test_a_tool_node_that_was_never_started_keeps_nothing_but_its_part(history):
    cell = Cell(history)
    cell.tool_dies()
    cell.open_gap()
    with pytest.raises(ConflictError, match="not there: start it"):  # it may yet be found
        cell.session.run("c1", LONG_S, cell.now_s, cell.wall_ns)
    cell.pass_time(GONE_S)
    result = cell.ran("c1")
    assert (result.code, result.thermal_code) == (Code.ACCEPT, Code.NO_SIGNIFICANT_GAIN)
    assert (result.tool_code, result.left) == (Code.CONFLICT, ("tool measurement (quick)",))
    assert "tool: the tool node is not there: start it" in result.message
    assert not {"Arm", "Measure"} & set(kinds(cell))
    over(cell)
    cell.tool = ToolNode()
    assert cell.ran("c2").tool_answer == "pass"
    over(cell)


def test_a_tool_node_that_died_at_home_is_a_fault_that_can_be_acknowledged(cell):
    cell.ran("c1")
    cell.tool_dies()
    count = kinds(cell).count("Move")
    assert "not there: start it" in cell.ran("c2").message
    assert kinds(cell).count("Move") == count
    with pytest.raises(ConflictError, match=r"not confirmed .* not there"):
        cell.session.acknowledge("me")
    cell.pass_time(GONE_S)
    cell.session.acknowledge("me")
    assert cell.state is MaintenanceState.IDLE


def test_a_tool_node_that_died_where_it_moved_the_robot_is_not_let_go(cell):
    """One that is there must confirm, the same or a new one, and the robot must rest."""
    until_moving(cell, "tool")
    cell.tool_dies()
    cell.is_open = False
    over(cell, fault=True)
    cell.motion = AheadMotion(HOME)  # brought home by hand
    cell.pass_time(2.0 * GONE_S)
    with pytest.raises(ConflictError, match="not confirmed"):
        cell.session.acknowledge("me")
    cell.tool = ToolNode()
    cell.pass_time(1.0)
    cell.session.acknowledge("me")
    assert cell.state is MaintenanceState.IDLE


def test_a_tool_node_is_let_go_only_while_the_robot_stands_at_home(history):
    cell = Cell(history)
    cell.tool_dies()
    cell.motion = AheadMotion(POSES[0])
    cell.pass_time(2.0 * GONE_S)
    assert not cell.session.status(cell.now_s).disarmed
    cell.motion = AheadMotion(HOME)
    cell.pass_time(1.0)
    assert cell.session.status(cell.now_s).disarmed


def test_a_tool_node_that_hangs_is_not_let_go(history):
    """It is there, or was found meanwhile, and may be armed by an operator."""
    cell = Cell(history)
    cell.tool_dies()
    cell.pass_time(0.5 * GONE_S)
    cell.tool, cell.services["disarm"] = ToolNode(armed=True), SILENT
    cell.pass_time(2.0 * GONE_S)
    assert not cell.session.status(cell.now_s).disarmed
    cell.tool_dies()
    cell.pass_time(0.5 * GONE_S)  # absent anew: not for long
    assert not cell.session.status(cell.now_s).disarmed
    cell.pass_time(GONE_S)
    assert cell.session.status(cell.now_s).disarmed


def test_disarms_that_a_node_never_answers_do_not_pile_up():
    tool = Disarming()
    tool.doubt()
    for number in range(1, 1000):
        tool.asked(number, number * AGAIN_S)
    assert len(tool._asked) == MOST_ASKED
    tool.answered(990, DriverAnswer(Code.ACCEPT), 500.0)  # it wakes, with what waited for it
    assert not tool.engaged


@pytest.mark.parametrize("how", ["closed", "cancelled"])
def test_a_deaf_tool_node_is_stopped_by_what_armed_it(cell, how):
    """It hangs, and the robot moves on by the plan that the controller has."""
    until_moving(cell, "tool")
    cell.services |= {"disarm": SILENT, "cancel": SILENT}
    assert cell.moved_s == cell.now_s
    since_s = cell.now_s
    if how == "closed":
        cell.is_open = False
    else:
        cell.session.cancel("by the PLC")
    cell.pass_time(3.0)
    assert cell.moved_s <= since_s + 0.2 + DEAF_S + SHORTEST_STOP_S + 0.1
    assert cell.state is MaintenanceState.FAULT
    assert "Stop" in kinds(cell)
    with pytest.raises(ConflictError, match="not confirmed"):
        cell.session.acknowledge("me")


@pytest.mark.parametrize(
    ("how", "hears_s"), [("closed", BEAT_S), ("silent", STALE_S), ("cancelled", 0.0)]
)
def test_what_a_dead_tool_node_left_is_stopped_whoever_confirms(cell, how, hears_s):
    """Started anew it confirms at once, but knows nothing of the plan that the controller has."""
    until_moving(cell, "tool")
    cell.tool_dies()
    cell.tool = ToolNode()
    if how == "cancelled":
        cell.session.cancel("by the PLC")
    else:
        cell.is_open, cell.beating = how == "silent", how != "silent"
    believed_s = DRIVING.late_s + SHORTEST_STOP_S + SETTLED_S
    cell.pass_time(hears_s + believed_s + SHORTEST_STOP_S + 0.1)
    assert cell.moved_s < cell.now_s - TICK_S
    cell.finish()
    over(cell, fault=how != "cancelled")
    assert kinds(cell).count("Stop") == 1


def test_a_confirmation_at_home_does_not_hand_over_what_a_dead_tool_node_left(cell):
    """The way down begins with a rest of 0.3 s."""
    cell.run("c1", LONG_S)
    while not cell.tool.measuring:
        cell.step()
    cell.tool_dies()
    cell.tool = ToolNode()
    cell.session.cancel("by the PLC")
    cell.pass_time(0.1)  # it has confirmed
    status = cell.session.status(cell.now_s)
    assert (status.at_home, status.disarmed) == (True, False)
    cell.session.doubt_gap("two publish gap_open")
    cell.step()
    with pytest.raises(ConflictError, match="may still be driven"):
        cell.session.acknowledge("me")
    over(cell, fault=True)
    assert kinds(cell)[-1] == "Stop"
    assert cell.at_home()
    assert cell.session.status(cell.now_s).disarmed
    cell.session.acknowledge("me")


def test_a_robot_that_rests_but_is_not_handed_over_is_told_so(history):
    """The stop in the dead tool node's place is due after the time that a rest may take."""
    cell = opened(history, config=config_of(times=replace(TIMES, rest_s=0.3)))
    cell.run("c1", LONG_S)
    while not cell.tool.measuring or cell.now_s < cell.moved_s + 0.5:
        cell.step()
    cell.tool_dies()
    cell.tool = ToolNode()
    cell.session.cancel("by the PLC")
    assert "the robot rests, but what the tool node sent may" in cell.finish().message


@pytest.mark.parametrize("silent_s", [0.6, 3.0])
def test_a_deaf_tool_node_is_stopped_once_joint_states_are_back(cell, silent_s):
    """Not before: nobody knows where to stop from. One that stands by then is not pushed."""
    until_moving(cell, "tool")
    cell.services |= {"disarm": SILENT, "cancel": SILENT}
    cell.silent = True
    cell.is_open = False
    cell.pass_time(silent_s)
    assert "Stop" not in kinds(cell)
    moving = cell.moved_s == cell.now_s
    assert moving == (silent_s < 1.0)
    cell.silent, heard_s, q = False, cell.now_s, cell.q
    cell.pass_time(1.5)
    assert kinds(cell).count("Stop") == 1
    if moving:
        assert cell.moved_s <= heard_s + VELOCITY_S + SHORTEST_STOP_S + 0.1
    else:
        np.testing.assert_allclose(cell.q, q, atol=1e-6)


@pytest.mark.parametrize("how", ["closed", "cancelled"])
def test_a_tool_node_that_hears_is_left_to_stop_by_itself(cell, how):
    """Two stops at once would pull the robot to and fro; nor is one left for the next run."""
    until_moving(cell, "tool")
    if how == "closed":
        cell.is_open = False
        cell.pass_time(3.0)
        cell.motion = AheadMotion(HOME)  # brought home by hand
        cell.open_gap()
        cell.session.acknowledge("me")
    else:
        cell.session.cancel("by the PLC")
        cell.finish()
    assert cell.ran("c2").complete
    assert "Stop" not in kinds(cell)


def test_a_node_that_ends_stops_what_the_tool_node_moves_at_once(cell):
    until_moving(cell, "tool")
    before = cell.shelf.document
    asked = cell.session.give_up("the node ends", cell.now_s)
    assert [type(request).__name__ for request in asked] == ["Stop", "CancelMeasure", "Disarm"]
    assert cell.shelf.document == before  # a stop does not wait for the disk
    cell.session.close()
    cell.restart()
    assert cell.state is MaintenanceState.FAULT
    assert "the node ends" in cell.session.status(cell.now_s).fault


def test_a_node_that_ends_just_after_a_fault_stops_what_a_deaf_tool_node_moves(cell):
    """Nobody would be there to send the stop when it is due."""
    until_moving(cell, "tool")
    cell.services |= {"disarm": SILENT, "cancel": SILENT}
    cell.is_open = False
    while cell.state is not MaintenanceState.FAULT:
        cell.step()
    assert cell.moved_s == cell.now_s
    assert "Stop" not in kinds(cell)
    asked = cell.session.give_up("the node ends", cell.now_s)
    assert [type(request).__name__ for request in asked] == ["Stop"]
    assert cell.session.give_up("the node ends", cell.now_s) == []  # sent once
    cell.session.close()
    cell.restart()
    assert cell.state is MaintenanceState.FAULT


def test_a_tool_node_that_turns_deaf_at_the_station_is_a_fault(cell):
    until_moving(cell, "tool")
    cell.services["disarm"] = SILENT
    count = kinds(cell).count("Move")
    assert "does not confirm" in cell.finish().message
    assert kinds(cell).count("Move") == count
    with pytest.raises(ConflictError, match="not confirmed"):
        cell.session.acknowledge("me")


def test_after_a_restart_the_tool_node_is_disarmed_before_anything_else(cell):
    until_moving(cell, "tool")
    cell.restart()
    assert not cell.session.status(cell.now_s).disarmed
    with pytest.raises(ConflictError, match="not confirmed"):
        cell.session.acknowledge("me")
    cell.pass_time(0.5)
    assert cell.session.status(cell.now_s).disarmed
    assert not cell.tool.armed


def test_a_disarm_that_is_not_confirmed_outlives_a_restart(cell):
    until_moving(cell, "tool")
    cell.services |= {"disarm": SILENT, "cancel": SILENT}
    cell.is_open = False
    cell.pass_time(1.0)
    assert cell.state is MaintenanceState.FAULT
    cell.restart()
    cell.open_gap()
    assert not cell.session.status(cell.now_s).disarmed
    with pytest.raises(ConflictError, match="not confirmed"):
        cell.session.acknowledge("me")
    cell.services.clear()
    cell.pass_time(1.0)
    assert cell.session.status(cell.now_s).disarmed
    assert not cell.tool.armed


def test_an_idle_cell_that_restarts_does_not_begin_before_a_disarm(cell):
    cell.tool.armed = True  # by an operator
    cell.services["disarm"] = SILENT
    cell.restart()
    cell.open_gap()
    assert cell.run("c1", LONG_S) is Code.CONFLICT
    cell.services.clear()
    cell.pass_time(1.0)
    assert cell.run("c1", LONG_S) is Code.ACCEPT
    assert cell.finish().complete


def test_what_an_operator_armed_is_disarmed_before_anything_moves(cell):
    cell.tool.armed = True
    assert cell.ran("c1").complete
    assert kinds(cell)[:3] == ["Disarm", "BeginCycle", "Move"]
    over(cell)


def test_a_cycle_moves_nothing_before_the_disarm_is_confirmed(cell):
    cell.tool.armed = True
    cell.services["disarm"] = SILENT
    result = cell.ran("c1")
    assert "does not confirm" in result.message
    assert not {"Move", "BeginCycle", "Arm"} & set(kinds(cell))
    assert cell.state is MaintenanceState.FAULT
