# SPDX-License-Identifier: Apache-2.0
"""What starts nodes may be killed at any time: none of them goes on without it, or is cut short."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from domains import free_domain
from long_form import more

from bench.live.graph import Executable

ROOT = Path(__file__).parent.parent.parent
WITHIN_S = 10.0
FOLDERS = f"import sys; sys.path[:0] = {[str(ROOT / f) for f in ('', 'test/nodes', 'test/worlds')]}"
BENCH = f"""
{FOLDERS}
import time
from pathlib import Path
from bench.live.graph import Executable
node = Executable("cell_sim_node", {{}}, {{}}, Path(sys.argv[1]))
print(node.pid, flush=True)
time.sleep(600)
"""


def of_tests(forked: bool) -> str:
    return f"""
{FOLDERS}
import os, time
from conftest import EXECUTABLES, Executable
command = [str(EXECUTABLES / "cell_sim_node")]
node = Executable("cell_sim_node", command, dict(os.environ), forked={forked})
print(node.process.pid, flush=True)
time.sleep(600)
"""


SCRIPTS = {"bench": BENCH, "tests": of_tests(forked=False), "forked": of_tests(forked=True)}


# What a recorder does: it takes a moment to write the end of its file.
SLOW = f"""#!{sys.executable}
import signal, time
asked = []
signal.signal(signal.SIGINT, lambda *_: asked.append(1))
print("is there", flush=True)
while not asked:
    time.sleep(0.01)
print("ends", flush=True)
time.sleep(0.3)
print("asked", len(asked))
"""


def test_a_node_is_asked_to_end_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At a second signal a node ends at once, and a recording would lack its end."""
    program = tmp_path / "slow"
    program.write_text(SLOW)
    program.chmod(0o755)
    monkeypatch.setattr("bench.live.graph.EXECUTABLES", tmp_path)
    node = Executable("slow", {}, {}, tmp_path)

    def waits_for(words: str) -> None:
        deadline = time.monotonic() + WITHIN_S
        while words not in node.log.read_text() and time.monotonic() < deadline:
            time.sleep(0.01)

    waits_for("is there")
    node.ask_to_end()
    waits_for("ends")
    node.stop()
    assert node.log.read_text().splitlines() == ["is there", "ends", "asked 1"]


def lives(pid: int) -> bool:
    """Whether a process is there and has not ended; an ended one may wait for its heir."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize("by", [signal.SIGKILL, *more(signal.SIGTERM)])
@pytest.mark.parametrize("script", SCRIPTS.values(), ids=SCRIPTS)
def test_a_node_ends_with_what_started_it(script: str, by: signal.Signals, tmp_path: Path) -> None:
    with free_domain() as domain:
        starter = subprocess.Popen(
            [sys.executable, "-c", script, str(tmp_path)],
            env=os.environ | {"ROS_DOMAIN_ID": str(domain), "ROBOCAL_STATE": str(tmp_path)},
            stdout=subprocess.PIPE,
            text=True,
        )
        assert starter.stdout is not None
        node = int(starter.stdout.readline())
        time.sleep(0.5)  # it is a node by then, or on its way to one
        assert lives(node)
        starter.send_signal(by)
        starter.wait()
        deadline = time.monotonic() + WITHIN_S
        try:
            while lives(node) and time.monotonic() < deadline:
                time.sleep(0.05)
            assert not lives(node)
        finally:
            if lives(node):
                os.kill(node, signal.SIGKILL)
