# SPDX-License-Identifier: Apache-2.0
"""The whole demo: a PLC drives a cell of processes by OPC UA, and its page shows it."""

import csv
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from domains import free_domain
from robocal_msgs.msg import MaintenanceStatus

from bench.live.cell import SERIAL, TRUTH
from bench.live.graph import CellController, LiveError
from bench.live.lines import Answer, Look
from bench.live.plc import Gap, Plc
from bench.processes import ENDS_WITH_PARENT
from bench.soak_shift import _add_gaps
from bench.tables import Table
from robocal_ros.bags.bags import BagReader
from robocal_ros.cell_sim.trajectory_controller import ROOM
from robocal_ros.ground.errors import Code

pytestmark = pytest.mark.cell

ROOT = Path(__file__).parent.parent.parent
ANSWERED_S = 0.5  # what a PLC waits for the answer of a call (docs/plc.md)
LONGEST_S = 1800.0  # where nothing else runs: some 140 s
WITHIN_MM = 0.3  # what docs/simulation.md calls recovered
BENT_MM = 2.0
NOISE_MM = 0.05  # rms of a robot that repeats to some hundredths, and of what it was measured with


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> tuple[str, dict, Path]:
    """What the demo printed, what it told of its story, and its folder.

    A computer that is busy for half a second closes a gap in mid-measurement, as it must: the demo
    has it seen to, and gives it again.
    """
    out = tmp_path_factory.mktemp("demo")
    done = played(out)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout, json.loads((out / "story.json").read_text()), out


def played(out: Path) -> subprocess.CompletedProcess[str]:
    command = sys.executable, str(ROOT / "bags" / "demo.py")
    with free_domain() as domain:
        return subprocess.run(
            [*ENDS_WITH_PARENT, *command, "--out", str(out), "--no-open"],
            env=os.environ | {"ROS_DOMAIN_ID": str(domain), "COLUMNS": "120"},
            capture_output=True,
            text=True,
            timeout=LONGEST_S,
            check=False,
        )


def test_the_shift_goes_as_it_should(demo):
    printed, story, _ = demo
    drifted, corrected, bent, recovered = story["moments"]
    # The correction takes more away than measuring it again could explain.
    assert corrected["with_mm"] < drifted["with_mm"] - NOISE_MM
    # The bend is seen across its direction and added to what was there.
    assert abs(bent["with_mm"] - BENT_MM) < 2.0 * WITHIN_MM
    assert recovered["with_mm"] < WITHIN_MM
    assert recovered["without_mm"] > BENT_MM - 2.0 * WITHIN_MM
    for moment in story["moments"]:
        assert f"{moment['with_mm']:.3f}" in printed
    assert "simulated" in printed
    # Whether it is met is judged where nothing else runs: `bench.demo`.
    assert re.search(r"^\d+ s \(goal 180 s( MISSED)?\), 8 nodes", printed, re.MULTILINE)


def test_the_gaps_are_kept_and_used(demo):
    _, story, _ = demo
    first, second = story["gaps"]
    for gap in (first, second):
        assert gap["broken_off"] or gap["used_s"] <= gap["length_s"]
        assert (gap["code"], gap["complete"]) == (Code.ACCEPT.name, True)
    assert first["thermal_codes"][0] == Code.ACCEPT.name
    assert (first["tool_found_code"], second["tool_found_code"]) == ("ACCEPT", "LIMIT_EXCEEDED")
    assert second["tool_code"] == Code.ACCEPT.name
    assert first["accepted"]
    assert second["accepted"]


def test_the_line_reads_what_is_known(demo):
    """Nothing measured yet; then right; the collision is not known before the next gap."""
    _, story, _ = demo
    states = [moment["state"] for moment in story["moments"]]
    assert states[0] == "EXPIRED"
    assert states[1:] == ["OK", "OK", "OK"]


def test_the_drives_take_all_that_they_are_sent(demo):
    _, story, out = demo
    (bag,) = sorted((out / "recordings").glob("robocal_*"))
    with BagReader(bag) as reader:
        *_, last = (json.loads(m.message.data) for m in reader.messages([TRUTH]))
    assert last["drive_faults"] == 0, last
    assert last["peak_speed_share"] > 0.9  # the programme is near what the drives reach
    # A stop of a computer that is starved comes late, and steps back: judged where none is.
    if not any(gap["broken_off"] for gap in story["gaps"]):
        assert last["peak_speed_share"] < 1.0 + ROOM


def test_the_recording_gives_the_live_results_again(demo):
    _, story, out = demo
    report = json.loads((out / "report" / "report.json").read_text())
    (bag,) = report["bags"]
    assert bag["simulated"]
    kinds = {session["kind"]: session for session in bag["sessions"]}
    assert set(kinds) == {"thermal", "tool"}
    for session in kinds.values():
        assert session["as_recorded"]
        assert session["differs"] == []
        assert not any("broke off" in words for words in session["warnings"])
    cycles = kinds["thermal"]["cycles"]
    assert [cycle["verdict"]["code"] for cycle in cycles] == [
        code for gap in story["gaps"] for code in gap["thermal_codes"]
    ]
    page = (out / "report" / "report.html").read_text()
    assert "bit for bit" in page
    assert "simulated" in page
    rows = list(csv.DictReader((out / "report" / "decisions.csv").open()))
    runs = sum(1 + len(gap["broken_off"]) for gap in story["gaps"])
    assert sum(row["command"] == "run_maintenance" for row in rows) == runs


def test_the_plc_spoke_opc_ua_alone(demo):
    """The bridge's log names who called, and nobody else has published the gap."""
    printed, story, out = demo
    assert "its gaps go by OPC UA alone" in printed
    log = (out / "plc_bridge_node.log").read_text()
    runs = sum(1 + len(gap["broken_off"]) for gap in story["gaps"])
    assert log.count("plc called Run: ") >= runs
    assert log.count("ada called Acknowledge: ") >= printed.count("acknowledges the fault")
    assert len(story["called_s"]) >= runs
    assert max(story["called_s"]) <= ANSWERED_S


def test_the_page_shows_what_the_line_reads(demo):
    """As fetched by HTTP at the end: the last gap, its result in force, nothing that waits."""
    printed, story, _ = demo
    page, gap = story["page"], story["gaps"][-1]
    assert re.search(
        r"the page for the people at the line: http://127\.0\.0\.1:\d+$", printed, re.M
    )
    assert page["headline"] == story["moments"][-1]["state"] == "OK"
    assert (page["serial"], page["at_home"], page["waiting"]) == (SERIAL, True, [])
    assert page["cycle_id"] == gap["gap"] + "+" * len(gap["broken_off"])
    assert [page["last"][name] for name in ("code", "complete")] == ["ACCEPT", True]
    assert page["steps"]
    accepted = {number for of in story["gaps"] for number in of["accepted"]}
    assert accepted <= set(page["shift"]["accepted"])
    if not gap["broken_off"]:
        assert page["last"]["tool_found_code"] == "LIMIT_EXCEEDED"
        assert page["tasks"][0]["key"] == "LIMIT_EXCEEDED/tool mended"


class ScriptedLine:
    """A line whose cycle ends in the fault that is given, and then as planned."""

    def __init__(self, fault: str) -> None:
        self.is_open, self.fault, self.ran, self.acknowledged = False, fault, [], 0

    def run(self, cycle_id: str, gap_s: float) -> Answer:
        self.ran.append(cycle_id)
        return Answer(True, Code.ACCEPT, "begins")

    def acknowledge(self) -> Answer:
        self.fault, self.acknowledged = "", self.acknowledged + 1
        return Answer(True, Code.ACCEPT, "")

    def look(self) -> Look:
        code = Code.LIMIT_EXCEEDED if self.fault else Code.ACCEPT
        last = SimpleNamespace(
            cycle_id=self.ran[-1], code=code, message=self.fault, complete=not self.fault
        )
        now = {"doing": "", "at_home": True, "fault": self.fault, "last": last}
        state = MaintenanceStatus.FAULT if self.fault else MaintenanceStatus.IDLE
        return Look(SimpleNamespace(state=state, **now), None)


@pytest.mark.parametrize("fault", ["robot is not at home", "gap_open is silent for more than 1 s"])
def test_only_a_gap_that_closed_by_its_own_rule_is_given_again(fault, graph, monkeypatch):
    """Any other fault waits for a person, as at a PLC's program: it ends the demo, in one line."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(graph.domain))
    controller, line = CellController(), ScriptedLine(fault)
    plc = Plc(controller, line, print)
    monkeypatch.setattr(plc, "_see_to_it", line.acknowledge)  # no robot stands here
    try:
        if fault.startswith("gap_open"):
            assert plc.gap("gap", 60.0).result.complete
            assert (line.ran, line.acknowledged) == (["gap", "gap+"], 1)
        else:
            with pytest.raises(LiveError) as ended:
                plc.gap("gap", 60.0)
            assert str(ended.value).startswith("gap: FAULT LIMIT_EXCEEDED: robot is not at home; ")
            assert "\n" not in str(ended.value)
            assert (line.ran, line.acknowledged, line.is_open) == (["gap"], 0, False)
    finally:
        controller.close()


def test_the_live_shift_counts_what_came_of_every_try_of_a_gap():
    broken, ended, whole = (
        SimpleNamespace(accepted=numbers, code=Code.ACCEPT, complete=numbers != [1])
        for numbers in ([1], [2, 3], [4])
    )
    gaps = [Gap("gap-1", 120.0, 110.0, (broken, ended)), Gap("gap-2", 120.0, 60.0, (whole,))]
    table = Table("soak", "", ("what", "value", "goal"))
    _add_gaps(table, gaps)
    told = {what: value for what, value, _ in table.rows}
    assert told["gaps that left something over"] == 1
    assert told["came into force"] == 4
    assert not table.met
