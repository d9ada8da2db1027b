# SPDX-License-Identifier: Apache-2.0
"""What a cycle finds, what it leaves for the next gap, and what outlives a restart."""

from dataclasses import replace

import numpy as np
import pytest
from long_form import more
from maintenance_cell import (
    LONG_S,
    POSES,
    REFUSED,
    SILENT,
    Cell,
    bent,
    config_of,
    opened,
    passed,
)
from maintenance_tools import automatic, measured_in_full, until_verified

from robocal_ros.ground.errors import Code, StorageError
from robocal_ros.maintenance import robot_interface as ask
from robocal_ros.maintenance.accuracy import VERSION
from robocal_ros.maintenance.robot_interface import DriverAnswer
from robocal_ros.maintenance.session import MaintenanceState

SPOILT = {
    "a part is missing": lambda kept: kept.pop("tool"),
    "a figure that is not known": lambda kept: kept["tool"].update(newer=1),
    "a code that is not known": lambda kept: kept["cycles"][0].update(code=99),
    "a later one": lambda kept: kept.update(version=VERSION + 1),
    "a cycle is no document": lambda kept: kept.update(cycles=["c1"]),
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_a_state_of_another_version_is_refused_by_its_name(history, spoil):
    cell = opened(history)
    cell.ran("c1")
    spoil(cell.shelf.document)
    with pytest.raises(StorageError, match=r"^shelf is not of this version.*move it away"):
        Cell(history, shelf=cell.shelf)


def test_a_cycle_of_before_a_restart_is_told_to_be_old(history):
    cell = opened(history)
    for name in ("c1", "c2"):
        ended = cell.ran(name)
        assert cell.session.memory.words_of(ended) == ended.message
    assert (ended.run, ended.stamp_ns) == (2, cell.wall_ns)
    cell.restart()
    old = cell.session.run("c2", LONG_S, cell.now_s, cell.wall_ns)
    assert old == ended
    assert cell.session.memory.earlier == {"c1", "c2"}
    words = cell.session.memory.words_of(old)
    old = "cycle 'c2' is one of before this start of the node, run 2, 2023-11-14T"
    assert words.startswith(old)
    assert words.endswith(f"nothing runs now; it ended so: {ended.message}")
    cell.open_gap()
    new = cell.ran("c3")
    assert (new.run, cell.session.memory.words_of(new)) == (3, new.message)


def test_an_id_of_long_ago_that_comes_again_is_no_old_cycle(cell):
    """Finding: of a cycle that moved the robot it was told that nothing runs."""
    cell.ran("c1")
    cell.restart()
    cell.open_gap()
    session = cell.session
    del session.memory.cycles["c1"]  # as the 200 cycles after it do
    cell.begun.clear()
    assert cell.run("c1", LONG_S) is Code.ACCEPT
    assert session.running is not None
    assert session.memory.words_of(session.running) == ""
    assert "c1" not in session.memory.earlier


def test_a_cycle_that_was_killed_has_its_run_and_when_it_began(history):
    cell = opened(history)
    cell.run("c1", LONG_S)
    began_ns = cell.wall_ns
    cell.pass_time(0.5)
    cell.restart()
    result = cell.session.result("c1")
    assert result is not None
    assert (result.run, result.stamp_ns, result.code) == (1, began_ns, Code.CONFLICT)
    assert "run 1" in cell.session.memory.words_of(result)


def test_a_cycle_that_could_not_be_written_is_no_run(history):
    cell = opened(history)

    def full() -> None:
        raise StorageError("the disk is full")

    cell.shelf.takes = full
    assert cell.run("c1", LONG_S) is Code.STORAGE_FAILED
    cell.shelf.takes = lambda: None
    assert cell.ran("c2").run == 1


def test_a_state_of_the_first_version_is_read(history):
    cell = opened(history)
    message = cell.ran("c1").message
    kept = cell.shelf.document
    for name in ("version", "runs", "began_ns"):
        del kept[name]
    for cycle in kept["cycles"]:
        del cycle["stamp_ns"], cycle["run"]
    cell.restart()
    result = cell.session.result("c1")
    words = "cycle 'c1' is one of before this start of the node; nothing runs now; it ended so: "
    assert cell.session.memory.words_of(result) == words + message
    cell.open_gap()
    assert cell.ran("c2").run == 1


UNSURE = replace(bent(), code=Code.TOO_FEW_SAMPLES, answer="cannot tell")


def test_a_bent_tool_that_the_same_gap_mends_is_told(history):
    cell = automatic(history)
    number = measured_in_full(cell)
    until_verified(cell)
    cell.check = passed()
    result = cell.finish()
    assert (result.accepted, result.complete) == ((number,), True)
    assert (result.tool_found_code, result.tool_code) == (Code.LIMIT_EXCEEDED, Code.ACCEPT)
    assert f"tool: {bent().message}; tool: {passed().message}" in result.message
    cell.restart()
    assert cell.session.result(result.cycle_id) == result


@pytest.mark.parametrize("first", ["cannot tell", "a gap before"])
def test_a_bent_tool_that_only_the_full_measurement_finds_is_told(history, first):
    cell = automatic(history)
    if first == "a gap before":  # which was too short for more
        assert cell.run("c0", 30.0) is Code.ACCEPT
        assert cell.finish().left == ("tool measurement (full)",)
        cell.open_gap()
    else:
        cell.check = UNSURE
    number = measured_in_full(cell)
    until_verified(cell)
    cell.check = passed()
    result = cell.finish()
    assert result.accepted == (number,)
    assert (result.tool_found_code, result.tool_code) == (Code.LIMIT_EXCEEDED, Code.ACCEPT)


def test_another_tool_that_a_check_lets_pass_is_no_alarm(history):
    cell = automatic(history, full_every_s=1.0)
    cell.check = passed()
    number = measured_in_full(cell)
    result = cell.finish()
    assert result.tool_id == number
    assert result.tool_found_code is Code.ACCEPT


TOLD = {Code.NONE, Code.ACCEPT, Code.NO_SIGNIFICANT_GAIN, Code.WORSE_THAN_CURRENT}
UNKNOWN = [Code.TOO_FEW_SAMPLES, Code.SENSOR_OR_ROBOT_MOVED]
UNKNOWN += more(*sorted(set(Code) - TOLD - set(UNKNOWN)))


@pytest.mark.parametrize("how", [REFUSED, SILENT])
def test_a_thermal_node_that_fails_leaves_the_measurement(cell, how):
    cell.services["thermal"] = how
    result = cell.ran("c1")
    assert (result.code, result.complete, result.left) == (
        Code.ACCEPT,
        False,
        ("thermal measurement",),
    )
    assert "thermal: " in result.message
    assert result.tool_answer == "pass"


@pytest.mark.parametrize("code", UNKNOWN, ids=lambda code: code.name)
def test_a_verdict_that_does_not_tell_the_drift_leaves_it(cell, code):
    cell.thermal = DriverAnswer(code, "why")
    result = cell.ran("c1")
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
    assert cell.ran("c2").complete


def test_a_pose_that_an_earlier_gap_missed_is_still_named(cell):
    cell.services["sensor"] = SILENT
    cell.broken_off("c1", 2)
    cell.services["sensor"] = "ok"
    cell.open_gap()
    assert cell.ran("c2").left == ("thermal measurement at pose 1",)


def test_cold_poses_that_were_not_measured_are_named(cell):
    cell.thermal = replace(cell.thermal, missing=(2, 7))
    assert "without pose 2, 7 of the cold reference" in cell.ran("c1").message


def test_poses_that_the_thermal_node_lost_are_left(cell):
    """Started anew between two gaps it opens the same cycle, without what was measured before."""
    cell.broken_off("c1", 3)
    cell.open_gap()
    cell.thermal = replace(cell.thermal, visited=1)
    result = cell.ran("c2")
    words = "thermal measurement at 3 poses, of which the thermal node has 1"
    assert (result.complete, result.left) == (False, (words,))
    cell.open_gap()
    cell.thermal = replace(cell.thermal, visited=len(POSES))
    cell.log.clear()
    assert cell.ran("c3").complete
    assert [each.cycle_id for each in cell.log if isinstance(each, ask.BeginCycle)] == ["c3"]


def test_a_pose_that_was_taught_twice_is_one_to_the_thermal_node(history):
    """Past an obstacle, there and back."""
    config = config_of(poses=np.vstack([POSES, POSES[1]]), T_base_laser=None)
    cell = Cell(history, config=config)
    cell.open_gap()
    cell.thermal = replace(cell.thermal, visited=len(POSES))
    assert cell.ran("c1").complete


@pytest.mark.parametrize("every", [1, 2])
def test_a_sensor_that_measures_often_does_not_hold_the_robot(history, every):
    """The measurements that a pose takes must be stood through, not also those that follow."""
    config = config_of(T_base_laser=None)
    taken_s = []
    for ticks in (10, every):
        cell = Cell(history, config=config, measures_every=ticks)
        cell.open_gap()
        begin_s = cell.now_s
        assert cell.ran("c1").complete
        taken_s.append(cell.now_s - begin_s)
    assert taken_s[1] <= taken_s[0]
