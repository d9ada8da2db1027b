# SPDX-License-Identifier: Apache-2.0
"""hand_eye_node over DDS: a simulated robot brings a camera before a chessboard."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_driver import LENS, board_file, board_set, image
from command import robocal_json
from hand_eye_live import NAME, LiveSensor, recorded
from robocal_msgs.msg import HandEyeSample, HandEyeStatus, SessionEvent
from robocal_msgs.srv import HandEyeFile
from transforms import matrix_of, off_m

from robocal_ros.bags.bags import read_bag
from robocal_ros.ground.errors import Code
from robocal_ros.ros.session_node import EVENTS

COUNT = 8
CAMERA = HandEyeStatus.CAMERA


def showing(pixels: np.ndarray, encoding: str = "mono8") -> Any:
    return lambda stamp_ns: image(stamp_ns, pixels, encoding=encoding)


@pytest.fixture
def camera(graph: Any, tmp_path: Path) -> LiveSensor:
    sensor = LiveSensor(graph, tmp_path, limit_mm=2.0, capture_timeout_s=2.0)
    sensor.robot.q = board_set().q[0]
    file = str(board_file(tmp_path, intrinsics=True))
    assert sensor.start(target=CAMERA, target_file=file).success
    return sensor


def seen_all(camera: LiveSensor) -> None:
    for q, pixels in list(zip(board_set().q, board_set().images, strict=True))[:COUNT]:
        camera.robot.move(q, 0.2)
        told = camera.capture(showing(pixels), hz=5)
        assert told.state == HandEyeSample.CAPTURED, told.reason
        assert told.reason.startswith("54 corners")


def test_a_camera_is_calibrated_from_images_and_replayed_to_the_last_bit(
    graph: Any, camera: LiveSensor, tmp_path: Path
) -> None:
    live = graph.collect(SessionEvent, f"{NAME}/session_events", EVENTS)
    assert camera.start(target=CAMERA, target_file=str(tmp_path / "board.yaml")).success
    failed = camera.capture(showing(np.full((LENS.height, LENS.width), 90, np.uint8)), hz=5)
    assert (failed.state, failed.status) == (HandEyeSample.FAILED, Code.BAD_INPUT)
    assert "no board of 9x6 inner corners" in failed.reason
    seen_all(camera)
    result = camera.calibrate()
    assert result.success, result.message
    assert result.samples == COUNT
    # at the board; the limit of what is accepted
    assert off_m(result.sensor, board_set().cell.camera.matrices()[0], 0.55) < 2e-3
    path = str(graph.state / "K7" / "hand_eye" / "set.mcap")
    assert graph.call(HandEyeFile, f"{NAME}/save", path=path).success
    assert [m.topic for m in read_bag(path)] == ["data_set", *["joint_states", "image"] * COUNT]
    loaded = graph.call(HandEyeFile, f"{NAME}/load", path=path)
    assert (loaded.success, loaded.samples) == (True, COUNT), loaded.message
    again = camera.calibrate()
    assert (again.sensor, again.covariance) == (result.sensor, result.covariance)
    commands = 1 + 2 * (1 + COUNT) + 1 + 1 + 1
    graph.spin_until(lambda: len(live) >= commands + 2, "all events, with the configuration")
    bag = recorded(tmp_path, camera.sent, live)
    document = robocal_json("replay.hand_eye.json", "replay", bag)
    assert document["differs"] == []
    first, second = document["calibrations"]
    assert first["T_flange_sensor"] == second["T_flange_sensor"]
    assert first["T_flange_sensor"]["xyz_mm"] == pytest.approx(
        1e3 * matrix_of(result.sensor)[:3, 3], abs=1e-12
    )
    failures = [
        c for c in document["commands"] if c["command"] == "sample" and c["code"] != "ACCEPT"
    ]
    assert [c["code"] for c in failures] == ["BAD_INPUT"]


def test_images_that_are_not_read_are_named(graph: Any, camera: LiveSensor) -> None:
    pixels = board_set().images[0]
    for shot, words in (
        (showing(pixels, "mono16"), "encoding 'mono16' are not read"),
        (showing(pixels, "rgb8"), "do not hold 480 rows"),
        (None, "does the sensor publish it"),
    ):
        failed = camera.capture(shot, 2.3, hz=5)
        assert failed.state == HandEyeSample.FAILED
        assert words in failed.reason
    wrong = camera.start(target=HandEyeStatus.STEP, target_file=str(Path(graph.state) / "none"))
    assert (wrong.success, wrong.status) == (False, Code.BAD_INPUT)
    assert camera.node.is_active
    assert camera.capture(showing(pixels), hz=5).state == HandEyeSample.CAPTURED
