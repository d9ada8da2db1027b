# SPDX-License-Identifier: Apache-2.0
"""What is known of the tool: when it was checked, which one, and what may be concluded."""

from dataclasses import replace

import maintenance_cell
import pytest
from maintenance_cell import (
    KNOWN,
    Cell,
    bent,
    config_of,
    opened,
    passed,
    proposed,
    thermal_proposed,
    wrong_tool,
)
from maintenance_tools import (
    a_check_passes,
    decide,
    level,
    measured_in_full,
    modes,
    until_measuring,
)

from robocal_ros.ground.errors import Code
from robocal_ros.history.history_records import THERMAL, TOOL
from robocal_ros.maintenance import robot_interface as ask
from robocal_ros.maintenance.robot_interface import DriverAnswer
from robocal_ros.session.events import ACCEPT, ROLLBACK
from robocal_ros.thermal.accuracy import AccuracyLevel, ToolError

TOO_SHORT_FOR_FULL_S = 30.0
DAY_NS = 86_400 * 10**9
WITHOUT_WAY = DriverAnswer(Code.LIMIT_EXCEEDED, "the housing would be hit")
OTHER_MODEL = "another thermal model is in force than it was checked with: check it"


def test_a_check_in_the_future_is_none(cell, monkeypatch):
    """The computer's clock was set back by a day."""
    cell.ran("c1")
    assert level(cell) is AccuracyLevel.OK
    monkeypatch.setattr(maintenance_cell, "WALL_NS", maintenance_cell.WALL_NS - DAY_NS)
    assert level(cell) is AccuracyLevel.EXPIRED
    a_check_passes(cell, "c2")


def test_an_id_of_long_ago_that_comes_again_measures_the_tool_again(cell):
    """Finding: tcf_node gives the answer of a name again, and an old one counted as new."""
    for _ in range(2):
        cell.ran("c1")
        cell.session.memory.cycles.clear()  # as 200 cycles after it do
        cell.begun.clear()
    names = [request.cycle_id for request in cell.log if isinstance(request, ask.Measure)]
    assert len(names) == len(set(names)) == 2


@pytest.mark.parametrize("told", [wrong_tool(), WITHOUT_WAY])
@pytest.mark.parametrize("mode", ["quick", "full"])
def test_a_tool_that_no_run_can_measure_degrades_until_a_check_passes(
    cell, monkeypatch, mode, told
):
    cell.ran("c1")
    assert level(cell) is AccuracyLevel.OK
    cell.check, cell.full = (told if mode == "quick" else bent()), lambda _: told
    later_ns = round(cell.config.check_every_s * 1e9)
    monkeypatch.setattr(maintenance_cell, "WALL_NS", maintenance_cell.WALL_NS + later_ns)
    result = cell.ran("c2")
    assert (result.tool_code, result.complete) == (told.code, False)
    assert result.left == (f"tool measurement ({mode})",)
    assert level(cell) is AccuracyLevel.DEGRADED
    assert told.message in cell.session.accuracy(cell.now_s, cell.wall_ns).reason
    cell.restart()
    assert level(cell) is AccuracyLevel.DEGRADED
    cell.open_gap()
    assert a_check_passes(cell, "c3").complete


def test_a_full_measurement_comes_when_it_is_due_though_no_check_is(history, monkeypatch):
    """Where the gap has time for it: else each gap would check the tool, and leave the rest."""
    cell = opened(history, config=config_of(check_every_s=7200.0, full_every_s=3600.0))
    begun_ns, found = maintenance_cell.WALL_NS, []
    long_s, short_s = maintenance_cell.LONG_S, TOO_SHORT_FOR_FULL_S
    for later_s, gap_s in ((0, long_s), (1800, long_s), (4000, short_s), (4000, long_s)):
        monkeypatch.setattr(maintenance_cell, "WALL_NS", begun_ns + later_s * 10**9)
        cell.log.clear()
        assert cell.ran(f"c{len(found)}", gap_s).complete
        found.append(modes(cell))
    assert found == [["quick", "full"], [], [], ["quick", "full"]]


def test_a_first_check_that_fails_leaves_the_tool_unknown(cell):
    cell.check = wrong_tool()
    cell.ran("c1")
    assert level(cell) is AccuracyLevel.EXPIRED
    assert wrong_tool().message in cell.session.accuracy(cell.now_s, cell.wall_ns).reason


def found_bent(cell: Cell) -> None:
    cell.check = bent()
    cell.ran("bent", TOO_SHORT_FOR_FULL_S)
    assert level(cell) is AccuracyLevel.DEGRADED


def test_a_bent_tool_stays_bent_when_another_one_comes_into_force(cell):
    """The tool of the model in force changed, the one on the robot did not."""
    decide(cell, ACCEPT, proposed(cell.history))
    found_bent(cell)
    assert cell.session.decide_only(ROLLBACK, "a person", cell.wall_ns).done
    assert level(cell) is AccuracyLevel.DEGRADED
    a_check_passes(cell, "c2")


@pytest.mark.parametrize("rolled_back", [False, True])
def test_a_bent_tool_expires_as_any_other(cell, rolled_back):
    decide(cell, ACCEPT, proposed(cell.history))
    found_bent(cell)
    if rolled_back:
        cell.session.decide_only(ROLLBACK, "a person", cell.wall_ns)
    assert level(cell, 30 * DAY_NS) is AccuracyLevel.EXPIRED


def bent_measured_and_accepted(cell: Cell) -> int:
    cell.check = bent()
    number = measured_in_full(cell)
    cell.finish()
    assert level(cell) is AccuracyLevel.DEGRADED
    decide(cell, ACCEPT, number)
    return number


def test_a_measured_tool_that_came_into_force_is_due_until_a_check_passes(cell):
    bent_measured_and_accepted(cell)
    assert level(cell) is AccuracyLevel.DUE
    said = cell.session.accuracy(cell.now_s, cell.wall_ns)
    assert "measured and accepted; a check has not passed yet" in said.reason
    assert said.error is None  # of a tool that no check has seen nothing is predicted
    assert level(cell, 30 * DAY_NS) is AccuracyLevel.EXPIRED
    cell.restart()
    assert level(cell) is AccuracyLevel.DUE
    cell.open_gap()
    cell.check = passed()
    assert cell.ran("c2").tool_answer == "pass"
    assert level(cell) is AccuracyLevel.OK


def test_a_drift_beyond_tolerance_degrades_whatever_is_known_of_the_tool(cell):
    bent_measured_and_accepted(cell)
    assert level(cell) is AccuracyLevel.DUE
    beyond_m = 1.1 * cell.config.tolerance_m
    drift = replace(KNOWN, error=ToolError(0.5 * beyond_m, beyond_m))
    cell.session.drift(drift, cell.now_s)
    said = cell.session.accuracy(cell.now_s, cell.wall_ns)
    assert (said.level, said.error) == (AccuracyLevel.DEGRADED, None)
    assert "what is known of drift and tool" in said.reason


def test_another_tool_than_the_measured_one_stays_degraded(cell):
    number = bent_measured_and_accepted(cell)
    decide(cell, ACCEPT, proposed(cell.history))
    assert level(cell) is AccuracyLevel.DEGRADED
    decide(cell, ROLLBACK, number)
    assert level(cell) is AccuracyLevel.DUE
    cell.history.rollback(0, kind=TOOL, by="a person", reason="", wall_ns=cell.wall_ns)
    assert level(cell) is AccuracyLevel.DEGRADED


def test_a_measured_tool_whose_check_finds_it_bent_stays_degraded(cell):
    bent_measured_and_accepted(cell)
    assert cell.ran("c2", TOO_SHORT_FOR_FULL_S).tool_answer == "recalibrate"
    assert level(cell) is AccuracyLevel.DEGRADED


def test_a_pass_is_not_credited_to_another_tool(cell):
    """A person takes the tool back while it is checked."""
    decide(cell, ACCEPT, proposed(cell.history))
    until_measuring(cell, "quick")
    cell.session.decide_only(ROLLBACK, "a person", cell.wall_ns)
    result = cell.finish()
    assert "another tool came into force" in result.message
    assert (result.tool_answer, result.complete) == ("", False)
    assert level(cell) is AccuracyLevel.EXPIRED  # never checked
    cell.log.clear()
    assert cell.ran("c2").tool_answer == "pass"
    assert level(cell) is AccuracyLevel.OK


def test_a_full_measurement_of_another_tool_is_not_credited(cell):
    decide(cell, ACCEPT, proposed(cell.history))
    cell.check = bent()
    until_measuring(cell, "full")
    cell.session.decide_only(ROLLBACK, "a person", cell.wall_ns)
    assert "another tool came into force" in cell.finish().message
    assert level(cell) is AccuracyLevel.DEGRADED


@pytest.fixture
def checked(history) -> Cell:
    """A tool that passed its check with the second of two thermal models; the next is far off."""
    cell = opened(history, config=config_of(check_every_s=1e6))
    for kelvin in (10.0, 20.0):
        decide(cell, ACCEPT, thermal_proposed(history, kelvin))
    decide(cell, ACCEPT, proposed(history))
    assert cell.ran("c1").tool_answer == "pass"
    assert level(cell) is AccuracyLevel.OK
    cell.log.clear()
    return cell


def is_due_until_checked(cell: Cell, *, error_known: bool) -> None:
    assert level(cell) is AccuracyLevel.DUE
    said = cell.session.accuracy(cell.now_s, cell.wall_ns)
    assert OTHER_MODEL in said.reason
    assert (said.error is not None) == error_known
    cell.restart()
    assert level(cell) is AccuracyLevel.DUE
    cell.open_gap()
    a_check_passes(cell, "c2")


@pytest.mark.parametrize("by", ["the PLC", "another process"])
def test_a_thermal_model_that_is_rolled_back_leaves_the_tool_due(checked, by):
    """What was wrong with it may be in the tool."""
    history = checked.history
    first = next(d.calibration_id for d in history.decisions() if d.kind == THERMAL)
    if by == "the PLC":
        decide(checked, ROLLBACK, first)
    else:
        history.rollback(first, kind=THERMAL, by=by, reason="", wall_ns=0)
    is_due_until_checked(checked, error_known=False)


def test_a_thermal_model_that_is_accepted_leaves_the_tool_due(checked):
    decide(checked, ACCEPT, thermal_proposed(checked.history, 30.0))
    is_due_until_checked(checked, error_known=True)


def test_the_model_that_a_tool_was_checked_with_may_come_back(checked):
    history = checked.history
    back = history.head(THERMAL).calibration_id
    history.rollback(0, kind=THERMAL, by="a person", reason="", wall_ns=0)
    assert level(checked) is AccuracyLevel.DUE
    decide(checked, ROLLBACK, back)
    assert level(checked) is AccuracyLevel.OK


def test_a_tool_of_another_thermal_model_that_comes_back_is_due(checked):
    history, tool = checked.history, checked.history.head(TOOL).calibration_id
    decide(checked, ACCEPT, thermal_proposed(history, 30.0))
    decide(checked, ACCEPT, proposed(history))
    assert checked.ran("c2").tool_answer == "pass"
    assert level(checked) is AccuracyLevel.OK
    decide(checked, ROLLBACK, tool)
    assert level(checked) is AccuracyLevel.DUE
    a_check_passes(checked, "c3")


def test_a_station_that_moved_degrades_until_a_check_passes(cell):
    words = "the beam station was knocked, or the tool slipped in its mount"
    cell.check = bent()
    cell.full = lambda _: DriverAnswer(Code.STATION_MOVED, words, 7, (), True, "", 0.8, 0.03)
    result = cell.ran("c1")
    assert (result.tool_found_code, result.tool_code) == (Code.STATION_MOVED, Code.STATION_MOVED)
    assert result.accepted == ()
    for later_ns, said in ((0, AccuracyLevel.DEGRADED), (DAY_NS, AccuracyLevel.EXPIRED)):
        assert level(cell, later_ns) is said
        found = cell.session.accuracy(cell.now_s, cell.wall_ns + later_ns)
        assert words in found.reason
        assert found.error is None
    a_check_passes(cell, "c2")
