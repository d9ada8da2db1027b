# SPDX-License-Identifier: Apache-2.0
"""Faults of the cell over DDS: switched on by parameter, one call of the PLC, the right code within
one cycle, and the robot at home or a fault that says why not. All is simulated.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from maintenance_live import LiveCell
from panel_faults import heard, wrongly_told
from panel_page import accuracy
from robocal_msgs.msg import MaintenanceStatus
from robocal_msgs.srv import GetMaintenance, RunMaintenanceCycle
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from bench.closed_loop.faults import RIGHT
from bench.live.cell import TRUTH, set_fault
from robocal_ros.cell_sim.faults import Fault
from robocal_ros.ground.errors import Code
from robocal_ros.panel.node import SOURCES
from robocal_ros.panel.state import ACCURACY, STATUS, PanelState, plain
from robocal_ros.ros import endpoints

pytestmark = pytest.mark.cell

GAP_S = 120.0  # a tool that is found bent is measured in the same gap
AHEAD_S = 2.0  # until stamps have passed those of a clock that was ahead
WITHIN_S = 45.0
ELSEWHERE = (Code.SENSOR_OR_ROBOT_MOVED, Code.ACCEPT)  # soak_knocks.py, test_fixture_cell.py
ALL = [fault for fault, code in RIGHT.items() if code not in ELSEWHERE]
# The collision is last: its candidate waits for a person.
MATRIX = sorted(ALL, key=lambda fault: fault == "collision")


class FaultCell:
    """A live cell whose healthy tool was measured."""

    def __init__(self, graph: Any, folder: Path) -> None:
        self.graph, self.cell = graph, LiveCell(graph, folder)
        self.misled: list[str] = []
        self.truths = graph.collect(String, TRUTH, endpoints.LATCHED)
        self.until(lambda: self.told("/tcf_node/arm", SetBool, data=True), "armed")
        for _ in range(3):  # one that a busy machine breaks off is asked for again
            self.until(lambda: self.told("/tcf_node/measure_reference_trigger"), "it measures")
            self.until(lambda: " NONE " not in self.result(), "the healthy tool is measured")
            self.cell.drive_home()
            if " ACCEPT " in self.result():
                break
            self.until(lambda: self.told("/tcf_node/arm", SetBool, data=True), "armed again")
        assert " ACCEPT " in self.result(), self.result()

    def result(self) -> str:
        return str(self.graph.call(Trigger, "/tcf_node/result_trigger").message)

    def told(self, name: str, kind: type = Trigger, **fields: Any) -> bool:
        return bool(self.graph.call(kind, name, **fields).success)

    def until(self, done: Callable[[], object], what: str) -> None:
        def asked() -> object:
            self.graph.spin_for(0.2)
            return done()

        self.graph.spin_until(asked, what, WITHIN_S)

    def status(self, cycle_id: str = "") -> Any:
        return self.graph.call(GetMaintenance, "/maintenance_node/status", cycle_id=cycle_id)

    def gap(self, name: str) -> Any:
        """One call of the PLC, asked for until it has ended."""
        for again in range(3):
            cycle_id = f"{name} {again}"
            begun = self.graph.call(
                RunMaintenanceCycle, "/maintenance_node/run", cycle_id=cycle_id, gap_s=GAP_S
            )
            assert begun.success, begun.message
            self.until(lambda c=cycle_id: self.status(c).result.code != Code.NONE, cycle_id)
            ended = self.status(cycle_id)
            if "gap_open echoes" not in ended.result.message:
                break  # else a busy machine held the PLC up: it gives another gap
        return ended

    def page(self, fault: Fault, state: MaintenanceStatus) -> str:
        """Why the page does not send a person to what has the fault; empty: it does."""
        panel = PanelState()
        said = {STATUS: plain(state, SOURCES[STATUS][2]), ACCURACY: accuracy("DEGRADED")}
        heard(panel, said, 0.0)
        return wrongly_told(fault, panel, 0.0)

    def tried(self, fault: Fault) -> tuple[Code, str]:
        """The code of one gap with a fault, of whoever must tell it, and how the gap ended."""
        set_fault(self.graph.call, fault)
        ended = self.gap(f"gap with {fault}")
        state, result = ended.state, ended.result
        code = Code(state.fault_code or result.tool_found_code)
        faulty = state.state == MaintenanceStatus.FAULT
        self.misled.append(self.page(fault, state))
        end = "fault" if faulty else "at home" * self.cell.at_home()
        set_fault(self.graph.call, "none")
        self.graph.spin_for(AHEAD_S)
        if faulty:
            self.cell.drive_home()
        print(f"{fault}: {code.name}, {end}: {result.message} {state.fault}")
        return code, end


@pytest.mark.long
def test_each_fault_has_its_code_within_one_cycle(graph: Any, tmp_path: Path) -> None:
    cell = FaultCell(graph, tmp_path)
    healthy = cell.gap("healthy")
    assert healthy.result.tool_code == Code.ACCEPT, healthy.result.message
    told = {fault: cell.tried(fault) for fault in MATRIX}
    graph.spin_until(lambda: cell.truths, "the truth")
    truth = json.loads(cell.truths[-1].data)
    assert truth["drive_faults"] == 0, truth
    assert 0.1 < truth["peak_speed_share"] < 1.0  # no stop threw the robot back
    wrong = {fault: said for fault, said in told.items() if said[0] is not RIGHT[fault]}
    assert not wrong
    assert all(end for _, end in told.values()), told
    assert not any(cell.misled), cell.misled
