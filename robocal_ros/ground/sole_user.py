"""A part of a cell that one process at a time may play for a robot."""

import fcntl
import os
import time
from pathlib import Path

from robocal_ros.ground.errors import ConflictError, StorageError
from robocal_ros.ground.files import made_folder_beside

_POLL_S = 0.01


class SoleUser:
    """Holds ``<serial>/users/<name>`` beside a history; the system lets go of it with the process.

    Two robots that keep one history would bring each other's calibrations into force.

    Parameters
    ----------
    name : the part, as the executable is called.
    timeout_s : longest wait for one that is just ending.

    Raises
    ------
    ConflictError
        Another process holds it.
    StorageError
        The file cannot be made.
    """

    def __init__(self, history: Path, name: str, serial: str, timeout_s: float) -> None:
        path = made_folder_beside(history, "users") / name
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise StorageError(f"{path} cannot be made: {error}") from error
        try:
            self._wait_for(name, serial, history, timeout_s)
        except OSError as error:
            self.close()
            raise StorageError(
                f"{path} cannot be locked: {error}: keep histories on a local disk, not on NFS"
            ) from error
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, f"{os.getpid()}\n".encode(), 0)

    def _wait_for(self, name: str, serial: str, history: Path, timeout_s: float) -> None:
        deadline = time.monotonic() + timeout_s
        while not self._held():
            if time.monotonic() > deadline:
                other = os.pread(self._file, 20, 0).decode(errors="replace").strip()
                self.close()
                raise ConflictError(
                    f"another {name} (process {other or 'unknown'}) keeps the calibrations of "
                    f"robot '{serial}' in {history}: end it, or give each robot its own serial"
                )
            time.sleep(_POLL_S)

    def _held(self) -> bool:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Let go of it; idempotent."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1
