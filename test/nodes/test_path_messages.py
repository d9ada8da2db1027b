# SPDX-License-Identifier: Apache-2.0
"""Serialized trajectories are read and changed as ROS reads and writes the messages."""

import contextlib
import math
import struct
import time
from dataclasses import replace

import numpy as np
import pytest
from builtin_interfaces.msg import Duration, Time
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.correction.interface import Reason, RefusedError
from robocal_ros.correction.messages import PathMessage

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


@pytest.mark.parametrize(
    "given", [FIELDS, FIELDS[:1], FIELDS[:2], FIELDS[:3], ("positions", "effort")]
)
@pytest.mark.parametrize("frame_id", ["", "base", "base_link", "world_of_robots"])
@pytest.mark.parametrize("names", [("a", "b"), ("joint_a1", "joint_a2", "x")])
def test_reads_what_ros_writes(given, frame_id, names):
    message = a_path(names=names, given=given, frame_id=frame_id)
    command = PathMessage(serialize_message(message)).command()
    assert (command.names, command.mark) == (names, frame_id)
    assert command.stamp_ns == 17_123_456_789
    times = [p.time_from_start for p in message.points]
    assert command.time_from_start_s.tolist() == [t.sec + 1e-9 * t.nanosec for t in times]
    for field, found in zip(
        FIELDS, (command.position, command.velocity, command.acceleration), strict=False
    ):
        there = [list(getattr(p, field)) for p in message.points]
        assert (found is None) is (field not in given)
        assert found is None or found.tolist() == there


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
    others = JointTrajectory(joint_names=["a"], points=a_path().points)
    return {
        "ragged": (ragged, Reason.WRONG_SIZE),
        "rates in some points": (some, Reason.WRONG_SIZE),
        "no positions": (a_path(given=("velocities",)), Reason.NO_POSITION),
        "nothing": (a_path(names=("a",), given=()), Reason.NO_POSITION),
        "accelerations alone": (a_path(given=("positions", "accelerations")), Reason.WRONG_SIZE),
        "fewer names": (others, Reason.WRONG_SIZE),
        "no points": (JointTrajectory(joint_names=["a"]), Reason.NO_POINTS),
    }


@pytest.mark.parametrize("what", irregular())
def test_what_is_not_regular_is_refused(what):
    message, reason = irregular()[what]
    with pytest.raises(RefusedError) as found:
        PathMessage(serialize_message(message)).command()
    assert found.value.reason is reason


def test_what_is_refused_is_made_no_message_of_first():
    """Of 10 000 points that takes so long that nothing else is heard: here a tenth at most."""
    message = a_path(points=10_000)
    message.points[-1].velocities = []
    data = serialize_message(message)
    with pytest.raises(RefusedError, match="point 10000 has 0 velocities for 3 joints"):
        PathMessage(data).command()  # loads what is compiled

    def cpu_s(act):
        begin_s = time.process_time()
        with contextlib.suppress(RefusedError):
            act()
        return time.process_time() - begin_s

    ours = min(cpu_s(lambda: PathMessage(data).command()) for _ in range(5))
    assert ours < 0.1 * min(
        cpu_s(lambda: deserialize_message(data, JointTrajectory)) for _ in range(5)
    )


def test_efforts_may_be_missing_in_some_points():
    message = a_path()
    message.points[2].effort = []
    path = PathMessage(serialize_message(message))
    command = path.command()
    out = deserialize_message(
        path.changed(replace(command, position=2.0 * command.position, mark="robocal_corrected")),
        JointTrajectory,
    )
    assert [list(p.effort) for p in out.points] == [list(p.effort) for p in message.points]
    assert np.array_equal([p.positions for p in out.points], 2.0 * command.position)


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


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_damaged_bytes_do_no_harm(data):
    whole = serialize_message(a_path(points=2))
    cut = whole[: data.draw(st.integers(4, len(whole)))]
    damaged = bytearray(cut)
    for place in data.draw(st.lists(st.integers(4, len(whole) - 1), max_size=3)):
        if place < len(cut):
            damaged[place] = data.draw(st.integers(0, 255))
    path = PathMessage(whole)
    path._came, path._size, path.points = bytes(damaged), len(damaged) - 4, 0
    # ROS is not asked: it takes the memory that damaged lengths say
    with contextlib.suppress(RefusedError, struct.error, UnicodeDecodeError):
        path._read()
    if path.points:
        path.is_finite()
        with contextlib.suppress(RefusedError):
            command = replace(path.command(), mark=path._frame_id)
            assert len(path.changed(command)) >= len(damaged) - 8
