# SPDX-License-Identifier: Apache-2.0
"""Decisions that meet a held history, fail half way, or come after a person's."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from maintenance_cell import (
    KNOWN,
    LONG_S,
    POSES,
    Cell,
    bent,
    config_of,
    kept,
    kinds,
    opened,
    over,
    passed,
    proposed,
    thermal_proposed,
    until_moving,
)
from maintenance_tools import (
    automatic,
    decide,
    level,
    measured_in_full,
    thermal_candidate,
    until_verified,
)

from robocal_ros.ground.errors import Code, ConflictError, StorageError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import (
    THERMAL,
    TOOL,
    Action,
    CalibrationState,
    fixture_kind,
)
from robocal_ros.maintenance.deciding import HELD_S, Decider
from robocal_ros.maintenance.session import MaintenanceState
from robocal_ros.session.events import ACCEPT, REJECT, ROLLBACK
from robocal_ros.thermal.accuracy import AccuracyLevel, ToolError


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
    """Until a measurement has ended, and the robot rests at home again."""
    while (
        cell.tool.measuring
        or cell.tool.armed
        or not cell.at_home()
        or cell.now_s < cell.moved_s + 0.1
    ):
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
        assert cell.state is MaintenanceState.RUNNING
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
    cell.open_gap()
    cell.drift = None
    later = replace(KNOWN, error=ToolError(1e-5, 1.5e-5))
    cell.session.drift(later, cell.now_s)
    said = cell.session.accuracy(cell.now_s, cell.wall_ns)
    assert said.error.rms_m == pytest.approx(np.hypot(1e-4, 1e-5), rel=1e-9)
    assert said.error.bound_m > 1.5e-4


@pytest.mark.parametrize("poses", [POSES, POSES[:0]])
def test_of_a_tool_that_was_measured_through_an_unknown_drift_no_error_is_predicted(history, poses):
    """Also once the drift is known again; a cell without measuring poses asks for none."""
    unknown = replace(KNOWN, level=AccuracyLevel.EXPIRED, error=None)
    cell = opened(history, config=config_of(poses=poses), check=bent(), drift=unknown)
    finds_the_same = cell.full
    number = measured_in_full(cell)
    cell.finish()
    decide(cell, ACCEPT, number)
    cell.check = passed()
    cell.ran("c2")
    assert level(cell) is AccuracyLevel.OK
    assert (cell.session.accuracy(cell.now_s, cell.wall_ns).error is None) == bool(len(poses))
    cell.check, cell.full = bent(), finds_the_same
    cell.drift = replace(KNOWN, error=ToolError(1e-5, 1.5e-5))
    assert cell.ran("c3").tool_code is Code.NO_SIGNIFICANT_GAIN
    assert cell.session.accuracy(cell.now_s, cell.wall_ns).error is not None


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
        assert cell.state is MaintenanceState.RUNNING
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
    assert cell.state is MaintenanceState.FAULT
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


def test_many_that_wait_are_rejected_two_at_a_time(cell):
    for kelvin in range(1, 6):
        thermal_proposed(cell.history, float(kelvin))
    answers = [cell.session.decide_only(REJECT, "a person", cell.wall_ns) for _ in range(4)]
    assert [a.message.count("rejected") for a in answers] == [2, 2, 1, 0]
    assert [a.message.endswith("more wait: call again") for a in answers] == [
        True,
        True,
        False,
        False,
    ]
    assert all(a.done for a in answers)
    assert cell.history.pending(THERMAL) == ()


def test_a_history_that_is_held_is_waited_for_once(cell, monkeypatch):
    for kelvin in (1.0, 2.0):
        thermal_proposed(cell.history, kelvin)
    tried = []

    def held(*args, **kwargs):
        tried.append(args)
        raise StorageError("the history is held")

    monkeypatch.setattr(CalibrationHistory, "reject", held)
    answer = cell.session.decide_only(REJECT, "a person", cell.wall_ns)
    assert (answer.status, len(tried)) == (Code.STORAGE_FAILED, 1)


def test_an_acceptance_without_an_id_is_repeated_for_a_minute(cell):
    number = thermal_proposed(cell.history, 10.0)
    assert cell.session.decide_only(ACCEPT, "a person", cell.wall_ns).calibration_id == number
    again = cell.session.decide_only(ACCEPT, "a person", cell.wall_ns + 59 * 10**9)
    assert (again.status, again.calibration_id) == (Code.ACCEPT, number)
    for late_s in (61, -1):  # after a clock that was set back it is nobody's either
        with pytest.raises(ConflictError, match="one candidate must wait"):
            cell.session.decide_only(ACCEPT, "a person", cell.wall_ns + late_s * 10**9)


def test_a_fixture_waits_until_it_is_decided(cell):
    """Of several the newest; what is older than the one in force is outdated."""
    history, plate, wheel = cell.history, fixture_kind("plate"), fixture_kind("wheel")
    first, second, third = (kept(history, kind, {}) for kind in (plate, wheel, plate))
    kept(history, plate, {}, Code.RESIDUAL_TOO_LARGE)  # which tells nothing of where it stands
    for number, name in ((third, ACCEPT), (second, REJECT)):
        assert cell.session.status(cell.now_s).fixture_pending == number
        decide(cell, name, number)
    status = cell.session.status(cell.now_s)
    assert (status.fixture_pending, status.thermal_pending, status.tool_pending) == (0, 0, 0)
    assert history.get(first).state is CalibrationState.STALE


def test_a_fixture_that_was_put_back_waits_no_more(cell):
    plate = fixture_kind("plate")
    moved = kept(cell.history, plate, {})
    assert cell.session.status(cell.now_s).fixture_pending == moved
    kept(cell.history, plate, {}, Code.NO_SIGNIFICANT_GAIN)
    assert cell.session.status(cell.now_s).fixture_pending == 0


def test_what_waits_is_told_on_while_the_history_cannot_be_read(cell, tmp_path):
    number = kept(cell.history, fixture_kind("plate"), {})
    assert cell.session.status(cell.now_s).fixture_pending == number
    cell.history.path.rename(tmp_path / "elsewhere")
    status = cell.session.status(cell.now_s)
    assert "deleted or replaced" in status.trouble
    assert status.fixture_pending == number
    (tmp_path / "elsewhere").rename(cell.history.path)
    decide(cell, REJECT, number)
    assert cell.session.status(cell.now_s).fixture_pending == 0


def test_a_history_that_was_replaced_is_not_what_the_line_goes_by(history, tmp_path):
    cell = opened(history, drift=KNOWN, check=passed())
    cell.ran("c1")
    thermal_proposed(history, 10.0)
    assert level(cell) is AccuracyLevel.OK
    history.path.rename(tmp_path / "elsewhere")
    with pytest.raises(StorageError, match="deleted or replaced"):
        level(cell)
    status = cell.session.status(cell.now_s)
    assert status.thermal_pending == 0
    assert "deleted or replaced" in status.trouble
    (tmp_path / "elsewhere").rename(history.path)
    assert level(cell) is AccuracyLevel.OK
    assert not cell.session.status(cell.now_s).trouble


@pytest.mark.parametrize("kind", [TOOL, THERMAL])
def test_a_check_is_not_of_what_another_history_has_in_force_by_the_same_numbers(
    history, tmp_path, kind
):
    """Both have a first calibration in force, of revision 1."""
    first, other = {TOOL: [(1e-3, 0.0, 0.0), (0.0, 1e-3, 0.0)], THERMAL: [10.0, 20.0]}[kind]
    make = {TOOL: proposed, THERMAL: thermal_proposed}[kind]
    told = {"by": "a person", "reason": "", "wall_ns": 0}
    before = history.accept(make(history, first), **told)
    cell = opened(history, drift=KNOWN, check=passed())
    cell.ran("c1")
    assert level(cell) is AccuracyLevel.OK
    with CalibrationHistory.open("K1", state_dir=tmp_path / "anew") as anew:
        after = anew.accept(make(anew, other), **told)
        assert (after.revision, after.calibration_id) == (before.revision, before.calibration_id)
        cell.history = anew
        cell.restart()
        cell.open_gap()
        assert level(cell) is AccuracyLevel.DUE


def test_a_history_that_is_taken_away_amid_a_cycle_ends_it_at_home(history, tmp_path):
    cell = opened(history, drift=KNOWN, check=passed())
    until_moving(cell, "thermal")
    history.path.rename(tmp_path / "elsewhere")
    result = cell.finish()
    assert result.code is Code.STORAGE_FAILED
    over(cell)
