"""Serialized trajectories are read and changed as ROS reads and writes the messages."""

import math
from dataclasses import replace

import numpy as np
import pytest
from builtin_interfaces.msg import Duration, Time
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.correction.interface import Reason, RefusedError, trajectory_command
from robocal_ros.correction.messages import PathMessage, read_path

FIELDS = ("positions", "velocities", "accelerations", "effort")


def a_path(points=5, names=("a", "joint_2", "j3"), given=FIELDS, frame_id="", seed=0):
    rng = np.random.default_rng(seed)
    made = [
        JointTrajectoryPoint(
            **{field: rng.normal(size=len(names)).tolist() for field in given},
            time_from_start=Duration(sec=i, nanosec=int(rng.integers(10**9))),
        )
        for i in range(points)
    ]
    header = Header(stamp=Time(sec=17, nanosec=123456789), frame_id=frame_id)
    return JointTrajectory(header=header, joint_names=list(names), points=made)


def assert_same(command, expected):
    assert command.names == expected.names
    assert (command.stamp_ns, command.mark) == (expected.stamp_ns, expected.mark)
    for name in ("position", "velocity", "acceleration", "time_from_start_s"):
        mine, other = getattr(command, name), getattr(expected, name)
        assert (mine is None) == (other is None), name
        assert mine is None or np.array_equal(mine, other), name


@pytest.mark.parametrize(
    "given", [FIELDS, FIELDS[:1], FIELDS[:2], FIELDS[:3], ("positions", "effort")]
)
@pytest.mark.parametrize("frame_id", ["", "base", "base_link", "world_of_robots"])
@pytest.mark.parametrize("names", [("a", "b"), ("joint_a1", "joint_a2", "x")])
def test_reads_what_ros_writes(given, frame_id, names):
    message = a_path(names=names, given=given, frame_id=frame_id)
    data = serialize_message(message)
    assert read_path(data) is not None
    assert_same(PathMessage(data).command(), trajectory_command(message))


@pytest.mark.parametrize("frame_id", ["", "base", "base_link", "world_of_robots"])
def test_ros_reads_what_is_changed(frame_id):
    message = a_path(frame_id=frame_id)
    path = PathMessage(serialize_message(message))
    command = path.command()
    rows = {name: 2.0 * getattr(command, name) for name in ("position", "velocity", "acceleration")}
    out = path.changed(replace(command, mark="robocal_corrected", **rows))
    out = deserialize_message(out, JointTrajectory) if isinstance(out, bytes) else out
    for point in message.points:
        for field in FIELDS[:3]:
            setattr(point, field, [2.0 * x for x in getattr(point, field)])
    message.header.frame_id = "robocal_corrected"
    assert out == message


def irregular():
    ragged = a_path()
    ragged.points[2].positions = [1.0]
    some = a_path()
    some.points[1].velocities = []
    return {
        "ragged": ragged,
        "rates in some points": some,
        "no positions": a_path(given=("velocities",)),
        "too many": a_path(names=("a",), given=()),
        "accelerations alone": a_path(given=("positions", "accelerations")),
        "fewer names": JointTrajectory(joint_names=["a"], points=a_path().points),
    }


@pytest.mark.parametrize("what", irregular())
def test_refuses_what_the_message_would_be_refused_for(what):
    message = irregular()[what]
    with pytest.raises(RefusedError) as expected:
        trajectory_command(message)
    with pytest.raises(RefusedError) as found:
        PathMessage(serialize_message(message)).command()
    assert found.value.reason is expected.value.reason


def test_an_effort_that_is_no_number_is_refused():
    message = a_path()
    message.points[3].effort[1] = math.nan
    with pytest.raises(RefusedError) as found:
        PathMessage(serialize_message(message)).command()
    assert found.value.reason is Reason.NOT_FINITE


def test_a_stop_has_no_points():
    data = serialize_message(JointTrajectory(joint_names=["a", "b"]))
    path = PathMessage(data)
    assert path.points == 0
    assert path.unchanged() == data


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damaged_bytes_do_no_harm(data):
    whole = serialize_message(a_path(points=2))
    cut = whole[: data.draw(st.integers(4, len(whole)))]
    damaged = bytearray(cut)
    for place in data.draw(st.lists(st.integers(4, len(whole) - 1), max_size=3)):
        if place < len(cut):
            damaged[place] = data.draw(st.integers(0, 255))
    path = read_path(bytes(damaged))
    if path is not None:
        for field in range(4):
            path.rows(field)
        with_mark = "robocal_corrected"
        if path.takes(with_mark):
            assert len(path.changed(with_mark, {})) >= len(damaged) - 8
