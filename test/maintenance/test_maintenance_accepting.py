# SPDX-License-Identifier: Apache-2.0
"""What may come into force without a person."""

import sqlite3
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from typing import Any

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
    kept,
    opened,
    passed,
    proposed,
    thermal_proposed,
)
from maintenance_tools import (
    automatic,
    measured_in_full,
    modes,
    straightened,
    thermal_candidate,
)
from tool_driver import TAUGHT

from robocal_ros.correction.interface import CorrectionState, ToldCorrection
from robocal_ros.ground.errors import Code, StaleError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import (
    THERMAL,
    TOOL,
    Action,
    Decision,
    Head,
    fixture_kind,
    insert_decision,
)
from robocal_ros.maintenance.accuracy import AcceptBounds
from robocal_ros.maintenance.robot_interface import DriverAnswer
from robocal_ros.motion.robot_watch import STALL_S
from robocal_ros.session.events import ACCEPT, WITHHOLD, Command, Outcome, decide
from robocal_ros.thermal.accuracy import AccuracyLevel
from robocal_ros.tool.run import rows_of

UNSOUND = (AccuracyLevel.FAULT, None)  # None: silent
BESIDE = np.eye(4) + 1e-5 * np.eye(4, k=3)  # a hundredth of a millimetre


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
    cell.thermal = DriverAnswer(code, "warm")
    number = measured_in_full(cell)
    while not cell.history.head(TOOL).revision:
        cell.step()
    cell.check = passed()
    assert cell.finish().accepted == (number,)


@pytest.mark.parametrize("said", [AccuracyLevel.DEGRADED, AccuracyLevel.EXPIRED, *UNSOUND])
def test_a_thermal_model_waits_while_the_drift_is_a_fault(history, said):
    """What is EXPIRED is just what a measurement mends."""
    cell = automatic(history)
    cell.check = passed()
    cell.drift = said and replace(KNOWN, level=said)
    number = thermal_candidate(cell)
    result = cell.ran("c1")
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


class Waiting(CalibrationHistory):
    """Tells when all that is read before an acceptance was read."""

    def accept(self, *given: Any, **more: Any) -> Head:
        self.read.set()
        return super().accept(*given, **more)


def test_a_tool_does_not_come_into_force_beside_a_model_that_is_just_accepted(history):
    """The PLC accepts it while thermal_node is committing; the drift would be corrected twice."""
    thermal, tool = thermal_proposed(history, 1.0), proposed(history)
    read = threading.Event()

    def accept_tool() -> Outcome:
        with Waiting.open(history.serial, state_dir=history.path.parent) as waiting:
            waiting.read = read
            return decide(waiting, Command(ACCEPT, {"id": tool}), 0, 1, TOOL)

    with (
        closing(sqlite3.connect(history.path, isolation_level=None)) as node,
        ThreadPoolExecutor(1) as plc,
    ):
        node.execute("BEGIN IMMEDIATE")
        insert_decision(node, Decision(0, THERMAL, Action.ACCEPT, thermal, "", "", 1, 0, 1))
        answer = plc.submit(accept_tool)
        assert read.wait(10.0)
        node.execute("COMMIT")
        outcome = answer.result(10.0)
    assert outcome.status is Code.STALE, outcome.message
    assert "thermal revision 0, in force is 1: measure it again" in outcome.message
    assert (history.head(THERMAL).revision, history.head(TOOL).revision) == (1, 0)


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
    copied(history, kept(history, fixture_kind("plate"), {}), 9_999)
    copied(history, thermal_proposed(history, 1.0), 9_999)
    took_s = []
    for _ in range(5):
        begin_s = time.perf_counter()
        status = cell.session.status(cell.now_s)
        took_s.append(time.perf_counter() - begin_s)
    pending = status.thermal_pending, status.tool_pending, status.fixture_pending
    assert pending == (40_000, 0, 30_000)
    assert min(took_s) < 0.1 * STALL_S
    number = proposed(history)
    assert cell.session.status(cell.now_s).tool_pending == number


def test_a_tool_of_another_thermal_revision_is_not_accepted_without_a_person(history):
    cell = automatic(history)
    number = measured_in_full(cell, thermal_revision=3)
    result = cell.finish()
    assert f"tool candidate {number} waits for a decision: tool {number} was" in result.message
    assert result.accepted == ()


@pytest.mark.parametrize("cause", ["doubt", "station"])
def test_a_tool_that_may_be_the_stations_waits_for_a_person(history, cause):
    cell = automatic(history)
    number = measured_in_full(cell, cause=cause)
    result = cell.finish()
    assert f"tool candidate {number} waits" in result.message
    assert "nothing proves that the tool has changed and not the beam station" in result.message
    assert result.accepted == ()
    assert cell.session.decide(ACCEPT, number, "a person", "", cell.wall_ns).done


SILENT_S = 5.0
OFF = ToldCorrection(state=CorrectionState.OFF, enabled=False)
ON = ToldCorrection(state=CorrectionState.ON, enabled=True, tool_revision=1)


@pytest.fixture
def corrected(history) -> Cell:
    """A bent tool was measured, accepted and checked; the line asked before it was."""
    cell = automatic(history, correction_silent_s=SILENT_S)
    line(cell)
    cell.full = straightened
    assert cell.ran("c1").accepted
    assert cell.history.head(TOOL).revision == 1
    return cell


def line(cell: Cell, told: ToldCorrection | None = None):
    """What it reads, when the correction has just said so."""
    if told is not None:
        cell.session.correction(told, cell.now_s)
    return cell.session.accuracy(cell.now_s, cell.wall_ns)


def test_a_power_cut_that_leaves_the_correction_off_is_told_at_once(corrected):
    assert line(corrected, ON).level is AccuracyLevel.OK
    corrected.restart()
    corrected.session.drift(KNOWN, corrected.now_s)
    found = line(corrected, OFF)
    assert found.level is AccuracyLevel.DEGRADED
    assert found.reason == "correction: joint_correction_node is OFF: call ~/enable"
    assert found.error is None  # what is known of model and tool is not what the robot does
    assert line(corrected, ON).level is AccuracyLevel.OK


def test_a_correction_that_falls_silent_is_told(corrected):
    line(corrected, ON)
    corrected.pass_time(SILENT_S - 0.1)
    assert line(corrected).level is AccuracyLevel.OK
    corrected.pass_time(0.2)
    found = line(corrected)
    assert (found.level, "is silent" in found.reason) == (AccuracyLevel.DEGRADED, True)


def test_a_tool_that_the_correction_refused_is_told_once_it_must_have_heard_of_it(corrected):
    refused = replace(ON, tool_revision=0, last_refusal="4.0 deg from the taught tool")
    assert line(corrected, refused).level is AccuracyLevel.OK  # tcf_node follows within a second
    corrected.pass_time(SILENT_S + 0.1)
    found = line(corrected, refused)
    assert found.level is AccuracyLevel.DEGRADED
    assert "corrects with tool revision 0, in force is revision 1" in found.reason
    assert "4.0 deg from the taught tool" in found.reason
