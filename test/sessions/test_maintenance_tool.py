"""What is known of the tool: when it was checked, which one, and what may be concluded."""

import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any

import maintenance_cell
import numpy as np
import pytest
from maintenance_cell import (
    CELL,
    KNOWN,
    LONG_S,
    POSES,
    REFUSED,
    SILENT,
    Cell,
    bent,
    config_of,
    kinds,
    new_tool,
    opened,
    passed,
    proposed,
    thermal_proposed,
    wrong_tool,
)
from tool_driver import TAUGHT

from robocal_ros.core.codes import Code
from robocal_ros.core.errors import ConflictError, StaleError, StorageError
from robocal_ros.core.proposals import THERMAL, TOOL, Action
from robocal_ros.core.thermal.accuracy import AccuracyLevel, ToolError
from robocal_ros.sessions.events import ACCEPT, REJECT, ROLLBACK, WITHHOLD
from robocal_ros.sessions.gap import STALL_S
from robocal_ros.sessions.maintenance import AcceptBounds, State
from robocal_ros.sessions.maintenance import requests as ask
from robocal_ros.sessions.maintenance.deciding import Decider
from robocal_ros.sessions.maintenance.requests import Answer
from robocal_ros.sessions.maintenance.settling import HELD_S
from robocal_ros.sessions.tool_config import rows_of
from robocal_ros.storage.calibrations import CalibrationHistory

TOO_SHORT_FOR_FULL_S = 33.0
DAY_NS = 86_400 * 10**9


@pytest.fixture
def cell(history) -> Cell:
    return opened(history)


def level(cell: Cell, later_ns: int = 0) -> AccuracyLevel:
    """With a drift of which all is known."""
    cell.session.drift(KNOWN, cell.now_s)
    return cell.session.accuracy(cell.now_s, cell.wall_ns + later_ns).level


def modes(cell: Cell) -> list[str]:
    return [request.mode for request in cell.log if isinstance(request, ask.Measure)]


def test_a_check_in_the_future_is_none(cell, monkeypatch):
    """The computer's clock was set back by a day."""
    cell.run("c1", LONG_S)
    cell.finish()
    assert level(cell) is AccuracyLevel.OK
    monkeypatch.setattr(maintenance_cell, "WALL_NS", maintenance_cell.WALL_NS - DAY_NS)
    assert level(cell) is AccuracyLevel.EXPIRED
    cell.log.clear()
    cell.run("c2", LONG_S)
    cell.finish()
    assert modes(cell) == ["quick"]
    assert level(cell) is AccuracyLevel.OK


@pytest.mark.parametrize("mode", ["quick", "full"])
def test_a_tool_that_no_run_can_measure_degrades_until_a_check_passes(cell, monkeypatch, mode):
    cell.run("c1", LONG_S)
    cell.finish()
    assert level(cell) is AccuracyLevel.OK
    cell.check, cell.full = (wrong_tool() if mode == "quick" else bent()), lambda _: wrong_tool()
    later_ns = round(cell.config.check_every_s * 1e9)
    monkeypatch.setattr(maintenance_cell, "WALL_NS", maintenance_cell.WALL_NS + later_ns)
    cell.run("c2", LONG_S)
    result = cell.finish()
    assert (result.tool_code, result.complete) == (Code.WRONG_TOOL, False)
    assert result.left == (f"tool measurement ({mode})",)
    assert level(cell) is AccuracyLevel.DEGRADED
    assert wrong_tool().message in cell.session.accuracy(cell.now_s, cell.wall_ns).reason
    cell.restart()
    assert level(cell) is AccuracyLevel.DEGRADED
    cell.pass_time(0.3)
    cell.log.clear()
    cell.check = passed()
    cell.run("c3", LONG_S)
    assert cell.finish().complete
    assert modes(cell) == ["quick"]
    assert level(cell) is AccuracyLevel.OK


def test_a_first_check_that_fails_leaves_the_tool_unknown(cell):
    cell.check = wrong_tool()
    cell.run("c1", LONG_S)
    cell.finish()
    assert level(cell) is AccuracyLevel.EXPIRED
    assert wrong_tool().message in cell.session.accuracy(cell.now_s, cell.wall_ns).reason


def decide(cell: Cell, name: str, calibration_id: int) -> None:
    assert cell.session.decide(name, calibration_id, "a person", "", cell.wall_ns).done


def found_bent(cell: Cell) -> None:
    cell.check = bent()
    cell.run("bent", TOO_SHORT_FOR_FULL_S)
    cell.finish()
    assert level(cell) is AccuracyLevel.DEGRADED


def test_a_bent_tool_stays_bent_when_another_one_comes_into_force(cell):
    """The tool of the model in force changed, the one on the robot did not."""
    decide(cell, ACCEPT, proposed(cell.history))
    found_bent(cell)
    assert cell.session.decide_only(ROLLBACK, "a person", cell.wall_ns).done
    assert level(cell) is AccuracyLevel.DEGRADED
    cell.check = passed()
    cell.log.clear()
    cell.run("c2", LONG_S)
    cell.finish()
    assert modes(cell) == ["quick"]
    assert level(cell) is AccuracyLevel.OK


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
    cell.pass_time(0.3)
    cell.check = passed()
    cell.run("c2", LONG_S)
    assert cell.finish().tool_answer == "pass"
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
    cell.run("c2", TOO_SHORT_FOR_FULL_S)
    assert cell.finish().tool_answer == "recalibrate"
    assert level(cell) is AccuracyLevel.DEGRADED


def until_measuring(cell: Cell, mode: str) -> None:
    cell.run("c1", LONG_S)
    while not (cell.tool.measuring and cell.mode == mode):
        cell.step()


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
    cell.run("c2", LONG_S)
    assert cell.finish().tool_answer == "pass"
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
    cell.run("c1", LONG_S)
    assert cell.finish().tool_answer == "pass"
    assert level(cell) is AccuracyLevel.OK
    cell.log.clear()
    return cell


OTHER_MODEL = "another thermal model is in force than it was checked with: check it"


def is_due_until_checked(cell: Cell, *, error_known: bool) -> None:
    assert level(cell) is AccuracyLevel.DUE
    said = cell.session.accuracy(cell.now_s, cell.wall_ns)
    assert OTHER_MODEL in said.reason
    assert (said.error is not None) == error_known
    cell.restart()
    assert level(cell) is AccuracyLevel.DUE
    cell.pass_time(0.3)
    cell.run("c2", LONG_S)
    assert cell.finish().tool_answer == "pass"
    assert modes(cell) == ["quick"]
    assert level(cell) is AccuracyLevel.OK


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
    checked.run("c2", LONG_S)
    assert checked.finish().tool_answer == "pass"
    assert level(checked) is AccuracyLevel.OK
    decide(checked, ROLLBACK, tool)
    assert level(checked) is AccuracyLevel.DUE
    checked.log.clear()
    checked.run("c3", LONG_S)
    checked.finish()
    assert modes(checked) == ["quick"]
    assert level(checked) is AccuracyLevel.OK


def automatic(history, **changes) -> Cell:
    """A cell that may accept without a person, whose tool is found bent."""
    config = config_of(bounds=AcceptBounds(automatic=True), **changes)
    return opened(history, config=config, check=bent(), drift=KNOWN)


def measured_in_full(cell: Cell, **given: Any) -> int:
    """Until the full measurement is about to give a candidate."""
    until_measuring(cell, "full")
    number = proposed(cell.history, **given)
    cell.full = lambda cell: new_tool(number)
    return number


@pytest.mark.parametrize("how", [REFUSED, SILENT])
def test_a_tool_without_a_thermal_result_waits(history, how):
    cell = automatic(history)
    cell.services["thermal"] = how
    number = measured_in_full(cell)
    result = cell.finish()
    assert f"tool candidate {number} waits" in result.message
    (withheld,) = (outcome for name, outcome in cell.events if name == WITHHOLD)
    assert withheld.command.arguments == {"id": number, "kind": TOOL}
    assert withheld.message in result.message
    assert result.accepted == ()
    assert cell.history.head(TOOL).revision == 0


@pytest.mark.parametrize("poses", [POSES, POSES[:0]])
@pytest.mark.parametrize("code", [Code.NO_SIGNIFICANT_GAIN, Code.WORSE_THAN_CURRENT])
def test_a_tool_with_a_known_drift_is_accepted(history, poses, code):
    """No other model explains this cycle better than the one in force."""
    cell = automatic(history, poses=poses)
    cell.thermal = Answer(code, "warm")
    number = measured_in_full(cell)
    while not cell.history.head(TOOL).revision:
        cell.step()
    cell.check = passed()
    assert cell.finish().accepted == (number,)


def thermal_candidate(cell: Cell) -> int:
    """What the thermal node answers from now on."""
    number = thermal_proposed(cell.history, 10.0)
    cell.thermal = Answer(Code.ACCEPT, "warm", number)
    return number


UNSOUND = (AccuracyLevel.FAULT, None)  # None: silent


@pytest.mark.parametrize("said", [AccuracyLevel.DEGRADED, AccuracyLevel.EXPIRED, *UNSOUND])
def test_a_thermal_model_waits_while_the_drift_is_a_fault(history, said):
    """What is EXPIRED is just what a measurement mends."""
    cell = automatic(history)
    cell.check = passed()
    cell.drift = said and replace(KNOWN, level=said)
    number = thermal_candidate(cell)
    cell.run("c1", LONG_S)
    result = cell.finish()
    assert result.accepted == (() if said in UNSOUND else (number,)), result.message
    assert (f"thermal candidate {number} waits" in result.message) == (said in UNSOUND)


@pytest.mark.parametrize("said", [AccuracyLevel.EXPIRED, *UNSOUND])
def test_a_tool_waits_while_the_drift_is_not_known(history, said):
    cell = automatic(history)
    cell.drift = said and replace(KNOWN, level=said)
    number = measured_in_full(cell)
    result = cell.finish()
    assert f"tool candidate {number} waits" in result.message
    assert ("silent" if said is None else said.name) in result.message
    assert result.accepted == ()


@pytest.mark.parametrize(
    "bounds", [{"tool_m": np.nan}, {"tool_rad": np.nan}, {"tool_m": 0.9e-3}, {"thermal_m": np.nan}]
)
def test_a_bound_that_is_no_number_lets_nothing_pass(history, bounds):
    cell = opened(
        history,
        config=config_of(bounds=AcceptBounds(automatic=True, **bounds)),
        check=bent(),
        drift=KNOWN,
    )
    thermal = thermal_candidate(cell)
    number = measured_in_full(cell, thermal_revision=int("thermal_m" not in bounds))
    result = cell.finish()
    assert f"tool candidate {number} waits" in result.message
    assert result.accepted == (() if "thermal_m" in bounds else (thermal,))


BESIDE = np.eye(4) + 1e-5 * np.eye(4, k=3)  # a hundredth of a millimetre


@pytest.mark.parametrize(
    ("other", "what"),
    [
        ({"taught": rows_of(BESIDE @ TAUGHT)}, "'taught' tool"),
        ({"points_m": rows_of(CELL.laser.points + np.full(3, 1e-5))}, "'laser'"),
    ],
)
def test_bounds_hold_only_against_what_both_nodes_were_given(history, other, what):
    cell = automatic(history)
    number = measured_in_full(cell, **other)
    result = cell.finish()
    assert f"tool candidate {number} waits" in result.message
    assert f"another {what} than this node's: give both nodes the same" in result.message
    assert result.accepted == ()


def test_a_tool_of_another_thermal_revision_is_stale(cell):
    cell.check = bent()
    number = measured_in_full(cell, thermal_revision=3)
    cell.finish()
    with pytest.raises(StaleError, match="thermal revision 3, in force is 0: measure it again"):
        cell.session.decide(ACCEPT, number, "a person", "", cell.wall_ns)
    assert cell.session.status(cell.now_s).tool_pending == 0
    cell.log.clear()
    cell.run("c2", LONG_S)  # it waits for nobody
    cell.finish()
    assert modes(cell) == ["full"]


def copied(history: CalibrationHistory, calibration_id: int, count: int) -> None:
    """So many more of a calibration, as other nodes would propose them."""
    columns = (
        "kind, model_hash, based_on, cycle_id, stamp_ns, created_ns, software, method, code, reason"
    )
    with closing(sqlite3.connect(history.path)) as raw, raw:
        raw.execute(
            "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < ?) "
            f"INSERT INTO calibrations ({columns}) "
            f"SELECT {columns} FROM calibrations, n WHERE id = ?",
            (count, calibration_id),
        )
        raw.execute(
            "INSERT INTO payloads SELECT c.id, p.name, p.data, p.sha256 FROM calibrations c, "
            "payloads p WHERE p.calibration_id = ? AND c.id NOT IN "
            "(SELECT calibration_id FROM payloads)",
            (calibration_id,),
        )


def test_a_status_is_no_pause_however_many_candidates_wait(cell):
    """It is asked for five times a second by the process that looks after the robot."""
    history = cell.history
    copied(history, proposed(history), 9_998)
    outdated = proposed(history, thermal_revision=3)
    copied(history, outdated, 10_000)
    copied(history, thermal_proposed(history, 1.0), 9_999)
    took_s = []
    for _ in range(5):
        begin_s = time.perf_counter()
        status = cell.session.status(cell.now_s)
        took_s.append(time.perf_counter() - begin_s)
    assert (status.thermal_pending, status.tool_pending) == (30_000, 0)
    assert min(took_s) < 0.1 * STALL_S
    number = proposed(history)
    assert cell.session.status(cell.now_s).tool_pending == number


def test_a_tool_of_another_thermal_revision_is_not_accepted_without_a_person(history):
    cell = automatic(history)
    number = measured_in_full(cell, thermal_revision=3)
    result = cell.finish()
    assert f"tool candidate {number} waits for a decision: tool {number} was" in result.message
    assert result.accepted == ()


@contextmanager
def held_by_another(history: CalibrationHistory) -> Iterator[None]:
    """Another process is in the middle of a change of the history."""
    history.wait_at_most(0.0)
    with closing(sqlite3.connect(history.path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield
        other.execute("ROLLBACK")


def accepts(cell: Cell) -> list[Code]:
    return [outcome.status for name, outcome in cell.events if name == ACCEPT]


def until_back_home(cell: Cell) -> None:
    """Until a measurement has ended, and the robot is at home again."""
    while cell.tool.measuring or cell.tool.armed or not cell.at_home():
        cell.step()
        assert cell.now_s < cell.ends_s


@pytest.mark.parametrize("kind", ["thermal", "tool"])
def test_an_acceptance_that_meets_a_held_history_comes_later(history, kind):
    cell = automatic(history, poses=POSES[: len(POSES) * (kind == "thermal")])
    if kind == "thermal":
        cell.check = passed()
        number = thermal_candidate(cell)
        cell.run("c1", LONG_S)
        while kinds(cell)[-1:] != ["EndCycle"]:
            cell.step()
            assert cell.now_s < cell.ends_s
    else:
        number = measured_in_full(cell)
        until_back_home(cell)
    with held_by_another(history):
        cell.pass_time(HELD_S / 2.0)
        assert cell.state is State.RUNNING
        assert history.head(kind).calibration_id is None
    cell.check = passed()
    assert cell.finish().accepted == (number,)
    assert accepts(cell) == [Code.ACCEPT]  # told once


def test_an_acceptance_waits_no_longer_than_it_may(history):
    cell = automatic(history)
    number = measured_in_full(cell)
    with held_by_another(history):
        until_back_home(cell)
        home_s = cell.now_s
        result = cell.finish()
    assert HELD_S <= cell.now_s - home_s < HELD_S + 1.0
    assert result.accepted == ()
    assert "another process holds it" in result.message
    assert cell.session.status(cell.now_s).tool_pending == number
    assert accepts(cell) == [Code.STORAGE_FAILED]


def until_verified(cell: Cell) -> None:
    """Until the accepted tool is checked."""
    while not (cell.history.head(TOOL).revision and cell.tool.measuring):
        cell.step()
        assert cell.now_s < cell.ends_s


def test_an_accepted_tool_that_fails_its_check_is_taken_back(history):
    cell = automatic(history)
    measured_in_full(cell)
    result = cell.finish()
    assert "was taken back" in result.message
    assert level(cell) is AccuracyLevel.DEGRADED
    assert (result.code, result.accepted) == (Code.ACCEPT, ())
    assert history.head(TOOL).calibration_id is None


@pytest.mark.parametrize("how", ["closed", "cancelled"])
def test_a_tool_accepted_in_a_run_that_is_broken_off_is_told(history, how):
    cell = automatic(history)
    number = measured_in_full(cell)
    until_verified(cell)
    if how == "closed":
        cell.is_open = False
    else:
        cell.session.cancel("by the PLC")
    result = cell.finish()
    assert history.head(TOOL).calibration_id == number
    assert result.code is Code.CONFLICT
    assert (result.accepted, result.tool_id) == ((number,), number)
    assert (result.tool_answer, result.tool_code) == ("recalibrate", Code.ACCEPT)


def test_the_drift_that_went_into_a_tool_counts_as_long_as_that_tool(history):
    """The model is known better by now, but the tool was measured through the one before."""
    cell = automatic(history)
    cell.drift = replace(KNOWN, error=ToolError(1e-4, 1.5e-4))
    measured_in_full(cell)
    until_verified(cell)
    cell.check = replace(passed(), deviation_mm=0.0, sigma_mm=0.0)
    assert cell.finish().complete
    cell.restart()
    cell.pass_time(0.3)
    cell.drift = None
    later = replace(KNOWN, error=ToolError(1e-5, 1.5e-5))
    cell.session.drift(later, cell.now_s)
    said = cell.session.accuracy(cell.now_s, cell.wall_ns)
    assert said.error.rms_m == pytest.approx(np.hypot(1e-4, 1e-5), rel=1e-9)
    assert said.error.bound_m > 1.5e-4


def test_what_a_person_chose_meanwhile_is_not_taken_back(history):
    cell = automatic(history)
    first = proposed(cell.history)
    decide(cell, ACCEPT, first)
    second = proposed(cell.history)
    decide(cell, ACCEPT, second)
    number = measured_in_full(cell)
    while not (history.head(TOOL).calibration_id == number and cell.tool.measuring):
        cell.step()
    decide(cell, ROLLBACK, first)
    result = cell.finish()
    assert history.head(TOOL).calibration_id == first
    assert result.accepted == ()
    assert "taken back" not in result.message


def test_what_a_person_chose_while_the_history_was_held_is_not_taken_back(history):
    """Between two tries."""
    cell = automatic(history)
    first = proposed(history)
    decide(cell, ACCEPT, first)
    decide(cell, ACCEPT, proposed(history))
    measured_in_full(cell)
    while not (history.head(TOOL).revision == 3 and cell.tool.measuring):
        cell.step()
        assert cell.now_s < cell.ends_s
    with held_by_another(history):
        until_back_home(cell)
        cell.pass_time(HELD_S / 4.0)
        assert cell.state is State.RUNNING
    history.rollback(first, kind=TOOL, by="a person", reason="", wall_ns=0)
    result = cell.finish()
    assert history.head(TOOL).calibration_id == first
    assert (result.code, result.accepted) == (Code.ACCEPT, ())
    assert "is no longer in force" in result.message
    assert level(cell) is AccuracyLevel.DEGRADED


def fails_once_after(monkeypatch, owner: Any, name: str) -> None:
    """The change is made; what is read or written next fails."""
    real, made = getattr(owner, name), []

    def once(*args, **kwargs):
        result = real(*args, **kwargs)
        if not made:
            made.append(name)
            raise StorageError("disk I/O error")
        return result

    monkeypatch.setattr(owner, name, once)


@pytest.mark.parametrize("owner", [CalibrationHistory, Decider])
def test_an_acceptance_whose_answer_was_lost_is_made_once(history, monkeypatch, owner):
    cell = automatic(history)
    number = measured_in_full(cell)
    fails_once_after(monkeypatch, owner, {Decider: "decide"}.get(owner, "accept"))
    until_verified(cell)
    cell.check = passed()
    result = cell.finish()
    assert (result.accepted, result.tool_answer) == ((number,), "pass")
    assert [d.calibration_id for d in history.decisions()] == [number]


@pytest.mark.parametrize("owner", [CalibrationHistory, Decider])
def test_a_rollback_whose_answer_was_lost_is_made_once(history, monkeypatch, owner):
    cell = automatic(history)
    first = proposed(history)
    decide(cell, ACCEPT, first)
    measured_in_full(cell)
    fails_once_after(monkeypatch, owner, {Decider: "roll_back"}.get(owner, "rollback"))
    result = cell.finish()
    assert (result.code, result.accepted) == (Code.ACCEPT, ())
    assert history.head(TOOL).calibration_id == first
    assert [d.action for d in history.decisions()] == [
        Action.ACCEPT,
        Action.ACCEPT,
        Action.ROLLBACK,
    ]


@pytest.mark.parametrize("name", [ACCEPT, REJECT, ROLLBACK])
def test_a_decision_that_was_made_is_told_though_nothing_can_be_read_after_it(
    cell, monkeypatch, name
):
    number = proposed(cell.history)
    if name == ROLLBACK:
        decide(cell, ACCEPT, number)
    real = getattr(CalibrationHistory, name)

    def unreadable(*args, **kwargs):
        raise StorageError("disk I/O error")

    def last(*args, **kwargs):
        result = real(*args, **kwargs)
        monkeypatch.setattr(CalibrationHistory, "head", unreadable)
        return result

    monkeypatch.setattr(CalibrationHistory, name, last)
    if name == ROLLBACK:
        answer = cell.session.decide_only(ROLLBACK, "a person", cell.wall_ns)
    else:
        answer = cell.session.decide(name, number, "a person", "", cell.wall_ns)
    assert (answer.done, answer.revision) == (True, {ACCEPT: 1, REJECT: 0, ROLLBACK: 2}[name])


@pytest.mark.parametrize("where", [(CalibrationHistory, "rollback"), (Decider, "roll_back")])
def test_a_tool_that_cannot_be_taken_back_is_a_fault(history, monkeypatch, where):
    def held(*args, **kwargs):
        raise StorageError("the history is held")

    cell = automatic(history)
    number = measured_in_full(cell)
    until_verified(cell)
    monkeypatch.setattr(*where, held)
    result = cell.finish()
    assert result.accepted == (number,)
    assert result.code is Code.CONFLICT
    assert "could not be taken back: the history is held" in result.message
    assert cell.state is State.FAULT
    assert not cell.tool.armed
    assert cell.at_home()


def test_a_calibration_that_is_in_force_again_is_taken_back_again(cell):
    first = proposed(cell.history)
    decide(cell, ACCEPT, first)
    session, head = cell.session, cell.history.head
    assert session.decide_only(ROLLBACK, "a person", cell.wall_ns).done
    assert "already" in session.decide_only(ROLLBACK, "a person", cell.wall_ns).message
    decide(cell, ROLLBACK, first)
    assert head(TOOL).calibration_id == first
    session.decide_only(ROLLBACK, "a person", cell.wall_ns)
    assert head(TOOL).calibration_id is None


def test_a_rejection_is_told_where_the_next_one_fails(cell, monkeypatch):
    numbers = {proposed(cell.history), thermal_proposed(cell.history, 10.0)}
    reject = CalibrationHistory.reject

    def once(*args, **kwargs):
        monkeypatch.setattr(CalibrationHistory, "get", held)
        return reject(*args, **kwargs)

    def held(*args, **kwargs):
        raise StorageError("the history is held")

    monkeypatch.setattr(CalibrationHistory, "reject", once)
    answer = cell.session.decide_only(REJECT, "a person", cell.wall_ns)
    recorded, failed = (outcome for name, outcome in cell.events if name == REJECT)
    assert {recorded.calibration_id, failed.command.arguments["id"]} == numbers
    assert answer.status is Code.STORAGE_FAILED
    assert recorded.message in answer.message
    assert "the history is held" in answer.message


def test_many_that_wait_are_rejected_ten_at_a_time(cell):
    for kelvin in range(1, 26):
        thermal_proposed(cell.history, float(kelvin))
    answers = [cell.session.decide_only(REJECT, "a person", cell.wall_ns) for _ in range(4)]
    assert [a.message.count("rejected") for a in answers] == [10, 10, 5, 0]
    assert [a.message.endswith("more wait: call again") for a in answers] == [
        True,
        True,
        False,
        False,
    ]
    assert all(a.done for a in answers)
    assert cell.history.pending(THERMAL) == ()


def test_an_acceptance_without_an_id_is_repeated_for_a_minute(cell):
    number = thermal_proposed(cell.history, 10.0)
    assert cell.session.decide_only(ACCEPT, "a person", cell.wall_ns).calibration_id == number
    again = cell.session.decide_only(ACCEPT, "a person", cell.wall_ns + 59 * 10**9)
    assert (again.status, again.calibration_id) == (Code.ACCEPT, number)
    for late_s in (61, -1):  # after a clock that was set back it is nobody's either
        with pytest.raises(ConflictError, match="one candidate must wait"):
            cell.session.decide_only(ACCEPT, "a person", cell.wall_ns + late_s * 10**9)
