# SPDX-License-Identifier: Apache-2.0
"""Processes forked from one that has read the code: each saves a second and more of a core."""

import ctypes
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from multiprocessing import forkserver, get_context
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any
from unittest.mock import patch

PR_SET_PDEATHSIG = 1
HANGS_S = 900.0  # a process that only waits for busy cores has ended before


@cache
def forks() -> ForkServerContext:
    """Of the process that has read the code; it ends with this one."""
    forkserver.set_forkserver_preload(["read_ahead"])
    given = ("ROBOCAL_STATE", "COLUMNS")  # by whoever runs the tests
    plain = {name: value for name, value in os.environ.items() if name not in given}
    here = Path(__file__).parent
    path = f"{here}:{here.parents[1]}:{plain.get('PYTHONPATH', '')}"
    with patch.dict(os.environ, plain | {"PYTHONPATH": path}, clear=True):
        forkserver.ensure_running()
    return get_context("forkserver")


def become(environment: Mapping[str, str], folder: Path, outputs: Sequence[Path]) -> None:
    """Take over environment, folder, and files for standard output and error."""
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    for number, file in enumerate(outputs, 1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)


def _as_script(words: list[str], environment: Mapping[str, str], folder: Path, log: Path) -> None:
    # What it holds of this would keep the process that it is forked from, its parent, alive.
    os.close(forkserver._forkserver._forkserver_alive_fd)
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    become(environment, folder, [log, log])
    sys.stdout.reconfigure(line_buffering=True)
    sys.argv = words
    status: Any = 0
    try:
        runpy.run_path(words[0], run_name="__main__")
    except SystemExit as ended:
        status = ended.code or 0
    sys.stdout.flush()
    # With C's part of an exit, which a fork omits, a DDS participant tells others that it leaves.
    ctypes.CDLL(None).exit(status)


class ForkedScript:
    """A Python script as a process, with what is used of `subprocess.Popen`.

    It is asked to end once this process is gone, however that ended.
    """

    def __init__(self, words: Sequence[str], environment: Mapping[str, str], log: Path) -> None:
        given = (list(words), dict(environment), Path.cwd(), log)
        self._process = forks().Process(target=_as_script, args=given, daemon=True)
        self._process.start()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid or 0

    @property
    def returncode(self) -> int | None:
        """Its status; negative: the signal that ended it. None while it runs."""
        return self._process.exitcode

    def poll(self) -> int | None:
        """Its status; None while it runs."""
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        """Its status, once it has ended.

        Raises `subprocess.TimeoutExpired`.
        """
        self._process.join(timeout)
        if (status := self._process.exitcode) is None:
            raise subprocess.TimeoutExpired([str(self.pid)], timeout or 0.0)
        return status

    def send_signal(self, by: int) -> None:
        """Send a signal, where it still runs."""
        if self.poll() is None:
            os.kill(self.pid, by)

    def kill(self) -> None:
        """End it as a power cut would."""
        self.send_signal(signal.SIGKILL)
