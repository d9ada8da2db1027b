# SPDX-License-Identifier: Apache-2.0
"""Who may work in a shared place: one at a time, whatever dies, is cut off or restarts."""

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robocal_ros.maintenance.sharing import HEARTBEAT_S, SharedPlace

LEASE_S, STEP_S = 10.0, 0.1
LEAVES_S = 2.0  # it stops and goes home; below half the lease less HEARTBEAT_S
NAMES = ("left", "right")


def place(start_s=0.0):
    """Where both robots have told that they are out."""
    shared = SharedPlace(NAMES, LEASE_S, start_s)
    for name in NAMES:
        shared.tell(name, True, start_s + 1.0)
    return shared


def test_of_two_at_one_instant_one_gets_it():
    shared = place()
    assert [shared.want(name, True, 2.0) for name in ("right", "left")] == [True, False]
    shared = place()
    shared.want("left", False, 2.0)
    assert shared.holder(2.0) == ""


def test_the_one_that_waited_longest_is_next_and_only_when_the_other_is_out():
    shared = place()
    assert shared.want("right", True, 2.0)
    shared.tell("right", False, 2.1)
    assert not shared.want("left", True, 2.2)
    shared.want("right", False, 2.3)
    shared.tell("right", True, 2.4)  # may be of before its gap had closed
    assert not shared.want("left", True, 2.5)
    assert "right is not known to be out" in shared.why(2.5)
    shared.tell("right", True, 2.0 + HEARTBEAT_S + 0.1)
    assert shared.want("left", True, 2.7)


def test_who_dies_loses_it_when_the_lease_ends():
    shared = place()
    assert shared.want("left", True, 2.0)
    shared.tell("left", False, 2.1)  # and nothing more
    for k in range(200):
        now_s = 2.2 + k * STEP_S
        shared.tell("right", True, now_s)
        got = shared.want("right", True, now_s)
        assert got == (now_s > 2.1 + LEASE_S), now_s


def test_a_plc_whose_robot_does_not_answer_keeps_nothing():
    shared, opened = place(), []
    for k in range(150):
        now_s = 2.0 + k * STEP_S
        shared.tell("right", True, now_s)
        opened.append(shared.want("left", True, now_s))
    closed_s = 2.0 + STEP_S * opened.index(False)
    assert closed_s == pytest.approx(1.0 + 0.5 * LEASE_S, abs=2 * STEP_S)
    assert not any(opened[opened.index(False) :])
    assert shared.want("right", True, now_s)


def test_after_a_restart_nothing_is_given_before_all_have_spoken():
    shared = SharedPlace(NAMES, LEASE_S, 0.0)
    assert not shared.want("left", True, 1.0), "right may be in"
    shared.tell("right", False, 1.1)
    assert not shared.want("left", True, 1.2), "right is in"
    shared.tell("right", True, 1.3)
    assert shared.want("left", True, 1.4)


@dataclass
class Robot:
    """What a maintenance_node does with its gap, and when it is really in the place."""

    heard_s: float = -1e9  # of an open gap
    inside: bool = False
    leaves_s: float = 0.0
    alive: bool = True
    wants: bool = False
    hears: bool = True
    told: bool = True

    def step(self, now_s):
        is_open = self.alive and now_s - self.heard_s <= HEARTBEAT_S
        if is_open:
            self.inside, self.leaves_s = True, now_s + LEAVES_S
        elif not self.alive or now_s >= self.leaves_s:
            self.inside = False


EVENTS = st.lists(
    st.tuples(
        st.integers(1, 80),
        st.sampled_from(NAMES),
        st.sampled_from(["wants", "hears", "told", "dies", "restart"]),
    ),
    max_size=25,
)


@given(EVENTS)
def test_never_are_two_inside(events):
    """Heartbeats, cuts of either way, deaths and restarts of the arbiter at any time."""
    robots, shared = {name: Robot() for name in NAMES}, SharedPlace(NAMES, LEASE_S, 0.0)
    now_s = 0.0
    for steps, name, event in [*events, (300, "left", "none")]:
        one = robots[name]
        if event == "restart":
            shared = SharedPlace(NAMES, LEASE_S, now_s)
        elif event == "dies":
            one.alive = not one.alive
        elif event != "none":
            setattr(one, event, not getattr(one, event))
        for _ in range(steps):
            now_s += STEP_S
            for other, robot in robots.items():
                if robot.alive and robot.told:
                    shared.tell(other, not robot.inside, now_s)
                if shared.want(other, robot.wants, now_s) and robot.hears:
                    robot.heard_s = now_s
                robot.step(now_s)
            assert sum(robot.inside for robot in robots.values()) <= 1, now_s


def test_a_place_that_is_wanted_and_free_is_given():
    robots, shared, turns = {name: Robot(wants=True) for name in NAMES}, place(), []
    for k in range(3000):
        now_s = 2.0 + k * STEP_S
        for name, robot in robots.items():
            robot.wants = (k // 150) % 2 == NAMES.index(name)  # each 15 s in turn
            shared.tell(name, not robot.inside, now_s)
            if shared.want(name, robot.wants, now_s):
                robot.heard_s = now_s
            robot.step(now_s)
        turns.append(shared.holder(now_s))
    for name in NAMES:  # but for the way out of the other, and two steps
        lost_s = LEAVES_S + HEARTBEAT_S + 4 * STEP_S
        assert turns.count(name) * STEP_S > 150.0 - 10 * lost_s
