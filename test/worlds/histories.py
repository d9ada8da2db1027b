# SPDX-License-Identifier: Apache-2.0
"""Histories of calibrations, for their tests."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from forked import HANGS_S
from history_workers import SERIAL, proposal

from robocal_ros.history.calibrations import CalibrationHistory

BY = {"by": "Ada", "reason": "tested", "wall_ns": 1_700_000_002_000_000_000}


def reopened(history: CalibrationHistory, **options: Any) -> CalibrationHistory:
    return CalibrationHistory.open(history.serial, state_dir=history.path.parent, **options)


def in_process(work: str, *arguments: object) -> Any:
    """Run a worker in a process group of its own, which never outlives the test."""
    script = Path(__file__).with_name("history_workers.py")
    command = [sys.executable, str(script), work, *(str(a) for a in arguments)]
    root = str(Path(__file__).parents[2])
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": root},
    ) as process:
        try:
            out, _ = process.communicate(timeout=HANGS_S)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 0
    return json.loads(out)


def filled(folder: Path) -> Path:
    with CalibrationHistory.open(SERIAL, state_dir=folder) as history:
        for revision in range(5):
            history.accept(history.propose(proposal(based_on=revision)), **BY)
    return history.path
