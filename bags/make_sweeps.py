# SPDX-License-Identifier: Apache-2.0
"""Make the golden bag of a swept tool: ``python bags/make_sweeps.py`` writes ``sweeps.mcap``.

Simulated: the UR10 of ``make_tool_runs``, beside whose crossed beams two parallel ones stand,
sweeps a bent tool through these: straight, turned, twice upright as the session says, and a plunge.
The first sweep loses an edge, is refused and driven again; the tool is accepted. Topics as there;
the gears, which err there, do not in these sweeps.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from make_tool_runs import BENT, BY, EVENTS, RADIUS_M, SEED, START_NS, TAUGHT, Recorder

from bench.measured_runs import Sample
from bench.parallel_sweeps import STATION, STRAIGHT, SweepProgram, plunge_at, upright_of
from robocal_ros.bags.bags import BagWriter
from robocal_ros.cell_sim.beams import RoundTool
from robocal_ros.ground.frames import Array
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.session import events
from robocal_ros.tool.edges import PARALLEL
from robocal_ros.tool.touch_points import PLUNGE

BAG = Path(__file__).with_name("sweeps.mcap")


def record(path: Path) -> None:
    """Make the bag."""
    with (
        tempfile.TemporaryDirectory() as folder,
        CalibrationHistory.open("SIM-UR10-4", state_dir=Path(folder)) as history,
        BagWriter(path, latched=[EVENTS]) as bag,
    ):
        cell = Recorder(bag, history, parallel=replace(STATION, names=PARALLEL))
        bent, rng = RoundTool.cylinder(BENT, RADIUS_M), np.random.default_rng(SEED)
        program = SweepProgram(cell.program.cell, bent, rng, START_NS)
        cell.program = program
        cell.truth(BENT)

        def swept(R: Array, name: str, x_m: float | None = None, lost: str = "") -> str:
            samples: list[Sample] = program.sweep(R, TAUGHT[:3, 3], name, x_m)
            first = next((s for s in samples if getattr(s, "beam", None) == lost), None)
            cell.give([s for s in samples if s is not first])
            taken = cell.command(events.SWEEP)
            print(f"{name}: {taken.status.name} {taken.message}")
            return taken.message

        swept(STRAIGHT["straight"], "straight", lost="down")
        for name in ("straight", "turned"):
            told = swept(STRAIGHT[name], name)
        for name, R in upright_of(told).items():
            told = swept(R, name)
        swept(R, PLUNGE, plunge_at(told))
        solved = cell.command(events.SOLVE_SWEEPS, by=BY)
        cell.command(events.ACCEPT, id=solved.calibration_id, by=BY, reason="its verdict")
        print(solved.message)


def main() -> None:
    """Write the bag beside this script."""
    record(BAG)
    print(f"{BAG.name}: {BAG.stat().st_size / 1e6:.2f} MB, simulated")


if __name__ == "__main__":
    main()
