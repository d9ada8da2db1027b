# SPDX-License-Identifier: Apache-2.0
"""Joint messages on the wire are read and written as ROS does."""

import math

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from robocal_ros.correction.interface import JointCommand, finite_command
from robocal_ros.correction.messages import JointWire

NAMES = (("a", "b"), ("joint_a1", "joint_a2", "x"), ("only",))
FRAMES = ("", "base", "base_link", "world_of_robots", "grüße")


def a_state(names, frame_id="", velocity=True, effort=0, seed=0):
    rng = np.random.default_rng(seed)
    return JointState(
        header=Header(stamp=Time(sec=5 + seed, nanosec=999999999), frame_id=frame_id),
        name=list(names),
        position=rng.normal(size=len(names)).tolist(),
        velocity=rng.normal(size=len(names)).tolist() if velocity else [],
        effort=rng.normal(size=effort).tolist(),
    )


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("frame_id", FRAMES)
@pytest.mark.parametrize("velocity", [True, False])
@pytest.mark.parametrize("effort", [0, 1, 3])
def test_as_ros_reads_and_writes(names, frame_id, velocity, effort):
    wire = JointWire()
    for seed in range(3):
        message = a_state(names, frame_id, velocity, effort, seed)
        data = serialize_message(message)
        command, expected = wire.read(data), finite_command(message)
        assert (command.names, command.stamp_ns, command.mark) == (
            expected.names, expected.stamp_ns, expected.mark,
        )  # fmt: skip
        assert np.array_equal(command.position, expected.position)
        assert (command.velocity is None) == (expected.velocity is None)
        assert command.velocity is None or np.array_equal(command.velocity, expected.velocity)
        rates = None if command.velocity is None else -command.velocity
        for mark in ("robocal_corrected", "robocal_taught", "robocal_taught", frame_id):
            changed = JointCommand(names, 2.0 * command.position, rates, mark=mark)
            out = deserialize_message(wire.written(data, changed), JointState)
            message.header.frame_id = mark
            message.position = changed.position.tolist()
            message.velocity = [] if rates is None else rates.tolist()
            assert out == message


def test_messages_of_several_sources_are_told_apart():
    wire = JointWire()
    for names in (*NAMES, *reversed(NAMES), ("b", "a")):
        command = wire.read(serialize_message(a_state(names)))
        assert command.names == names


@pytest.mark.parametrize(
    "message",
    [
        JointState(name=["a"], position=[math.nan]),
        JointState(name=["a"], position=[math.inf]),
        JointState(name=["a"], position=[0.0], velocity=[math.nan]),
        JointState(name=["a"], position=[0.0], effort=[math.nan]),
        JointState(name=["a", "b"], position=[0.0]),
        JointState(name=["a", "b"], position=[0.0, 0.0], velocity=[1.0]),
        JointState(name=["a"], velocity=[0.0]),
        JointState(),
    ],
)
def test_what_is_not_regular_is_left_to_the_message(message):
    assert JointWire().read(serialize_message(message)) is None


@pytest.mark.parametrize("text", [b"map\0", b"joint_a1\0"])
def test_a_text_that_does_not_end_is_left_to_the_message(text):
    """ROS reads such a name with its last byte: what goes out would be of another joint."""
    state = JointState(name=["joint_a1"], position=[0.5])
    state.header.frame_id = "map"
    whole = serialize_message(state)
    assert JointWire().read(whole.replace(text, text[:-1] + b"x")) is None


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_damaged_bytes_do_no_harm(data):
    wire, whole = JointWire(), serialize_message(a_state(NAMES[1], effort=3))
    wire.read(whole)
    damaged = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    for place in data.draw(st.lists(st.integers(0, len(whole) - 1), max_size=3)):
        if place < len(damaged):
            damaged[place] = data.draw(st.integers(0, 255))
    command = wire.read(bytes(damaged))
    if command is not None:
        assert np.isfinite(command.position).all()
        assert len(command.names) == len(command.position)
        wire.written(bytes(damaged), command)
