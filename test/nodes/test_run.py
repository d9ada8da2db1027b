# SPDX-License-Identifier: Apache-2.0
"""A node as a process of its own: how it starts and how it ends."""

import signal
from pathlib import Path
from typing import Any

import pytest
from std_srvs.srv import Trigger

SCRIPT = """
import contextlib
import sys
import time
from pathlib import Path
from std_srvs.srv import Trigger
from robocal_ros.ros.base import HouseNode
from robocal_ros.ros.base import run

def participant():
    found = []
    for name in Path("/proc/self/task").glob("*/comm"):
        with contextlib.suppress(OSError):
            found.append(name.read_text().strip())
    # the watchdog is of the process, not of a participant
    return [name for name in found if name.startswith("dds") and "wdog" not in name]

class Sleeper(HouseNode):
    NAME = "sleeper"
    def configure(self):
        self.add_service(Trigger, "~/ping", self.on_ping)
        self.add_service(Trigger, "~/break", self.on_break)
        self.add_service(Trigger, "~/break_unguarded", self.on_break_unguarded)
    def on_ping(self, request, response):
        response.success = True
        return response
    def on_break(self, request, response):
        self.add_timer(0.01, lambda: 1 / 0)
        return response
    def on_break_unguarded(self, request, response):
        self.create_timer(0.01, lambda: 1 / 0)
        return response
    def cleanup(self):
        print("released", flush=True)

run(Sleeper, events=EVENTS)
"""


@pytest.fixture(params=[False, True], ids=["plain executor", "events executor"])
def script(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "sleeper.py"
    path.write_text(SCRIPT.replace("EVENTS", str(request.param)))
    return path


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_ends_cleanly_at_a_signal(graph: Any, script: Path, by: signal.Signals) -> None:
    sleeper = graph.start(script)
    assert graph.call(Trigger, "/sleeper/ping").success
    assert sleeper.stop(by) == 0
    assert sleeper.output.count("released") == 1
    assert "Traceback" not in sleeper.output


END = "\nrun(Sleeper, events=EVENTS)\n"
END_THAT_TELLS = """
try:
    run(Sleeper, events=EVENTS)
finally:
    ends = time.monotonic() + 5.0  # a thread that has been joined is listed for a moment more
    while participant() and time.monotonic() < ends:
        time.sleep(0.01)
    print("after", *participant(), flush=True)
"""
HALF_A_NODE = """
    def __init__(self):
        super().__init__()
        print("before", *participant())
        1 / 0
"""


@pytest.mark.parametrize("whole", [True, False], ids=["whole", "failed half way"])
def test_what_dds_runs_has_ended_before_the_process_does(
    graph: Any, tmp_path: Path, whole: bool
) -> None:
    """Finding: C's exit took it down amid its running threads, by a SIGSEGV of one in a hundred."""
    path = tmp_path / "sleeper.py"
    text = SCRIPT.replace('print("released"', "print('before', *participant()); print('released'")
    if not whole:
        text = SCRIPT.replace("    def configure(", f"{HALF_A_NODE}    def configure(")
    for events in ("False", "True"):
        path.write_text(text.replace(END, END_THAT_TELLS).replace("EVENTS", events))
        sleeper = graph.start(path)
        if whole:
            assert graph.call(Trigger, "/sleeper/ping").success
            assert sleeper.stop() == 0
        else:
            assert sleeper.process.wait(60) == 1
            assert "ZeroDivisionError" in sleeper.output
        lines = [line.split() for line in sleeper.output.splitlines() if line]
        told = {words[0]: words[1:] for words in lines}
        assert told["before"]
        assert not told["after"]


def test_a_second_signal_ends_a_start_that_takes_long(graph: Any, tmp_path: Path) -> None:
    path = tmp_path / "sleeper.py"
    text = SCRIPT.replace("EVENTS", "True")
    starts = "print('starts', flush=True); time.sleep(600)"
    path.write_text(text.replace("def configure(self):", f"def configure(self):\n        {starts}"))
    sleeper = graph.start(path)
    graph.spin_until(lambda: "starts" in sleeper.output, "the start")
    sleeper.process.send_signal(signal.SIGINT)
    assert sleeper.stop(signal.SIGTERM) == 128 + signal.SIGTERM


def test_a_bug_in_a_timer_is_told_and_the_node_lives_on(graph: Any, script: Path) -> None:
    sleeper = graph.start(script)
    graph.call(Trigger, "/sleeper/break")
    graph.spin_until(lambda: "ZeroDivisionError" in sleeper.output, "the bug is logged")
    assert graph.call(Trigger, "/sleeper/ping").success
    assert sleeper.stop() == 0


def test_a_bug_that_nothing_catches_ends_the_process_and_says_where(
    graph: Any, script: Path
) -> None:
    sleeper = graph.start(script)
    client = graph.probe.create_client(Trigger, "/sleeper/break_unguarded")
    graph.spin_until(client.service_is_ready, "the service appears")
    client.call_async(Trigger.Request())
    graph.spin_until(lambda: sleeper.process.poll() is not None, "the process ends")
    assert sleeper.process.returncode == 1
    assert "ZeroDivisionError" in sleeper.output
    assert "released" in sleeper.output


def test_waits_for_a_better_parameter_when_one_is_bad(graph: Any, script: Path) -> None:
    sleeper = graph.start(script, {"serial": 5})
    graph.spin_until(lambda: "is not text" in sleeper.output, "the fault is logged")
    assert sleeper.stop() == 0
