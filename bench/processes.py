# SPDX-License-Identifier: Apache-2.0
"""What the system knows of a process."""

import os
from pathlib import Path

ENDS_WITH_PARENT = ("setpriv", "--pdeathsig", "TERM", "--")
"""Before a command: the system asks it to end once the thread that started it is gone, however that
ended. A node that outlived its test or bench would go on talking to those that come after."""


def resident_mb(pid: int) -> float:
    """Resident memory, MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
