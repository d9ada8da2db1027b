# SPDX-License-Identifier: Apache-2.0
"""What a measurement said outlives a run that breaks off; no tool stays in force unchecked."""

from collections.abc import Callable
from dataclasses import replace

import pytest
from driven_robot import AheadMotion
from maintenance_cell import (
    HOME,
    LONG_S,
    POSES,
    SILENT,
    Cell,
    bent,
    new_tool,
    opened,
    passed,
    proposed,
    wrong_tool,
)
from maintenance_tools import (
    a_check_passes,
    automatic,
    decide,
    level,
    measured_in_full,
    modes,
    until_measuring,
    until_verified,
)

from robocal_ros.ground.errors import Code, StorageError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import TOOL
from robocal_ros.maintenance.session import MaintenanceState
from robocal_ros.session.events import ACCEPT, REJECT
from robocal_ros.thermal.accuracy import AccuracyLevel

NO_POSES = POSES[:0]
CHECK_ONLY_S = 24.0  # a gap that has no time for a full measurement after it
FULL_ONLY_S = 22.0  # a gap that has no time for a check after it
UNSURE = replace(passed(), code=Code.TOO_FEW_SAMPLES, answer="cannot tell")


def answered(cell: Cell) -> None:
    """Until the measurement that runs has its answer; the robot is not at home yet."""
    while cell.tool.measuring:
        cell.step()
    cell.step()
    assert not cell.at_home()


def broken_off(cell: Cell, how: str) -> None:
    if how == "cancelled":
        cell.session.cancel("by the PLC")
    elif how == "closed":
        cell.is_open = False
    else:
        cell.silent = True


@pytest.mark.parametrize(
    ("how", "answer"), [("cancelled", bent()), ("closed", wrong_tool()), ("silent", bent())]
)
def test_what_a_check_found_outlives_a_run_that_breaks_off_on_the_way_home(history, how, answer):
    cell = opened(history)
    assert cell.ran("c0").tool_answer == "pass"
    assert level(cell) is AccuracyLevel.OK
    cell.check = answer
    until_measuring(cell, "quick")
    answered(cell)
    broken_off(cell, how)
    assert cell.finish().code is not Code.ACCEPT
    record = cell.session.memory.tool
    assert record.words == answer.message
    cell.pass_time(3.0)  # a stop comes before the disk
    cell.restart()
    assert cell.session.memory.tool == record
    if how == "cancelled":
        assert level(cell) is AccuracyLevel.DEGRADED


def test_a_full_measurement_outlives_a_run_that_breaks_off_on_the_way_home(history):
    cell = automatic(history)
    number = measured_in_full(cell)
    answered(cell)
    cell.session.cancel("by the PLC")
    cell.finish()
    decide(cell, ACCEPT, number)
    assert level(cell) is AccuracyLevel.DUE  # known as the measured tool


def until_answered(cell: Cell) -> int:
    """Until the check of the accepted tool has said that it is bent; its number."""
    number = measured_in_full(cell)
    until_verified(cell)
    answered(cell)
    assert cell.history.head(TOOL).calibration_id == number
    return number


def killed(cell: Cell) -> None:
    """The node; a person brings the robot home and acknowledges."""
    cell.restart()
    cell.motion = AheadMotion(HOME)
    cell.open_gap()
    cell.pass_time(0.5)
    assert cell.state is MaintenanceState.FAULT
    cell.session.acknowledge("me")


def test_a_tool_is_not_known_where_the_node_is_killed_on_the_way_home_from_its_check(history):
    cell = opened(history)
    assert cell.ran("c0").tool_answer == "pass"
    cell.check = bent()
    until_measuring(cell, "quick")
    answered(cell)
    killed(cell)
    assert level(cell) is AccuracyLevel.DEGRADED
    assert "found of it is lost" in cell.session.accuracy(cell.now_s, cell.wall_ns).reason
    a_check_passes(cell, "c2")


def test_an_accepted_tool_that_failed_its_check_as_the_node_was_killed_is_not_known(history):
    cell = automatic(history)
    until_answered(cell)
    killed(cell)
    assert level(cell) is AccuracyLevel.DEGRADED
    a_check_passes(cell, "c2")


def test_a_tool_that_failed_its_check_is_taken_back_by_a_cancelled_run_too(history):
    cell = automatic(history)
    until_answered(cell)
    cell.session.cancel("by the PLC")
    result = cell.finish()
    assert (result.code, result.accepted) == (Code.CONFLICT, ())
    assert result.message.startswith("by the PLC; the accepted tool failed its check and was taken")
    assert cell.state is MaintenanceState.IDLE
    assert cell.history.head(TOOL).calibration_id is None
    assert level(cell) is AccuracyLevel.DEGRADED


@pytest.mark.parametrize("how", ["closed", "held"])
def test_a_tool_that_failed_its_check_and_stays_in_force_is_a_fault(history, monkeypatch, how):
    def held(*args: object, **kwargs: object) -> None:
        raise StorageError("the history is held")

    cell = automatic(history)
    number = until_answered(cell)
    if how == "held":
        monkeypatch.setattr(CalibrationHistory, "rollback", held)
        cell.session.cancel("by the PLC")
        words = f"by the PLC; tool {number} failed its check and could not be taken back"
    else:
        cell.is_open = False
        words = f"handed over at home; tool {number} failed its check and is still in force"
    result = cell.finish()
    assert (result.code, result.accepted) == (Code.CONFLICT, (number,))
    assert words in result.message
    assert cell.state is MaintenanceState.FAULT
    assert words in cell.session.status(cell.now_s).fault


def test_a_disk_that_fails_after_a_failed_check_keeps_no_tool_in_force(history):
    def full() -> None:
        raise StorageError("no space left on the disk")

    cell = automatic(history)
    until_answered(cell)
    cell.shelf.takes = full
    while cell.history.head(TOOL).revision == 1:
        cell.step()
        assert cell.now_s < cell.ends_s
    cell.shelf.takes = lambda: None
    result = cell.finish()
    assert (result.code, result.accepted) == (Code.STORAGE_FAILED, ())
    assert cell.history.head(TOOL).calibration_id is None


def test_of_a_tool_that_was_taken_back_no_error_is_predicted(history):
    """What its check found was of the other tool."""
    cell = automatic(history)
    measured_in_full(cell)
    cell.finish()
    assert level(cell) is AccuracyLevel.DEGRADED
    assert cell.session.accuracy(cell.now_s, cell.wall_ns).error is None
    cell.log.clear()
    cell.check = passed()
    cell.ran("c2")
    assert modes(cell) == ["quick"]
    assert level(cell) is AccuracyLevel.OK
    assert cell.session.accuracy(cell.now_s, cell.wall_ns).error is not None


@pytest.mark.parametrize("second", [passed(), UNSURE])
def test_a_check_that_cannot_tell_is_repeated_once(history, second):
    cell = automatic(history)
    number = measured_in_full(cell)
    until_verified(cell)
    cell.log.clear()
    cell.check = UNSURE
    answered(cell)
    cell.check = second
    result = cell.finish()
    assert modes(cell) == ["quick"]
    assert (result.accepted, result.complete) == ((number,), second.answer == "pass")
    told = () if result.complete else ("verification of the accepted tool",)
    assert result.left == told
    assert level(cell) is (AccuracyLevel.OK if result.complete else AccuracyLevel.DUE)


def run(cell: Cell, name: str, gap_s: float) -> object:
    cell.open_gap()
    assert cell.run(name, gap_s) is Code.ACCEPT
    return cell.finish()


def postponed(cell: Cell) -> int:
    """A gap finds the tool bent, the next one measures it, and has no time for the check."""
    assert run(cell, "c1", CHECK_ONLY_S).left == ("tool measurement (full)",)
    made: list[int] = []

    def measure(cell: Cell) -> object:
        made.append(proposed(cell.history))
        return new_tool(made[-1])

    cell.full: Callable[[Cell], object] = measure
    result = run(cell, "c2", FULL_ONLY_S)
    (number,) = made
    assert (result.accepted, result.complete) == ((), False)
    assert result.left == (f"acceptance of tool candidate {number}",)
    assert "its check does not fit this gap" in result.message
    assert cell.history.head(TOOL).revision == 0
    return number


@pytest.mark.parametrize("meanwhile", ["nothing", "a restart", "a kill"])
def test_a_tool_whose_check_does_not_fit_is_accepted_in_the_next_gap(history, meanwhile):
    cell = automatic(history, poses=NO_POSES)
    number = postponed(cell)
    if meanwhile == "a restart":
        cell.restart()
        cell.open_gap()
    elif meanwhile == "a kill":
        cell.open_gap()
        assert cell.run("killed", CHECK_ONLY_S) is Code.ACCEPT
        killed(cell)
    cell.check = passed()
    short = run(cell, "c3", 15.0)
    assert (short.accepted, short.left) == ((), (f"acceptance of tool candidate {number}",))
    cell.log.clear()
    result = run(cell, "c4", CHECK_ONLY_S)
    assert (result.accepted, result.complete) == ((number,), True)
    assert (result.tool_id, result.tool_answer) == (number, "pass")
    assert modes(cell) == ["quick"]
    assert level(cell) is AccuracyLevel.OK


def test_a_tool_that_waited_for_its_check_is_taken_back_where_it_fails(history):
    cell = automatic(history, poses=NO_POSES)
    postponed(cell)
    result = run(cell, "c3", LONG_S)
    assert "was taken back" in result.message
    assert result.accepted == ()
    assert cell.history.head(TOOL).calibration_id is None


def test_a_tool_that_waits_for_its_check_is_a_persons_to_reject(history):
    cell = automatic(history, poses=NO_POSES)
    decide(cell, REJECT, postponed(cell))
    cell.log.clear()
    cell.full = lambda cell: wrong_tool()
    assert run(cell, "c3", LONG_S).accepted == ()
    assert modes(cell) == ["full"]


def test_a_tool_that_waits_for_its_check_stays_so_while_the_drift_is_not_known(history):
    cell = automatic(history)
    cell.check = bent()
    until_measuring(cell, "full")
    number = proposed(history)
    cell.full = lambda cell: new_tool(number)
    while cell.tool.measuring:
        cell.step()
    cell.session._cell.gap.ends_s = cell.ends_s = cell.now_s + 12.0  # the line is early
    assert cell.finish().left == (f"acceptance of tool candidate {number}",)
    cell.services["thermal"] = SILENT
    cell.check = passed()
    assert run(cell, "c2", LONG_S).accepted == ()
    cell.services.clear()
    assert run(cell, "c3", LONG_S).accepted == (number,)
