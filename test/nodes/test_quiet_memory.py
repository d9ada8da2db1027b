# SPDX-License-Identifier: Apache-2.0
"""Garbage is collected when it is told to be, and never in between."""

import gc
import sys
import weakref

import pytest

from robocal_ros.ros.base import QuietMemory


class Knot:
    """Garbage that only a collection finds."""

    def __init__(self) -> None:
        self.own = self


@pytest.fixture
def memory():
    quiet = QuietMemory()
    yield quiet
    quiet.end()


def test_garbage_waits_for_the_look(memory):
    knot = weakref.ref(Knot())
    kept = [[] for _ in range(10 * gc.get_threshold()[0])]  # enough for Python to collect
    assert knot() is not None, f"collected while {len(kept)} objects were made"
    memory.look()
    assert knot() is None


def test_what_was_kept_for_a_while_goes_too(memory):
    old = Knot()
    knot = weakref.ref(old)
    for _ in range(3):  # now it is of the oldest generation
        memory.look()
    del old
    memory.look()
    assert knot() is None


def test_what_the_start_made_is_not_looked_at(memory):
    assert gc.get_freeze_count() > 0
    assert not gc.isenabled()


def test_in_the_end_python_collects_again(memory):
    memory.end()
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


NODE = """
import gc
from robocal_ros.ros.base import HouseNode, run

class Counting(HouseNode):
    NAME = "counting"

    def activate(self):
        self.made = [[] for _ in range(100_000)]
        self.add_timer(0.01, self.tick, steady=True)

    def tick(self):
        print("frozen", gc.get_freeze_count(), gc.isenabled(), flush=True)

run(Counting)
"""


def test_no_node_looks_at_what_its_start_made(graph):
    """Nor one that collects as Python does."""
    node = graph.run("counting", [sys.executable, "-c", NODE])
    graph.spin_until(lambda: "frozen" in node.output, "it works")
    _, frozen, enabled = node.output[node.output.index("frozen") :].split("\n")[0].split()
    assert int(frozen) > 100_000
    assert enabled == "True"
