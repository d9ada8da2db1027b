# SPDX-License-Identifier: Apache-2.0
"""thermal_node of a measuring robot, over DDS: cycles, and what the sensor sees, in base."""

import json
from typing import Any

import numpy as np
import pytest
from cell import DEEP, Cell
from geometry_msgs.msg import Point, PointStamped, PoseStamped
from robocal_msgs.srv import CorrectPoints
from scipy.stats import chi2
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

    def reference(self) -> dict[str, Any]:
        """The cold reference, as the session's record tells it."""
        last = [e for e in self.cell.events if e.command == "configure"][-1]
        told: dict[str, Any] = json.loads(last.arguments)["arguments"]["reference"]
        return told


def correct(graph: Any, points: list[PointStamped]) -> Any:
    return graph.call(CorrectPoints, "/thermal_node/correct_points", points=points)


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
    mount = np.array(measuring.reference()["T_flange_sensor"])
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


def test_points_are_placed_on_call_with_what_they_are_worth(measuring, graph):
    """A sphere seen from poses that no cycle visited is where it was when cold, within sigma."""
    cell, shift = measuring.cell, measuring.shift
    warm = warmed(measuring.cold)
    cell.play(shift.visit(warm, measuring.q, after_h=2.0))
    found = cell.call("identify", cycle_id="warm")
    assert cell.call("accept", id=found.candidate_id, by="me").success
    graph.spin_until(lambda: cell.models[-1].revision == 1, "the model is in force")
    way = list(shift.visit(warm, looking(12, seed=21)))
    cell.play([s for s in way if isinstance(s, JointSample)])
    newest = way[-1].stamp_ns
    graph.spin_until(
        lambda: stamp_ns(measuring.poses[-1].header.stamp) == newest, "the joints came"
    )
    seen = [s for s in way if not isinstance(s, JointSample)]
    asked = [
        PointStamped(header=header(s.stamp_ns, FRAME), point=Point(x=x, y=y, z=z))
        for s in seen
        for x, y, z in [s.position_m.tolist()]
    ]
    told = correct(graph, asked)
    assert told.success, told.message
    assert list(told.reasons) == [""] * len(seen)
    reference = measuring.reference()
    centres = dict(zip(reference["sphere"], np.array(reference["centre"]), strict=True))
    places = np.array([[p.point.x, p.point.y, p.point.z] for p in told.corrected])
    off = places - np.array([centres[s.target] for s in seen])
    sigma = np.array(told.sigma_mm) * 1e-3
    assert np.all(sigma > 0.0)
    # Errors of a rigid arm's parameters are common to all of them: some six independent numbers.
    ratio = np.mean(np.sum(off**2, axis=1)) / np.mean(sigma**2)
    low, high = chi2.ppf([0.0005, 0.9995], 6) / 6
    assert low < ratio < high

    late, early = asked[0], asked[1]
    late.header.stamp = header(newest + 5_000_000, FRAME).stamp
    early.header.stamp = header(newest - 3600_000_000_000, FRAME).stamp
    asked[2].header.frame_id = "another"
    part = correct(graph, asked[:4])
    assert (part.success, part.status) == (False, Code.BAD_INPUT)
    assert [bool(why) for why in part.reasons] == [True, True, True, False]
    assert [s < 0.0 for s in part.sigma_mm] == [True, True, True, False]
    assert np.isnan(part.corrected[0].point.x)
    assert part.corrected[3].point == told.corrected[3].point


def test_a_knocked_sensor_sees_nothing_in_base(measuring, graph):
    """After a step that no drift explains neither the call nor the topics give a place."""
    cell, shift = measuring.cell, measuring.shift
    knock = frames.transform(frames.exp_rotation([0.0, 1e-3, 0.0]), [8e-4, 0.0, 5e-4])
    shift.T_flange_sensor = T_FLANGE_SENSOR @ knock
    cell.play(shift.visit(measuring.cold, measuring.q, after_h=0.1))
    found = cell.call("identify", cycle_id="knocked")
    assert found.status == Code.SENSOR_OR_ROBOT_MOVED, found.message
    way = list(shift.visit(measuring.cold, looking(1, seed=3)))
    measuring.send(way[-1].stamp_ns)
    cell.play([s for s in way if isinstance(s, JointSample)])

    def told() -> bool:
        status = cell.status()
        words = "" if status is None else " ".join(v.value for v in status.values)
        return words.count("the sensor moved on the flange") >= 2  # of either topic

    graph.spin_until(told, "why nothing is placed")
    assert not measuring.points
    assert not measuring.clouds
