# SPDX-License-Identifier: Apache-2.0
"""What a bag tells of its cell's truth, as ``robocal validate`` reads it."""

import json
import tracemalloc
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robocal_ros.bags.bag_writer import BagWriter
from robocal_ros.bags.bags import BagReader
from robocal_ros.cli.recording import HAND_EYE, TOOL, BagTruth
from robocal_ros.cli.validating import cell_courses
from robocal_ros.ground.errors import InputError
from robocal_ros.report.figures import CellCourse

NS = 1_000_000_000
TOPIC = "/cell_sim_node/truth/state"
STRING, ACCURACY = "std_msgs/msg/String", "robocal_msgs/msg/AccuracyState"


def told(state: dict[str, Any]) -> dict[str, str]:
    return {"data": json.dumps({"simulated": True} | state)}


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Four states, half an hour apart; a bound is told from 15 minutes on."""
    path = tmp_path / "cell.mcap"
    states = [
        {"faults": {}, "tcp_error_rms_m": 3e-4, "T_flange_tool": np.eye(4).tolist()},
        {"faults": {}, "tcp_error_rms_m": 4e-4, "commanded_tcp_error_rms_m": 4e-5},
        {"faults": {"collision": 2e-3}, "tcp_error_rms_m": 2e-3, "commanded_within_share": 0.5},
        {
            "faults": {},
            "tcp_error_rms_m": 4e-4,
            "visited_tcp_error_rms_m": 5e-4,
            "within_share": 0.3,
            "visited_within_share": 0.2,
            "commanded_tcp_error_p95_m": 1e-4,
        },
    ]
    with BagWriter(path) as writer:
        for i, state in enumerate(states):
            at_ns = 1000 * NS + i * 1800 * NS
            writer.write(TOPIC, STRING, told(state), at_ns)
            accuracy = {"bound_mm": -1.0 if i == 0 else 0.2, "tolerance_mm": 0.3}
            writer.write("/accuracy_state", ACCURACY, accuracy, at_ns - 900 * NS * (i > 0))
    return path


def courses(path: Path) -> list[CellCourse]:
    with BagReader(path) as reader:
        return cell_courses(reader, BagTruth(reader))


def test_the_course_is_what_was_told(bag: Path) -> None:
    (course,) = courses(bag)
    assert course.topic == TOPIC
    np.testing.assert_allclose(course.hours, [0.0, 0.5, 1.0, 1.5])
    np.testing.assert_allclose(course.without_mm, [0.3, 0.4, 2.0, 0.5])
    np.testing.assert_allclose(course.with_mm, [np.nan, 0.04, np.nan, np.nan])
    np.testing.assert_allclose(course.p95_mm, [np.nan, np.nan, np.nan, 0.1])
    np.testing.assert_allclose(course.lambda_without, [np.nan, np.nan, np.nan, 0.2])
    np.testing.assert_allclose(course.lambda_with, [np.nan, np.nan, 0.5, np.nan])
    np.testing.assert_allclose(course.bound_mm, [np.nan, 0.2, 0.2, 0.2])
    assert course.tolerance_mm == pytest.approx(0.3)
    assert list(course.faults) == [
        {"hours": 1.0, "fault": "collision", "size": 2e-3, "told": "2 mm"},
        {"hours": 1.5, "fault": "collision", "size": 0.0, "told": ""},
    ]


def test_the_tool_of_a_state_is_the_true_one(bag: Path) -> None:
    with BagReader(bag) as reader:
        ((stamp_ns, T_flange_tool),) = BagTruth(reader).transforms(TOOL, "")
    assert stamp_ns == 1000 * NS
    np.testing.assert_array_equal(T_flange_tool, np.eye(4))


def test_a_bag_without_a_truth_has_no_course(tmp_path: Path) -> None:
    path = tmp_path / "plain.mcap"
    with BagWriter(path) as writer:
        writer.write("/note", STRING, {"data": "x"}, NS)
    assert courses(path) == []


# ---- two robots ---------------------------------------------------------------------------------


def two_robots(path: Path, topics: Iterable[str]) -> Path:
    """The left robot is off by 0.1 mm and the right one by 2 mm; only the right tells a bound."""
    with BagWriter(path) as writer:
        for i, topic in enumerate(topics):
            tool = np.eye(4)
            tool[2, 3] = 0.1 * (i + 1)
            error = {"tcp_error_rms_m": (1e-4, 2e-3)[i], "T_flange_tool": tool.tolist()}
            writer.write(topic, STRING, told(error), 1000 * NS + i)
        accuracy = {"bound_mm": 2.5, "tolerance_mm": 0.3}
        writer.write("/right/accuracy_state", ACCURACY, accuracy, 999 * NS)
    return path


@pytest.mark.parametrize("node", ["", "/cell_sim_node"])
def test_each_robot_has_its_own_truth(tmp_path: Path, node: str) -> None:
    topics = [f"/{side}{node}/truth/state" for side in ("left", "right")]
    path = two_robots(tmp_path / "two.mcap", topics)
    left, right = courses(path)
    assert [left.topic, right.topic] == topics
    assert left.without_mm == pytest.approx(0.1)
    assert right.without_mm == pytest.approx(2.0)
    assert np.isnan(left.bound_mm)
    assert right.bound_mm == pytest.approx(2.5)
    assert (left.tolerance_mm, right.tolerance_mm) == (None, 0.3)
    with BagReader(path) as reader:
        truth = BagTruth(reader)
        for side, away in (("/left", 0.1), ("/right", 0.2)):
            ((_, T_flange_tool),) = truth.transforms(TOOL, side)
            assert T_flange_tool[2, 3] == pytest.approx(away)
            assert truth.transforms(HAND_EYE, side) == []
        assert truth.transforms(TOOL, "/other") == []


def test_two_truths_of_one_namespace_are_refused(tmp_path: Path) -> None:
    topics = [f"/{node}/truth/state" for node in ("left_sim", "right_sim")]
    with (
        BagReader(two_robots(tmp_path / "two.mcap", topics)) as reader,
        pytest.raises(InputError) as refused,
    ):
        BagTruth(reader).transforms(TOOL, "")
    for name in (*topics, "namespace '/'", "two.mcap"):
        assert name in str(refused.value)


# ---- what is no number --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "field"),
    [
        ({"faults": {"collision": np.nan}}, "faults.collision is nan"),
        ({"commanded_tcp_error_rms_m": np.inf}, "commanded_tcp_error_rms_m is inf"),
        ({"T_flange_tool": np.full((4, 4), np.nan).tolist()}, "T_flange_tool holds"),
        ({"T_flange_tool": [1.0]}, "T_flange_tool has the shape (1,)"),
    ],
)
def test_a_state_that_is_no_number_is_named(tmp_path: Path, state, field: str) -> None:
    path = tmp_path / "x.mcap"
    with BagWriter(path) as writer:
        writer.write(TOPIC, STRING, told(state), NS)
    with pytest.raises(InputError) as refused:
        courses(path)
    for name in ("x.mcap", TOPIC, field):
        assert name in str(refused.value)


def test_a_tolerance_that_is_no_number_is_named(bag: Path, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with BagWriter(path) as writer:
        writer.write(TOPIC, STRING, told({"tcp_error_rms_m": 1e-4}), 2 * NS)
        accuracy = {"bound_mm": 0.2, "tolerance_mm": np.nan}
        writer.write("/accuracy_state", ACCURACY, accuracy, NS)
    with pytest.raises(InputError, match=r"x\.mcap.*/accuracy_state.*tolerance_mm is nan"):
        courses(path)


# ---- a long shift -------------------------------------------------------------------------------


def test_a_long_shift_takes_little_memory(tmp_path: Path) -> None:
    """Two hours once a second, as long as a real state: of each are kept six numbers."""
    path, count = tmp_path / "long.mcap", 7200
    state = {"tcp_error_rms_m": 1e-4, "faults": {"collision": 2e-3}, "motor_k": [1.5] * 6}
    state |= {"T_flange_tool": np.eye(4).tolist()}
    with BagWriter(path) as writer:
        for i in range(count):
            writer.write(TOPIC, STRING, told(state), (1000 + i) * NS)
    with BagReader(path) as reader:
        tracemalloc.start()
        truth = BagTruth(reader)
        truth.transforms(TOOL, "")
        (states,) = truth.states.values()
        kept, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert len(states.stamp_ns) == count
    assert len(states.faults) == len(states.transforms["T_flange_tool"]) == 1
    assert kept < 2 * 48 * count  # the arrays grow ahead of their numbers
