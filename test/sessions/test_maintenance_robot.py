"""A robot that is silent, off its plan, pushed, or not at home; faults and their ends."""

import numpy as np
import pytest
from maintenance_cell import (
    ARM,
    HOME,
    LONG_S,
    POSES,
    SILENT,
    Cell,
    kinds,
    opened,
    over,
    until_moving,
)

from robocal_ros.core.codes import Code
from robocal_ros.core.errors import LimitError, StorageError
from robocal_ros.sessions.maintenance import State
from robocal_ros.sim.joint_motion import JointMotion


@pytest.fixture
def cell(history) -> Cell:
    return opened(history)


def until_measuring(cell: Cell, pose: int) -> None:
    cell.run("c1", LONG_S)
    while not cell.session.status(cell.now_s).doing.startswith(f"measuring pose {pose}"):
        cell.step()


def test_silent_joint_states_stop_the_robot(cell):
    until_moving(cell, "thermal")
    cell.silent = True
    cell.pass_time(1.0)
    cell.silent = False
    over(cell, fault=True)
    assert "joint states are silent" in cell.session.status(cell.now_s).fault


def test_a_robot_off_its_plan_is_stopped(cell):
    until_moving(cell, "thermal")
    cell.offset[1] = np.radians(2.0)
    cell.pass_time(1.0)
    over(cell, fault=True)
    assert "away from its plan" in cell.session.status(cell.now_s).fault


def pushed(cell: Cell, joint: int = 1, by_deg: float = 25.0) -> None:
    """Somebody else has moved the robot; it rests."""
    q = cell.q.copy()
    q[joint] += np.radians(by_deg)
    cell.motion = JointMotion(q)


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
    assert cell.state is State.FAULT
    assert "stands away from home" in cell.session.status(cell.now_s).fault


def test_a_robot_that_is_not_at_home_is_not_moved(cell):
    cell.offset[2] = np.radians(5.3)
    cell.pass_time(0.5)
    with pytest.raises(LimitError, match=f"not at home: {ARM.joint_names[2]} is 5.30 deg off"):
        cell.session.run("c1", LONG_S, cell.now_s, cell.wall_ns)
    assert cell.state is State.FAULT
    cell.offset[2] = 0.0
    cell.pass_time(0.5)
    assert cell.run("c1", LONG_S) is Code.CONFLICT  # until it is acknowledged
    cell.session.acknowledge("me")
    assert cell.run("c1", LONG_S) is Code.ACCEPT
    assert cell.log == []


def test_a_fault_away_from_home_is_not_acknowledged(cell):
    until_moving(cell, "tool")
    cell.is_open = False
    over(cell, fault=True)
    fault = cell.session.status(cell.now_s).fault
    with pytest.raises(LimitError, match=r"not at home: .* is .* deg off .*bring it home"):
        cell.session.acknowledge("me")
    cell.silent = True
    cell.pass_time(0.5)
    with pytest.raises(LimitError, match="joint states are missing"):
        cell.session.acknowledge("me")
    assert cell.session.status(cell.now_s).fault == fault
    cell.silent, cell.motion = False, JointMotion(HOME)
    cell.pass_time(0.5)
    cell.session.acknowledge("me")
    assert cell.state is State.IDLE


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
    assert (after.state, after.fault) == (State.FAULT, before.fault)
    assert after.fault_code is Code.LIMIT_EXCEEDED
    assert cell.run("c1", LONG_S) is Code.CONFLICT


def test_a_reading_that_is_older_does_not_count(cell):
    cell.motion = JointMotion(POSES[0])
    cell.pass_time(0.5)
    cell.session.reading(cell.now_s - 0.3, HOME, cell.now_s)
    assert not cell.session.status(cell.now_s).at_home
    assert cell.run("c1", LONG_S) is Code.LIMIT_EXCEEDED


def test_a_restart_in_the_middle_of_a_run_is_a_fault(cell):
    until_moving(cell, "thermal")
    cell.restart()
    status = cell.session.status(cell.now_s)
    assert status.state is State.FAULT
    assert "see where the robot is" in status.fault
    assert status.last.code is Code.CONFLICT
    cell.restart()
    assert cell.state is State.FAULT
