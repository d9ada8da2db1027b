import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # for the helper modules beside the tests

from robocal_ros.history.calibrations import CalibrationHistory


@pytest.fixture
def history(tmp_path):
    with CalibrationHistory.open("K1", state_dir=tmp_path) as opened:
        yield opened
