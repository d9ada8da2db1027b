# SPDX-License-Identifier: Apache-2.0
"""Which profiles of a recording are shots, and of which its session made samples."""

from dataclasses import replace

import numpy as np
import pytest
from hand_eye_driver import (
    ARM,
    Q_NEAR,
    Driver,
    Recorded,
    Robot,
    namespace,
    profile,
    sphere_shots_of,
)

from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import StandstillRule
from robocal_ros.hand_eye.data import StandingShot, Standstills, captured_marks, first_of_each
from robocal_ros.hand_eye.profiles import DEFAULT
from robocal_ros.hand_eye.session import HandEyeConfig, HandEyeSession
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.session import events
from robocal_ros.session.events import Command

RULE = StandstillRule()
SHOTS = list(sphere_shots_of(3))


@pytest.fixture
def pairs() -> Standstills:
    return Standstills(ARM.joint_names, RULE, DEFAULT)


def show(pairs: Standstills, message: Recorded) -> None:
    pairs.take(message.kind, namespace(message.fields))


def robot_of(pairs: Standstills) -> Robot:
    return Robot(lambda message: show(pairs, message))


def test_a_profile_at_standstill_is_a_shot_with_the_joints_there(pairs):
    robot = robot_of(pairs)
    for q, shot in SHOTS:
        robot.move(q)
        robot.rest(0.5)
        show(pairs, shot(robot.now_ns))
        robot.rest(0.5)
    pairs.close()
    assert [one.name for one in pairs.found] == ["shot_01", "shot_02", "shot_03"]
    for one, (q, _) in zip(pairs.found, SHOTS, strict=True):
        assert one.q == pytest.approx(q, abs=5e-7)  # hum of 1e-7 rad
    assert pairs.rejected == {}


def test_the_same_joints_as_a_session_takes_for_its_sample(pairs, tmp_path):
    with CalibrationHistory.open("K1", state_dir=tmp_path) as history:
        driver = Driver(HandEyeSession(ARM, history, HandEyeConfig(sensor_frame="laser"), "test"))
        driver.sphere(2)
        for one in driver.recorded:
            if isinstance(one, Recorded):
                show(pairs, one)
        samples = driver.session.data.samples.values()
    found = {one.shot.stamp_ns: one.q for one in pairs.found}
    for sample in samples:
        assert np.array_equal(found[sample.stamp_ns], sample.q)


def test_what_is_no_shot_is_named(pairs):
    robot = robot_of(pairs)
    (q, shot), (_, other) = SHOTS[:2]
    show(pairs, shot(robot.now_ns))  # before any joints
    robot.rest(1.0)
    robot.move(q, 1.0)
    show(pairs, shot(robot.now_ns - 300_000_000))
    robot.rest(1.0)
    show(pairs, profile(robot.now_ns, np.full((50, 2), np.nan)))
    show(pairs, profile(robot.now_ns, np.column_stack([np.arange(50.0), np.ones(50)]) * 1e-3, "b"))
    robot.rest(0.3)
    show(pairs, other(robot.now_ns))
    pairs.close()
    assert pairs.found == []
    words = ["no joint readings from before", "moved by", "0 points", "frame 'b'", "recording ends"]
    assert list(pairs.rejected) == [f"shot_{i:02d}" for i in (1, 2, 3, 4, 5)]
    for why, word in zip(pairs.rejected.values(), words, strict=True):
        assert word in why


def test_a_pose_that_is_met_again_later_is_a_standstill_of_its_own():
    shot = SHOTS[0][1](1)
    there = StandingShot("a", shot, Q_NEAR)
    away = replace(there, name="b", q=Q_NEAR + 0.1)
    kept, _ = first_of_each([there, away, replace(there, name="c")], RULE.tolerance_rad)
    assert [one.name for one in kept] == ["a", "b", "c"]


def told(*rows: tuple) -> list:
    """Commands with what came of them."""
    return [
        (Command(name, words), {"status": int(code[0]) if code else int(Code.ACCEPT)})
        for name, words, *code in rows
    ]


class TestCaptured:
    def test_what_the_session_holds_in_the_end(self):
        """Of the last data set; neither what was removed nor what failed."""
        commands = told(
            (events.START, {}),
            (events.CAPTURE, {"handle": 1, "mark": "near"}),
            (events.SAMPLE, {"handle": 1, "shot_ns": 10}),
            (events.START, {}),
            (events.CAPTURE, {"handle": 2, "mark": "near"}),
            (events.SAMPLE, {"handle": 2, "shot_ns": 20}),
            (events.CAPTURE, {"handle": 3, "mark": "far"}),
            (events.SAMPLE, {"handle": 3, "shot_ns": 30}),
            (events.CAPTURE, {"handle": 4, "mark": "far"}),
            (events.BREAK_OFF, {"handle": 4}, Code.BAD_INPUT),
            (events.REMOVE, {"handle": 9}, Code.BAD_INPUT),
            (events.REMOVE, {"handle": 2}),
        )
        assert captured_marks(commands) == {30: "far"}

    def test_a_recording_that_begins_amid_a_data_set(self):
        commands = told(
            (events.CAPTURE, {"handle": 7}), (events.SAMPLE, {"handle": 7, "shot_ns": 70})
        )
        assert captured_marks(commands) == {70: ""}

    def test_a_recording_without_a_data_set(self):
        assert captured_marks([]) is None
        assert captured_marks(told((events.IDENTIFY, {}), (events.ACCEPT, {}))) is None
