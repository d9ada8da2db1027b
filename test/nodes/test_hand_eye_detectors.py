# SPDX-License-Identifier: Apache-2.0
"""hand_eye_node over DDS with what cameras and detectors publish: compressed images, tags on tf."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_driver import CHARUCO_FILE, LENS, board_file, board_set, camera_info, compressed, image
from command import robocal_json
from geometry_msgs.msg import PoseStamped, TransformStamped
from hand_eye_driver import ARM, FRAME, T_BASE_BOARD, Recorded, sphere_set, target_pose
from hand_eye_live import NAME, SHOTS, STREAM, LiveSensor, filled, recorded
from robocal_msgs.msg import HandEyeSample, HandEyeStatus, SessionEvent
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage
from transforms import off_m

from robocal_ros.adapter.node import AdapterNode
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.data import TARGET_POSE
from robocal_ros.ros import endpoints
from robocal_ros.ros.endpoints import ERROR, OK, WARN
from robocal_ros.ros.session_node import EVENTS

CAMERA = HandEyeStatus.CAMERA
TAG = "tag36h11:0"
COUNT = 8


def replayed_alike(graph: Any, folder: Path, sensor: LiveSensor, live: list, result: Any) -> None:
    """A recording of the session gives its result again, bit for bit."""
    graph.spin_until(lambda: any(one.command == "calibrate" for one in live), "the events")
    document = robocal_json("replay.hand_eye.json", "replay", recorded(folder, sensor.sent, live))
    assert document["differs"] == []
    (again,) = document["calibrations"]
    t = result.sensor.translation
    assert again["T_flange_sensor"]["xyz_mm"] == [1e3 * t.x, 1e3 * t.y, 1e3 * t.z]


@pytest.mark.long
def test_compressed_images_of_a_marked_board_before_a_camera_that_tells_its_lens(
    graph: Any, tmp_path: Path
) -> None:
    sensor = LiveSensor(graph, tmp_path, limit_mm=2.0, capture_timeout_s=2.0)
    shots = board_set(COUNT, marked=True)
    sensor.robot.q = shots.q[0]
    file = tmp_path / "charuco.yaml"
    file.write_text(CHARUCO_FILE + "intrinsics: camera_info\n")
    early = sensor.start(target=CAMERA, target_file=str(file))
    assert (early.success, early.status) == (False, Code.BAD_INPUT)
    assert "no camera_info has come yet" in early.message
    info = graph.publisher(CameraInfo, "camera_info", endpoints.SENSOR)
    heard = sensor.node.inputs["camera_info"]

    def tell(message: CameraInfo) -> None:
        before = heard.received
        info.publish(message)
        graph.spin_until(lambda: heard.received > before, "camera_info")

    graph.spin_until(info.get_subscription_count, "the node")
    tell(camera_info())
    live = graph.collect(SessionEvent, f"{NAME}/session_events", EVENTS)
    assert sensor.start(target=CAMERA, target_file=str(file)).success
    for q, pixels in zip(shots.q, shots.images, strict=True):
        sensor.robot.move(q, 0.2)
        told = sensor.capture(lambda ns, pixels=pixels: compressed(ns, pixels), hz=5)
        assert told.state == HandEyeSample.CAPTURED, told.reason
    result = sensor.calibrate()
    assert result.success, result.message
    assert result.samples == COUNT
    assert (
        off_m(result.sensor, shots.cell.camera.matrices()[0], 0.55) < 2e-3
    )  # the limit of acceptance
    replayed_alike(graph, tmp_path, sensor, live, result)
    tell(camera_info(binning_x=2, binning_y=2))
    refused = sensor.ask_capture()
    assert (refused.success, refused.status) == (False, Code.BAD_INPUT)
    assert "camera_info differs from the intrinsics of the data set in the size" in refused.message
    moved = camera_info()
    moved.k[2] += 1.5
    tell(moved)
    assert "by up to 1.5 px: was it set anew?" in sensor.ask_capture().message
    tell(camera_info(header=Header(frame_id="other_camera")))
    refused = sensor.ask_capture()
    assert "camera_info in frame 'other_camera', the images' frame is" in refused.message
    assert sensor.node.health().level == ERROR
    tell(camera_info())
    assert sensor.ask_capture().success


def test_a_file_of_intrinsics_that_the_camera_contradicts_is_told(
    graph: Any, tmp_path: Path
) -> None:
    """It counts all the same: who calibrated the lens may know better than its driver."""
    sensor = LiveSensor(graph, tmp_path, capture_timeout_s=2.0)
    sensor.robot.q = board_set().q[0]
    info = graph.publisher(CameraInfo, "camera_info", endpoints.SENSOR)
    file = str(board_file(tmp_path, intrinsics=True))
    assert sensor.start(target=CAMERA, target_file=file).success
    for message, words in (
        (camera_info(), ""),
        (
            camera_info(k=[LENS.fx, 0.0, LENS.cx + 3, 0.0, LENS.fy, LENS.cy, 0.0, 0.0, 1.0]),
            "3.0 px",
        ),
        (camera_info(k=[0.0] * 9), ""),
        (camera_info(header=Header(frame_id="other_camera")), "frame 'other_camera', the images'"),
    ):
        heard = sensor.node.inputs["camera_info"]
        before = heard.received
        graph.spin_until(info.get_subscription_count, "the node")
        info.publish(message)
        graph.spin_until(lambda heard=heard, before=before: heard.received > before, "camera_info")
        health = sensor.node.health()
        assert ("camera_info" in str(health.message)) == bool(words)
        assert words in str(health.message)
    told = sensor.capture(lambda ns: image(ns, board_set().images[0]), hz=5)
    assert told.state == HandEyeSample.CAPTURED, told.reason


class SensorOfTags(LiveSensor):
    """Its detector puts the tag onto tf, as apriltag_ros does, where the robot's links are too."""

    def __init__(self, graph: Any, folder: Path) -> None:
        self.adapter = graph.add(AdapterNode, {"target_frame": TAG})
        super().__init__(graph, folder, target="camera", target_file="")
        graph.probe.destroy_publisher(self._publishers[TARGET_POSE])
        self.tf = graph.publisher(TFMessage, "/tf", STREAM)
        self._publishers[TARGET_POSE] = self
        graph.spin_until(self.heard, "the adapter")

    def heard(self) -> bool:
        return any(one.node_name == "adapter_node"
                   for one in self.graph.probe.get_subscriptions_info_by_topic("/tf"))  # fmt: skip

    def tell(self, pose: PoseStamped, camera: str = "", tag: str = TAG) -> None:
        """The tag on tf beside a link of the robot, and once more, as some publishers do."""
        p, link = pose.pose.position, TransformStamped(child_frame_id="link_1")
        seen = TransformStamped(header=pose.header, child_frame_id=tag)
        seen.header.frame_id = camera or pose.header.frame_id
        seen.transform.rotation = pose.pose.orientation
        t = seen.transform.translation
        t.x, t.y, t.z = p.x, p.y, p.z
        for _ in range(2):
            self.tf.publish(TFMessage(transforms=[link, seen]))

    def publish(self, message: Recorded | PoseStamped) -> None:
        if isinstance(message, PoseStamped):
            self.tell(message)
        else:
            super().publish(message)


def test_a_camera_by_a_tag_on_tf(graph: Any, tmp_path: Path) -> None:
    """0.05 mm and 0.02 deg of noise, as `test_a_camera_by_the_poses_of_its_target`."""
    sensor = SensorOfTags(graph, tmp_path)
    assert sensor.adapter.health().level == WARN
    assert f"no {TAG} on /tf yet" in str(sensor.adapter.health().message)
    live = graph.collect(SessionEvent, f"{NAME}/session_events", EVENTS)
    truth, rng = sphere_set()[0].T_flange_sensor, np.random.default_rng(2)
    assert sensor.start().success
    for q, _ in SHOTS[:10]:
        noise = frames.exp_rotation(np.radians(0.02) * rng.standard_normal(3))
        tag = frames.transform(noise, 5e-5 * rng.standard_normal(3))
        seen = frames.invert(ARM.fk(q) @ truth) @ T_BASE_BOARD @ tag
        sensor.robot.move(q, 0.2)
        told = sensor.capture(lambda ns, seen=seen: target_pose(ns, seen))
        assert told.state == HandEyeSample.CAPTURED, told.reason
    result = sensor.calibrate()
    assert result.success, result.message
    assert off_m(result.sensor, truth, 0.5) < 5e-4
    health = sensor.adapter.health()
    poses = sum(one.kind == TARGET_POSE for one in sensor.sent)
    assert (health.level, health.values["target poses"]) == (OK, poses)  # none of them twice
    assert health.values["cameras"] == FRAME
    replayed_alike(graph, tmp_path, sensor, live, result)
    # A second camera sees the tag too: it is told, and hand_eye_node takes its own alone.
    last = filled(PoseStamped(), target_pose(sensor.robot.now_ns, np.eye(4)).fields)
    sensor.tell(last, camera="other_camera")
    graph.spin_until(lambda: sensor.adapter.health().level == WARN, "both cameras")
    assert f"in frames {FRAME}, other_camera" in str(sensor.adapter.health().message)
