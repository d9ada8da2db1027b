# SPDX-License-Identifier: Apache-2.0
"""A maintenance run in gaps of all lengths, with everything that may go wrong."""

import re
from dataclasses import replace

import numpy as np
import pytest
from driven_robot import AheadMotion
from maintenance_cell import (
    CELL,
    DOWN,
    DRIVING,
    HOME,
    HOUSING,
    LONG_S,
    MANY_POSES,
    POSES,
    REFUSED,
    SILENT,
    SLOW,
    STALE_S,
    TICK_S,
    TIMES,
    Cell,
    bent,
    config_of,
    kinds,
    opened,
    over,
    until_moving,
)

from robocal_ros.ground.errors import Code, InputError, StorageError
from robocal_ros.maintenance import robot_interface as ask
from robocal_ros.maintenance.mover import Mover
from robocal_ros.maintenance.session import MaintenanceState
from robocal_ros.motion.plan import SHORTEST_STOP_S, JointPlan
from robocal_ros.session.events import LEAVE
from robocal_ros.thermal.accuracy import Accuracy, AccuracyLevel, ToolError

SMALL = ToolError(1e-4, 1.5e-4)


def test_a_long_gap_takes_everything_in_its_order(cell):
    assert cell.run("c1", LONG_S) is Code.ACCEPT
    result = cell.finish()
    assert (result.code, result.complete) == (Code.ACCEPT, True), result.message
    assert (result.thermal_code, result.tool_answer) == (Code.NO_SIGNIFICANT_GAIN, "pass")
    assert kinds(cell) == [
        "Disarm",
        "BeginCycle",
        *(["Move"] * 4),
        "EndCycle",
        "Arm",
        "Measure",
        "Disarm",
        "Move",
    ]
    ends = [r.plan.q[-1] for r in cell.log if isinstance(r, ask.Move)]
    np.testing.assert_allclose(ends[:4], [*POSES, HOME], atol=1e-9)
    np.testing.assert_allclose(cell.q, HOME, atol=1e-6)
    over(cell)


def test_a_bent_tool_is_measured_in_full(cell):
    cell.check = bent()
    cell.ran("c1")
    assert [r.mode for r in cell.log if isinstance(r, ask.Measure)] == ["quick", "full"]
    over(cell)


def test_a_tool_that_a_check_finds_bent_is_measured_from_where_the_robot_stands(cell):
    """Finding: on the way home and back the time went that the measurement needed."""
    cell.check = bent()
    assert cell.ran("c1", 33.0).complete
    first = kinds(cell).index("Arm")
    tool = ["Arm", "Measure", "Disarm"]
    assert kinds(cell)[first:] == [*tool, *tool, "Move"]
    over(cell)


def test_a_full_measurement_that_does_not_fit_any_more_lets_the_robot_go_home(cell):
    """What was found is kept before it, and the disk takes its time."""

    def takes() -> None:
        if "Measure" in kinds(cell):
            cell.shelf.takes = lambda: None
            cell.pause(1.0)

    cell.check, cell.shelf.takes = bent(), takes
    result = cell.ran("c1", 33.0)
    assert result.left == ("tool measurement (full)",)
    assert result.code is Code.ACCEPT
    assert kinds(cell)[-1] == "Move"
    over(cell)


@pytest.mark.parametrize("gap_s", np.arange(2.0, 62.0, 6.0))
def test_no_gap_is_overrun(cell, gap_s):
    """What does not fit is left, whatever the length."""
    cell.check = bent()
    cell.services["measure"] = SLOW
    result = cell.ran("c1", gap_s)
    assert cell.now_s <= cell.ends_s
    assert result.code is Code.ACCEPT, result.message
    assert result.complete == (not result.left)
    over(cell)


@pytest.fixture
def drift_only(history):
    """A cell that measures its drift alone, at more poses than fit a short gap."""
    cell = Cell(history, config_of(poses=MANY_POSES, T_base_laser=None, resume_within_s=60.0))
    cell.open_gap()
    return cell


def would_do_s(result):
    """Length of the gap that a result says would do."""
    found = re.search(r"([\d.]+) s too short, one of (\d+) s would do", result.message)
    assert found, result.message
    assert float(found[1]) > 0.0
    return float(found[2])


def test_a_gap_in_which_no_cycle_would_end_begins_none_and_says_which_would_do(drift_only):
    """Finding: it measured the poses that it reached, and began anew in each such gap for ever."""
    cell = drift_only
    short_s = cell.session.worst_cases()["the first measuring pose"]  # but for the reserve
    result = cell.ran("c0", short_s)
    assert (result.code, result.thermal_code) == (Code.ACCEPT, Code.LIMIT_EXCEEDED)
    assert result.left == (f"thermal measurement, {len(MANY_POSES)} poses",)
    assert not cell.log, "nothing is driven in vain"
    gap_s, gaps = would_do_s(result), []
    assert short_s < gap_s <= short_s + TIMES.reserve_s + 2.0
    while not gaps or not gaps[-1].complete:
        cell.log.clear()
        gaps.append(cell.ran(f"c{len(gaps) + 1}", gap_s))
        over(cell)
        assert kinds(cell).count("Move") >= 2, "each such gap brings the cycle on"
    assert 1 < len(gaps) < len(MANY_POSES)
    assert [gap.thermal_code for gap in gaps[:-1]] == [Code.NONE] * (len(gaps) - 1)
    assert gaps[-1].thermal_code is cell.thermal.code


def test_a_cycle_that_is_open_waits_for_a_gap_that_is_long_enough(drift_only):
    cell = drift_only
    gap_s = would_do_s(cell.ran("c0", 10.0))
    first = cell.ran("c1", gap_s)
    assert "thermal measurement" in first.left[0]
    measured = kinds(cell).count("Move") - 1
    cell.log.clear()
    assert would_do_s(cell.ran("c2", 12.0)) == gap_s
    assert not cell.log
    assert cell.ran("c3").complete
    assert [r.cycle_id for r in cell.log if isinstance(r, ask.BeginCycle)] == ["c1"]
    assert kinds(cell).count("Move") == len(MANY_POSES) - measured + 1


def test_what_did_not_fit_is_resumed_in_the_next_gap(drift_only):
    cell = drift_only
    first = cell.ran("c1", 24.0)
    assert "thermal measurement" in first.left[0]
    visited = sum(isinstance(r, ask.Move) for r in cell.log) - 1
    assert 0 < visited < len(MANY_POSES)
    cell.pass_time(20.0)
    cell.log.clear()
    assert cell.ran("c2").complete
    assert [r.cycle_id for r in cell.log if isinstance(r, ask.BeginCycle)] == ["c1"]
    thermal = kinds(cell)[: kinds(cell).index("EndCycle")]
    assert thermal.count("Move") == len(MANY_POSES) - visited + 1


def test_a_thermal_cycle_that_is_too_old_begins_anew(history):
    cell = Cell(history, config_of(resume_within_s=5.0))
    cell.open_gap()
    cell.broken_off("c1", 2)
    cell.pass_time(6.0)
    cell.log.clear()
    words = cell.ran("c2").message
    assert re.search(r"cycle 'c1' with 1 of 3 .* \d+ s old \(resume_within_s = 5 s\)", words)
    assert [r.cycle_id for r in cell.log if isinstance(r, ask.BeginCycle)] == ["c2"]
    assert kinds(cell)[: kinds(cell).index("EndCycle")].count("Move") == len(POSES) + 1


def test_a_thermal_cycle_whose_first_pose_is_old_ends_with_the_poses_that_it_has(history):
    """A sphere seen at eight and one seen at noon are of no state of the robot."""
    lone = {"poses": MANY_POSES, "T_base_laser": None}
    cell = Cell(history, config_of(**lone, resume_within_s=60.0, cycle_within_s=50.0))
    cell.open_gap()
    (left,) = cell.ran("c1", 24.0).left
    cell.pass_time(40.0)  # its last pose is young enough
    cell.log.clear()
    result = cell.ran("c2", 24.0)
    assert kinds(cell) == ["EndCycle"], "nothing more is driven"
    assert (result.thermal_code, result.complete) == (cell.thermal.code, False)
    (missing,) = result.left
    assert missing.startswith(f"{left}: the first of its cycle is 5")
    assert missing.endswith(" s old (cycle_within_s = 50 s), and the robot drifts on")
    assert cell.ran("c3").complete, "the next gap begins anew"
    assert [r.cycle_id for r in cell.log if isinstance(r, ask.BeginCycle)] == ["c3"]


def test_a_full_measurement_that_did_not_fit_comes_next(cell):
    cell.check = bent()
    assert cell.ran("c1", 30.0).left == ("tool measurement (full)",)
    (left,) = (outcome for name, outcome in cell.events if name == LEAVE)
    assert left.command.arguments["what"] == "tool measurement (full)"
    worst_s = cell.session.worst_cases()["tool measurement (full)"]
    assert 0.0 < left.command.arguments["left_s"] < worst_s + TIMES.reserve_s
    cell.log.clear()
    cell.ran("c2")
    assert [r.mode for r in cell.log if isinstance(r, ask.Measure)] == ["full"]


@pytest.mark.parametrize("which", ["thermal", "tool"])
@pytest.mark.parametrize("how", ["closed", "stale"])
def test_a_gap_that_closes_stops_everything_at_once(cell, which, how):
    until_moving(cell, which)
    if how == "closed":
        cell.is_open = False
        limit_s = 0.2 + SHORTEST_STOP_S + 0.1
    else:
        cell.beating = False
        limit_s = STALE_S + SHORTEST_STOP_S + 0.1
    closed_s = cell.now_s
    cell.pass_time(3.0)
    assert cell.moved_s <= closed_s + limit_s
    over(cell, fault=True)
    assert "not handed over at home" in cell.session.status(cell.now_s).fault


def test_a_gap_that_closes_while_the_robot_is_at_home_is_no_fault(cell):
    cell.services["thermal"] = SILENT
    cell.run("c1", LONG_S)
    cell.pass_time(0.1)
    cell.is_open = False
    result = cell.finish()
    assert (result.code, result.message) == (Code.CONFLICT, "gap_open is false")
    over(cell)


def test_a_gap_that_closes_on_the_way_home_of_a_cancelled_cycle_stops_the_robot(cell):
    until_moving(cell, "thermal")
    assert cell.session.cancel("by the PLC")
    assert cell.state is MaintenanceState.BREAKING_OFF
    cell.is_open = False
    cell.pass_time(1.5)
    assert cell.state is MaintenanceState.FAULT
    assert kinds(cell)[-1] == "Stop"


@pytest.mark.parametrize("which", ["thermal", "tool"])
def test_a_cancelled_run_goes_home(cell, which):
    until_moving(cell, which)
    assert cell.session.cancel("by the PLC")
    assert cell.state is MaintenanceState.BREAKING_OFF
    result = cell.finish()
    assert (result.code, result.message) == (Code.CONFLICT, "by the PLC")
    over(cell)


def test_after_a_fault_the_ways_begin_at_home_again(cell):
    """Stopped between the first and the second pose, and brought home by hand."""
    cell.run("c1", LONG_S)
    while kinds(cell).count("Move") < 2:
        cell.step()
    cell.pass_time(0.4)
    cell.is_open = False
    cell.pass_time(1.5)
    assert cell.state is MaintenanceState.FAULT
    cell.motion = AheadMotion(HOME)
    cell.open_gap()
    cell.pass_time(0.5)
    cell.session.acknowledge("me")
    assert cell.session.status(cell.now_s).doing == ""
    assert cell.ran("c2").complete
    over(cell)


@pytest.mark.parametrize("service", ["thermal", "arm", "measure", "sensor"])
@pytest.mark.parametrize("how", [REFUSED, SILENT])
def test_nodes_that_fail_leave_the_robot_at_home(cell, service, how):
    cell.services[service] = how
    assert cell.ran("c1").code is Code.ACCEPT
    over(cell)


def test_a_defect_is_a_fault_and_no_cycle_is_left_without_a_code(cell, monkeypatch):
    until_moving(cell, "thermal")
    with monkeypatch.context() as patch:
        patch.setattr(Mover, "arrived", lambda mover, now_s: 1 / 0)
        cell.step()
    result = cell.session.result("c1")
    assert result.code is Code.CONFLICT
    assert "ZeroDivisionError: division by zero" in result.message
    assert "defect in test_maintenance.py:" in result.message
    assert kinds(cell)[-1] == "Stop"
    over(cell, fault=True)


def test_nothing_runs_twice_not_after_a_restart_either(cell):
    first = cell.ran("c1")
    count = len(cell.log)
    assert cell.session.run("c1", LONG_S, cell.now_s, cell.wall_ns) == first
    cell.restart()
    cell.open_gap()
    assert cell.session.run("c1", LONG_S, cell.now_s, cell.wall_ns) == first
    cell.pass_time(1.0)
    assert kinds(cell)[count:] == ["Disarm"]  # of the start


def test_calls_that_make_no_sense_are_refused(cell):
    for gap_s in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="gap of"):
            cell.session.run("c1", gap_s, cell.now_s, cell.wall_ns)
    with pytest.raises(InputError, match="cycle id"):
        cell.session.run("", 10.0, cell.now_s, cell.wall_ns)
    assert not cell.session.cancel("nothing runs")
    cell.run("c1", LONG_S)
    assert cell.run("c2", LONG_S) is Code.CONFLICT


def test_a_run_that_cannot_be_kept_does_not_begin(cell, monkeypatch):
    def full(document):
        raise StorageError("disk full")

    monkeypatch.setattr(cell.shelf, "save", full)
    assert cell.run("c1", LONG_S) is Code.STORAGE_FAILED
    assert cell.state is MaintenanceState.IDLE
    cell.pass_time(1.0)
    assert cell.log == []


def test_worst_cases_hold(cell):
    """The tool node takes all the time that it may, and its end is slow."""
    cell.services |= {"measure": SLOW, "arm": SLOW, "disarm": SLOW}
    worst = cell.session.worst_cases()
    cell.run("c1", LONG_S)
    begun = {}
    while cell.state is MaintenanceState.RUNNING:
        count = len(cell.log)
        cell.step()
        begun |= {type(r).__name__: cell.now_s for r in cell.log[count:]}
    took = cell.now_s - begun["Arm"]
    assert cell.config.times.check_s < took < worst["tool measurement (quick)"]


def unsettled_rad(now_s: float, sent_s: float, plan: JointPlan) -> float:
    """By how much the last joint is off, so that each rest takes nearly `rest_s`."""
    late_s = TIMES.rest_s - 3 * TICK_S
    arrives_s = sent_s + plan.duration_s + late_s
    rests_s = arrives_s + late_s
    if now_s < arrives_s:
        return 1e-3
    calm = rests_s <= now_s < rests_s + 0.1
    trembles = now_s < rests_s + TIMES.measure_s + late_s and not calm
    return 2e-4 * (round(now_s / TICK_S) % 2) * trembles


def test_a_pose_takes_its_worst_case_and_no_more(history):
    """The way, a rest there, the measurement, a rest before the next, which does not fit, home."""
    cell = Cell(history, config_of(poses=POSES[:2], T_base_laser=None), services={"sensor": SILENT})
    cell.open_gap()
    least_s = cell.session.worst_cases()["the first measuring pose"] + TIMES.reserve_s
    cell.run("c1", least_s + 1.5 * TICK_S)  # a tick goes by before it begins
    sent: list[tuple[float, ask.Move]] = []
    while cell.state is MaintenanceState.RUNNING:
        if sent:
            cell.offset[-1] = unsettled_rad(cell.now_s + TICK_S, sent[-1][0], sent[-1][1].plan)
        count = len(cell.log)
        cell.step()
        sent += [(cell.now_s, r) for r in cell.log[count:] if isinstance(r, ask.Move)]
    assert "thermal measurement, 1 poses" in cell.session.result("c1").left
    assert len(sent) == 2
    took_s, worst_s = cell.now_s - sent[0][0], sent[0][1].worst_s
    assert worst_s - 0.5 * TIMES.rest_s < took_s <= worst_s


def accuracy(cell: Cell, level=AccuracyLevel.OK, error=SMALL):
    cell.session.drift(Accuracy(level, "95 % below", error, 600.0), cell.now_s)
    return cell.session.accuracy(cell.now_s, cell.wall_ns)


def test_the_line_reads_one_state(cell):
    assert accuracy(cell).level is AccuracyLevel.EXPIRED  # the tool was never checked
    cell.ran("c1")
    found = accuracy(cell)
    assert found.level is AccuracyLevel.OK, found.reason
    assert 1e-4 < found.error.rms_m < found.error.bound_m <= cell.config.tolerance_m
    assert accuracy(cell, AccuracyLevel.DUE).level is AccuracyLevel.DUE
    large = accuracy(cell, error=ToolError(2e-4, 2.5e-4))
    assert large.level is AccuracyLevel.DEGRADED
    assert "drift and tool" in large.reason
    cell.pass_time(6.0)
    silent = cell.session.accuracy(cell.now_s, cell.wall_ns)
    assert (silent.level, silent.error) == (AccuracyLevel.FAULT, None)
    later_ns = cell.wall_ns + 3 * 3600 * 10**9
    cell.session.drift(Accuracy(AccuracyLevel.OK, "", ToolError(1e-5, 2e-5), 600.0), cell.now_s)
    assert cell.session.accuracy(cell.now_s, later_ns).level is AccuracyLevel.DUE
    later_ns += 6 * 3600 * 10**9
    assert cell.session.accuracy(cell.now_s, later_ns).level is AccuracyLevel.EXPIRED


def test_an_error_that_is_no_number_is_not_within_tolerance(cell):
    cell.ran("c1")
    assert accuracy(cell).level is AccuracyLevel.OK
    assert accuracy(cell, error=ToolError(1e-4, np.nan)).level is AccuracyLevel.DEGRADED


def test_a_bent_tool_degrades(cell):
    cell.check = bent()
    cell.ran("c1", 30.0)
    assert accuracy(cell).level is AccuracyLevel.DEGRADED


def test_a_time_that_is_too_short_for_the_way_home_is_refused(history):
    """From 100 mm above at 50 mm/s it takes more than two seconds."""
    with pytest.raises(InputError, match="tool_home_s = 2 s"):
        Cell(history, config_of(times=replace(TIMES, tool_home_s=2.0)))


def test_a_time_that_is_too_short_is_refused_where_the_way_cannot_be_planned_from_home(history):
    """Turned as at home the tool would cut into the housing."""
    narrow = replace(DRIVING, housing=replace(HOUSING, clear_radius_m=0.009))
    with pytest.raises(InputError, match=r"tool_home_s = 2 s: .* takes 2\.1 s"):
        Cell(history, config_of(driving=narrow, times=replace(TIMES, tool_home_s=2.0)))


def test_a_way_home_that_took_longer_than_was_set_counts_from_then_on(history):
    """How the tool node turns the tool is seen only then."""
    set_s, takes_s = 2.2, DOWN.duration_s
    cell = opened(history, config=config_of(times=replace(TIMES, tool_home_s=set_s)))
    before_s = cell.session.worst_cases()
    cell.run("c1", LONG_S)
    words = f"tool_home_s = 2.2 s: the way home from the beams takes {takes_s:.1f} s; set 3 s"
    assert words in cell.finish().message
    after_s = cell.session.worst_cases()
    for mode in ("quick", "full"):
        step = f"tool measurement ({mode})"
        assert after_s[step] - before_s[step] == pytest.approx(takes_s - set_s, abs=0.02)
    quick_s = before_s["tool measurement (quick)"] + TIMES.reserve_s
    cell = cell.session._cell
    cell.begin(quick_s + 0.01)
    assert not cell.fits(cell.tool_worst_s("quick"))


def test_without_a_station_only_the_drift_is_measured(history):
    cell = Cell(history, config_of(T_base_laser=None))
    cell.open_gap()
    assert cell.ran("c1").complete
    assert not {"Arm", "Disarm"} & set(kinds(cell))
    assert accuracy(cell).level is AccuracyLevel.OK


def test_without_poses_only_the_tool_is_measured(history):
    cell = Cell(history, config_of(poses=np.zeros((0, CELL.arm.n))))
    cell.open_gap()
    assert cell.ran("c1").complete
    assert kinds(cell) == ["Disarm", "Disarm", "Arm", "Measure", "Disarm", "Move"]
