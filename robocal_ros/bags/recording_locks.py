"""Who writes a recording: a lock on a file in its folder."""

import errno
import fcntl
import os
import socket
from pathlib import Path
from typing import TextIO

OPEN = "OPEN"  # of this name, locked by the process that writes it; gone with its end

# As file systems say that they know no locks (NFS without its lock daemon).
_NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL}


def hold_open(folder: Path) -> TextIO:
    """Say that this process writes a recording, as long as the file is open.

    Raises
    ------
    OSError
        When it cannot be said, or another process writes it.
    """
    file = (folder / OPEN).open("w", encoding="utf-8")
    try:
        file.write(f"{socket.gethostname()} {os.getpid()}\n")
        file.flush()
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            file.close()
            raise
    return file


def is_open(folder: Path) -> bool:
    """Whether a process writes it; one that a crash left behind is not.

    Where the disk knows no locks, one of another host counts as open, and one of this host as long
    as there is a process of its number.
    """
    try:
        with (folder / OPEN).open("r+", encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                return error.errno not in _NO_LOCKS or _writer_lives(file.read())
    except FileNotFoundError:
        return False
    except OSError:  # it cannot be told: a read-only disk, another user's
        return True
    return False


def _writer_lives(text: str) -> bool:
    host, _, process = text.strip().rpartition(" ")
    if host != socket.gethostname() or not process.isdigit():
        return True
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
