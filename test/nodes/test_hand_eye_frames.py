# SPDX-License-Identifier: Apache-2.0
"""hand_eye_node beside somebody else who puts the sensor's frame onto tf."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Transform, TransformStamped
from hand_eye_driver import FRAME
from hand_eye_live import NAME, LiveSensor
from robocal_msgs.srv import Decide, ListCalibrations
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from robocal_ros.ground.errors import Code
from robocal_ros.ros import endpoints
from robocal_ros.ros.endpoints import ERROR
from robocal_ros.ros.graph import FRESH_S
from robocal_ros.session.events import ACCEPT, Command


def below(parent: str, transform: Transform) -> TFMessage:
    message = TransformStamped(child_frame_id=FRAME, transform=transform)
    message.header.frame_id = parent
    return TFMessage(transforms=[message])


def error_of(sensor: LiveSensor) -> str:
    health = sensor.node.health()
    return str(health.message) if health.level == ERROR else ""


@pytest.fixture
def calibrated(graph: Any, tmp_path: Path) -> tuple[LiveSensor, Any]:
    sensor = LiveSensor(graph, tmp_path)
    sensor.sphere(8)
    return sensor, sensor.calibrate()


def test_the_joint_of_a_urdf_is_told_from_the_candidate(
    graph: Any, calibrated: tuple[LiveSensor, Any]
) -> None:
    sensor, result = calibrated
    urdf = graph.publisher(TFMessage, "/tf_static", endpoints.LATCHED)
    drawn = deepcopy(result.sensor)
    drawn.translation.x += 0.01
    urdf.publish(below("tool0", drawn))

    def refused() -> Any:
        return sensor.node._frame_fault(Command(ACCEPT, {"id": result.candidate_id}))

    graph.spin_until(refused, "the joint is seen")
    told = graph.call(Decide, f"{NAME}/accept", id=result.candidate_id, by="me")
    assert (told.success, told.status) == (False, Code.BAD_INPUT)
    for words in ("'tool0' to 'laser'", "10.000 mm", "out of the URDF", "another name"):
        assert words in told.message
    # A description that was exported from this very calibration says the same: no conflict.
    urdf.publish(below("tool0", result.sensor))
    graph.spin_until(lambda: not refused(), "the pose agrees")
    assert graph.call(Decide, f"{NAME}/accept", id=result.candidate_id, by="me").success
    assert error_of(sensor) == ""
    # Who comes later is told of too.
    urdf.publish(below("tool0", drawn))
    graph.spin_until(lambda: "out of the URDF" in error_of(sensor), "the diagnostics")


def test_tf_is_listened_to_only_for_an_answer(graph: Any, tmp_path: Path) -> None:
    """A robot's /tf is many messages; who puts the frame there late is heard all the same."""
    transform = Transform()
    transform.rotation.w = 1.0
    told = below("base", transform)
    told.transforms[0].child_frame_id = "gripper"
    tf = graph.probe.create_publisher(TFMessage, "/tf", endpoints.own(endpoints.RELIABLE))
    graph.probe.create_timer(0.05, lambda: tf.publish(told))
    sensor = LiveSensor(graph, tmp_path)

    def listens() -> int:
        return int(graph.probe.count_subscribers("/tf"))

    graph.spin_until(listens, "it listens")
    sensor.sphere(8)
    result = sensor.calibrate()
    graph.spin_until(lambda: sensor.node._frames.settled and not listens(), "it has heard enough")
    told = below("camera_rail", transform)
    sensor.node._frames._ended -= FRESH_S  # as a while later
    refused = graph.call(Decide, f"{NAME}/accept", id=result.candidate_id, by="me")
    assert (refused.success, refused.status) == (False, Code.BAD_INPUT)
    assert "'camera_rail'" in refused.message
    graph.spin_until(lambda: not listens(), "it has heard enough again")


def test_an_accept_waits_until_all_was_heard(
    graph: Any, calibrated: tuple[LiveSensor, Any]
) -> None:
    sensor, result = calibrated
    urdf = graph.publisher(TFMessage, "/tf_static", endpoints.LATCHED)
    urdf.publish(below("camera_rail", result.sensor))
    for step in ("deactivate", "activate"):
        getattr(sensor.node, f"trigger_{step}")()
    assert not sensor.node._frames.settled
    early = graph.call(Decide, f"{NAME}/accept", id=result.candidate_id, by="me")
    assert (early.success, early.status) == (False, Code.BAD_INPUT)
    assert "'camera_rail'" in early.message
    assert "'tool0'" in early.message
    twin = graph.call(Trigger, f"{NAME}/accept_trigger")
    assert twin.message.startswith("0 BAD_INPUT tf shows")
    (listed,) = graph.call(ListCalibrations, f"{NAME}/list").calibrations
    assert listed.state == "pending"
    # One that waits while the node is deactivated is answered.
    sensor.node._frames._listen_anew()
    asked = graph._clients[f"{NAME}/accept"].call_async(
        Decide.Request(id=result.candidate_id, by="me")
    )
    graph.spin_for(0.3)
    assert not asked.done()
    sensor.node.trigger_deactivate()
    graph.spin_until(asked.done, "the answer")
    assert (asked.result().success, asked.result().status) == (False, Code.CONFLICT)
    # Once the other publisher has gone, nothing stands in the way.
    graph.probe.destroy_publisher(urdf)
    sensor.node.trigger_activate()
    assert graph.call(Decide, f"{NAME}/accept", id=result.candidate_id, by="me").success


def test_the_twin_looks_at_the_candidate_that_it_would_accept(
    graph: Any, calibrated: tuple[LiveSensor, Any]
) -> None:
    sensor, result = calibrated
    assert sensor.calibrate().candidate_id > result.candidate_id
    rail = graph.publisher(TFMessage, "/tf_static", endpoints.LATCHED)
    rail.publish(below("camera_rail", result.sensor))
    graph.spin_until(
        lambda: sensor.node._frame_fault(Command(ACCEPT, {"id": result.candidate_id})), "it is seen"
    )
    twin = graph.call(Trigger, f"{NAME}/accept_trigger")
    assert twin.message.startswith("0 CONFLICT exactly one fresh candidate must be pending")


def test_a_frame_that_is_taken_at_the_start_is_not_published(
    graph: Any, calibrated: tuple[LiveSensor, Any]
) -> None:
    sensor, result = calibrated
    assert graph.call(Decide, f"{NAME}/accept", id=result.candidate_id, by="me").success
    for step in ("deactivate", "cleanup"):
        getattr(sensor.node, f"trigger_{step}")()
    rail = Transform()
    rail.rotation.w = 1.0
    others = graph.probe.create_publisher(TFMessage, "/tf_static", endpoints.own(endpoints.LATCHED))
    others.publish(below("camera_rail", rail))
    tf = graph.collect(TFMessage, "/tf_static", endpoints.LATCHED)
    for step in ("configure", "activate"):
        getattr(sensor.node, f"trigger_{step}")()
    graph.spin_until(lambda: sensor.node._frames.settled, "all was heard")
    graph.spin_for(0.7)  # a round of the node's watch
    shown = [t.header.frame_id for m in tf for t in m.transforms if t.child_frame_id == FRAME]
    assert set(shown) == {"camera_rail"}
    assert "camera_rail" in error_of(sensor)
    # It comes as soon as the other has gone.
    graph.probe.destroy_publisher(others)
    graph.spin_until(lambda: tf[-1].transforms[0].header.frame_id == "tool0", "it is published")
    got = tf[-1].transforms[0].transform.translation
    wanted = result.sensor.translation
    assert np.allclose([got.x, got.y, got.z], [wanted.x, wanted.y, wanted.z], atol=0.0)
