# SPDX-License-Identifier: Apache-2.0
"""Make the golden bag of a laser frame: ``python bags/make_laser_frame.py``, ``laser_frame.mcap``.

Simulated: the UR10 of ``make_tool_runs`` carries a mandrel, whose place and radius are certified,
through its beam station, three times: when the station is commissioned, in a gap, and after
somebody has knocked the station by 0.5 mm. Topics as there; ``/truth/station``: what happened.
"""

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from make_tool_runs import EVENTS, RADIUS_M, TAUGHT, Recorder

from robocal_ros.bags.bags import BagWriter
from robocal_ros.cell_sim.beams import RoundTool, bent
from robocal_ros.history.calibrations import CalibrationHistory

BAG = Path(__file__).with_name("laser_frame.mcap")
MANDREL = bent(TAUGHT, [-0.02, 0.01, -0.01], [0.0, 0.01, 0.0])
KNOCK = np.array([3e-4, -2e-4, 3.5e-4])  # in base, m


def record(path: Path) -> None:
    """Make the bag."""
    with (
        tempfile.TemporaryDirectory() as folder,
        CalibrationHistory.open("SIM-UR10-2", state_dir=Path(folder)) as history,
        BagWriter(path, latched=[EVENTS]) as bag,
    ):
        cell = Recorder(bag, history, MANDREL)
        program = cell.program
        program.tool = RoundTool.cylinder(MANDREL, RADIUS_M)
        cell.run("laser", "commissioning")
        cell.run("laser", "gap-1")
        station = program.cell.station
        beams = tuple(replace(b, start=b.start + KNOCK, end=b.end + KNOCK) for b in station.beams)
        program.cell.station = replace(station, beams=beams)
        told = {"simulated": True, "knocked_m": KNOCK.tolist()}
        at = program.ns(program.now_s)
        bag.write("/truth/station", "std_msgs/msg/String", {"data": json.dumps(told)}, at)
        cell.run("laser", "gap-2")


def main() -> None:
    """Write the bag beside this script."""
    record(BAG)
    print(f"{BAG.name}: {BAG.stat().st_size / 1e6:.2f} MB, simulated")


if __name__ == "__main__":
    main()
