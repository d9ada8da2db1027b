# SPDX-License-Identifier: Apache-2.0
"""A measuring robot's session: the sensor on the flange sees spheres that are fixed in the cell."""

from dataclasses import replace

import numpy as np
import pytest
from shift import NOISE_M, T_FLANGE_SENSOR, DriftingRobot, MeasuringShift, built, looking, warmed

from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.session import events
from robocal_ros.thermal.drift_following import FLANGE, ThermalConfig

POSES, ROUNDS = 8, 3
CONFIG = ThermalConfig(sigma_m=NOISE_M, arrangement=FLANGE)


@pytest.fixture
def robot(tmp_path) -> DriftingRobot:
    found = DriftingRobot(tmp_path, CONFIG)
    found.shift, found.q = MeasuringShift(found.nominal.joint_names), looking(POSES)
    found.feed(found.shift.visit(found.cold, np.tile(found.q, (ROUNDS, 1))))
    return found


@pytest.fixture
def captured(robot) -> DriftingRobot:
    outcome = robot.ask(events.CAPTURE_REFERENCE)
    assert outcome.status is Code.ACCEPT, outcome.message
    return robot


def cycle(robot: DriftingRobot, kelvin: float, after_h: float = 2.0):
    robot.feed(robot.shift.visit(warmed(robot.cold, kelvin), robot.q, after_h))
    return robot.ask(events.IDENTIFY)


def test_a_drift_is_found_where_the_sensor_looks(captured):
    """As of a fixed sensor: held-out poses, and any point of the field at postures never shown."""
    outcome = cycle(captured, 15.0)
    assert outcome.status is Code.ACCEPT, outcome.message
    document = outcome.document
    assert document["in_force"]["held_out"]["rms_mm"] > 0.2
    assert document["calibrated"]["held_out"]["rms_mm"] < 0.1
    accepted = captured.ask(events.ACCEPT, id=outcome.calibration_id)
    assert accepted.status is Code.ACCEPT
    q, seen = looking(200, 9), T_FLANGE_SENSOR @ [0.0, 0.0, 0.7, 1.0]
    hot, model = warmed(captured.cold), captured.session.current.arm
    moved = ((hot.fk(q) - captured.cold.fk(q)) @ seen)[:, :3]
    told = ((model.fk(q) - captured.nominal.fk(q)) @ seen)[:, :3]
    left = np.linalg.norm(moved - told, axis=1)
    size = np.mean(np.linalg.norm(moved, axis=1))
    assert size > 3e-4
    assert np.mean(left) < size  # better than no correction, where nothing was measured too
    # What the accuracy says of all postures: 95 % of errors below its bound.
    bound = captured.session.accuracy(captured.shift.now_ns).error.bound_m
    assert np.mean(left < bound) >= 0.95


def test_a_sphere_hidden_at_a_pose_when_cold_is_left_out_there(tmp_path):
    """Of a cycle, and where a new cold reference is compared with the old one."""
    robot = DriftingRobot(tmp_path, CONFIG)
    robot.shift, robot.q = MeasuringShift(robot.nominal.joint_names), looking(POSES)
    samples = list(robot.shift.visit(robot.cold, np.tile(robot.q, (ROUNDS, 1))))
    hidden = [s for s in samples if getattr(s, "target", "") == "b"][5::POSES]
    robot.feed(s for s in samples if not any(s is one for one in hidden))
    assert robot.ask(events.CAPTURE_REFERENCE).status is Code.ACCEPT
    outcome = cycle(robot, 15.0)
    assert (outcome.status, outcome.samples) == (Code.ACCEPT, 2 * POSES - 1), outcome.message
    assert sum(c.total() for c in robot.session.desk.ignored.values()) == 1
    assert robot.ask(events.ACCEPT, id=outcome.calibration_id).done
    robot.feed(robot.shift.visit(robot.cold, np.tile(robot.q, (ROUNDS, 1)), 12.0))
    again = robot.ask(events.CAPTURE_REFERENCE)
    assert again.status is Code.ACCEPT, again.message
    assert "the robot is cold" in again.message


def test_spheres_seen_from_one_pose_judge_as_one(captured):
    """Two spheres from three poses: three visits, each as far off as the robot repeats."""
    hot = warmed(captured.cold)
    captured.feed(captured.shift.visit(hot, captured.q[:3], 2.0))
    few = captured.ask(events.IDENTIFY)
    assert few.status is Code.TOO_FEW_SAMPLES
    assert "3 held-out poses cannot judge" in few.message
    captured.feed(captured.shift.visit(hot, captured.q[:1]))
    assert "one pose cannot show a drift" in captured.ask(events.IDENTIFY).message


def test_a_session_that_starts_anew_goes_on_bit_for_bit(captured):
    first = cycle(captured, 8.0)
    assert first.status is Code.ACCEPT, first.message
    state = captured.session.follower.state.document()
    reference = captured.session.reference
    again = captured.start()
    assert again.follower.state.document() == state
    kept = again.reference
    assert np.array_equal(kept.spheres.T_flange_sensor, reference.spheres.T_flange_sensor)
    assert np.array_equal(kept.data.position, reference.data.position)
    assert cycle(captured, 15.0).status is Code.ACCEPT


def test_what_was_seen_is_kept(captured):
    """The centres in the sensor follow from what the history keeps, to the last micrometre."""
    reference = captured.session.reference
    shift = MeasuringShift(captured.nominal.joint_names)  # the same noise again
    measured = [
        s for s in shift.visit(captured.cold, np.tile(captured.q, (ROUNDS, 1)))
        if hasattr(s, "position_m")
    ]  # fmt: skip
    seen = reference.spheres.seen(reference.cell, reference.data)
    assert seen.target == tuple(s.target for s in measured)
    assert seen.position == pytest.approx(np.array([s.position_m for s in measured]), abs=1e-9)


def test_the_sensor_is_placed_as_far_as_the_arm_knows_itself(captured):
    """The mount is off by the arm's own static errors, some tenths of a millimetre, no more."""
    found = captured.session.reference.spheres.T_flange_sensor
    away = frames.invert(T_FLANGE_SENSOR) @ found
    assert np.linalg.norm(away[:3, 3]) < 3e-3
    assert np.linalg.norm(frames.log_rotation(away[:3, :3])) < np.radians(0.2)


@pytest.mark.parametrize("what", ["sensor", "spheres"])
def test_a_knock_is_no_drift(captured, what):
    assert cycle(captured, 8.0).status is Code.ACCEPT
    shift = captured.shift
    if what == "sensor":
        knock = frames.transform(frames.exp_rotation([0.0, 1e-3, 0.0]), [8e-4, 0.0, 5e-4])
        shift.T_flange_sensor = T_FLANGE_SENSOR @ knock
        words = "the sensor moved on the flange by 0."
    else:
        away = np.array([8e-4, 0.0, 5e-4])
        shift.spheres = {name: c + away for name, c in shift.spheres.items()}
        words = "spheres and robot base moved against each other by 0."
    outcome = cycle(captured, 8.0, after_h=0.1)
    assert outcome.status is Code.SENSOR_OR_ROBOT_MOVED, outcome.message
    assert words in outcome.message


def test_a_capture_of_the_cold_robot_after_a_drift(captured):
    """Recognised by the poses of the reference in force, as of a fixed sensor."""
    warm = cycle(captured, 15.0)
    captured.ask(events.ACCEPT, id=warm.calibration_id)
    q = np.tile(captured.q, (ROUNDS, 1))
    captured.feed(captured.shift.visit(captured.cold, q, 12.0))
    again = captured.ask(events.CAPTURE_REFERENCE)
    assert again.status is Code.ACCEPT, again.message
    assert "the robot is cold" in again.message
    captured.feed(captured.shift.visit(warmed(captured.cold), q, 3.0))
    there = captured.ask(events.CAPTURE_REFERENCE)
    assert there.status is Code.ACCEPT, there.message
    assert "as warm as the model in force" in there.message


def test_without_a_reference_geometry_and_mount_are_identified(tmp_path):
    robot = DriftingRobot(tmp_path, replace(CONFIG, hold_out=0.4))
    robot.shift, q = MeasuringShift(robot.nominal.joint_names), looking(60)
    robot.cold = built(robot.nominal, 7)
    robot.feed(robot.shift.visit(robot.cold, q))
    outcome = robot.ask(events.IDENTIFY)
    assert outcome.status is Code.ACCEPT, outcome.message
    assert robot.ask(events.ACCEPT, id=outcome.calibration_id).status is Code.ACCEPT
    # A second calibration is judged against the first one: it has nothing left to gain.
    robot.feed(robot.shift.visit(robot.cold, looking(60, 5)))
    again = robot.ask(events.IDENTIFY)
    held_out = {name: again.document[name]["held_out"] for name in ("in_force", "nominal")}
    assert held_out["in_force"]["rms_mm"] < 0.5 * held_out["nominal"]["rms_mm"]
    assert again.status is not Code.ACCEPT, again.message


def test_a_fixed_sensors_placement_is_refused(robot):
    outcome = robot.ask(events.CALIBRATE_SENSOR)
    assert outcome.status is Code.BAD_INPUT
    assert "capture_reference" in outcome.message
