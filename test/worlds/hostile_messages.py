# SPDX-License-Identifier: Apache-2.0
"""Messages that may come to a joint correction node: good ones, and every kind of bad ones."""

from array import array
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration, Time
from hypothesis import strategies as st
from joint_correction_live import (
    HOME,
    NAMES,
    drifted,
    model_message,
    tool_message,
    trajectory,
)
from robocal_msgs.msg import KinematicModel, ToolFrame
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.ground.samples import CORRECTED, TAUGHT

# A drift of some millimetres.
ACTUAL = drifted(times=10.0)

NUMBERS = st.one_of(
    st.floats(width=64),
    st.sampled_from([np.nan, np.inf, -np.inf, 1e300, 5e-324, 57.3, -720.0, 0.0]),
)
WORDS = st.one_of(st.sampled_from(NAMES), st.text(max_size=8))
STAMPS = st.builds(
    Time,
    sec=st.one_of(st.sampled_from([0, 1, 2**31 - 1]), st.integers(0, 2**31 - 1)),
    nanosec=st.integers(0, 999_999_999),
)
HEADERS = st.builds(Header, stamp=STAMPS, frame_id=st.sampled_from(["", "base", CORRECTED, TAUGHT]))
NEAR = st.lists(st.floats(-0.02, 0.02), min_size=6, max_size=6).map(lambda d: HOME + np.array(d))
FAR = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6).map(lambda d: HOME + np.array(d))


def numbers() -> st.SearchStrategy[Any]:
    """As many as there are joints, now and then more or fewer; one of them bad, or all."""
    spoilt = st.builds(
        lambda q, i, x: [*q[:i], x, *q[i + 1 :]], NEAR.map(list), st.integers(0, 5), NUMBERS
    )
    values = st.one_of(spoilt, st.lists(NUMBERS, min_size=6, max_size=6), st.lists(NUMBERS))
    return values.map(lambda row: array("d", row))


GARBAGE_JOINTS = st.builds(
    JointState,
    header=HEADERS,
    name=st.one_of(st.just(NAMES), st.permutations(NAMES), st.lists(WORDS, max_size=8)),
    position=numbers(),
    velocity=numbers(),
    effort=numbers(),
)
GARBAGE_POINTS = st.builds(
    JointTrajectoryPoint,
    positions=st.one_of(numbers(), NEAR.map(lambda q: array("d", q))),
    velocities=numbers(),
    accelerations=numbers(),
    effort=numbers(),
    time_from_start=st.builds(
        Duration, sec=st.integers(-5, 5), nanosec=st.integers(0, 999_999_999)
    ),
)
GARBAGE_PATHS = st.builds(
    JointTrajectory,
    header=HEADERS,
    joint_names=st.one_of(st.just(NAMES), st.lists(WORDS, max_size=8)),
    points=st.lists(GARBAGE_POINTS, min_size=1, max_size=4),
)


def broken_model(column: str, place: int, value: float, change: dict[str, Any]) -> KinematicModel:
    message = model_message(ACTUAL, 2, **change)
    getattr(message, column)[place] = value
    return message


MODELS = st.builds(
    broken_model,
    st.sampled_from(["d", "theta", "a", "alpha", "beta"]),
    st.integers(0, 5),
    NUMBERS.filter(lambda x: not abs(x) < 3.0),
    st.sampled_from([{}, {"serial": "s2"}, {"model_hash": "x"}, {"state": KinematicModel.NONE}]),
)


def broken_tool(values: list[float], change: dict[str, Any]) -> ToolFrame:
    message = tool_message(np.eye(4), 9, **change)
    message.tool.translation.x, message.tool.rotation.w = values
    return message


TOOLS = st.builds(
    broken_tool,
    st.tuples(NUMBERS.filter(lambda x: not abs(x) < 0.1), NUMBERS).map(list),
    st.sampled_from([{}, {"serial": "s2"}, {"state": ToolFrame.CANDIDATE}]),
)
STREAMS = {
    "joint_targets": GARBAGE_JOINTS,
    "joint_commands": st.builds(Float64MultiArray, data=numbers()),
}


def good_path(points: list[tuple[np.ndarray, float]]) -> JointTrajectory:
    """Through joints, each after a time in s."""
    times = np.cumsum([after_s for _, after_s in points])
    return trajectory(np.array([q for q, _ in points]), times)


PATHS = st.lists(st.tuples(NEAR, st.floats(0.05, 0.5)), min_size=1, max_size=5).map(good_path)
# and whether the controller accepts it
GOALS = st.tuples(st.one_of(PATHS, PATHS, GARBAGE_PATHS), st.booleans())


def attacks(stream: str, on: bool) -> st.SearchStrategy[Any]:
    """What is sent, and where to; ``taught``: a good command of the stream, near or far."""
    kinds = {
        "taught": st.one_of(NEAR, NEAR, FAR),
        "enable": st.booleans() if on else st.just(False),
        "path": PATHS,
        "goal": GOALS,
        "flood": STREAMS[stream],
        stream: STREAMS[stream],
        "joint_trajectory": GARBAGE_PATHS,
        "joint_states": GARBAGE_JOINTS,
        "kinematic_model": MODELS,
        "tool": TOOLS,
    }
    one = st.one_of([st.tuples(st.just(what), values) for what, values in kinds.items()])
    return st.lists(one, min_size=1, max_size=8)


# In the stretched wrist hardly anything is corrected, so the blend runs through at once.
THROUGH_A_SINGULARITY = [
    *10 * [("taught", HOME)],
    ("taught", np.array([0.31, -1.21, 1.22, 0.4, 0.0, -0.28])),
    ("path", good_path([(np.array([0.32, -1.19, 1.22, 0.41, 0.91, -0.3]), 0.13)])),
]
