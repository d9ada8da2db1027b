# SPDX-License-Identifier: Apache-2.0
"""Hand-eye sessions of a camera on a simulated robot that looks at a chessboard."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from board_driver import COLUMNS, LENS, ROWS, SQUARE_M, board_file, board_set, image
from hand_eye_driver import ARM, CAMERA, FRAME, SPHERE, Driver, Recorded, namespace
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from robocal_ros.bags.bags import read_data_set, write_data_set
from robocal_ros.bags.replay import replay
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.hand_eye import data as hand_eye_data
from robocal_ros.hand_eye.data import data_set_begun, data_set_of, shot_of
from robocal_ros.hand_eye.planning import judged_plan
from robocal_ros.hand_eye.session import HandEyeConfig, HandEyeSession, take_hand_eye_message
from robocal_ros.hand_eye.targets import read_target, target_document
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.session import events
from robocal_ros.session.events import digest

CONFIG = HandEyeConfig(sensor_frame=FRAME, limit_m=2e-3)  # as `robocal hand-eye camera`
CORNERS = COLUMNS * ROWS
PLAIN = np.full((LENS.height, LENS.width), 120, dtype=np.uint8)


def start_of(folder, intrinsics: bool = False) -> dict:
    target = read_target(board_file(folder, intrinsics))
    return SPHERE | {"target": target_document("camera", target)}


def begun(history, folder, intrinsics: bool = False) -> Driver:
    """A robot at the first pose, with an open data set."""
    driver = Driver(HandEyeSession(ARM, history, CONFIG, "test"))
    driver.robot.q = board_set().q[0]
    driver.robot.rest(0.5)
    assert driver.ask(events.START, **start_of(folder, intrinsics)).done
    return driver


def captured(driver: Driver, pixels: np.ndarray, **how):
    """A capture at rest, and how it ended."""
    assert driver.ask(events.CAPTURE).done
    driver.robot.rest(0.6, lambda stamp_ns: image(stamp_ns, pixels, **how), hz=5)
    return driver.session.data.captures[max(driver.session.data.captures)]


def seen_all(driver: Driver) -> None:
    """A capture from each pose."""
    shots = board_set()
    for q, pixels in zip(shots.q, shots.images, strict=True):
        driver.robot.move(q, 0.2)
        capture = captured(driver, pixels)
        assert capture.code is Code.ACCEPT, capture.reason


def surprise(history, outcome) -> float:
    """Squared error of the camera's place in units of its covariance; chi2 of six."""
    T = np.array(history.model(outcome.calibration_id)["T_parent_sensor"])
    truth = board_set().cell.camera.matrices()[0]
    turn = Rotation.from_matrix(T[:3, :3] @ truth[:3, :3].T).as_rotvec()
    e = np.concatenate([T[:3, 3] - truth[:3, 3], turn])
    return float(e @ np.linalg.solve(np.array(outcome.document["covariance"]), e))


# ---- a whole calibration ------------------------------------------------------------------------


@pytest.mark.parametrize("given", [True, False])
def test_a_camera_is_calibrated_from_images_of_a_board(history, tmp_path, given):
    driver = begun(history, tmp_path, given)
    seen_all(driver)
    outcome = driver.ask(events.CALIBRATE)
    assert outcome.status is Code.ACCEPT, outcome.message
    assert outcome.samples == len(board_set().q)
    assert surprise(history, outcome) < chi2.ppf(0.9999, 6)
    camera = outcome.document["intrinsics"]
    assert camera["from_images"] is not given
    if given:
        assert (camera["fx_px"], camera["sigma"]) == (LENS.fx, None)
    else:
        assert abs(camera["fx_px"] - LENS.fx) < 4.0 * camera["sigma"][0]
    assert driver.ask(events.ACCEPT, id=outcome.calibration_id, by="me").done
    assert driver.session.in_force.model["parent"] == "tool0"


def test_a_sample_keeps_the_corners_alone(history, tmp_path):
    driver = begun(history, tmp_path)
    capture = captured(driver, board_set().images[0])
    assert capture.reason == f"{CORNERS} corners, sample 1"
    (sample,) = driver.session.data.samples.values()
    assert sample.values.shape == (1 + CORNERS, 2)
    assert sample.values[0].tolist() == [LENS.width, LENS.height]
    cell = board_set().cell
    y, x = np.mgrid[:ROWS, :COLUMNS]
    points = SQUARE_M * np.column_stack([x.ravel(), y.ravel(), np.zeros(CORNERS)])
    views = cell.views(np.random.default_rng(6), len(board_set().q))
    truth = LENS.corners(views.take(0), points)
    assert np.abs(sample.values[1:] - truth).max() < 0.5  # a rendered pixel is half known


def test_without_a_file_a_camera_tells_poses(history, tmp_path):
    driver = begun(history, tmp_path)
    assert driver.session.data.topic == "image"
    assert driver.ask(events.START, **CAMERA).done
    assert driver.session.data.topic == "target_pose"
    with pytest.raises(InputError, match="not for a camera"):
        judged_plan(data_set_begun(start_of(tmp_path)), ARM.fk(board_set().q), [], np.eye(4),
                    None, CONFIG)  # fmt: skip


def test_a_wrong_mount_is_named(history, tmp_path):
    driver = begun(history, tmp_path)
    seen_all(driver)
    swapped = driver.session.data.document() | {"mount": "to-hand"}
    assert driver.ask(events.LOAD, set=swapped).done
    refused = driver.ask(events.CALIBRATE)
    assert (refused.status, refused.calibration_id) == (Code.BAD_INPUT, 0)
    assert "in-hand" in refused.message, refused.message


def test_few_images_give_no_intrinsics(history, tmp_path):
    driver = begun(history, tmp_path)
    for q, pixels in list(zip(*board_set()[1:], strict=True))[:4]:
        driver.robot.move(q, 0.2)
        assert captured(driver, pixels).code is Code.ACCEPT
    few = driver.ask(events.CALIBRATE)
    assert few.status is Code.TOO_FEW_SAMPLES
    assert "at least 5 are needed, or give the intrinsics" in few.message


# ---- images that are of no use ------------------------------------------------------------------


def blurred(sigma_px: float) -> np.ndarray:
    return cv2.GaussianBlur(board_set().images[0], (0, 0), sigma_px)


def half_hidden() -> np.ndarray:
    """A hand before the board."""
    pixels = board_set().images[0].copy()
    pixels[:, LENS.width // 2 :] = 90
    return pixels


USELESS = {
    "no board": (lambda: PLAIN, {}, "no board of 9x6 inner corners in the image of"),
    "blurred": (lambda: blurred(20.0), {}, "no board of 9x6 inner corners in the image of"),
    "hidden": (half_hidden, {}, "no board of 9x6 inner corners in the image of"),
    "16 bits": (lambda: PLAIN, {"encoding": "mono16"}, "encoding 'mono16' are not read"),
    "too few bytes": (lambda: PLAIN, {"encoding": "bgr8"}, "do not hold 480 rows"),
    "another frame": (lambda: PLAIN, {"frame": "hand"}, "the sensor's frame is 'laser'"),
}


@pytest.mark.parametrize("what", list(USELESS))
def test_an_image_of_no_use_fails_in_its_words(history, tmp_path, what):
    pixels, how, words = USELESS[what]
    driver = begun(history, tmp_path)
    driver.session.config = HandEyeConfig(sensor_frame=FRAME, capture_timeout_s=0.5)
    failed = captured(driver, pixels(), **how)
    assert failed.code is Code.BAD_INPUT
    assert words in failed.reason
    assert driver.session.data.samples == {}
    # the next capture is as good as if nothing had been
    assert captured(driver, board_set().images[0]).code is Code.ACCEPT


def test_an_image_of_another_size_is_refused(history, tmp_path):
    small = cv2.resize(board_set().images[0], (320, 240), interpolation=cv2.INTER_AREA)
    for intrinsics in (True, False):
        driver = begun(history, tmp_path, intrinsics)
        if not intrinsics:
            assert captured(driver, board_set().images[0]).code is Code.ACCEPT
        failed = captured(driver, small)
        assert failed.code is Code.BAD_INPUT
        assert "320x240 px where 640x480 px are expected" in failed.reason


def test_a_board_that_slipped_is_left_out_by_its_handle(history, tmp_path):
    """From the third pose the image of another one is taken."""
    driver = begun(history, tmp_path, intrinsics=True)
    shots = board_set()
    for i, q in enumerate(shots.q):
        driver.robot.move(q, 0.2)
        assert captured(driver, shots.images[7 if i == 2 else i]).code is Code.ACCEPT
    outcome = driver.ask(events.CALIBRATE)
    assert outcome.document["rejected"] == ["3"]
    assert outcome.samples == len(shots.q) - 1


def test_colours_are_seen_as_grey(history, tmp_path):
    driver = begun(history, tmp_path)
    grey = board_set().images[0]
    assert captured(driver, grey).code is Code.ACCEPT
    colours = np.repeat(grey[:, :, None], 3, axis=2)
    for encoding in ("rgb8", "bgr8"):
        assert captured(driver, colours, encoding=encoding).code is Code.ACCEPT
    first, *others = driver.session.data.samples.values()
    for other in others:
        assert np.array_equal(other.values, first.values)


def test_images_take_bounded_memory(monkeypatch):
    monkeypatch.setattr(hand_eye_data, "MOST_BYTES", 3 * PLAIN.nbytes)
    log = hand_eye_data.ShotLog()
    for at_ns in range(1, 9):
        log.add(shot_of("image", namespace(image(at_ns, PLAIN).fields)), FRAME, 1)
    assert [shot.stamp_ns for shot in log.since("image", 0)] == [6, 7, 8]


# ---- files and recordings -----------------------------------------------------------------------


def test_a_saved_data_set_gives_the_identical_result(history, tmp_path):
    driver = begun(history, tmp_path)
    seen_all(driver)
    first = driver.ask(events.CALIBRATE)
    path, data = tmp_path / "set.mcap", driver.session.data
    write_data_set(path, data.document(), data.topic, FRAME, ARM)
    assert path.stat().st_size < board_set().images[0].nbytes
    with CalibrationHistory.open("K2", state_dir=tmp_path) as other:
        fresh = Driver(HandEyeSession(ARM, other, CONFIG, "test"))
        assert fresh.ask(events.LOAD, path=str(path), set=read_data_set(path, ARM)).done
        assert json.dumps(fresh.session.data.document()) == json.dumps(data.document())
        again = fresh.ask(events.CALIBRATE)
        assert digest(again.document) == digest(first.document)
        assert other.model(again.calibration_id) == history.model(first.calibration_id)


def test_a_data_set_of_other_corners_is_refused(history, tmp_path):
    driver = begun(history, tmp_path)
    for pixels in board_set().images[:2]:
        assert captured(driver, pixels).code is Code.ACCEPT
    whole = json.loads(json.dumps(driver.session.data.document()))
    assert len(data_set_of(whole, ARM).samples) == 2
    one, two = whole["samples"]
    for broken, words in (
        (two | {"values": two["values"][:-1]}, "53 corners where the board has 54"),
        (two | {"values": [[320, 240], *two["values"][1:]]}, "320x240 px where 640x480 px"),
        (two | {"values": []}, "corners where the board has 54"),
    ):
        with pytest.raises(InputError, match=words):
            data_set_of(whole | {"samples": [one, broken]}, ARM)


def test_a_recording_gives_the_same_again(history, tmp_path):
    driver = begun(history, tmp_path)
    captured(driver, PLAIN)
    seen_all(driver)
    live = driver.ask(events.CALIBRATE)
    assert live.status is Code.ACCEPT, live.message
    messages = [
        SimpleNamespace(topic=f"/{m.kind}", message=namespace(m.fields))
        for m in driver.recorded
        if isinstance(m, Recorded)
    ]
    with CalibrationHistory.open("K2", state_dir=tmp_path) as other:
        session = HandEyeSession(ARM, other, CONFIG, "test")
        report = replay(session, messages, driver.commands, None, take_hand_eye_message)
        assert report.differs == []
        assert [o.message for o in report.outcomes] == [o.message for o in driver.outcomes]
        assert digest(report.outcomes[-1].document) == digest(live.document)
        assert digest(session.data.document()) == digest(driver.session.data.document())
