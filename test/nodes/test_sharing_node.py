# SPDX-License-Identifier: Apache-2.0
"""sharing_node over DDS: two PLCs want the gap; one has it, whatever dies."""

from types import SimpleNamespace

import pytest
from robocal_msgs.msg import GapOpen, MaintenanceStatus
from std_msgs.msg import String

from robocal_ros.maintenance.sharing_node import SharingNode
from robocal_ros.ros import endpoints

NAMES = ("left", "right")
LEASE_S = 2.0
EVERY_S = 0.1
HELD = 5  # steps: a gap is closed half a second after it was renewed


@pytest.fixture
def cells(graph):
    """Two robots and their PLCs: ``want`` and ``out`` say what each tells; None: nothing."""
    node = graph.add(SharingNode, {"lease_s": LEASE_S})
    gaps = {
        name: graph.collect(GapOpen, f"/{name}/gap_open", endpoints.HEARTBEAT) for name in NAMES
    }
    wanted, status = (
        {name: graph.publisher(kind, f"/{name}/{topic}", profile) for name in NAMES}
        for kind, topic, profile in (
            (GapOpen, "gap_wanted", endpoints.HEARTBEAT),
            (MaintenanceStatus, "maintenance_node/status", endpoints.LATCHED),
        )
    )
    holder = graph.collect(String, "/sharing_node/holder", endpoints.LATCHED)
    told = SimpleNamespace(want=dict.fromkeys(NAMES, False), out=dict.fromkeys(NAMES, True))
    beat = iter(range(1, 1_000_000))
    renewed = {name: -HELD for name in NAMES}  # the step in which its gap was last told to be open

    def step():
        """All that is told within a tenth of a second; never are both gaps open."""
        now = next(beat)
        count = {name: len(gaps[name]) for name in NAMES}
        for name in NAMES:
            if told.out[name] is not None:
                out = told.out[name]
                state = MaintenanceStatus.IDLE if out else MaintenanceStatus.RUNNING
                status[name].publish(MaintenanceStatus(state=state, at_home=out))
            if told.want[name] is not None:
                wanted[name].publish(GapOpen(open=told.want[name], echo=now))
        graph.spin_for(EVERY_S)
        for name in NAMES:
            if any(message.open for message in gaps[name][count[name] :]):
                renewed[name] = now
        assert not all(now - step < HELD for step in renewed.values())

    def until(condition):
        for _ in range(200):
            step()
            if condition():
                return
        pytest.fail("not within 20 s")

    def has():
        return holder[-1].data if holder else None

    return SimpleNamespace(told=told, until=until, step=step, has=has, gaps=gaps, node=node)


def test_one_has_the_gap_and_the_other_the_next(cells):
    told = cells.told
    cells.until(lambda: cells.has() == "")
    told.want["left"] = told.want["right"] = True
    cells.until(lambda: cells.has() in NAMES and cells.gaps[cells.has()][-1].open)
    first = cells.has()
    other = NAMES[1 - NAMES.index(first)]
    told.out[first] = False
    for _ in range(8):
        cells.step()
    assert cells.has() == first
    assert not cells.gaps[other][-1].open
    told.want[first] = False
    for _ in range(8):
        cells.step()
    assert cells.has() == first, "it is not out yet"
    assert f"{other} waits: {first}" in cells.node.health().message
    told.out[first] = True
    cells.until(lambda: cells.has() == other and cells.gaps[other][-1].open)


def test_a_holder_that_dies_loses_it(cells):
    told = cells.told
    told.want["left"] = True
    cells.until(lambda: cells.has() == "left")
    told.out["left"] = False
    cells.step()
    told.out["left"] = told.want["left"] = None
    told.want["right"] = True
    cells.until(lambda: cells.has() == "right" and cells.gaps["right"][-1].open)
    count = len(cells.gaps["left"])
    cells.step()
    assert len(cells.gaps["left"]) == count, "nothing is renewed that nobody renewed"


def test_what_is_passed_on_is_as_it_came(cells):
    cells.told.want["right"] = True
    cells.until(lambda: cells.has() == "right" and cells.gaps["right"][-1].open)
    echoes = [message.echo for message in cells.gaps["right"]]
    assert echoes == sorted(set(echoes)), "each beat once, in its order"


def test_where_two_tell_of_one_robot_it_is_not_out(graph, cells):
    """One that says so would give the place away in which the robot works."""
    told, gaps = cells.told, cells.gaps["left"]
    told.want["left"] = True
    cells.until(lambda: cells.has() == "left" and gaps[-1].open)
    told.out["left"], told.want["right"] = False, True
    topic = "/left/maintenance_node/status"
    second = graph.publisher(MaintenanceStatus, topic, endpoints.LATCHED)
    cells.until(lambda: not gaps[-1].open)
    told.want["left"] = False
    for _ in range(8):
        second.publish(MaintenanceStatus(state=MaintenanceStatus.IDLE, at_home=True))
        cells.step()
        assert cells.has() == "left"
    assert f"{topic} has 2 publishers" in cells.node.health().message
    graph.probe.destroy_publisher(second)
    told.out["left"] = True
    cells.until(lambda: cells.has() == "right")


def test_of_two_plcs_that_ask_for_one_robot_none_has_it(graph, cells):
    told, gaps = cells.told, cells.gaps["left"]
    told.want["left"] = True
    cells.until(lambda: cells.has() == "left" and gaps[-1].open)
    second = graph.publisher(GapOpen, "/left/gap_wanted", endpoints.HEARTBEAT)
    cells.until(lambda: not gaps[-1].open)
    count = len(gaps)
    for _ in range(8):
        cells.step()
    assert len(gaps) > count
    assert not any(message.open for message in gaps[count:])
    assert "/left/gap_wanted has 2 publishers" in cells.node.health().message
    graph.probe.destroy_publisher(second)
    cells.until(lambda: cells.has() == "left" and gaps[-1].open)
