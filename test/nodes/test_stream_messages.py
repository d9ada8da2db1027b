# SPDX-License-Identifier: Apache-2.0
"""Joint messages that came in, and what goes out for them: irregular ones by way of a message."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.correction.interface import Reason, RefusedError
from robocal_ros.correction.messages import ArrayMessage, JointMessage, JointWire, PathMessage
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import CORRECTED

NAN, NAMES = math.nan, ("a", "b")


def a_state(**fields: Any) -> JointState:
    given = {"name": ["a", "b"], "position": [1.0, 2.0], "velocity": [0.1, 0.2]}
    return JointState(header=Header(frame_id="planner"), **(given | fields))


def a_path(**fields: Any) -> JointTrajectory:
    given = {"positions": [1.0, 2.0], "velocities": [0.1, 0.2], "effort": [5.0, 6.0]}
    points = [JointTrajectoryPoint(**given), JointTrajectoryPoint(**(given | fields))]
    points[1].time_from_start.sec = 1
    return JointTrajectory(joint_names=["a", "b"], points=points)


def came(state: JointState, *, readings_of: Sequence[str] = ()) -> JointMessage:
    return JointMessage(JointWire(readings_of), serialize_message(state))


def as_message(out: Any, kind: type) -> Any:
    return deserialize_message(out, kind) if isinstance(out, bytes) else out


@pytest.mark.parametrize("velocity", [[0.1, 0.2], []])
@pytest.mark.parametrize("effort", [[], [3.0, 4.0], [NAN, 4.0]])
def test_a_reading_goes_out_with_other_values(velocity: list[float], effort: list[float]) -> None:
    state = a_state(velocity=velocity, effort=effort)
    message = came(state, readings_of=NAMES)
    assert message.is_finite()
    command = message.command()
    faster = None if command.velocity is None else 2.0 * command.velocity
    changed = replace(command, position=command.position + 1.0, velocity=faster, mark=CORRECTED)
    expected = a_state(
        position=[2.0, 3.0],
        velocity=[2.0 * v for v in velocity],
        effort=effort if np.isfinite(effort).all() else [],
    )
    expected.header.frame_id = CORRECTED
    assert as_message(message.changed(changed), JointState) == expected


def test_a_reading_without_efforts_goes_out_unchanged_but_for_them() -> None:
    message = came(a_state(effort=[NAN, NAN]), readings_of=NAMES)
    assert message.unchanged() == a_state()


def test_a_regular_message_stays_serialized() -> None:
    data = serialize_message(a_state())
    message = JointMessage(JointWire(), data)
    assert message.unchanged() is data
    assert isinstance(message.changed(message.command()), bytes)
    path = PathMessage(serialize_message(a_path()))
    assert isinstance(path.changed(path.command()), bytes)


@pytest.mark.parametrize("field", ["position", "velocity", "effort"])
def test_a_target_that_is_not_finite_is_seen_and_refused(field: str) -> None:
    message = came(a_state(**{field: [1.0, NAN]}))
    assert not message.is_finite()
    if field != "velocity":  # which the session refuses, for the arm's joints
        with pytest.raises(RefusedError) as refused:
            message.command()
        assert refused.value.reason is Reason.NOT_FINITE


@pytest.mark.parametrize("field", ["positions", "velocities", "accelerations", "effort"])
@pytest.mark.parametrize("ragged", [False, True])
def test_a_path_that_is_not_finite_is_seen(field: str, ragged: bool) -> None:
    for value, finite in ((1.0, True), (math.inf, False), (NAN, False)):
        path = a_path(**{field: [1.0, value]})
        if field == "accelerations":
            path.points[0].accelerations = [0.0, 0.0]
        if ragged:
            path.points[0].effort = []
        assert PathMessage(serialize_message(path)).is_finite() == finite


def test_an_array_has_the_configured_joints() -> None:
    message = ArrayMessage(("a", "b"), Float64MultiArray(data=[1.0, 2.0]))
    command = message.command()
    assert command.names == ("a", "b")
    assert message.is_finite()
    assert list(message.changed(replace(command, position=np.array([3.0, 4.0]))).data) == [3.0, 4.0]
    assert not ArrayMessage(("a",), Float64MultiArray(data=[NAN])).is_finite()


@pytest.mark.parametrize("read", [partial(JointMessage, JointWire()), PathMessage])
def test_what_is_no_message_is_told(read: Any) -> None:
    with pytest.raises(InputError, match="this is no Joint"):
        read(b"\0\1\0\0\1")


def test_a_velocity_of_another_joint_that_is_no_number_does_not_go_out() -> None:
    """A gripper's, which the correction does not touch; the arm's are read all the same."""
    message = came(a_state(velocity=[0.1, NAN]), readings_of=["a"])
    command = message.command()
    assert command.velocity is not None
    assert command.velocity[0] == 0.1
    assert message.unchanged() == a_state(velocity=[])
    command = replace(command, velocity=None)  # as the session leaves them out
    out = as_message(message.changed(replace(command, mark=CORRECTED)), JointState)
    assert list(out.velocity) == []
    assert list(out.position) == [1.0, 2.0]


@pytest.mark.parametrize("rows", [{}, {"velocity": []}, {"effort": [3.0, NAN]}])
def test_another_joint_without_a_position_is_left_out(rows: dict[str, list[float]]) -> None:
    state = a_state(position=[1.0, NAN], **rows)
    out = a_state(name=["a"], position=[1.0], velocity=rows.get("velocity", [0.1]))
    out.effort = rows.get("effort", [])[:1]
    message = came(state, readings_of=["a"])
    assert message.is_finite()
    assert message.command().names == ("a",)
    assert message.unchanged() == out
    for of in (["a", "b"], ["b"]):  # the robot's own
        with pytest.raises(RefusedError) as refused:
            came(state, readings_of=of).command()
        assert refused.value.reason is Reason.NOT_FINITE


def test_readings_of_others_of_which_no_position_is_known_tell_nothing() -> None:
    assert came(a_state(position=[NAN, NAN]), readings_of=["c"]).command().names == ()


@pytest.mark.parametrize("velocity", [[NAN, NAN], [0.1, NAN], [0.1], [0.1, 0.2, 0.3]])
def test_velocities_of_a_reading_that_are_unknown_are_absent(velocity: list[float]) -> None:
    message = came(a_state(velocity=velocity, effort=[NAN, NAN]), readings_of=NAMES)
    assert message.is_finite()
    assert message.command().velocity is None
    assert message.unchanged() == a_state(velocity=[])
