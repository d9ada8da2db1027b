# SPDX-License-Identifier: Apache-2.0
"""The correction session: off until asked, never a jump, never beyond its bounds, never NaN."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from correction_robot import (
    DT,
    HOME,
    LIMITS,
    NAMES,
    NOMINAL,
    REST,
    ROUNDING,
    Robot,
    bent_tool,
    distance,
    drifted,
    large,
    offer,
    pose,
    refused,
    swing,
)

from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import (
    JointCommand,
    Reason,
    TrajectoryCommand,
    finite_command,
    joint_command,
)
from robocal_ros.correction.session import CorrectionSession

# ---- off, on, off --------------------------------------------------------------------------------


def test_off_until_enabled(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted()))
    robot.session.offer_tool(bent_tool())
    for _ in range(100):
        assert np.array_equal(robot.stream(), HOME)
    points = np.stack([HOME, HOME + 0.1])
    command = TrajectoryCommand(NAMES, points, np.array([0.0, 5.0]))
    assert robot.session.trajectory(command, robot.now) is command
    assert np.array_equal(robot.read(HOME).position, HOME)
    status = robot.session.status()
    assert not status.enabled
    assert status.revision == 1
    assert status.withheld_most_m == 0.0


def test_enabled_without_a_model_changes_nothing(robot: Robot) -> None:
    robot.session.enable(True)
    assert np.array_equal(robot.stream(), HOME)


def test_reaches_the_taught_pose_and_goes_back(robot: Robot) -> None:
    actual = drifted()
    robot.session.offer_model(offer(actual))
    robot.session.enable(True)
    q = robot.settle()
    goal = pose(NOMINAL, HOME)
    assert distance(pose(actual, HOME), goal) > 1e-4
    assert distance(pose(actual, q), goal) < 1e-9
    assert np.allclose(robot.read(q).position, HOME, rtol=0.0, atol=1e-12)
    robot.session.enable(False)
    assert np.array_equal(robot.settle(), HOME)
    assert not robot.session.status().active


def test_reaches_it_with_a_new_tool_too(warm: Robot) -> None:
    tool = bent_tool()
    warm.change_tool(tool)
    q = warm.settle()
    actual = replace(drifted(), T_flange_tool=tool.T_flange_tool)
    assert distance(pose(actual, q), pose(NOMINAL, HOME)) < 1e-9
    assert np.allclose(warm.read(q).position, HOME, rtol=0.0, atol=1e-12)


def test_the_reference_is_what_the_program_was_taught_with() -> None:
    cold = drifted(20.0, seed=5)  # millimetres from the nominal model
    warm_arm = cold.with_mdh(cold.mdh + drifted().mdh - NOMINAL.mdh)
    robot = Robot()
    robot.session = CorrectionSession(NOMINAL, cold, "s1", CorrectionConfig(**LIMITS))
    robot.rest()
    robot.session.offer_model(offer(warm_arm))
    robot.session.enable(True)
    q = robot.settle()
    assert distance(pose(warm_arm, q), pose(cold, HOME)) < 1e-9
    # back to the nominal model: no drift is known, so nothing is corrected
    robot.session.offer_model(offer(NOMINAL, revision=2))
    assert np.array_equal(robot.settle(), HOME)


def test_a_pause_does_not_let_the_blend_jump(robot: Robot) -> None:
    robot.stream()
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    assert np.abs(robot.stream(dt=100.0) - HOME).max() <= REST * 0.02 + ROUNDING


def test_what_was_withheld_at_most_is_that_of_one_instant_at_the_tool() -> None:
    """The largest of each joint are of different instants, and do not add up at the tool."""
    robot = large()
    robot.stream()
    first = robot.session.status()
    assert first.withheld_m > 1e-3
    assert first.withheld_most_m == pytest.approx(first.withheld_m, rel=1e-2)
    robot.settle()
    settled = robot.session.status()
    assert settled.withheld_m == 0.0
    assert settled.withheld_most_m == pytest.approx(first.withheld_most_m, rel=1e-2)


@pytest.mark.parametrize("joints", [6, 5])
def test_what_a_trajectory_withholds_is_told_at_the_tool(joints: int) -> None:
    robot = large()
    path = swing(first_s=1.0, duration=9.0)
    names, q = NAMES[:joints], path.position[:, :joints]
    robot.session.trajectory(TrajectoryCommand(names, q, path.time_from_start_s), robot.now)
    told = robot.session.status()
    assert told.withheld_most.max() > 1e-4
    assert 1e-4 < told.withheld_most_m < 4e-3  # of a tool that is bent by 2 mm


# ---- Joints by name, in part and of others; commands from messages -------------------------------


def test_joints_are_matched_by_name(warm: Robot) -> None:
    straight = warm.stream()
    order = [3, 0, 5, 1, 4, 2]
    names = tuple(NAMES[i] for i in order)
    warm.now += DT
    out = warm.session.target(JointCommand(names, HOME[order]), warm.now)
    assert out.names == names
    assert np.array_equal(out.position, straight[order])


def test_a_part_of_the_joints_is_completed_from_the_readings(warm: Robot) -> None:
    part = JointCommand(NAMES[2:4], HOME[2:4])
    new = Robot()
    new.session = type(new.session)(NOMINAL, NOMINAL, "s1")
    refused(Reason.MISSING_JOINT, new.session.target, part, new.now)
    straight = warm.stream()
    warm.read(straight)
    assert np.allclose(warm.session.target(part, warm.now).position, straight[2:4], atol=1e-12)


def test_joints_of_others_pass_in_readings_but_not_in_targets(warm: Robot) -> None:
    q = warm.stream()
    names = ("gripper", *NAMES, "track")
    values = np.array([0.04, *q, 1.5])
    out = warm.session.reading(JointCommand(names, values, velocity=0.1 * np.ones(8)), warm.now)
    assert out.names == names
    assert np.allclose(out.position[1:-1], HOME, rtol=0.0, atol=1e-12)
    assert out.position[[0, -1]].tolist() == [0.04, 1.5]
    assert out.velocity is not None
    assert out.velocity[[0, -1]].tolist() == [0.1, 0.1]
    said = refused(Reason.UNKNOWN_JOINT, warm.session.target, JointCommand(names, values), warm.now)
    assert "gripper" in said
    alone = JointCommand(("gripper",), np.array([0.02]))
    assert warm.session.reading(alone, warm.now).position.tolist() == [0.02]


def test_readings_of_velocity_are_un_corrected(warm: Robot) -> None:
    h = 1e-4
    speed = np.array([0.2, -0.1, 0.3, 0.1, -0.2, 0.5])
    before, here, after = (warm.stream(HOME + speed * t) for t in (-h, 0.0, h))
    state = warm.read(here, velocity=(after - before) / (2 * h))
    assert state.velocity is not None
    assert np.allclose(state.velocity, speed, rtol=0.0, atol=1e-6)


# ---- from messages -------------------------------------------------------------------------------


def header(frame: str = "") -> SimpleNamespace:
    return SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=500), frame_id=frame)


def test_targets_are_built_from_messages() -> None:
    message = SimpleNamespace(
        header=header("x"), name=["a", "b"], position=[1.0, 2.0], velocity=[], effort=[]
    )
    command = joint_command(message)
    assert command.names == ("a", "b")
    assert command.velocity is None
    assert (command.stamp_ns, command.mark) == (1_000_000_500, "x")
    message.velocity = [1.0]
    refused(Reason.WRONG_SIZE, joint_command, message)
    message.position = []
    refused(Reason.NO_POSITION, joint_command, message)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_efforts_that_are_not_finite_do_not_go_out(bad: float) -> None:
    target = SimpleNamespace(header=header(), name=["a"], position=[1.0], velocity=[], effort=[bad])
    refused(Reason.NOT_FINITE, finite_command, target)


def test_readings_of_foreign_joints_that_are_not_finite_are_refused() -> None:
    state = SimpleNamespace(
        header=header(), name=["a", "gripper"], position=[1.0, np.nan], velocity=[], effort=[]
    )
    refused(Reason.NOT_FINITE, joint_command, state)
