# SPDX-License-Identifier: Apache-2.0
"""The cell from its commissioning to the complete recording, and what that recording gives."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from bench.live.cell import PARAMETERS, commission, wiring, write_settings
from bench.live.graph import CellController, LiveError
from bench.live.lines import Line, OpcUaLine, RosLine
from bench.live.plc import Plc
from bench.startup import ROOT

VALIDATED_WITHIN_S = 120.0


@contextmanager
def live_cell(
    folder: Path, recordings: Path, tell: Callable[[str], None]
) -> Iterator[tuple[CellController, Plc]]:
    """Commission the cell and start its nodes; at the end the recording is complete.

    Raises
    ------
    LiveError
        When it cannot go on.
    RobocalError
        When the cell cannot be commissioned.
    """
    tell("commissioning the cold cell, in one process")
    made = commission(folder)
    controller = CellController()
    line: Line | None = None
    try:
        files = PARAMETERS, folder / "cell.yaml"
        write_settings(made, recordings, files[1])
        for name, wires in wiring().items():
            controller.start(folder, name, {}, wires, files)
        line = _line(controller, folder, tell)
        plc = Plc(controller, line, tell)
        tell(f"waiting for {len(controller.pids)} nodes, three hours of work later")
        plc.take_over()
        yield controller, plc
        controller.end_nodes()  # completes the recording
    finally:
        if line is not None:
            line.close()
        controller.close()


def _line(controller: CellController, folder: Path, tell: Callable[[str], None]) -> Line:
    """The PLC's way to the cell: by OPC UA, where its library is installed."""
    try:
        line = OpcUaLine(controller, folder / "plc")
    except ImportError as error:
        tell(f"{error}, which robocal_ros[plc] brings: the PLC calls by ROS, not by OPC UA")
        return RosLine(controller)
    controller.start(folder, "plc_bridge_node", line.parameters)
    tell("the PLC: certificates and users are made, its gaps go by OPC UA alone")
    return line


def validate(recordings: Path, report: Path) -> Path:
    """The page of ``robocal validate`` of what was recorded.

    Raises
    ------
    LiveError
        When there is no recording, or it cannot be validated.
    """
    bags = sorted(recordings.glob("robocal_*"))
    if not bags:
        raise LiveError(f"nothing was recorded in {recordings}")
    command = [sys.executable, "-m", "robocal_ros.cli.main", "validate", *map(str, bags)]
    done = subprocess.run(
        [*command, "--report", str(report)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=VALIDATED_WITHIN_S,
        check=False,
    )
    if done.returncode != 0:
        raise LiveError(f"the recording cannot be validated:\n{done.stdout}{done.stderr}")
    return report / "report.html"
