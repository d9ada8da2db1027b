# SPDX-License-Identifier: Apache-2.0
"""What several tests of the tool begin with."""

import pytest
from tool_driver import TAUGHT, Driver, config_of, noisy_cell

from robocal_ros.cell_sim.beams import RoundTool
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.tool.session import ToolSession

RADIUS_M = 2.5e-3


@pytest.fixture
def driver(tmp_path):
    """The healthy tool was measured."""
    cell = noisy_cell()
    with CalibrationHistory.open("K1", state_dir=tmp_path) as history:
        made = Driver(
            ToolSession(cell.arm, history, config_of(cell), "test"),
            cell,
            RoundTool.cylinder(TAUGHT, RADIUS_M),
        )
        assert made.measure("reference").done
        made.history = history
        yield made
