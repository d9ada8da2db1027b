# SPDX-License-Identifier: Apache-2.0
"""Measured tools of the joint correction: which are taken over, and when."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from correction_robot import HOME, NAMES, NOMINAL, REST, ROUNDING, Robot, bent_tool, refused, still

from robocal_ros.correction.interface import (
    JointCommand,
    Reason,
    TrajectoryCommand,
    offered_tool,
)
from robocal_ros.history.history_records import Past


def waiting(robot: Robot) -> int | None:
    return robot.session.status().waiting_tool


@pytest.fixture
def robot() -> Robot:
    """Enabled, and it has been sent something."""
    robot = Robot()
    robot.session.enable(True)
    robot.stream()
    return robot


def test_a_tool_waits_while_a_stream_is_under_way(robot: Robot) -> None:
    tool = bent_tool()
    robot.session.offer_tool(tool)
    for _ in range(100):
        assert np.array_equal(robot.stream(), HOME)
        robot.session.look(robot.now, 0)
    assert waiting(robot) == tool.revision
    assert robot.session.status().tool_revision is None
    robot.rest()
    assert waiting(robot) is None
    assert robot.session.status().tool_revision == tool.revision
    first = robot.stream()
    assert np.abs(robot.settle() - first).max() > 1e-3


def test_before_anything_was_commanded_it_is_known_at_once() -> None:
    robot = Robot()
    tool = bent_tool()
    robot.session.offer_tool(tool)
    assert robot.session.status().tool_revision == tool.revision


def test_it_waits_for_a_robot_that_stands(robot: Robot) -> None:
    robot.session.offer_tool(bent_tool())
    for i in range(1, 21):  # a stream that stopped, an arm that still creeps
        robot.now += 0.05
        robot.read(HOME + 2.0 * np.radians(0.02) * i)
        robot.session.look(robot.now, 0)
        assert waiting(robot) is not None
    robot.at = HOME + 2.0 * np.radians(0.02) * 20
    robot.rest()
    assert waiting(robot) is None


def test_after_a_pause_it_waits_for_a_robot_that_stands(robot: Robot) -> None:
    """It was commanded before: whether it still moves is not known."""
    robot.now += 60.0
    robot.session.resume(robot.now, 0)
    robot.session.offer_tool(bent_tool())
    assert waiting(robot) is not None
    robot.rest()
    assert waiting(robot) is None


def test_a_gripper_does_not_tell_that_the_arm_stands() -> None:
    """Of its own driver; the arm's readings pause while it moves."""
    robot = Robot(joint_state_age_s=1.0)
    for i in range(20):
        robot.now += 0.01
        robot.read(HOME + 0.01 * i)
    for _ in range(40):
        robot.now += 0.01
        robot.session.reading(JointCommand(("gripper",), np.zeros(1)), robot.now)
    assert not robot.session.robot.stands(np.arange(6), robot.now)
    at = HOME + 0.01 * 19
    refused(Reason.START_MISMATCH, robot.session.target, JointCommand(NAMES, at), robot.now)


def test_without_joint_states_nobody_knows_whether_it_stands(robot: Robot) -> None:
    robot.session.offer_tool(bent_tool())
    robot.now += 10.0
    robot.session.look(robot.now, 0)
    assert waiting(robot) is not None
    robot.read(HOME)
    robot.session.look(robot.now, 0)
    assert waiting(robot) is None  # where it was ten seconds ago, too


def test_a_trajectory_keeps_its_tool_and_the_next_one_takes_the_new_one(robot: Robot) -> None:
    robot.rest()
    robot.session.trajectory(still(), robot.now)
    tool = bent_tool()
    robot.session.offer_tool(tool)
    for _ in range(3):
        robot.now += 0.3
        assert np.array_equal(robot.read(HOME).position, HOME)
        robot.session.look(robot.now, 0)
    assert waiting(robot) == tool.revision
    out = robot.session.trajectory(still(first_s=0.1), robot.now)
    assert waiting(robot) is None
    steps = np.abs(np.diff(out.position, axis=0)).max(axis=1)
    assert 0.0 < steps.max() <= REST * 0.5 + ROUNDING


def test_a_trajectory_that_is_refused_takes_no_tool_over(robot: Robot) -> None:
    robot.session.offer_tool(bent_tool())
    nowhere = TrajectoryCommand(NAMES, np.full((2, 6), np.nan), np.array([0.0, 1.0]))
    refused(Reason.NOT_FINITE, robot.session.trajectory, nowhere, robot.now)
    assert waiting(robot) is not None
    for _ in range(50):
        assert np.array_equal(robot.stream(), HOME)


def test_rolled_back_it_is_the_taught_tool(robot: Robot) -> None:
    robot.change_tool(bent_tool())
    assert np.abs(robot.settle() - HOME).max() > 1e-3
    robot.change_tool(bent_tool(T_flange_tool=None))
    assert not robot.session.status().new_tool
    assert np.array_equal(robot.settle(), HOME)


def test_only_accepted_tools_of_this_robot(robot: Robot) -> None:
    for changes, reason in (
        ({"accepted": False}, Reason.NOT_ACCEPTED),
        ({"robot": "UR10"}, Reason.WRONG_ROBOT),
        ({"serial": "s2"}, Reason.WRONG_ROBOT),
        ({"model_hash": "0123456789abcdef"}, Reason.WRONG_ROBOT),
        ({"serial": "s2", "T_flange_tool": None}, Reason.WRONG_ROBOT),
    ):
        refused(reason, robot.session.offer_tool, bent_tool(**changes))
    assert waiting(robot) is None


def test_an_older_tool_waits_for_a_newer_stamp_or_the_operator(robot: Robot) -> None:
    robot.change_tool(bent_tool(revision=5, stamp_ns=10))
    robot.change_tool(bent_tool(revision=5, stamp_ns=11))  # another one: the history began again
    assert "take_over" in refused(
        Reason.OLD_REVISION, robot.session.offer_tool, bent_tool(1e-3, revision=4, stamp_ns=11)
    )
    robot.rest()
    assert robot.session.status().tool_revision == 5
    robot.session.take_over()
    assert waiting(robot) == 4
    robot.rest()
    assert robot.session.status().tool_revision == 4


def test_a_tool_that_was_rolled_back_stays_so_where_its_message_is_repeated(robot: Robot) -> None:
    """Also to none; what is in force by then was measured before it."""
    withdrawn = bent_tool(revision=5, stamp_ns=200)
    robot.change_tool(withdrawn)
    robot.change_tool(bent_tool(1e-3, revision=6, stamp_ns=100))
    refused(Reason.OLD_REVISION, robot.session.offer_tool, withdrawn)
    robot.change_tool(bent_tool(revision=7, T_flange_tool=None))
    refused(Reason.OLD_REVISION, robot.session.offer_tool, withdrawn)
    assert not robot.session.status().new_tool


def test_a_tool_that_was_rolled_back_before_the_session_stays_so(robot: Robot) -> None:
    robot.session.know_past(Past(), Past(7, 200))
    for _ in range(2):  # as the first one, and after the one in force
        refused(Reason.OLD_REVISION, robot.session.offer_tool, bent_tool(revision=5, stamp_ns=200))
        robot.change_tool(bent_tool(revision=7, T_flange_tool=None))
    assert not robot.session.status().new_tool


def test_that_a_tool_says_nothing_of_the_mounted_one_is_news(robot: Robot) -> None:
    """tcf_node says so of the same revision, once another tool is taught; and takes it back."""
    robot.change_tool(bent_tool(revision=5, stamp_ns=10))
    robot.change_tool(bent_tool(revision=5, stamp_ns=10, T_flange_tool=None))
    status = robot.session.status()
    assert (status.new_tool, status.tool_revision) == (False, 0)  # not the one in force
    assert np.array_equal(robot.settle(), HOME)
    robot.change_tool(bent_tool(revision=5, stamp_ns=10))
    assert np.abs(robot.settle() - HOME).max() > 1e-3


def test_the_tool_in_use_again_ends_the_wait_of_another(robot: Robot) -> None:
    first = bent_tool(stamp_ns=1)
    robot.change_tool(first)
    robot.session.offer_tool(bent_tool(1e-3, stamp_ns=2))
    robot.session.offer_tool(bent_tool(revision=first.revision, stamp_ns=3))
    assert waiting(robot) is None


# ---- what is being added, and joints as they were taught -----------------------------------------


def test_the_offset_is_what_was_added(robot: Robot) -> None:
    tool = bent_tool()
    before = robot.session.offset(robot.now)
    assert np.array_equal(before.offset, np.zeros(6))
    assert (before.revision, before.tool_revision) == (None, None)
    assert not before.withheld.any()
    robot.change_tool(tool)
    robot.stream()
    progress = []
    while not robot.session.status().settled:
        at = robot.stream()
        robot.read(at)
        offset = robot.session.offset(robot.now)
        assert np.allclose(offset.offset, at - HOME, rtol=0.0, atol=1e-11)
        assert offset.tool_revision == tool.revision
        progress.append(np.abs(offset.withheld).max())
    assert progress[-1] == 0.0
    assert progress[0] > 1e-3
    assert np.all(np.diff(progress) < 0.0)


def test_any_joint_state_is_un_corrected_without_being_remembered(robot: Robot) -> None:
    robot.change_tool(bent_tool())
    at = robot.settle()
    robot.read(at)
    for x in np.linspace(0.0, 0.2, 200):
        shifted = robot.stream(HOME + x)
    speed = np.full(6, 0.1)
    read = robot.read(shifted, velocity=speed)
    robot.read(at)
    position, velocity = robot.session.taught(NAMES, shifted, speed, robot.now)
    assert np.array_equal(position, read.position)
    assert np.array_equal(velocity, read.velocity)
    some, none = robot.session.taught(NAMES[3:], at[3:], None, robot.now)
    assert none is None
    assert np.allclose(some, HOME[3:], rtol=0.0, atol=1e-12)
    refused(Reason.NOT_FINITE, robot.session.taught, NAMES, shifted * np.nan, None, robot.now)


# ---- from messages -------------------------------------------------------------------------------


def message(**changes: Any) -> SimpleNamespace:
    vector, turn = {"x": 0.1, "y": 0.0, "z": 0.2}, {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    fields = {
        "header": SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=5), frame_id="tool0"),
        "child_frame_id": "tcp",
        "robot": NOMINAL.name,
        "serial": "s1",
        "model_hash": NOMINAL.model_hash,
        "robot_file_hash": "",
        "revision": 3,
        "tool": SimpleNamespace(
            translation=SimpleNamespace(**vector), rotation=SimpleNamespace(**turn)
        ),
        "state": 2,
    }
    return SimpleNamespace(**(fields | changes))


def test_tools_are_built_from_messages() -> None:
    tool = offered_tool(message(), 2)
    assert tool.T_flange_tool is not None
    assert tool.T_flange_tool[:3, 3].tolist() == [0.1, 0.0, 0.2]
    assert (tool.accepted, tool.revision, tool.stamp_ns) == (True, 3, 1_000_000_005)
    assert not offered_tool(message(state=1), 2).accepted
    taught = offered_tool(message(state=0, revision=0), 2)
    assert taught.accepted
    assert taught.T_flange_tool is None
    bad = message()
    bad.tool.rotation.w = np.nan
    refused(Reason.BAD_TOOL, offered_tool, bad, 2)
