# SPDX-License-Identifier: Apache-2.0
"""What the joint correction keeps in the robot's history: what it corrected with, since when."""

import contextlib
import sqlite3
import time
from pathlib import Path
from typing import Any

import numpy as np
from history_workers import proposal
from joint_correction_live import (
    HOME,
    NODE,
    NOMINAL,
    Line,
    drifted,
    joints,
    model_message,
    tool_message,
)
from robocal_msgs.msg import CorrectionStatus
from std_srvs.srv import Trigger

from robocal_ros import __version__
from robocal_ros.correction import report as correction_log
from robocal_ros.ground import frames
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import CALIBRATED, CorrectionRecord
from robocal_ros.history.history_records import NOMINAL as AS_NOMINAL
from robocal_ros.kinematics.robots import load_description, save_robot
from robocal_ros.ros.conversions import header
from robocal_ros.ros.session_node import history_notice


def kept(graph: Any, serial: str = "s1") -> list[CorrectionRecord]:
    """All records, oldest first."""
    with CalibrationHistory.open(serial, state_dir=graph.state) as history:
        return list(reversed(history.corrections(1000)))


def after(graph: Any, count: int) -> list[CorrectionRecord]:
    graph.spin_until(lambda: len(kept(graph)) >= count, f"{count} records")
    return kept(graph)


def test_each_change_is_kept_with_the_choice_of_the_reference(graph: Any) -> None:
    began = time.time_ns()
    line = Line(graph)
    first = after(graph, 1)[0]
    assert first == CorrectionRecord(
        wall_ns=first.wall_ns,
        software=__version__,
        model_hash=NOMINAL.model_hash,
        enabled=False,
        shadow=False,
        model_revision=0,
        tool_revision=0,
        reference=AS_NOMINAL,
        reference_source="kr150_r3100",
        reference_name=NOMINAL.name,
        reference_hash=NOMINAL.model_hash,
        taught_tool=(*NOMINAL.T_flange_tool[:3, 3], *frames.quat_xyzw(NOMINAL.T_flange_tool)),
    )
    T = NOMINAL.T_flange_tool @ frames.transform(np.eye(3), [2e-3, 0.0, 0.0])
    line.enable()
    after(graph, 2)
    line.take(model_message(drifted(), 3), line.to_model, "kinematic_model")
    after(graph, 3)
    line.take(tool_message(T, 5), line.to_tool, "tool")
    after(graph, 4)
    line.enable(False)
    records = after(graph, 5)
    changes = [(r.enabled, r.model_revision, r.tool_revision) for r in records]
    assert changes == [(False, 0, 0), (True, 0, 0), (True, 3, 0), (True, 3, 5), (False, 3, 5)]
    times = [r.wall_ns for r in records]
    assert began < times[0]
    assert times == sorted(times)
    assert times[-1] <= time.time_ns()
    line.enable(False)  # changes nothing
    graph.spin_for(2.5 * 0.1)
    assert len(kept(graph)) == 5


def test_what_the_history_has_rolled_back_stays_so_where_its_message_is_repeated(
    graph: Any,
) -> None:
    """As by a bridge: the node never had it in use."""
    stamp_ns, by = 1_700_000_000_000_000_000, {"by": "Ada", "reason": "", "wall_ns": 1}
    with CalibrationHistory.open("s1", state_dir=graph.state) as history:
        made = {"model_hash": NOMINAL.model_hash, "stamp_ns": stamp_ns}
        history.accept(history.propose(proposal(**made)), **by)
        history.rollback(0, **by)
    line = Line(graph)
    withdrawn = model_message(drifted(), 1, stamp=header(stamp_ns, "base"))
    line.refused(line.to_model, withdrawn, "kinematic_model")  # as the first one, too
    line.take(model_message(NOMINAL, 2), line.to_model, "kinematic_model")
    line.refused(line.to_model, withdrawn, "kinematic_model")
    told = line.told(model_waits=True)
    assert (told.model_revision, told.waiting_model_revision) == (2, 1)


def test_a_calibrated_reference_is_kept_and_shown(graph: Any, tmp_path: Path) -> None:
    cold = tmp_path / "cold.yaml"
    save_robot(drifted(), cold, load_description("kr150_r3100"))
    line = Line(graph, reference=str(cold), shadow=True)
    record = after(graph, 1)[0]
    assert (record.reference, record.reference_source) == (CALIBRATED, str(cold))
    assert record.reference_hash != record.model_hash == NOMINAL.model_hash
    assert record.shadow
    told = line.told(state=CorrectionStatus.OFF)
    assert told.reference == f"{cold}: {record.reference_name} {record.reference_hash}"


def test_a_history_that_cannot_be_written_holds_nothing_up(graph: Any, monkeypatch: Any) -> None:
    """Another program holds the file; the commands go on, and the record comes later."""
    monkeypatch.setattr(correction_log, "RETRY_S", 0.2)
    with CalibrationHistory.open("s1", state_dir=graph.state) as history:
        path = history.path
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as holder:
        holder.execute("BEGIN IMMEDIATE")
        line = Line(graph)
        line.target()
        slowest = 0.0
        for on in (True, False) * 5:
            begun = time.monotonic()
            line.enable(on)
            line.target()
            slowest = max(slowest, time.monotonic() - begun)
        assert slowest < 1.0  # a write gives up after two
        warning = line.report(b"\x01", "wait to be written into the history")
        assert "another process holds it" in warning.message
        holder.execute("ROLLBACK")
    records = after(graph, 11)
    assert [r.enabled for r in records] == [False] + [True, False] * 5
    line.diagnostics.clear()
    line.report(b"\x00", "")


def test_the_end_of_the_node_loses_no_record(graph: Any) -> None:
    line = Line(graph)
    line.enable()
    line.enable(False)
    line.node.close()
    graph.executor.remove_node(line.node)
    assert [r.enabled for r in kept(graph)] == [False, True, False]


def test_a_damaged_history_is_not_touched_and_what_could_not_be_written_comes_later(
    graph: Any, monkeypatch: Any
) -> None:
    """It only adds to the history: setting it aside is for the nodes whose history it is."""
    monkeypatch.setattr(correction_log, "RETRY_S", 0.1)
    graph.state.mkdir(exist_ok=True)
    path = graph.state / "s1.sqlite"
    path.write_bytes(b"\xff" * 5000)
    line = Line(graph)
    graph.spin_until(
        lambda: "is damaged" in line.node.health().message, "the diagnostics say so", 20.0
    )
    assert path.read_bytes() == b"\xff" * 5000
    assert not list(graph.state.glob("*.damaged-*"))
    CalibrationHistory.open("s1", state_dir=graph.state).close()  # as thermal_node starts
    assert len(list(graph.state.glob("*.damaged-*"))) == 1
    after(graph, 1)
    graph.spin_until(lambda: "is damaged" not in line.node.health().message, "it is not told now")


def test_a_damaged_history_is_told_until_a_person_acknowledges_it(
    graph: Any, monkeypatch: Any
) -> None:
    """Finding: who acknowledged a mismatch ended both, and every node fell silent about it."""
    monkeypatch.setattr(correction_log, "RETRY_S", 0.1)
    graph.state.mkdir(exist_ok=True)
    (graph.state / "s1.sqlite").write_bytes(b"\xff" * 5000)
    CalibrationHistory.open("s1", state_dir=graph.state).close()  # its owner sets it aside
    line = Line(graph)
    graph.spin_until(lambda: line.statuses and line.statuses[-1].history, "the status says so")
    assert "was set aside as" in line.statuses[-1].history
    assert "was set aside as" in line.report(b"\x01", "set aside").message
    line.enable()
    line.at = HOME + np.radians(2.0)
    line.rest()
    line.refused(line.to_target, joints(HOME), "joint_targets")
    graph.spin_until(lambda: line.statuses[-1].mismatch and line.statuses[-1].history, "both")
    answer = graph.call(Trigger, f"{NODE}/acknowledge")
    assert "; acknowledged: START_MISMATCH" in answer.message
    assert "damaged" not in answer.message
    graph.spin_until(lambda: not line.statuses[-1].mismatch, "the mismatch has ended")
    graph.spin_for(0.3)  # three looks of the log
    assert "was set aside as" in line.node._report.log.damage
    answer = graph.call(Trigger, f"{NODE}/acknowledge")
    assert answer.success
    assert "; acknowledged: a damaged history was set aside as" in answer.message
    graph.spin_until(lambda: not line.statuses[-1].history, "it is known now")
    assert len(list(graph.state.glob("*.damaged-*"))) == 1
    assert graph.call(Trigger, f"{NODE}/acknowledge").message.endswith("; acknowledged: nothing")


def test_damage_that_came_after_what_was_told_is_not_known(graph: Any) -> None:
    graph.state.mkdir(exist_ok=True)
    path = graph.state / "s1.sqlite"
    settings = {"serial": "s1", "state_dir": ""}
    log = correction_log.CorrectionLog(settings, load_description("kr150_r3100"))
    told = []
    for _ in range(2):
        path.write_bytes(b"\xff" * 5000)
        CalibrationHistory.open("s1", state_dir=graph.state).close()
        told.append(history_notice(settings))
    assert told[0] != told[1]
    log.acknowledge(told[0])
    log.close()
    assert log.damage == history_notice(settings) == told[1]
