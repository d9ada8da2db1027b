# SPDX-License-Identifier: Apache-2.0
"""thermal_node of a measuring robot, over DDS: cycles, and what the sensor sees, in base."""

import json
from typing import Any

import numpy as np
import pytest
from cell import DEEP, Cell
from geometry_msgs.msg import Point, PointStamped, PoseStamped
from sensor_msgs.msg import PointCloud2
from shift import T_FLANGE_SENSOR, MeasuringShift, built, looking, warmed

from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import JointSample, cloud_points, stamp_ns
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import cloud, header

FRAME, POSES = "scanner", 6
SEEN = np.array([[0.02, -0.03, 0.6], [-0.05, 0.01, 0.7]])


class MeasuringCell:
    """A node with a cold reference, the robot before its spheres, and the corrected topics."""

    def __init__(self, graph: Any) -> None:
        self.graph, self.nominal = graph, load_robot("kr150_r3100")
        self.shift = MeasuringShift(self.nominal.joint_names)
        self.cold, self.q = built(self.nominal), looking(POSES)
        self.poses = graph.collect(PoseStamped, "/thermal_node/flange_pose", endpoints.STREAM)
        self.points = graph.collect(PointStamped, "/thermal_node/corrected_point")
        self.clouds = graph.collect(PointCloud2, "/thermal_node/corrected_cloud")
        probe = graph.probe
        self.point = probe.create_publisher(PointStamped, "/point", DEEP)
        self.cloud = probe.create_publisher(PointCloud2, "/cloud", DEEP)
        self.cell = Cell(graph, arrangement="flange-sensor")
        graph.spin_until(
            lambda: all(p.get_subscription_count() for p in (self.point, self.cloud)),
            "the node takes points",
        )
        self.cell.play(self.shift.visit(self.cold, self.q))

    def send(self, stamp: int, frame: str = FRAME) -> None:
        """One point, and two as a cloud, seen at a stamp."""
        x, y, z = SEEN[0].tolist()
        self.point.publish(PointStamped(header=header(stamp, frame), point=Point(x=x, y=y, z=z)))
        lost = np.full((1, 3), np.nan)  # where nothing returned
        self.cloud.publish(cloud(stamp, frame, np.vstack([SEEN, lost])))

    def mount(self) -> np.ndarray:
        """T_flange_sensor (4, 4) of the cold reference, as the session's record tells it."""
        last = [e for e in self.cell.events if e.command == "configure"][-1]
        return np.array(json.loads(last.arguments)["arguments"]["reference"]["T_flange_sensor"])


@pytest.fixture
def measuring(graph) -> MeasuringCell:
    made = MeasuringCell(graph)
    captured = made.cell.call("capture_reference")
    assert captured.success, captured.message
    return made


def test_points_are_told_in_base_by_the_model_in_force(measuring, graph):
    cell, shift = measuring.cell, measuring.shift
    warm = warmed(measuring.cold)
    cell.play(shift.visit(warm, measuring.q, after_h=2.0))
    found = cell.call("identify", cycle_id="warm")
    assert found.status == Code.ACCEPT, found.message
    assert cell.call("accept", id=found.candidate_id, by="me").success
    graph.spin_until(lambda: cell.models[-1].revision == 1, "the model is in force")
    way = list(shift.visit(warm, looking(2, seed=8)))
    joints = [s for s in way if isinstance(s, JointSample)]
    moving = joints[10].stamp_ns + 4_000_000  # between two readings, in motion
    measuring.send(moving)
    cell.play(joints)
    graph.spin_until(lambda: measuring.points and measuring.clouds, "corrected points")
    graph.spin_until(
        lambda: stamp_ns(measuring.poses[-1].header.stamp) == joints[-1].stamp_ns, "flange poses"
    )
    point, many = measuring.points[-1], measuring.clouds[-1]
    assert point.header.frame_id == many.header.frame_id == "base"
    assert stamp_ns(point.header.stamp) == stamp_ns(many.header.stamp) == moving
    q = joints[10].position + 0.4 * (joints[11].position - joints[10].position)
    told = np.array([point.point.x, point.point.y, point.point.z])
    # Where it truly is, but for the mount, which is known as far as the cold arm knew itself: the
    # drift at hand is told, of what a model without it would miss.
    warmth = frames.apply(warm.fk(q) @ T_FLANGE_SENSOR, SEEN[:1])[0]
    drift = warmth - frames.apply(measuring.cold.fk(q) @ T_FLANGE_SENSOR, SEEN[:1])[0]
    mount = measuring.mount()
    told_drift = told - frames.apply(measuring.nominal.fk(q) @ mount, SEEN[:1])[0]
    assert np.linalg.norm(drift) > 2e-4
    assert np.linalg.norm(told_drift - drift) < 0.5 * np.linalg.norm(drift)
    assert cloud_points(many)[0] == pytest.approx(told, abs=1e-6)  # 32 bit
    assert len(cloud_points(many)) == len(SEEN)


def test_what_cannot_be_placed_is_counted(graph):
    measuring = MeasuringCell(graph)  # no reference yet
    newest = measuring.shift.now_ns
    measuring.send(newest)
    cell = measuring.cell

    def told(key: str) -> bool:
        status = cell.status()
        return status is not None and any(key in v.key or key in v.value for v in status.values)

    graph.spin_until(lambda: told("the sensor is not placed"), "why nothing is placed")
    assert cell.call("capture_reference").success
    measuring.send(newest, "another")
    graph.spin_until(lambda: told("is not the placed sensor's"), "another sensor is not this one")
    measuring.send(newest - 60_000_000_000)
    graph.spin_until(lambda: told("no joint readings about"), "older than the joint readings")
    assert not measuring.points
    assert not measuring.clouds
