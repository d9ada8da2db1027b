# SPDX-License-Identifier: Apache-2.0
"""Captures that fail say why, and poses that tell too little are refused."""

import numpy as np
import pytest
from hand_eye_driver import FRAME, SPHERE, START_NS, Recorded, namespace, profile, sphere_set
from hand_eye_laser import SHOTS, STEP, begun, driver_of

from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye import data as hand_eye_data
from robocal_ros.hand_eye.data import MOST_BYTES, MOST_KEPT, Shot, ShotLog
from robocal_ros.hand_eye.targets import target_document
from robocal_ros.session import events

# ---- captures that fail -------------------------------------------------------------------------


def last_capture(driver):
    return driver.session.data.captures[max(driver.session.data.captures)]


def test_a_capture_of_a_moving_robot_fails_and_says_why(history):
    driver = begun(history, capture_timeout_s=1.0)
    assert driver.ask(events.CAPTURE).done
    _, shot = SHOTS[0]
    for _ in range(2):  # it never stands still for the 0.4 s that a sample takes
        for q in (SHOTS[1][0], SHOTS[0][0]):
            driver.robot.move(q, 0.3)
            driver.robot.rest(0.2, shot)
    failed = last_capture(driver)
    assert failed.code is Code.BAD_INPUT
    assert failed.reason.startswith("no profile with the robot at standstill within 1 s: ")
    assert "moved by" in failed.reason
    assert driver.session.data.samples == {}
    # the next one, at rest, is as good as if nothing had been
    assert driver.ask(events.CAPTURE).done
    driver.robot.rest(0.7, shot)
    assert last_capture(driver).code is Code.ACCEPT
    assert list(driver.session.data.samples) == [2]


def test_a_capture_takes_the_first_shot_at_standstill_not_one_from_before(history):
    driver = begun(history)
    _, before = SHOTS[1]
    q, shot = SHOTS[0]
    driver.robot.rest(0.3, before)
    assert driver.ask(events.CAPTURE).done
    driver.robot.move(q, 0.3)
    driver.robot.rest(0.8, shot)
    (sample,) = driver.session.data.samples.values()
    assert sample.values == pytest.approx(np.float32(_seen(0)).astype(float), abs=0)


def test_a_capture_takes_no_shot_that_was_received_before_it(history):
    """Not even one that is stamped a little ahead of the joint states."""
    driver = begun(history)
    ahead_ns = driver.robot.now_ns + 400_000_000
    driver.give(SHOTS[1][1](ahead_ns))
    asked = driver.ask(events.CAPTURE)
    assert asked.command.arguments["from_ns"] == ahead_ns + 1  # a replay obeys it
    driver.robot.rest(1.2, SHOTS[0][1])
    (sample,) = driver.session.data.samples.values()
    assert sample.stamp_ns > ahead_ns
    assert sample.values == pytest.approx(np.float32(_seen(0)).astype(float), abs=0)
    again = driver.ask(events.CAPTURE)
    newest = max(m.stamp_ns for m in driver.recorded if isinstance(m, Recorded))
    assert again.command.arguments["from_ns"] == newest
    # a replay in which messages of the topics come in another order keeps to the recorded bound
    driver.ask(events.REMOVE, handle=2)
    late = driver.ask(events.CAPTURE, from_ns=newest + 500_000_000)
    driver.robot.rest(1.2, SHOTS[0][1])
    assert driver.session.data.samples[3].stamp_ns >= late.command.arguments["from_ns"]


def test_a_shot_from_before_the_first_joints_holds_no_capture_up(history):
    """Its clock could not be held against theirs: it may be an hour ahead."""
    driver = driver_of(history, capture_timeout_s=1.0)
    driver.give(SHOTS[1][1](driver.robot.now_ns + 3600 * 10**9))
    assert "came before any joint states" in driver.session.ignored.words()
    driver.robot.rest(0.1)
    assert driver.ask(events.START, **SPHERE).done
    assert driver.ask(events.CAPTURE).done
    driver.robot.rest(0.7, SHOTS[0][1])
    assert last_capture(driver).code is Code.ACCEPT


def test_a_shot_that_is_stamped_before_the_call_is_told_as_that(history):
    driver = begun(history, capture_timeout_s=1.0)
    driver.robot.rest(0.5)
    driver.ask(events.CAPTURE)
    driver.give(SHOTS[0][1](driver.robot.now_ns - 200_000_000))
    driver.robot.rest(1.2)
    failed = last_capture(driver)
    assert "profile is stamped 0.200 s before the call" in failed.reason


@pytest.fixture
def read(monkeypatch):
    """Messages whose profiles were read."""
    found = []
    points = hand_eye_data.cloud_profile
    monkeypatch.setattr(
        hand_eye_data, "cloud_profile", lambda m, sensor: found.append(m) or points(m, sensor)
    )
    return found


def test_shots_are_not_read_while_nobody_asks_and_little_is_kept(history, read):
    driver = begun(history)
    driver.robot.rest(1.0, SHOTS[0][1])
    assert not read
    driver.ask(events.CAPTURE)
    driver.robot.rest(0.7, SHOTS[0][1])
    assert 0 < len(read) < 7
    log = ShotLog()
    for i in range(3 * MOST_KEPT):
        log.add(Shot("profile", i, FRAME, namespace({"data": b"x" * 1_000_000})), FRAME, 1)
    kept = list(log.since("profile", 0))
    assert sum(shot.size for shot in kept) <= MOST_BYTES
    assert kept[-1].stamp_ns == 3 * MOST_KEPT - 1
    assert len(kept) == MOST_BYTES // 1_000_000


def test_shots_of_a_moving_robot_are_not_read(history, read):
    """What was read is kept with the shot: of images that is many times what came."""
    driver = begun(history)
    assert driver.ask(events.CAPTURE).done
    for number in (1, 0, 1, 0):
        driver.robot.move(SHOTS[number][0], 0.3)
        driver.robot.rest(0.2, SHOTS[number][1])
    assert not read
    driver.robot.rest(0.6, SHOTS[0][1])
    assert last_capture(driver).code is Code.ACCEPT
    assert len(read) == 1


def test_the_given_error_of_the_robot_is_the_one_that_is_used(history):
    """The error to expect is that of the robot's poses, four times as large, and the profiles'."""
    told = {}
    for sigma in (5e-5, 2e-4):
        driver = driver_of(history, robot_sigma_m=sigma, robot_sigma_rad=1e-5)
        driver.sphere(10)
        told[sigma] = driver.ask(events.CALIBRATE).document["working_error_mm"]
    assert 2.0 < told[2e-4] / told[5e-5] <= 4.0


def test_without_a_candidate_the_twin_says_what_gives_one(history):
    told = driver_of(history).ask(events.ACCEPT, choose="only", by="me")
    assert told.message == "no fresh candidate is pending: calibrate first"


def test_a_clock_that_jumps_ahead_is_told_as_that(history):
    driver = begun(history)
    driver.ask(events.CAPTURE)
    driver.robot.now_ns += 3600 * 10**9
    driver.robot.rest(0.2)
    failed = last_capture(driver)
    assert failed.code is Code.CONFLICT
    assert failed.reason.startswith("the joint states' clock jumped by 3600.0 s")
    driver.ask(events.CAPTURE)
    driver.robot.rest(0.9, SHOTS[0][1])
    assert last_capture(driver).code is Code.ACCEPT


def test_a_calibration_that_fails_leaves_no_earlier_candidate(history):
    driver = driver_of(history)
    driver.sphere(8)
    first = driver.ask(events.CALIBRATE)
    assert driver.session.data.candidate == first.calibration_id > 0
    assert not driver.ask(events.CALIBRATE, handles=[99]).done
    assert driver.session.data.candidate == 0


def _seen(number):
    points = sphere_set()[1].profiles[number]
    return points[np.isfinite(points).all(axis=1)]


WITHOUT = {
    "no profile": (None, Code.TOO_FEW_SAMPLES, "does the sensor publish it"),
    "an empty profile": (
        lambda stamp_ns: profile(stamp_ns, np.full((400, 2), np.nan)),
        Code.TOO_FEW_SAMPLES,
        "has 0 points (at least 10): check the exposure",
    ),
    "a cloud of nothing": (
        lambda stamp_ns: profile(stamp_ns, np.empty((0, 2))), Code.BAD_INPUT, "has 0 points",
    ),
    "points beside the plane": (
        lambda stamp_ns: profile(stamp_ns, _seen(0), y=0.003), Code.BAD_INPUT,
        "3 mm beside the plane y = 0",
    ),
    "another frame": (
        lambda stamp_ns: profile(stamp_ns, _seen(0), frame="camera"), Code.BAD_INPUT,
        "profile in frame 'camera', the sensor's frame is 'laser'",
    ),
    "another clock": (
        lambda stamp_ns: profile(stamp_ns - 3600 * 10**9, _seen(0)), Code.BAD_INPUT,
        "-3600.0 s from the joint states: stamp both on one clock",
    ),
    "millimetres": (
        lambda stamp_ns: profile(stamp_ns, 1e3 * _seen(0)), Code.BAD_INPUT,
        "a thousand times too large? A table's x_mm and z_mm hold mm, a message m",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", list(WITHOUT))
def test_a_capture_without_a_usable_profile_fails_in_its_words(history, what):
    shot, code, words = WITHOUT[what]
    driver = begun(history, capture_timeout_s=1.0)
    driver.ask(events.CAPTURE)
    driver.robot.rest(1.3, shot)
    failed = last_capture(driver)
    assert failed.code is code
    assert words in failed.reason
    assert driver.session.data.samples == {}


def test_a_clock_that_jumps_back_ends_a_capture(history):
    driver = begun(history)
    driver.ask(events.CAPTURE)
    driver.robot.move(SHOTS[1][0], 0.2)
    driver.robot.rest(0.1, SHOTS[1][1])
    driver.robot.move(SHOTS[0][0], 0.2)
    driver.robot.now_ns = START_NS - 600 * 10**9
    driver.robot.rest(0.6, SHOTS[0][1])
    assert last_capture(driver).code is Code.CONFLICT
    assert "the clock jumped back" in last_capture(driver).reason
    driver.ask(events.CAPTURE)
    driver.robot.rest(0.7, SHOTS[0][1])
    assert last_capture(driver).code is Code.ACCEPT


def test_a_shot_from_before_a_jump_of_the_clock_is_no_shot_of_after_it(history):
    """The clock comes by the stamp of the old shot again, with the robot elsewhere."""
    driver = begun(history, capture_timeout_s=2.0)
    driver.robot.rest(1.5)
    driver.robot.rest(0.4, SHOTS[0][1])
    driver.robot.now_ns -= 1_500_000_000
    driver.robot.q = SHOTS[1][0]
    driver.robot.rest(0.1)
    assert driver.ask(events.CAPTURE).done
    driver.robot.rest(2.2)
    assert last_capture(driver).code is Code.TOO_FEW_SAMPLES
    assert driver.session.data.samples == {}


def test_commands_out_of_turn_are_refused(history):
    driver = driver_of(history)
    for name in (events.CAPTURE, events.CALIBRATE):
        refused = driver.ask(name)
        assert refused.status is Code.CONFLICT
        assert "no data set is open" in refused.message
    assert driver.ask(events.START, **SPHERE).done
    assert "no joint states yet" in driver.ask(events.CAPTURE).message
    empty = driver.ask(events.CALIBRATE)
    assert (empty.status, empty.samples) == (Code.TOO_FEW_SAMPLES, 0)
    driver.robot.rest(0.1)
    assert driver.ask(events.CAPTURE).done
    again = driver.ask(events.CAPTURE)
    assert again.status is Code.CONFLICT
    assert again.message.startswith("capture 1 still waits")
    # another start forgets the capture; its handle never comes again
    assert driver.ask(events.START, **SPHERE).done
    assert driver.ask(events.CAPTURE).command.arguments["handle"] == 2
    assert driver.ask(events.REMOVE, handle=2).done
    driver.robot.rest(0.7, SHOTS[0][1])
    assert driver.session.data.captures == {}


BAD_STARTS = {
    "target": {"target": {"kind": "cone"}},
    "method": {"method": "quick"},
    "mount": {"mount": "on the wall"},
    "feature": {"feature": "hole"},
    "seen by a sensor on the flange": {"mount": "to-hand"},
}


@pytest.mark.parametrize("words", list(BAD_STARTS))
def test_a_data_set_that_nothing_answers_for_is_refused(history, words):
    driver = driver_of(history)
    refused = driver.ask(events.START, **(SPHERE | BAD_STARTS[words]))
    assert refused.status is Code.BAD_INPUT
    assert words in refused.message
    assert driver.session.data is None


def test_a_mark_must_be_one_of_the_target(history):
    driver = begun(history)
    assert "none of the target's: none" in driver.ask(events.CAPTURE, mark="near").message
    stairs = target_document("step", STEP)
    assert driver.ask(events.START, **(SPHERE | {"target": stairs})).done
    assert driver.ask(events.CAPTURE).status is Code.BAD_INPUT
    assert driver.ask(events.CAPTURE, mark="far").done


# ---- refusals of the estimator ------------------------------------------------------------------


def test_poses_without_turns_are_refused_with_the_open_directions(history):
    driver = driver_of(history)
    driver.robot.rest(0.1)
    driver.ask(events.START, **SPHERE)
    q, shot = SHOTS[0]
    driver.robot.move(q)
    for _ in range(8):
        driver.ask(events.CAPTURE)
        driver.robot.rest(0.7, shot)
    refused = driver.ask(events.CALIBRATE)
    assert refused.status is Code.RANK_DEFICIENT
    assert "the poses do not turn" in refused.message
    assert refused.document["unobservable"]
    assert not refused.calibration_id
    assert history.list() == ()
