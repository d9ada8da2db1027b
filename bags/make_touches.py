# SPDX-License-Identifier: Apache-2.0
"""Make the golden bag of a touched tool: ``python bags/make_touches.py``, ``touches.mcap``.

Simulated: a UR10 that repeats to 0.03 mm touches one point with a bent tool's tip from eight
postures; a touch in motion is refused, and the tool that follows is accepted. Topics as those of
``make_tool_runs``.
"""

import tempfile
from pathlib import Path

import numpy as np
from make_tool_runs import BENT, BY, EVENTS, Recorder

from bench.measured_runs import touching
from robocal_ros.bags.bags import BagWriter
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.session import events

BAG = Path(__file__).with_name("touches.mcap")
COUNT, SCATTER_M = 8, 3e-5


def record(path: Path) -> None:
    """Make the bag."""
    with (
        tempfile.TemporaryDirectory() as folder,
        CalibrationHistory.open("SIM-UR10-3", state_dir=Path(folder)) as history,
        BagWriter(path, latched=[EVENTS]) as bag,
    ):
        cell = Recorder(bag, history)
        cell.truth(BENT)
        program = cell.program
        arm, near = program.cell.arm, program.cell.q_near
        rng = np.random.default_rng(3)
        for q in touching(arm, BENT, near, COUNT, scatter_m=SCATTER_M, rng=rng):
            program.q = q
            cell.rest(0.1)
            cell.command(events.TOUCH, by=BY)  # it has just come: refused
            cell.rest(0.4)
            cell.command(events.TOUCH, by=BY)
        solved = cell.command(events.SOLVE_TOUCHES, by=BY)
        cell.command(events.ACCEPT, id=solved.calibration_id, by=BY, reason="its verdict")
        print(solved.message)


def main() -> None:
    """Write the bag beside this script."""
    record(BAG)
    print(f"{BAG.name}: {BAG.stat().st_size / 1e6:.2f} MB, simulated")


if __name__ == "__main__":
    main()
