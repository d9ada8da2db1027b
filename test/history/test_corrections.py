# SPDX-License-Identifier: Apache-2.0
"""What commands were corrected with, in the robot's history."""

import contextlib
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from robocal_ros.history import history_file
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_file import history_path
from robocal_ros.history.history_records import CALIBRATED, NOMINAL, CorrectionRecord

SERIAL = "K7"
RECORD = CorrectionRecord(
    wall_ns=1_700_000_000_123_456_789,
    software="0.1.0",
    model_hash="abc",
    enabled=False,
    shadow=False,
    model_revision=0,
    tool_revision=0,
    reference=NOMINAL,
    reference_source="kr150_r3100",
    reference_name="KR 150",
    reference_hash="abc",
    taught_tool=(0.1, 0.2, 0.3, 0.0, 0.0, 0.6, 0.8),
)
OTHER = replace(
    RECORD,
    wall_ns=RECORD.wall_ns + 1,
    enabled=True,
    shadow=True,
    model_revision=3,
    tool_revision=2,
    reference=CALIBRATED,
    reference_source="/cells/7/cold.yaml",
    reference_hash="def",
)


def opened(folder: Path) -> CalibrationHistory:
    return CalibrationHistory.open(SERIAL, state_dir=folder)


def test_records_come_back_as_they_were_kept(tmp_path: Path) -> None:
    with opened(tmp_path) as history:
        assert history.corrections() == ()
        for record in (RECORD, OTHER):
            history.note_correction(record)
    with opened(tmp_path) as history:
        assert history.corrections() == (OTHER, RECORD)
        assert history.corrections(1) == (OTHER,)


def test_they_are_never_changed(tmp_path: Path) -> None:
    with opened(tmp_path) as history:
        history.note_correction(RECORD)
    with contextlib.closing(sqlite3.connect(history_path(SERIAL, tmp_path))) as raw:
        for change in ("UPDATE corrections SET enabled = 1", "DELETE FROM corrections"):
            with pytest.raises(sqlite3.IntegrityError, match="never changed"):
                raw.execute(change)


def test_an_older_history_is_brought_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(history_file, "MIGRATIONS", history_file.MIGRATIONS[:1])
        patch.setattr(history_file, "SCHEMA_VERSION", 1)
        opened(tmp_path).close()
    with opened(tmp_path) as history:
        history.note_correction(RECORD)
        assert history.corrections() == (RECORD,)


WRITER = """
import sys
from dataclasses import replace
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_corrections import RECORD, opened
with opened(Path(sys.argv[1])) as history:
    for number in range(100_000):
        history.note_correction(replace(RECORD, wall_ns=number))
        print(number, flush=True)
"""


def test_a_killed_writer_leaves_whole_records_only(tmp_path: Path) -> None:
    """Each that was said to be kept is there, at most one more, and none in part."""
    begun = 0
    for pause_s in (0.0, 0.003, 0.011):
        process = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(tmp_path), str(Path(__file__).parent)],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(pause_s)
        process.kill()
        said = 1 + len([line for line in process.stdout.read().split("\n")[:-1] if line])
        process.wait()
        with opened(tmp_path) as history:
            found = history.corrections(100_000)
        kept = [record.wall_ns for record in reversed(found)][begun:]
        begun = len(found)
        assert kept == list(range(len(kept)))
        assert said <= len(kept) <= said + 1
        assert all(replace(record, wall_ns=RECORD.wall_ns) == RECORD for record in found)
