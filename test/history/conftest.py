# SPDX-License-Identifier: Apache-2.0
from collections.abc import Iterator
from pathlib import Path

import pytest
from history_workers import SERIAL

from robocal_ros.history.calibrations import CalibrationHistory


@pytest.fixture
def history(tmp_path: Path) -> Iterator[CalibrationHistory]:
    with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as opened:
        yield opened
