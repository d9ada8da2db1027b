"""hand_eye_node beside somebody else who puts the sensor's frame onto tf."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Transform, TransformStamped
from hand_eye_driver import FRAME
from hand_eye_live import NAME, LiveSensor
from robocal_msgs.srv import Decide
from tf2_msgs.msg import TFMessage

from robocal_ros.core.codes import Code
from robocal_ros.nodes import qos
from robocal_ros.nodes.diagnostics import ERROR
from robocal_ros.sessions.events import ACCEPT, Command


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
    urdf = graph.publisher(TFMessage, "/tf_static", qos.LATCHED)
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


def test_a_frame_that_is_taken_at_the_start_is_not_published(
    graph: Any, calibrated: tuple[LiveSensor, Any]
) -> None:
    sensor, result = calibrated
    assert graph.call(Decide, f"{NAME}/accept", id=result.candidate_id, by="me").success
    for step in ("deactivate", "cleanup"):
        getattr(sensor.node, f"trigger_{step}")()
    rail = Transform()
    rail.rotation.w = 1.0
    others = graph.probe.create_publisher(TFMessage, "/tf_static", qos.own(qos.LATCHED))
    others.publish(below("camera_rail", rail))
    tf = graph.collect(TFMessage, "/tf_static", qos.LATCHED)
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
