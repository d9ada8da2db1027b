# SPDX-License-Identifier: Apache-2.0
"""A calibration by laser tracker from captures: each point and profile at its own standstill."""

import json
from pathlib import Path

import numpy as np
import pytest
from command import beyond_rounding, robocal_json
from hand_eye_driver import ARM, FRAME, LASER, Driver, tracker_point
from scipy.stats import chi2
from tracked_robot import CELL, START, Capture, captured, captures, marks, scans_of_marks

from robocal_ros.bags.bags import DATA_SET, read_bag, read_data_set, write_data_set
from robocal_ros.estimation.edge import EdgeRule
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.files import SensorMount
from robocal_ros.hand_eye.profiles import Profile
from robocal_ros.hand_eye.result import increment
from robocal_ros.hand_eye.session import HandEyeConfig, HandEyeSession, sample_poses
from robocal_ros.hand_eye.touch_test import scanned_points, touch_test
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.session import events

KNOCKED_M = np.array([0.0, 0.004, 0.0])


@pytest.fixture
def driver(tmp_path):
    with CalibrationHistory.open("K1", state_dir=tmp_path) as history:
        config = HandEyeConfig(sensor_frame=FRAME, joint_error_rad=3e-4)
        yield Driver(HandEyeSession(ARM, history, config, "test"))


def knocked(mark: str) -> list[Capture]:
    """All captures; the second point of a mark was read 4 mm off."""
    shots = list(captures())
    bad = [i for i, one in enumerate(shots) if one.mark == mark][1]
    point = shots[bad].shot(1).fields["point"]
    off = np.array([point[a] for a in "xyz"]) + KNOCKED_M
    shots[bad] = shots[bad]._replace(shot=lambda stamp_ns: tracker_point(stamp_ns, off))
    return shots


def kept_set(driver, path):
    """Its captures in a file, and as they are read from it."""
    data = driver.session.data
    write_data_set(path, data.document(), data.topic, FRAME, ARM)
    return read_data_set(path, ARM)


def test_a_set_of_another_tracker_or_sensor_frame_is_refused(driver, tmp_path):
    captured(driver, captures())
    path = tmp_path / "set.mcap"
    kept = kept_set(driver, path)
    shots = {m.topic: m.message.header.frame_id for m in read_bag(path) if m.topic != DATA_SET}
    assert shots == {"tracker_point": "tracker", "profile": FRAME, "joint_states": ""}
    for name in ("tracker_frame", "sensor_frame"):
        refused = driver.ask(events.LOAD, set=kept | {name: "another"}, path=str(path))
        assert refused.status is Code.BAD_INPUT
        assert f"referred to {name} 'another'" in refused.message
    assert driver.ask(events.LOAD, set=kept, path=str(path)).done


@pytest.mark.long
def test_the_sensor_is_found_as_well_as_it_says(driver, tmp_path):
    captured(driver, captures())
    outcome = driver.ask(events.CALIBRATE)
    assert outcome.status is Code.ACCEPT, outcome.message
    model = driver.session._history.model(outcome.calibration_id)
    found = np.array(model["T_parent_sensor"])
    document = outcome.document
    off = increment(found, CELL.T_flange_sensor, np.zeros(3))
    spread = np.array(document["covariance_at_pivot"])
    assert document["joint_errors"]["size_urad"] < 30.0  # of this robot, which has no gears
    assert off @ np.linalg.solve(spread, off) < chi2.ppf(0.9999, 6)
    # In the file, and from it again: the same to the last bit.
    path = tmp_path / "set.mcap"
    assert driver.ask(events.LOAD, set=kept_set(driver, path), path=str(path)).done
    repeated = driver.ask(events.CALIBRATE)
    assert repeated.document == document


@pytest.mark.long
def test_a_sensor_that_tells_heights_is_found_too(tmp_path):
    with CalibrationHistory.open("K1", state_dir=tmp_path) as history:
        config = HandEyeConfig(sensor_frame=FRAME, sensor=LASER)
        driver = Driver(HandEyeSession(ARM, history, config, "test"))
        captured(driver, captures(towards=True))
        outcome = driver.ask(events.CALIBRATE)
        assert outcome.status is Code.ACCEPT, outcome.message
        found = np.array(history.model(outcome.calibration_id)["T_parent_sensor"])
    truth = CELL.T_flange_sensor @ np.diag([1.0, -1.0, -1.0, 1.0])
    off = increment(found, truth, np.zeros(3))
    spread = np.array(outcome.document["covariance_at_pivot"])
    assert off @ np.linalg.solve(spread, off) < chi2.ppf(0.9999, 6)


def test_a_point_that_was_misread_is_named_by_its_capture(driver):
    captured(driver, knocked("arc_b"))
    outcome = driver.ask(events.CALIBRATE)
    bad = [h for h, one in driver.session.data.samples.items() if one.mark == "arc_b"][1]
    assert outcome.status is Code.ACCEPT, outcome.message
    assert str(bad) in outcome.document["rejected_because"]


def test_what_is_missing_is_named(driver):
    captured(driver, [one for one in captures() if one.mark != "face_2"])
    outcome = driver.ask(events.CALIBRATE)
    assert outcome.status is Code.TOO_FEW_SAMPLES
    assert "face_2" in outcome.message


def test_what_cannot_be_a_point_of_the_tracker(driver):
    driver.robot.rest(0.1)
    assert driver.ask(events.START, **START).done
    assert "arc_a" in driver.ask(events.CAPTURE, mark="face_3").message
    for point, frame, words in (
        (np.array([3e3, 1e2, 4.0]), "tracker", "is it in mm?"),
        (np.ones(3), "laser", "set tracker_frame"),
    ):
        assert driver.ask(events.CAPTURE, mark="sphere").done
        driver.robot.rest(0.6, lambda stamp_ns, p=point, f=frame: tracker_point(stamp_ns, p, f))
        driver.robot.rest(11.0)
        assert words in driver.outcomes[-1].message


def test_marked_points_judge_a_mount_and_find_none(driver):
    driver.robot.rest(0.1)
    assert driver.ask(events.START, **START | {"target": {"kind": "point"}}).done
    assert "name the point" in driver.ask(events.CAPTURE).message
    for q, mark, shot in scans_of_marks(3):
        driver.robot.move(q, 0.1)
        driver.robot.rest(0.1)
        assert driver.ask(events.CAPTURE, mark=mark).done
        driver.robot.rest(0.5, shot)
    assert "call verify" in driver.ask(events.CALIBRATE).message
    samples = driver.session.data.chosen([])
    scanned, rejected = scanned_points(
        [one.mark for one in samples], [Profile(one.values, str(one.handle)) for one in samples],
        sample_poses(samples, ARM), EdgeRule(),
    )  # fmt: skip
    assert not rejected
    found = touch_test(SensorMount("flange", CELL.T_flange_sensor), scanned, marks(), 1e-3)
    # The edge of 37 um profiles is found to some 0.02 mm along the line and across; nothing else
    # errs here.
    assert found.accuracy.max_m < 1e-4


def test_the_golden_bag_gives_its_session_again():
    """`bags/make_tracker.py`, where one capture does not see the tracker; its truth is found."""
    bag = Path(__file__).parents[2] / "bags" / "hand_eye_tracker.mcap"
    document = robocal_json("replay.hand_eye.json", "replay", bag)
    assert (document["recorded"], beyond_rounding(document)) == (True, [])
    codes = [c["code"] for c in document["commands"] if c["command"] == events.BREAK_OFF]
    assert codes == ["TOO_FEW_SAMPLES"]
    (found,), seen = document["calibrations"], document["final_sensor"]
    assert found["kind"] == "tracker"
    (told,) = [m.message for m in read_bag(bag) if m.topic == "/truth/hand_eye"]
    truth = np.array(json.loads(told.data)["T_flange_sensor"])
    T = frames.transform_from_quat(1e-3 * np.array(seen["xyz_mm"]), np.array(seen["quat_xyzw"]))
    off = increment(T, truth, np.zeros(3))
    spread = np.array(found["covariance_at_pivot"])
    assert off @ np.linalg.solve(spread, off) < chi2.ppf(0.9999, 6)
