# SPDX-License-Identifier: Apache-2.0
"""One process at a time plays a part for a robot, and a killed one holds nothing."""

import subprocess
import sys
import time

import pytest

from robocal_ros.ground.errors import ConflictError, StorageError
from robocal_ros.history.calibrations import CalibrationHistory

HOLD = """
import sys, time
from pathlib import Path
from robocal_ros.history.calibrations import CalibrationHistory
CalibrationHistory.open("K7", state_dir=Path(sys.argv[1]), sole_user="thermal_node")
print("held", flush=True)
time.sleep(60.0)
"""


def opened(folder, serial="K7", name="thermal_node", within_s=0.2):
    return CalibrationHistory.open(
        serial, state_dir=folder, sole_user=name, busy_timeout_s=within_s
    )


def test_a_second_process_is_refused_until_the_first_is_gone(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        try:
            assert other.stdout.readline() == "held\n"
            with pytest.raises(ConflictError, match=rf"thermal_node \(process {other.pid}\).*'K7'"):
                opened(tmp_path)
            opened(tmp_path, serial="K8").close()
            opened(tmp_path, name="maintenance_node").close()
            CalibrationHistory.open("K7", state_dir=tmp_path).close()  # a reader plays no part
        finally:
            other.kill()
    opened(tmp_path).close()


def test_one_that_ends_meanwhile_is_waited_for(tmp_path):
    first = opened(tmp_path)
    begin = time.monotonic()
    with pytest.raises(ConflictError):
        opened(tmp_path, within_s=0.3)
    assert time.monotonic() - begin >= 0.3
    first.close()
    first.close()
    opened(tmp_path, within_s=0.0).close()


def test_a_history_that_cannot_be_opened_is_not_held(tmp_path):
    (tmp_path / "K7.sqlite").mkdir()
    with pytest.raises(StorageError):
        opened(tmp_path)
    (tmp_path / "K7.sqlite").rmdir()
    opened(tmp_path, within_s=0.0).close()
