"""What a bag tells of its cell's truth, as ``robocal validate`` reads it."""

import json
from pathlib import Path

import numpy as np
import pytest

from robocal_ros.cli.bag_truth import TOOL, true_transforms
from robocal_ros.cli.validating_cell import cell_course
from robocal_ros.storage.bag_writer import BagWriter
from robocal_ros.storage.bags import BagReader

NS = 1_000_000_000
TOPIC = "/cell_sim_node/truth/state"


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
            told = {"data": json.dumps({"simulated": True} | state)}
            writer.write(TOPIC, "std_msgs/msg/String", told, at_ns)
            accuracy = {"bound_mm": -1.0 if i == 0 else 0.2, "tolerance_mm": 0.3}
            kind = "robocal_msgs/msg/AccuracyState"
            writer.write("/accuracy_state", kind, accuracy, at_ns - 900 * NS * (i > 0))
    return path


def test_the_course_is_what_was_told(bag: Path) -> None:
    with BagReader(bag) as reader:
        course = cell_course(reader)
    assert course is not None
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
        ((stamp_ns, T_flange_tool),) = true_transforms(reader, TOOL, "T_flange_tool")
    assert stamp_ns == 1000 * NS
    np.testing.assert_array_equal(T_flange_tool, np.eye(4))


def test_a_bag_without_a_truth_has_no_course(tmp_path: Path) -> None:
    path = tmp_path / "plain.mcap"
    with BagWriter(path) as writer:
        writer.write("/note", "std_msgs/msg/String", {"data": "x"}, NS)
    with BagReader(path) as reader:
        assert cell_course(reader) is None
