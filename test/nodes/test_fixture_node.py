# SPDX-License-Identifier: Apache-2.0
"""fixture_node over DDS: taught, moved, measured, accepted, rolled back."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from fixture_driver import mounted, visit
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from rclpy.qos import HistoryPolicy, QoSProfile
from robocal_msgs.msg import CalibrationQuality
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from transforms import matrix_of

from bench.measured_fixture import ARM, FRAME, PLATE, MeasuredFixture
from robocal_ros.cell_sim.fixture import T_FLANGE_SENSOR
from robocal_ros.fixture.files import fixture_document
from robocal_ros.fixture.node import FixtureNode
from robocal_ros.fixture.session import POINT
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import JOINTS
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import header

STREAM = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=2000)
NAME = "/fixture_node"


@pytest.fixture
def cell(graph, tmp_path):
    with CalibrationHistory.open("F1", model_hash=ARM.model_hash, state_dir=tmp_path) as history:
        mounted(history)
    file = tmp_path / "plate.yaml"
    file.write_text(json.dumps(fixture_document(PLATE)))
    frame = graph.collect(PoseWithCovarianceStamped, f"{NAME}/frame", endpoints.LATCHED)
    quality = graph.collect(CalibrationQuality, f"{NAME}/quality", endpoints.LATCHED)
    settings = {"robot": "kr150_r3100", "serial": "F1", "state_dir": str(tmp_path)}
    settings |= {"fixture_file": str(file), "sensor_frame": FRAME}
    node = graph.add(FixtureNode, settings)
    out = {JOINTS: graph.publisher(JointState, JOINTS, STREAM)}
    out[POINT] = graph.publisher(PointStamped, POINT, STREAM)
    graph.spin_for(0.2)
    told = []

    def show(points, begin_s):
        """Publish what a gap's standstills give, and see it taken."""
        for one in visit(points, begin_s):
            sample = one.message
            if one.topic == JOINTS:
                message = JointState(header=header(sample.stamp_ns, ""))
                message.name, message.position = list(sample.names), sample.position.tolist()
            else:
                message = PointStamped(header=header(sample.stamp_ns, sample.frame))
                message.point.x, message.point.y, message.point.z = sample.p.tolist()
            out[one.topic].publish(message)
            told.append(one)  # at most two are on their way, so that topics stay in step
            graph.spin_until(lambda: sum(c.received for c in node.inputs.values()) >= len(told) - 2)
        graph.spin_until(lambda: node._session.points == len(points))

    def call(name):
        answer = graph.call(Trigger, f"{NAME}/{name}_trigger")
        return answer.success, answer.message

    return SimpleNamespace(show=show, call=call, frame=frame, quality=quality, graph=graph)


def test_a_fixture_is_taught_found_moved_accepted_and_rolled_back(cell):
    world = MeasuredFixture(3)
    cell.show(world.points(world.faults(), 3, 1), 10.0)
    assert cell.call("measure")[1].split()[1] == "CONFLICT", "nothing is taught yet"
    assert cell.call("teach")[0]
    assert cell.call("accept")[0]
    cell.graph.spin_until(lambda: len(cell.frame) == 1)
    cell.show(world.points(world.faults("fixture_moved", 5e-4), 2, 2), 100.0)
    done, words = cell.call("measure")
    assert done, words
    assert "plate moved by 0.5" in words
    cell.graph.spin_until(lambda: cell.quality[-1].code == Code.ACCEPT)
    assert cell.call("accept")[0]
    cell.graph.spin_until(lambda: len(cell.frame) == 2)
    told = cell.frame[-1].pose
    assert np.all(np.diag(np.reshape(told.covariance, (6, 6))) > 0.0)
    before, after = (matrix_of(one.pose.pose) for one in cell.frame[-2:])
    change = SimpleNamespace(change=after @ frames.invert(before))
    assert world.worst_m(change, "fixture_moved", 5e-4) < 1e-4
    assert cell.call("rollback")[0]
    cell.graph.spin_until(lambda: len(cell.frame) == 3)
    assert cell.frame[-1].pose.pose.position.x == cell.frame[0].pose.pose.position.x


def test_after_a_rollback_to_nothing_a_late_subscriber_gets_no_frame(cell):
    world = MeasuredFixture(3)
    topic = PoseWithCovarianceStamped, f"{NAME}/frame", endpoints.LATCHED
    cell.show(world.points(world.faults(), 1, 1), 10.0)
    assert cell.call("teach")[0]
    assert cell.call("accept")[0]
    cell.graph.spin_until(lambda: len(cell.frame) == 1)
    assert cell.call("rollback")[0]
    late = cell.graph.collect(*topic)
    cell.show(world.points(world.faults(), 1, 2), 100.0)
    assert cell.call("teach")[0]
    assert not late
    assert cell.call("accept")[0]
    cell.graph.spin_until(lambda: late and len(cell.frame) == 2)
    assert late == cell.frame[1:], "who was there before hears of the next one too"


def test_diagnostics_warn_of_a_fixture_that_another_place_of_the_sensor_taught(cell, tmp_path):
    world = MeasuredFixture(3)
    said = cell.graph.collect(DiagnosticArray, "/diagnostics")
    newest = lambda: said[-1].status[0] if said else DiagnosticStatus()  # noqa: E731
    cell.show(world.points(world.faults(), 1, 1), 10.0)
    assert cell.call("teach")[0]
    assert cell.call("accept")[0]
    taught = lambda: any(one.value == "yes" for one in newest().values)  # noqa: E731
    cell.graph.spin_until(taught)
    assert "taught" not in newest().message
    placed = {one.key: one.value for one in newest().values}["placed"]
    assert placed == "tool by the robot file, feature_sensor by calibration 1"
    with CalibrationHistory.open("F1", model_hash=ARM.model_hash, state_dir=tmp_path) as history:
        mounted(history, T_FLANGE_SENSOR @ frames.transform(np.eye(3), [4e-4, 0.0, 0.0]))
    words = "another place of feature_sensor 0.400 mm away"
    cell.graph.spin_until(lambda: words in newest().message)
    assert newest().level == DiagnosticStatus.WARN
