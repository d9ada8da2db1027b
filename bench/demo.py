# SPDX-License-Identifier: Apache-2.0
"""How long `make demo` takes once it is set up, beside its goal; all in it is simulated.

It needs ROS, and runs in the venv of the nodes. The demo itself only says so where it took longer:
on a machine that has other work too that is no error.
"""

import os
import subprocess
import tempfile
import time
from collections.abc import Sequence

from bench.startup import EXECUTABLES, ROOT
from bench.tables import Goal, Table

GOAL_S = 180.0


def tables() -> Sequence[Table]:
    """All tables of this module; none where no nodes are installed."""
    if EXECUTABLES.is_dir():
        return [demo_table(taken_s())]
    print("no nodes in install/ (run `make setup`): the demo is left out")
    return []


def taken_s() -> float:
    """Seconds from the start of a demo to the end of its report."""
    with tempfile.TemporaryDirectory() as folder:
        demo = ("python", "bags/demo.py", "--out", folder, "--no-open")
        begin_s = time.monotonic()
        subprocess.run(
            [str(ROOT / "tools" / "with_ros"), *demo],
            cwd=ROOT,
            env=os.environ | {"ROS_DOMAIN_ID": str(1 + os.getpid() % 100)},
            capture_output=True,
            text=True,
            check=True,
        )
        return time.monotonic() - begin_s


def demo_table(seconds: float) -> Table:
    """Its time and its goal."""
    table = Table(
        "demo",
        "The demo, from its start to its report",
        ("what", "took, s", "goal"),
        "Once, set up before: the cell's nodes and its PLC as processes, in real time, and the "
        "recording replayed.",
    )
    table.add("make demo", seconds, Goal(seconds, GOAL_S))
    return table
