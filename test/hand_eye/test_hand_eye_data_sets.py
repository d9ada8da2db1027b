# SPDX-License-Identifier: Apache-2.0
"""Data sets in files and recordings give the identical result, or are refused."""

import json

import numpy as np
import pytest
from hand_eye_driver import ARM, FRAME, SPHERE, START_NS, joints
from hand_eye_laser import SHOTS, WARM, begun, driver_of

from robocal_ros.bags.bags import read_data_set, write_data_set
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.hand_eye.data import data_set_of
from robocal_ros.hand_eye.session import configuration, hand_eye_session_as_recorded
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL
from robocal_ros.kinematics.arm import model_document
from robocal_ros.session import events
from robocal_ros.session.events import Command, bring_into_force, digest


def test_a_saved_data_set_gives_the_identical_result(history, tmp_path):
    driver = driver_of(history)
    driver.sphere(10)
    first = driver.ask(events.CALIBRATE)
    path = tmp_path / "set.mcap"
    data = driver.session.data
    write_data_set(path, driver.session.document(), data.topic, FRAME, ARM)
    with CalibrationHistory.open("K2", state_dir=tmp_path) as other:
        fresh = driver_of(other)
        loaded = fresh.ask(events.LOAD, path=str(path), set=read_data_set(path, ARM))
        assert loaded.message == f"10 samples of a sphere loaded from {path}"
        again = fresh.ask(events.CALIBRATE)
        assert digest(again.document) == digest(first.document)
        assert other.model(again.calibration_id) == history.model(first.calibration_id)
        fresh.robot.rest(0.1)
        assert fresh.ask(events.CAPTURE).command.arguments["handle"] == 11
        # with another thermal model in force it is the same still, and whose poses are told
        bring_into_force(other, THERMAL, ARM, model_document(WARM), "test")
        moved = fresh.ask(events.LOAD, path=str(path), set=read_data_set(path, ARM))
        assert moved.message.endswith("; their flange poses are those of thermal revision 0")
        assert digest(fresh.ask(events.CALIBRATE).document) == digest(first.document)


POINTS = [[1e-3 * i, 0.2] for i in range(12)]
ROW = {"handle": 1, "mark": "", "stamp_ns": 1, "thermal": 0, "q": [0.0] * 6, "values": POINTS}
EMPTY = SPHERE | {"thermal_models": [{"revision": 0, "model": None}]}


def rows(count: int, points: int = 12) -> list[dict]:
    return [ROW | {"handle": i + 1, "values": POINTS * (points // 12)} for i in range(count)]


BAD_SETS = {
    "handle 0": {"samples": [ROW | {"handle": 0}]},
    "handle -1": {"samples": [ROW | {"handle": -1}]},
    "handle 4294967296": {"samples": [ROW | {"handle": 2**32}]},
    "handle 1.5": {"samples": [ROW | {"handle": 1.5}]},
    "two samples of handle 1": {"samples": [ROW, ROW]},
    "mark 'near' is none": {"samples": [ROW | {"mark": "near"}]},
    "501 samples": {"samples": rows(501)},
    "points in 21 samples": {"samples": rows(21, 12_000)},
    "of thermal model 1": {"samples": [ROW | {"thermal": 1}]},
    "mdh has shape (1, 3)": {"thermal_models": [{"revision": 1, "model": {"mdh": [[0.0] * 3]}}]},
    "no time stamp": {"samples": [ROW | {"stamp_ns": 0}]},
    "profile of sample 1 has 3 points": {"samples": [ROW | {"values": POINTS[:3]}]},
    "is no pose": {"target": {"kind": "camera"}, "samples": [ROW | {"values": [[0.0] * 7]}]},
    "target cannot be read": {"target": {"kind": "sphere", "radius_m": -1.0}},
    "nothing is known of the sphere": {"target": {"kind": "sphere"}},
    "cannot be read": {"target": {"kind": "cone"}},
}


@pytest.mark.parametrize("words", list(BAD_SETS))
def test_a_file_that_is_refused_replaces_nothing(history, words):
    driver = begun(history)
    driver.ask(events.CAPTURE)
    driver.robot.rest(0.7, SHOTS[0][1])
    before = driver.session.data
    refused = driver.ask(events.LOAD, path="x", set=EMPTY | {"samples": [ROW]} | BAD_SETS[words])
    assert not refused.done
    assert words in refused.message
    assert driver.session.data is before
    assert driver.ask(events.CAPTURE).command.arguments["handle"] == 2


def test_handles_end_where_a_message_can_no_longer_carry_them(history):
    driver = begun(history)
    full = EMPTY | {"samples": [ROW | {"handle": 2**32 - 1}]}
    assert driver.ask(events.LOAD, path="x", set=full).done
    refused = driver.ask(events.CAPTURE)
    assert refused.status is Code.LIMIT_EXCEEDED
    assert "4294967295" in refused.message


def test_a_data_set_holds_so_many_captures_and_no_more(history):
    driver = begun(history)
    assert driver.ask(events.LOAD, path="x", set=EMPTY | {"samples": rows(499)}).done
    assert driver.ask(events.CAPTURE).done
    driver.robot.rest(0.7, SHOTS[0][1])
    refused = driver.ask(events.CAPTURE)
    assert refused.status is Code.LIMIT_EXCEEDED
    assert refused.message.startswith("500 captures")


def test_a_data_set_that_is_none_is_refused():
    whole = EMPTY | {"samples": [ROW]}
    assert len(data_set_of(json.loads(json.dumps(whole)), ARM).samples) == 1
    (sample,) = whole["samples"]
    for broken in (
        {name: value for name, value in whole.items() if name != "target"},
        whole | {"samples": [sample | {"q": [0.0] * 5}]},
        whole | {"samples": [sample | {"values": [[0.0, 0.2], [0.1]]}]},
        whole | {"samples": [sample | {"values": [[0.0, float("nan")]] * 10}]},
        whole | {"target": {"kind": "cone"}},
    ):
        with pytest.raises(InputError):
            data_set_of(broken, ARM)


def test_a_session_begins_where_a_recorded_one_did(history, tmp_path):
    driver = driver_of(history, capture_timeout_s=3.0, limit_m=1e-3)
    driver.sphere(10)
    outcome = driver.ask(events.CALIBRATE)
    driver.ask(events.ACCEPT, id=outcome.calibration_id, by="me")
    configured = configuration(driver.session, {})
    told = Command(configured.name, json.loads(json.dumps(configured.arguments)))
    with CalibrationHistory.open("K2", state_dir=tmp_path) as other:
        again = hand_eye_session_as_recorded(ARM, other, told, "test")
        assert again.config == driver.session.config
        assert again.in_force.model == driver.session.in_force.model


@pytest.mark.parametrize("name", ["config", "model", "sensor"])
def test_a_recording_that_lacks_a_setting_is_refused(history, name):
    configured = configuration(driver_of(history).session, {})
    left = {key: value for key, value in configured.arguments.items() if key != name}
    with pytest.raises(InputError, match=f"lacks {name}"):
        hand_eye_session_as_recorded(ARM, history, Command(configured.name, left), "test")


def test_what_is_decided_elsewhere_is_taken_over(history):
    driver = driver_of(history)
    driver.sphere(10)
    outcome = driver.ask(events.CALIBRATE)
    history.accept(outcome.calibration_id, by="cli", reason="", wall_ns=5)
    (told,) = driver.session.poll()
    assert told.outside
    assert driver.session.in_force.revision == 1
    stale = driver.ask(events.ACCEPT, id=outcome.calibration_id, by="me")
    assert stale.status is Code.CONFLICT


def test_joint_readings_of_another_robot_are_counted(history):
    driver = driver_of(history)
    message = joints(START_NS, np.zeros(6))
    message.fields["name"] = [f"axis_{i}" for i in range(6)]
    for i in range(3):
        message.fields["header"]["stamp"]["nanosec"] = i
        driver.give(message)
    (reason,) = driver.session.ignored["joint_states"]
    assert "joint state has no position of" in reason
