# SPDX-License-Identifier: Apache-2.0
"""The cell from its commissioning to the complete recording, and what that recording gives."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from bench.live.cell import PARAMETERS, commission, wiring, write_settings
from bench.live.graph import CellController, LiveError
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
    controller, plc = CellController(), None
    try:
        files = PARAMETERS, folder / "cell.yaml"
        write_settings(made, recordings, files[1])
        for name, wires in wiring().items():
            controller.start(folder, name, {}, wires, files)
        plc = Plc(controller, tell)
        tell("waiting for six nodes, three hours of work later")
        plc.take_over()
        yield controller, plc
        controller.end_nodes()  # completes the recording
    finally:
        if plc is not None:
            plc.close()
        controller.close()


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
