# SPDX-License-Identifier: Apache-2.0
"""A whole cell by OPC UA alone; its bridge is killed while its robot stands or moves.

The robot stops by the gap's rules, nothing is lost, and the bridge that is started again says what
is true.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asyncua import ua
from long_form import more
from maintenance_live import HOME_DEG, SERIAL, LiveCell
from other_stack import gap_by_another_stack
from robocal_msgs.msg import MaintenanceStatus
from test_maintenance_calls import proposed
from test_plc_bridge import refused

from bench.live.opc_ua import PlcClient, free_port, security_folder
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.plc.cell import CONTEST_S

pytestmark = pytest.mark.cell
GAP_S = 150.0
ANSWERED_MS = 500.0  # what a PLC waits for the answer of a call (docs/plc.md)
TRIES = 3  # of a cycle that a busy machine breaks off
# A way to the beams, then the first circle: so many motions of a cycle have begun.
ON_ITS_WAY, MEASURES = 1, 2
# What the bridge shows, by what maintenance_node says.
TRUE = {
    "Maintenance.State": lambda s: s.state,
    "Maintenance.Fault": lambda s: s.fault,
    "Maintenance.AtHome": lambda s: s.at_home,
    "Maintenance.Disarmed": lambda s: s.disarmed,
    "LastCycle.CycleId": lambda s: s.last.cycle_id,
    "LastCycle.Code": lambda s: s.last.code,
    "LastCycle.ToolCode": lambda s: s.last.tool_code,
    "LastCycle.Run": lambda s: s.last.run,
    "LastCycle.ToolId": lambda s: s.last.tool_id,
    "LastCycle.Left": lambda s: list(s.last.left),
    "Candidates.ThermalId": lambda s: s.thermal_pending,
    "Candidates.ToolId": lambda s: s.tool_pending,
    "Candidates.FixtureId": lambda s: s.fixture_pending,
}


class KilledBridge:
    """The cell, its bridge, a PLC and an engineer's panel."""

    def __init__(self, graph: Any, folder: Path) -> None:
        self.graph, self.do, self.cell = graph, graph.meanwhile, LiveCell(graph, folder)
        self.cell._stop_beats()
        graph.probe.destroy_publisher(self.cell.gap)  # the bridge's PLC alone gives the gap
        certificates, port = security_folder(folder / "plc"), free_port()
        self.settings = {"security_dir": str(certificates), "host": "127.0.0.1", "port": port}
        self.plc = PlcClient(certificates, port)
        self.ada = PlcClient(certificates, port, "ada", "panel")
        graph.at_close += [self.plc.close, self.ada.close]
        self.plc.start(self.plc.program())
        self.start()

    @property
    def status(self) -> MaintenanceStatus:
        return self.cell.status

    def start(self) -> None:
        """Start the bridge; its clients come back, as PLCs do."""
        self.bridge = self.graph.start("plc_bridge_node", self.settings, mortal=True)
        self.comes_back()

    def comes_back(self) -> None:
        """Its clients begin sessions anew."""
        for client in (self.plc, self.ada):
            self.do(client, client.connect_once_there())

    def call(self, method: str, *arguments: Any, client: PlcClient | None = None) -> list[Any]:
        plc = client or self.plc
        return list(self.do(plc, plc.call(method, *arguments)))

    def opens(self) -> None:
        self.plc.beating = self.plc.is_open = True
        self.graph.spin_until(lambda: not self.status.doing, "the gap is open")

    def ended(self, cycle: str) -> bool:
        return self.status.last.cycle_id == cycle and self.status.last.code != Code.NONE

    def begins(self, name: str, motions: int) -> str:
        """A cycle's id, once so many of its motions have begun, as what is said then has it."""
        for again in range(TRIES):
            before, cycle = len(self.cell.goals), f"{name}{'+' * again}"
            self.graph.spin_until(lambda c=cycle: self.call("Run", c, GAP_S)[0], "it begins")
            self.graph.spin_until(
                lambda n=before, c=cycle: (
                    (len(self.cell.goals) >= n + motions and not self.cell.at_home())
                    or self.ended(c)
                ),
                "a motion",
            )
            said = len(self.cell.statuses)
            self.graph.spin_until(lambda n=said: len(self.cell.statuses) > n, "how it is by now")
            if not self.ended(cycle):
                return cycle
            self.made_good()
        raise AssertionError(self.status)

    def made_good(self) -> None:
        """A person drives the robot home, an engineer acknowledges, and decides on what waits."""
        if waiting := self.status.tool_pending:  # while one waits no tool is measured
            self.call("Reject", waiting, "it is measured anew", client=self.ada)
            self.graph.spin_until(lambda: not self.status.tool_pending, "nothing waits")
        if self.status.state == MaintenanceStatus.FAULT:
            self.graph.spin_until(lambda: self.cell.stands(0.5), "the robot rests")
            self.cell.drive_between(self.cell.q, np.radians(HOME_DEG))
            self.graph.spin_until(self.cell.at_home, "at home")
            self.graph.spin_until(self._acknowledged, "the fault ends")
        self.opens()

    def _acknowledged(self) -> bool:
        try:
            return bool(self.call("Acknowledge", client=self.ada)[0])
        except ua.uaerrors.BadTimeout:  # call again
            return False

    def says_the_truth(self) -> None:
        """What is shown is what maintenance_node says, which may go on meanwhile."""

        def agrees() -> bool:
            shown = self.do(self.plc, self.plc.read_all([*TRUE]))
            return bool(shown == [read(self.status) for read in TRUE.values()])

        self.graph.spin_until(agrees, "the bridge says so too")

    def killed(self, moves: bool) -> None:
        """Kill it; the gap closes by its own rule, and what moves stops."""
        sent = len(self.cell.goals)
        self.plc.beating = False  # this PLC's next heartbeat is of a person's will
        self.bridge.kill()
        if moves:
            self.graph.spin_until(lambda: len(self.cell.goals) > sent, "the stop", within_s=1.5)
        self.graph.spin_until(lambda: self.cell.stands(1.0), "it stands", within_s=4.0)
        self.graph.spin_until(lambda: self.status.doing, "the gap is closed", 5.0)
        stood = len(self.cell.goals)
        self.graph.spin_for(1.0)
        assert len(self.cell.goals) == stood
        assert stood == sent or moves


@pytest.fixture(scope="module")
def cell(
    next_graph: Callable[[], Any], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[KilledBridge]:
    with pytest.MonkeyPatch.context() as patch:
        graph = next_graph()
        patch.setenv("ROBOCAL_STATE", str(graph.state))
        yield KilledBridge(graph, tmp_path_factory.mktemp("cell"))


@pytest.fixture
def line(cell: KilledBridge) -> KilledBridge:
    """Its robot at home, its bridge alive, its gap open, however the test before has ended."""
    if cell.bridge.process.poll() is not None:
        cell.start()
    cell.made_good()
    return cell


def test_a_whole_gap_by_another_stack(line: KilledBridge, tmp_path: Path) -> None:
    """It gives the gap, calls, and follows the robot that moves; asyncua's PLC is silent."""
    for again in range(TRIES):
        line.plc.beating = False
        line.graph.spin_until(lambda: line.status.doing, "the gap is closed", 5.0)
        line.graph.spin_for(CONTEST_S)
        sent, cycle = len(line.cell.goals), f"other{'+' * again}"
        folder, port = line.plc.folder, line.plc.port
        seen = gap_by_another_stack(line.graph, folder, port, tmp_path, cycle, GAP_S)
        if seen["lastCode"] == Code.ACCEPT and len(line.cell.goals) >= sent + MEASURES:
            break
        line.comes_back()
        line.made_good()
    assert seen["run"][:3] == ["Good", True, Code.ACCEPT]
    assert (seen["lastCode"], seen["status"][:2]) == (Code.ACCEPT, ["Good", True])
    assert max(seen["calledMs"]) <= ANSWERED_MS
    assert len(line.cell.goals) >= sent + MEASURES
    assert line.cell.at_home()
    assert (line.status.last.cycle_id, line.status.last.tool_code) == (cycle, Code.ACCEPT)


@pytest.mark.parametrize("is_open", [True, *more(False)])
def test_killed_while_the_robot_stands_nothing_moves(line: KilledBridge, is_open: bool) -> None:
    line.plc.is_open = is_open
    if not is_open:
        line.graph.spin_until(lambda: line.status.doing, "the gap is closed")
    line.killed(moves=False)
    line.start()
    line.says_the_truth()
    assert line.status.doing  # nobody has opened it since
    assert (line.status.state, line.status.at_home) == (MaintenanceStatus.IDLE, True)
    assert line.call("Run", "closed", GAP_S)[:2] == [False, Code.CONFLICT]


@pytest.mark.long
def test_killed_while_a_cycle_is_broken_off_the_robot_stops_or_is_at_home(
    line: KilledBridge,
) -> None:
    busy = (MaintenanceStatus.RUNNING, MaintenanceStatus.BREAKING_OFF)
    for again in range(TRIES):
        cycle = line.begins(f"cancelled {again}", MEASURES)
        if line.call("Cancel")[0]:
            line.graph.spin_until(lambda: line.status.state != busy[0], "it is broken off")
            if line.status.state == busy[1] and not line.cell.at_home():
                break
        # A busy machine has broken it off before, or has let it come home meanwhile.
        line.graph.spin_until(lambda c=cycle: line.ended(c), "it has ended")
        line.made_good()
    line.killed(moves=True)
    line.graph.spin_until(lambda: line.status.state not in busy, "it is over", 5.0)
    status = line.status
    assert status.at_home or status.state == MaintenanceStatus.FAULT
    assert (status.last.cycle_id, status.last.code) == (cycle, Code.CONFLICT)
    line.start()
    line.says_the_truth()


@pytest.mark.parametrize("motions", [MEASURES, *more(ON_ITS_WAY)])
def test_killed_while_the_robot_moves_it_stops_and_a_person_looks(
    line: KilledBridge, motions: int
) -> None:
    cycle = line.begins(f"killed {motions}", motions)
    line.killed(moves=True)
    line.graph.spin_until(lambda: line.status.state == MaintenanceStatus.FAULT, "it is over", 5.0)
    status = line.status
    assert status.disarmed
    assert (status.last.cycle_id, status.last.code) == (cycle, Code.CONFLICT)
    line.start()
    line.says_the_truth()
    runs = line.status.last.run
    if not status.at_home:
        away = line.call("Acknowledge", client=line.ada)
        assert away[:2] == [False, Code.LIMIT_EXCEEDED]
        assert "robot is not at home: " in away[2]
    assert refused(lambda: line.call("Acknowledge")) == "BadUserAccessDenied"
    line.killed(moves=False)  # and in the fault: it is there still
    line.start()
    line.says_the_truth()
    assert (line.status.state, line.status.fault) == (status.state, status.fault)
    line.made_good()
    again = line.call("Run", cycle, GAP_S)  # a cycle that has ended is not run again
    assert again[:2] == [True, Code.ACCEPT]
    assert again[4] == Code.CONFLICT
    assert line.status.last.run == runs


@pytest.mark.long
def test_killed_while_a_decision_waits_it_waits_on(line: KilledBridge) -> None:
    model_hash, state = line.cell.arm.model_hash, line.graph.state
    with CalibrationHistory.open(SERIAL, model_hash=model_hash, state_dir=state) as history:
        waits = proposed(history, 0)
    line.graph.spin_until(lambda: line.status.thermal_pending == waits, "it waits")
    line.killed(moves=False)
    line.start()
    line.says_the_truth()
    assert line.do(line.plc, line.plc.read("Candidates.ThermalId")) == waits
    taken = line.call("Accept", waits, "seen", client=line.ada)
    assert taken[:2] == [True, Code.ACCEPT], taken
    with CalibrationHistory.open(SERIAL, model_hash=model_hash, state_dir=state) as history:
        (last,) = history.decisions(newest=1)
    assert (last.calibration_id, last.by, last.reason) == (waits, "ada", "seen")
