# SPDX-License-Identifier: Apache-2.0
"""A robot that is silent, off its plan, pushed, or not at home; faults and their ends."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from driven_robot import AheadMotion
from maintenance_cell import (
    ARM,
    DRIVING,
    HOME,
    KNOWN,
    LAG_S,
    LONG_S,
    POSES,
    SILENT,
    TICK_S,
    Cell,
    bent,
    config_of,
    kinds,
    opened,
    over,
    until_moving,
)

from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, LimitError, RobocalError, StorageError
from robocal_ros.maintenance.mover import Ways
from robocal_ros.maintenance.robot_interface import CellInterface, DriverAnswer
from robocal_ros.maintenance.session import MaintenanceState
from robocal_ros.motion.cell import ToolBody
from robocal_ros.motion.plan import SHORTEST_STOP_S
from robocal_ros.thermal.accuracy import AccuracyLevel


def until_measuring(cell: Cell, pose: int) -> None:
    cell.run("c1", LONG_S)
    while not cell.session.status(cell.now_s).doing.startswith(f"measuring pose {pose}"):
        cell.step()


@pytest.mark.parametrize("which", ["thermal", "tool"])
def test_silent_joint_states_stop_the_robot(cell, which):
    until_moving(cell, which)
    cell.silent = True
    while cell.state is not MaintenanceState.FAULT:
        cell.step()
    cell.silent = False
    over(cell, fault=True)
    status = cell.session.status(cell.now_s)
    assert status.fault_code is Code.TOO_FEW_SAMPLES
    assert "joint states are silent" in status.fault


def test_a_robot_that_was_never_heard_is_not_moved(history):
    cell = Cell(history, silent=True)
    cell.open_gap()
    assert cell.run("c1", LONG_S) is Code.TOO_FEW_SAMPLES
    assert cell.state is MaintenanceState.IDLE  # nothing has moved: nobody need look
    cell.silent = False
    cell.pass_time(0.5)
    assert cell.run("c1", LONG_S) is Code.ACCEPT


def test_a_robot_off_its_plan_is_stopped(cell):
    until_moving(cell, "thermal")
    cell.offset[1] = np.radians(2.0)
    cell.pass_time(1.0)
    over(cell, fault=True)
    assert "away from its plan" in cell.session.status(cell.now_s).fault


def test_one_wild_reading_is_no_motion(cell):
    until_moving(cell, "thermal")
    cell.offset[1] = 1.0
    cell.step()
    cell.offset[1] = 0.0
    q = cell.q.copy()
    cell.pass_time(1.0)
    longest_s = TICK_S + LAG_S + SHORTEST_STOP_S
    assert np.max(np.abs(cell.q - q)) < DRIVING.limits.joint_velocity * longest_s
    over(cell, fault=True)
    assert "away from its plan" in cell.session.status(cell.now_s).fault


def refused(ask: Callable[[], object], words: str) -> Code:
    with pytest.raises(RobocalError, match=words) as caught:
        ask()
    return caught.value.code


def pushed(cell: Cell, joint: int = 1, by_deg: float = 25.0) -> None:
    """Somebody else has moved the robot; it rests."""
    q = cell.q.copy()
    q[joint] += np.radians(by_deg)
    cell.motion = AheadMotion(q)


@pytest.mark.parametrize("by_deg", [3.0, 25.0])
def test_a_robot_pushed_while_it_measures_is_not_driven(cell, by_deg):
    until_measuring(cell, 2)
    pushed(cell, by_deg=by_deg)
    moves = kinds(cell).count("Move")
    cell.pass_time(3.0)
    assert kinds(cell).count("Move") == moves
    over(cell, fault=True)
    joint = ARM.joint_names[1]
    words = f"not where it came to rest: {joint} is {by_deg:.2f} deg off"
    assert words in cell.session.status(cell.now_s).fault


def test_a_robot_pushed_while_a_run_is_broken_off_is_not_driven_home(cell):
    until_measuring(cell, 2)
    cell.session.cancel("by the PLC")
    pushed(cell)
    moves = kinds(cell).count("Move")
    cell.pass_time(3.0)
    assert kinds(cell).count("Move") == moves
    over(cell, fault=True)
    assert "robot is not on its taught way: " in cell.session.status(cell.now_s).fault


def test_silent_joint_states_while_the_robot_measures_are_a_fault(cell):
    until_measuring(cell, 2)
    cell.silent = True
    cell.services["sensor"] = SILENT
    cell.pass_time(0.3)
    assert cell.state is MaintenanceState.FAULT
    assert "stands away from home" in cell.session.status(cell.now_s).fault


def test_a_robot_that_is_not_at_home_is_not_moved(cell):
    cell.offset[2] = np.radians(5.3)
    cell.pass_time(0.5)
    words = f"not at home: {ARM.joint_names[2]} is 5.30 deg off"
    code = refused(lambda: cell.session.run("c1", LONG_S, cell.now_s, cell.wall_ns), words)
    assert code is Code.LIMIT_EXCEEDED
    assert cell.state is MaintenanceState.FAULT
    cell.offset[2] = 0.0
    cell.pass_time(0.5)
    assert cell.run("c1", LONG_S) is Code.CONFLICT  # until it is acknowledged
    cell.session.acknowledge("me")
    assert cell.run("c1", LONG_S) is Code.ACCEPT
    assert cell.log == []


def test_a_fault_is_not_acknowledged_before_its_stop_was_seen(cell):
    until_moving(cell, "thermal")
    cell.is_open = False
    while cell.state is not MaintenanceState.FAULT:
        cell.step()
    words = "a stop is under way: wait until the robot stands"
    assert refused(lambda: cell.session.acknowledge("me"), words) is Code.CONFLICT
    over(cell, fault=True)
    assert refused(lambda: cell.session.acknowledge("me"), "not at home") is Code.LIMIT_EXCEEDED


def test_a_stop_that_nobody_can_see_is_no_pause(cell):
    """Finding: joint states had died, and a person was told to wait until the robot stands."""
    until_moving(cell, "thermal")
    cell.silent = True
    cell.pass_time(0.5)
    assert cell.state is MaintenanceState.FAULT
    words = r"^joint states are silent for 0\.5. s: nobody knows whether the robot has stopped"
    assert refused(lambda: cell.session.acknowledge("me"), words) is Code.TOO_FEW_SAMPLES


def test_a_fault_away_from_home_is_not_acknowledged(cell):
    until_moving(cell, "tool")
    cell.is_open = False
    over(cell, fault=True)
    fault = cell.session.status(cell.now_s).fault
    words = r"not at home: .* is .* deg off .*bring it home"
    assert refused(lambda: cell.session.acknowledge("me"), words) is Code.LIMIT_EXCEEDED
    cell.silent = True
    cell.pass_time(0.5)
    words = r"joint states are silent for 0.5. s"
    assert refused(lambda: cell.session.acknowledge("me"), words) is Code.TOO_FEW_SAMPLES
    assert cell.session.status(cell.now_s).fault == fault
    cell.silent, cell.motion = False, AheadMotion(HOME)
    cell.pass_time(0.5)
    cell.session.acknowledge("me")
    assert cell.state is MaintenanceState.IDLE


@pytest.mark.parametrize("mode", ["quick", "full"])
def test_a_robot_that_left_its_plan_in_a_tool_run_is_not_driven_on(cell, mode):
    """It may be held, or have hit something; only a person knows."""
    held = DriverAnswer(Code.LIMIT_EXCEEDED, "away from its plan", left_plan=True)
    cell.check, cell.full = (held if mode == "quick" else bent()), lambda _: held
    assert cell.ran("c1").code is Code.LIMIT_EXCEEDED
    over(cell, fault=True)
    status = cell.session.status(cell.now_s)
    assert (cell.state, status.fault_code) == (MaintenanceState.FAULT, Code.LIMIT_EXCEEDED)
    assert held.message in status.fault
    asked = kinds(cell)
    assert "Move" not in asked[len(asked) - asked[::-1].index("Measure") :]
    cell.motion = AheadMotion(HOME)  # brought there by hand
    cell.pass_time(0.5)
    cell.session.acknowledge("me")
    cell.session.drift(KNOWN, cell.now_s)
    said = cell.session.accuracy(cell.now_s, cell.wall_ns)
    assert said.level > AccuracyLevel.DUE
    assert held.message in said.reason


def test_a_tool_run_that_ends_beside_home_is_brought_to_it(cell):
    """Within what counts as home, but not where the programme was taught to begin."""
    cell.run("c1", LONG_S)
    while not cell.tool.measuring or np.max(np.abs(cell.q - HOME)) < np.radians(0.1):
        cell.step()
    cell.session.cancel("by the PLC")
    cell.pass_time(0.2)
    assert cell.at_home()
    cell.finish()
    over(cell)
    assert np.max(np.abs(cell.q - HOME)) < np.radians(0.02)


def test_a_robot_that_never_left_is_not_moved(cell):
    """A programme may stop a little beside the taught home."""
    cell.motion = AheadMotion(HOME + np.radians(0.1))
    cell.services["thermal"] = SILENT
    cell.ran("c1")
    asked = kinds(cell)
    assert asked.index("BeginCycle") < asked.index("Arm")
    assert "Move" not in asked[: asked.index("Arm")]


def test_an_acknowledgement_that_cannot_be_kept_is_none(cell, monkeypatch):
    cell.offset[2] = np.radians(5.3)
    cell.pass_time(0.5)
    assert cell.run("c1", LONG_S) is Code.LIMIT_EXCEEDED
    cell.offset[2] = 0.0
    cell.pass_time(0.5)
    before = cell.session.status(cell.now_s)

    def full(document):
        raise StorageError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(cell.shelf, "save", full)
        with pytest.raises(StorageError):
            cell.session.acknowledge("me")
    after = cell.session.status(cell.now_s)
    assert (after.state, after.fault) == (MaintenanceState.FAULT, before.fault)
    assert after.fault_code is Code.LIMIT_EXCEEDED
    assert cell.run("c1", LONG_S) is Code.CONFLICT


def test_a_reading_that_is_older_does_not_count(cell):
    cell.motion = AheadMotion(POSES[0])
    cell.pass_time(0.5)
    cell.session.reading(cell.now_s - 0.3, HOME, cell.now_s)
    assert not cell.session.status(cell.now_s).at_home
    assert cell.run("c1", LONG_S) is Code.LIMIT_EXCEEDED


def test_a_restart_in_the_middle_of_a_run_is_a_fault(cell):
    until_moving(cell, "thermal")
    cell.restart()
    status = cell.session.status(cell.now_s)
    assert status.state is MaintenanceState.FAULT
    assert "see where the robot is" in status.fault
    assert status.last.code is Code.CONFLICT
    cell.restart()
    assert cell.state is MaintenanceState.FAULT


def test_a_robot_that_has_not_come_to_rest_is_not_handed_over(history):
    """Cancelled just before home, with the gap closed in the same moment."""
    cell = opened(history, config=config_of(home_near=np.radians(2.0)))
    until_moving(cell, "thermal")
    while cell.session.status(cell.now_s).doing != "on its way home":
        cell.step()
    while np.max(np.abs(cell.q - HOME)) > np.radians(1.9):
        cell.step()
    cell.session.cancel("by the PLC")
    cell.is_open = False
    cell.finish()
    assert cell.state is MaintenanceState.FAULT
    assert "not handed over at home" in cell.session.status(cell.now_s).fault
    over(cell, fault=True)
    cell.session.acknowledge("me")


def test_a_mandrel_beside_the_tool_must_be_clear_of_the_housing_too():
    """It hangs deeper than the tool: down to the beams on each taught way."""
    longer = config_of().T_flange_tool @ frames.transform(np.eye(3), [0.06, 0.0, 0.25])
    driving = replace(DRIVING, mandrel=ToolBody(longer, 0.1, 0.008, 0.05, "mandrel"))
    with pytest.raises(LimitError, match=r"taught way .: the mandrel"):
        Ways(ARM, config_of(driving=driving))


@pytest.mark.parametrize("left_s", [0.05, 5.0])
def test_the_rest_of_the_way_home_is_driven_where_it_fits(left_s):
    config = config_of(home_near=np.radians(2.0))
    cell = CellInterface(config, Ways(ARM, config))
    cell.begin(left_s)
    cell.left_home = True
    for now_s in np.arange(0.0, 0.5, TICK_S):
        cell.robot.reading(now_s, HOME + np.radians(1.0), now_s)
    assert next(cell.go_home(), "over") == (None if left_s > 1.0 else "over")
    assert [type(request).__name__ for request in cell.out] == ["Move"] * (left_s > 1.0)


def test_a_fault_ends_after_the_joints_clock_began_anew(cell):
    until_moving(cell, "tool")
    cell.is_open = False
    while cell.state is not MaintenanceState.FAULT:
        cell.step()
    cell.silent = True
    cell.pass_time(5.0)
    cell.silent, cell.clock_s = False, -cell.now_s  # the controller was switched off and on
    cell.motion = AheadMotion(HOME)
    cell.pass_time(1.0)
    cell.session.acknowledge("me")
    assert cell.state is MaintenanceState.IDLE
