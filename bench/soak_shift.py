# SPDX-License-Identifier: Apache-2.0
"""A live shift at real time: a cell's nodes as processes over DDS, driven by a PLC over OPC UA.

``tools/with_ros python -m bench.soak_shift --seconds 900`` for a look; an hour is the default.
With ``--keep`` it writes docs/figures/soak_shift.md too. The cell is the demo's, simulated.
"""

import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.live.cell import set_fault
from bench.live.graph import CellController
from bench.live.plc import GAP_S, Gap, Judge, Judged, Plc
from bench.live.running import live_cell, validate
from bench.processes import resident_mb
from bench.soaking import soak_main
from bench.tables import Goal, Table

COLLISION_MM = 2.0
EVERY_S = 300.0  # from the begin of a gap to the next one's
LEAST_S = 3.0 * EVERY_S
WARM = 2  # gaps until caches are full
MOST_GROWTH_MB = 10.0
LEAST_WITHIN = 0.95  # of the coordinates of the error, within 0.1 mm
RIGHT_AGAIN = 2  # gaps after a collision
LONGEST_CALL_S = 0.5  # docs/plc.md


@dataclass(frozen=True)
class Pass:
    """What a pass of the programme was worth; whether what was found in gaps was to make it right.

    That is after the first gap, and after a collision from `RIGHT_AGAIN` gaps on.
    """

    judged: Judged
    in_force: bool


class LiveShift:
    """Production and gaps by turns; at half time a collision bends the tool."""

    def __init__(self, controller: CellController, plc: Plc) -> None:
        self._controller, self._plc, self._judge = controller, plc, Judge(controller)
        self.passes: list[Pass] = []
        self.gaps: list[Gap] = []
        self.memory_mb: list[dict[str, float]] = []
        self.called_s: list[float] = []
        self._bent = False
        self._right_from = 1  # so many gaps on

    def run(self, seconds: float) -> None:
        """All of it."""
        begin_s = time.monotonic()
        for gap_s in np.arange(EVERY_S, seconds + 1.0, EVERY_S):
            self._work_until(begin_s + gap_s, begin_s + 0.5 * seconds)
            name = f"gap-{len(self.gaps) + 1}"
            self.gaps.append(self._plc.gap(name, GAP_S))
            pids = self._controller.pids
            self.memory_mb.append({node: resident_mb(pid) for node, pid in pids.items()})
        self._produce(bends=False)
        self.called_s = self._plc.called_s()

    def _work_until(self, end_s: float, bends_s: float) -> None:
        while time.monotonic() < end_s:
            self._produce(bends=not self._bent and time.monotonic() >= bends_s)

    def _produce(self, bends: bool) -> None:
        if bends:
            self._bent, self._right_from = True, len(self.gaps) + RIGHT_AGAIN
        self._plc.produce(halfway=self._bend if bends else None)
        self.passes.append(Pass(self._judge.now(), len(self.gaps) >= self._right_from))

    def _bend(self) -> None:
        set_fault(self._controller.call, "collision", COLLISION_MM)


def soak(seconds: float) -> Table:
    """Let the cell live, replay what was recorded, and judge both.

    A recording that is replayed otherwise than live is kept, with its report.

    Raises
    ------
    ValueError
        When it is too short for a gap before the collision, and two after it.
    """
    if seconds < LEAST_S:
        raise ValueError(f"{seconds:g} s are too short: {LEAST_S:g} s or more")
    folder = Path(tempfile.mkdtemp(prefix="soak_shift-"))
    kept = False
    try:
        recordings = folder / "recordings"
        with live_cell(folder, recordings, print) as (controller, plc):
            shift = LiveShift(controller, plc)
            shift.run(seconds)
        report = json.loads(
            validate(recordings, folder / "report").with_suffix(".json").read_text()
        )
        for words in (differing := _differing(report)):
            print(f"replayed otherwise than live: {words}; kept in {folder}")
        kept = bool(differing)
        return _judged(shift, report, seconds)
    finally:
        if not kept:
            shutil.rmtree(folder)


def _differing(report: dict[str, Any]) -> list[str]:
    """Each recorded session that is replayed otherwise than live, with what differs."""
    return [
        f"{session['node']}: {'; '.join(session['differs']) or 'not replayed as recorded'}"
        for bag in report["bags"]
        for session in bag["sessions"]
        if session["differs"] or not session["as_recorded"]
    ]


def _judged(shift: LiveShift, report: dict[str, Any], seconds: float) -> Table:
    table = Table(
        "soak_shift",
        f"A live shift of {seconds:.0f} s, a gap every {EVERY_S:g} s, a collision of "
        f"{COLLISION_MM:g} mm at half time; simulated",
        ("what", "value", "goal"),
        "Errors: of the tool at the visited working poses, true, rms of a pass. Passes in force: "
        f"after the first gap, those from the collision to the {RIGHT_AGAIN}nd gap after it left "
        f"out. Memory: resident, from after gap {WARM} on. Load of the machine in the last minute: "
        f"{os.getloadavg()[0]:.2f}; {os.cpu_count()} CPUs.",
    )
    _add_errors(table, shift)
    _add_gaps(table, shift.gaps)
    called_s = shift.called_s
    table.add("calls of the PLC, by OPC UA", len(called_s), None)
    table.add("the longest took, s", max(called_s), Goal(max(called_s), LONGEST_CALL_S))
    sessions = [session for bag in report["bags"] for session in bag["sessions"]]
    differ = len(_differing(report))
    table.add("recorded sessions, replayed", len(sessions), None)
    table.add("of them otherwise than live", differ, Goal(differ, 0))
    first, last = shift.memory_mb[min(WARM, len(shift.memory_mb)) - 1], shift.memory_mb[-1]
    for node, memory_mb in last.items():
        grew = memory_mb - first[node]
        table.add(f"memory of {node} grew, MB", grew, Goal(grew, MOST_GROWTH_MB))
    return table


def _add_errors(table: Table, shift: LiveShift) -> None:
    judged = [one.judged for one in shift.passes if one.in_force]
    table.add("passes of the programme", len(shift.passes), None)
    table.add("of them in force", len(judged), None)
    for what, values in (
        ("as taught", [one.without_mm for one in judged]),
        ("corrected", [one.with_mm for one in judged]),
    ):
        table.add(f"error {what}, median, mm", float(np.median(values)), None)
        table.add(f"error {what}, worst pass, mm", float(np.max(values)), None)
    within = float(np.mean([one.within for one in judged]))
    table.add("λ(0.1 mm) of the passes in force", within, Goal(within, LEAST_WITHIN, at_least=True))


def _add_gaps(table: Table, gaps: Sequence[Gap]) -> None:
    used = max(gap.used_s / gap.length_s for gap in gaps)
    again = sum(len(gap.results) > 1 for gap in gaps)
    table.add("gaps", len(gaps), None)
    table.add("longest use of a gap, of its length", used, Goal(used, 1.0))
    table.add("gaps that left something over", again, Goal(again, 0))
    accepted = sum(len(result.accepted) for gap in gaps for result in gap.results)
    table.add("came into force", accepted, None)


def main(arguments: Sequence[str] | None = None) -> int:
    """1 when a goal is missed."""
    return soak_main("soak_shift", soak, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
