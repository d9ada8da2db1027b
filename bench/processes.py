# SPDX-License-Identifier: Apache-2.0
"""What the system knows of a process."""

import os
from contextlib import suppress
from pathlib import Path

ENDS_WITH_PARENT = ("setpriv", "--pdeathsig", "TERM", "--")
"""Before a command: the system asks it to end once the thread that started it is gone, however that
ended. A node that outlived its test or bench would go on talking to those that come after."""


def resident_mb(pid: int) -> float:
    """Resident memory, MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def hand_nice_on(pid: int) -> None:
    """Give a process in a session of its own this one's nice value, where the user may.

    Linux shares cores out by session where autogroup is on (sched(7)): nice then counts within a
    session only, and `nice make demo` would say nothing to nodes that have one each.
    """
    with suppress(OSError):
        nice = os.getpriority(os.PRIO_PROCESS, 0)
        Path(f"/proc/{pid}/autogroup").write_text(str(nice), encoding="ascii")
