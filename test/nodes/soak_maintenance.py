# SPDX-License-Identifier: Apache-2.0
"""The maintenance of a whole cell over DDS, at the limits as they are set, and how long calls take.

Not of ``make test``, which shares its machine: a part of ``make soak``, or

    tools/with_ros python -m pytest -s test/nodes/soak_maintenance.py
"""

import os
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from maintenance_live import SERIAL, LiveCell
from robocal_msgs.action import MeasureTool
from robocal_msgs.msg import AccuracyState, MaintenanceStatus
from robocal_msgs.srv import Acknowledge, Decide, GetMaintenance, RunMaintenanceCycle
from std_srvs.srv import Trigger
from test_maintenance_calls import HOME_DEG, Plc, process, proposed

from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_robot

GAP_S = 150.0
BEND_MM = "[1.5, -0.8, 0.4]"
COUNT = 30
DECIDED = 1000  # decisions that the history holds before
TWINS = ("run_trigger", "status_trigger", "accept_trigger", "reject_trigger", "rollback_trigger")
PATIENCE_S = 0.5  # what docs/plc.md tells a PLC to wait


def test_one_call_keeps_a_cell_accurate(graph: Any, tmp_path: Path) -> None:
    print("load", os.getloadavg())
    cell = LiveCell(graph, tmp_path, busy=False, tool_bend_mm=BEND_MM)
    cell.state(AccuracyState.EXPIRED)
    cell.capture_reference()
    begin = time.monotonic()
    first = cell.run("c1", GAP_S)
    print(f"first gap: {time.monotonic() - begin:.1f} s: {first.message}")
    assert first.success, first.message
    result = first.result
    assert result.complete, first.message
    # In seconds nothing has drifted: the model in force stays, whatever the noise says.
    stays = (Code.NO_SIGNIFICANT_GAIN, Code.WORSE_THAN_CURRENT)
    assert result.thermal_code in stays, first.message
    assert (result.thermal_id > 0, result.tool_code) == (True, Code.ACCEPT), first.message
    assert result.tool_answer == MeasureTool.Result.RECALIBRATE
    assert cell.at_home()
    assert cell.stands(1.0)
    assert {f.feedback.state.state for f in cell.feedback} == {MaintenanceStatus.RUNNING}
    cell.state(AccuracyState.DEGRADED)
    # Nothing was accepted without a person; now the PLC accepts by the id.
    status = graph.call(GetMaintenance, "/maintenance_node/status", cycle_id="c1")
    assert status.state.thermal_pending == 0
    assert status.state.tool_pending == result.tool_id
    assert status.result == result
    refused = graph.call(Decide, "/maintenance_node/accept", id=result.thermal_id, by="plc")
    assert (refused.success, refused.status) == (False, result.thermal_code)
    for _ in range(2):
        answer = graph.call(Decide, "/maintenance_node/accept", id=result.tool_id, by="plc")
        assert (answer.success, answer.revision) == (True, 1), answer.message
    count = len(cell.goals)
    repeated = cell.run("c1", GAP_S)
    assert repeated == first
    assert len(cell.goals) == count
    begin = time.monotonic()
    second = cell.run("c2", GAP_S)  # verifies the tool that was accepted
    print(f"second gap: {time.monotonic() - begin:.1f} s: {second.message}")
    assert second.success, second.message
    assert second.result.tool_answer == MeasureTool.Result.PASS, second.message
    said = cell.state(AccuracyState.OK)
    assert 0.0 < said.predicted_error_mm < said.bound_mm <= said.tolerance_mm
    recorded = [e.command for e in cell.events]
    assert [n for n in recorded if n != "maintenance_ended"] == [
        "run_maintenance", "withhold", "accept", "accept", "run_maintenance",
    ]  # fmt: skip
    print("load", os.getloadavg())


def test_calls_do_their_work_in_time(graph: Any, tmp_path: Path) -> None:
    took_s: dict[str, list[float]] = defaultdict(list)
    cell = LiveCell(graph, tmp_path)
    cell.capture_reference()
    arm = load_robot("ur10")
    with CalibrationHistory.open(
        SERIAL, model_hash=arm.model_hash, state_dir=graph.state
    ) as history:

        def timed(kind: type, name: str, done: bool = True, **fields: Any) -> Any:
            answer, seconds = cell.timed(kind, name, **fields)
            assert answer.success == done, (name, answer.message)
            took_s[name].append(seconds)
            return answer

        for kind, name in {
            Decide: ("accept", "reject", "rollback"),
            GetMaintenance: ("status",),
            RunMaintenanceCycle: ("run",),
            Trigger: (*TWINS, "cancel_trigger"),
        }.items():
            for each in name:
                graph.call(kind, f"/maintenance_node/{each}")  # discovers it
        graph.spin_for(0.5)  # until the status tells of the cycle that was begun and cancelled
        until_idle(cell)
        for _ in range(DECIDED):
            history.reject(proposed(history, 0), by="test", reason="", wall_ns=1)
        base = proposed(history, 0)
        assert graph.call(Decide, "/maintenance_node/accept", id=base).success
        for number in range(COUNT):
            sent = len(cell.goals)
            timed(RunMaintenanceCycle, "run", cycle_id=f"c{number}", gap_s=GAP_S)
            graph.spin_until(lambda sent=sent: len(cell.goals) > sent, "a motion", within_s=30.0)
            graph.spin_until(lambda: not cell.at_home(), "it moves")
            timed(GetMaintenance, "status")
            in_force = history.head().revision
            good, bad = proposed(history, in_force), proposed(history, in_force)
            timed(Decide, "reject", id=bad)
            timed(Decide, "accept", id=good)
            timed(Decide, "rollback", id=base)
            assert history.head().calibration_id == base
            timed(Trigger, "status_trigger", done=False)  # a cycle runs: ask again
            twins(timed, history, base)
            timed(Trigger, "run_trigger")
            timed(Trigger, "cancel_trigger")
            until_idle(cell)
    show(took_s)
    assert max(max(times) for times in took_s.values()) < PATIENCE_S


def until_idle(cell: LiveCell) -> None:
    cell.graph.spin_until(
        lambda: cell.statuses[-1].state == MaintenanceStatus.IDLE, "home", within_s=60.0
    )


def twins(timed: Callable[..., Any], history: CalibrationHistory, base: int) -> None:
    """The calls without an id, with all that they may have to do."""
    in_force = history.head().revision
    for _ in range(2):
        proposed(history, in_force)
    timed(Trigger, "reject_trigger")
    proposed(history, in_force)
    timed(Trigger, "accept_trigger")
    timed(Trigger, "rollback_trigger")
    assert history.head().calibration_id == base
    assert not history.pending()


def test_an_acknowledgement_is_in_time(graph: Any) -> None:
    """The robot stands: it is a fault that ends."""
    plc = Plc(graph, lambda: process(graph))
    plc.call(Acknowledge, "acknowledge")
    plc.call(Trigger, "acknowledge_trigger")
    took_s: dict[str, list[float]] = defaultdict(list)
    for number in range(2 * COUNT):
        plc.q = np.radians(HOME_DEG) + 0.1
        graph.spin_for(0.2)
        assert plc.run(f"c{number}").status == Code.LIMIT_EXCEEDED
        plc.q = np.radians(HOME_DEG)
        graph.spin_for(0.2)
        kind, name = ((Acknowledge, "acknowledge"), (Trigger, "acknowledge_trigger"))[number % 2]
        begin = time.monotonic()
        assert plc.call(kind, name).success
        took_s[name].append(time.monotonic() - begin)
    show(took_s)
    assert max(max(times) for times in took_s.values()) < PATIENCE_S


def show(took_s: dict[str, list[float]]) -> None:
    print(time.strftime("%Y-%m-%d %H:%M"), "load", os.getloadavg(), "cores", os.cpu_count())
    for name, times in took_s.items():
        ms = 1e3 * np.array(times)
        print(f"{name}: n {len(ms)}, median {np.median(ms):.1f} ms, longest {ms.max():.1f} ms")
