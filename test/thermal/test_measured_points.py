# SPDX-License-Identifier: Apache-2.0
"""Points of a measuring robot's sensor that wait for joints, live and from a recording."""

import json

import numpy as np
import pytest
from command import robocal, robocal_json

from robocal_ros.bags.bags import BagWriter
from robocal_ros.ground.samples import JointSample, JointStream
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.observations import MOST_SHOTS, PlacedShot, PointQueue, SensorShot

ARM = load_robot("kr150_r3100")
BEGIN_S, PERIOD_S, READINGS = 1000.0, 0.02, 100
Q = np.radians([0.0, -70.0, 110.0, 0.0, 50.0, 0.0])


def shot(time_s):
    return SensorShot(round(time_s * 1e9), "scanner", np.array([[0.0, 0.0, 0.5]]))


def test_a_shot_that_came_before_the_joints_and_is_far_ahead_holds_no_other():
    stream = JointStream(ARM.joint_names)
    queue = PointQueue(stream)
    queue.add(shot(BEGIN_S + 4000.0))  # the sensor's clock, while no joints tell theirs
    for i in range(READINGS):
        stamp_ns = round((BEGIN_S + i * PERIOD_S) * 1e9)
        stream.add(JointSample(stamp_ns, ARM.joint_names, Q), 250_000_000)
    for i in range(MOST_SHOTS - 1):
        queue.add(shot(BEGIN_S + 0.5 + i * 1e-3))
    (_, error), *others = queue.ready(ARM, np.eye(4))
    assert "3998.0 s ahead" in str(error)
    assert len(others) == MOST_SHOTS - 1
    assert all(isinstance(placed, PlacedShot) for _, placed in others)


def header(time_s):
    sec, nanosec = divmod(round(time_s * 1e9), 1_000_000_000)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "scanner"}


@pytest.fixture
def recorded(tmp_path):
    """A bag whose joint states end before the last two points, and the options for it."""
    bag, mount = tmp_path / "points.mcap", tmp_path / "mount.json"
    mount.write_text(json.dumps({"T_flange_sensor": {"xyz_mm": [0, 0, 100],
                                                     "quat_xyzw": [0, 0, 0, 1]}}))  # fmt: skip
    with BagWriter(bag) as writer:
        for i in range(READINGS):
            time_s = BEGIN_S + i * PERIOD_S
            state = {"header": header(time_s), "name": list(ARM.joint_names), "position": Q}
            writer.write("joint_states", "sensor_msgs/msg/JointState", state, round(time_s * 1e9))
        for time_s in (BEGIN_S + 0.5, BEGIN_S + 2.0, BEGIN_S + 2.4):
            point = {"header": header(time_s), "point": {"x": 0.0, "y": 0.0, "z": 0.5}}
            writer.write("point", "geometry_msgs/msg/PointStamped", point, round(time_s * 1e9))
        writer.write("text", "std_msgs/msg/String", {"data": "hello"}, round(BEGIN_S * 1e9))
    return ["--robot", "kr150_r3100", "--model", "kr150_r3100", "--mount", mount, "--bag", bag]


def test_points_after_the_last_joints_are_told(recorded):
    document = robocal_json("correct-points.json", "correct-points", *recorded)
    assert [one["sample"] for one in document["points"]] == ["point/1"]
    assert document["not_placed"] == [
        f"point/{i}: no joint readings after the measurement" for i in (2, 3)
    ]


@pytest.mark.parametrize(
    ("option", "kinds"), [("--points", "PointStamped or "), ("--joints", "JointState")]
)
def test_a_topic_of_another_type_is_named(recorded, option, kinds):
    done = robocal("correct-points", *recorded, option, "text")
    assert done.returncode == 2
    assert "text is of type std_msgs/msg/String, not " in done.stderr
    assert kinds in done.stderr
