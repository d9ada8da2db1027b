"""Joints by name, in part and of others; commands from messages."""

from types import SimpleNamespace

import numpy as np
import pytest
from correction_robot import DT, HOME, NAMES, NOMINAL, Robot, refused

from robocal_ros.correction.interface import (
    JointCommand,
    Reason,
    finite_command,
    joint_command,
    trajectory_command,
)


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
    moved = point(0.0, [1.0], [], [])
    moved.effort = [bad]
    path = SimpleNamespace(header=header(), joint_names=["a"], points=[moved])
    refused(Reason.NOT_FINITE, trajectory_command, path)


def test_readings_of_foreign_joints_that_are_not_finite_are_refused() -> None:
    state = SimpleNamespace(
        header=header(), name=["a", "gripper"], position=[1.0, np.nan], velocity=[], effort=[]
    )
    refused(Reason.NOT_FINITE, joint_command, state)


def point(t: float, q: list[float], v: list[float], a: list[float]) -> SimpleNamespace:
    duration = SimpleNamespace(sec=int(t), nanosec=round(t % 1 * 1e9))
    return SimpleNamespace(
        time_from_start=duration, positions=q, velocities=v, accelerations=a, effort=[]
    )


def test_trajectories_are_built_from_messages() -> None:
    points = [point(0.0, [1.0, 2.0], [0.0, 0.0], []), point(1.5, [3.0, 4.0], [0.0, 1.0], [])]
    message = SimpleNamespace(header=header(), joint_names=["a", "b"], points=points)
    command = trajectory_command(message)
    assert command.position.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert command.time_from_start_s.tolist() == [0.0, 1.5]
    assert command.acceleration is None
    assert len(trajectory_command(SimpleNamespace(**vars(message) | {"points": []}))) == 0
    points[1].velocities = []
    refused(Reason.WRONG_SIZE, trajectory_command, message)
    points[0].velocities, points[0].accelerations = [], [0.0, 0.0]
    points[1].accelerations = [0.0, 0.0]
    refused(Reason.WRONG_SIZE, trajectory_command, message)
    points[1].positions = [1.0]
    refused(Reason.WRONG_SIZE, trajectory_command, message)
    points[0].positions = points[1].positions = []
    refused(Reason.NO_POSITION, trajectory_command, message)
