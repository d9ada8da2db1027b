# SPDX-License-Identifier: Apache-2.0
"""Hand-eye sessions, driven by a simulated robot that brings a laser sensor before a sphere."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from hand_eye_driver import (
    ARM,
    CAMERA,
    FRAME,
    SPHERE,
    T_BASE_BOARD,
    Recorded,
    namespace,
    profile,
    sphere_set,
    target_pose,
    wide_cell,
)
from hand_eye_laser import SHOTS, TARGETS, WARM, driver_of, off_m

from robocal_ros.bags.replay import replay
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import JOINTS
from robocal_ros.hand_eye.camera import CameraSettings
from robocal_ros.hand_eye.data import PROFILE
from robocal_ros.hand_eye.profiles import Profile
from robocal_ros.hand_eye.result import HandEyeSettings
from robocal_ros.hand_eye.session import (
    HandEyeConfig,
    HandEyeSession,
    solved,
    take_hand_eye_message,
)
from robocal_ros.hand_eye.solve import solve_task
from robocal_ros.hand_eye.stairs import task_of
from robocal_ros.hand_eye.tasks import HandEyeData
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL, hand_eye_kind
from robocal_ros.kinematics.arm import model_document
from robocal_ros.kinematics.joint_errors import HONEST
from robocal_ros.session import events
from robocal_ros.session.events import (
    bring_into_force,
    digest,
)

KIND = hand_eye_kind(FRAME)
LIMIT_M = 5e-4  # at the working distance


def test_nodes_and_commands_accept_alike():
    assert HandEyeConfig().limit_m == HandEyeSettings().limit_m == CameraSettings().limit_m


# ---- a whole calibration ------------------------------------------------------------------------


def test_a_sensor_is_captured_calibrated_accepted_and_rolled_back(history):
    driver = driver_of(history)
    driver.sphere()
    outcome = driver.ask(events.CALIBRATE)
    assert outcome.status is Code.ACCEPT, outcome.message
    model = history.model(outcome.calibration_id)
    told_m = 1e-3 * outcome.document["working_error_mm"]
    assert told_m < 0.5 * LIMIT_M
    assert off_m(history, outcome, sphere_set()[0].T_flange_sensor) < 3.0 * told_m
    assert (model["parent"], model["child"]) == ("tool0", FRAME)
    assert history.get(outcome.calibration_id).kind == KIND
    assert driver.ask(events.ACCEPT, id=outcome.calibration_id, by="me").done
    assert driver.session.in_force.revision == 1
    back = driver.ask(events.ROLLBACK, previous=True, by="me")
    assert back.message == "revision 2: nothing in force"
    assert driver.session.in_force.model is None


def test_each_sample_is_a_command_that_names_its_shot(history):
    driver = driver_of(history)
    driver.sphere(3)
    samples = [o for o in driver.outcomes if o.command.name == events.SAMPLE]
    assert [o.command.arguments["handle"] for o in samples] == [1, 2, 3]
    for outcome, sample in zip(samples, driver.session.data.samples.values(), strict=True):
        assert outcome.command.arguments["shot_ns"] == sample.stamp_ns
        assert set(outcome.command.marks) == {"joint_states", "profile", "clock_jumps"}
    # the mean of a standstill: of the readings from 0.3 s before the shot to 0.1 s after it
    first, last = sample.stamp_ns - 300_000_000, sample.stamp_ns + 100_000_000
    readings = [m for m in driver.recorded if isinstance(m, Recorded) and m.kind == "joint_states"]
    near = [m.fields["position"] for m in readings if first <= m.stamp_ns < last + 20_000_000]
    assert len(near) == 21
    assert sample.q == pytest.approx(np.mean(near, axis=0), abs=1e-15)
    q, _ = SHOTS[2]
    assert sample.q == pytest.approx(q, abs=1e-7)  # the readings scatter by that


@pytest.mark.parametrize("later", [JOINTS, PROFILE])
def test_a_recorder_may_write_the_topics_in_another_order(history, tmp_path, later):
    """One that stood still for seconds brings a topic far behind the other."""
    driver = driver_of(history)
    driver.sphere(6)
    written = [m for m in driver.recorded if isinstance(m, Recorded)]
    written.sort(key=lambda m: m.stamp_ns + 3_000_000_000 * (m.kind == later))
    messages = [SimpleNamespace(topic=m.kind, message=namespace(m.fields)) for m in written]
    with CalibrationHistory.open("K2", state_dir=tmp_path) as other:
        session = HandEyeSession(ARM, other, driver.session.config, "test")
        report = replay(session, messages, driver.commands, None, take_hand_eye_message)
        assert report.differs == []
        assert digest(session.data.document()) == digest(driver.session.data.document())


def test_flange_poses_come_from_the_thermal_model_in_force_when_they_were_captured(history):
    """A set that was taken cold stays one, however warm the robot is when it is solved."""
    driver = driver_of(history)
    driver.sphere(7)
    cold = driver.ask(events.CALIBRATE)
    bring_into_force(history, THERMAL, ARM, model_document(WARM), "test")
    still_cold = driver.ask(events.CALIBRATE)
    assert digest(still_cold.document) == digest(cold.document)
    driver.capture_sphere(7, 10)
    both = driver.ask(events.CALIBRATE)
    moved = np.linalg.norm((WARM.fk(SHOTS[0][0]) - ARM.fk(SHOTS[0][0]))[:3, 3])
    assert moved > 1e-4
    inputs = history.inputs(both.calibration_id)
    assert inputs["T_base_flange"][:7] == pytest.approx(ARM.fk(inputs["q"][:7]), abs=0)
    assert inputs["T_base_flange"][7:] == pytest.approx(WARM.fk(inputs["q"][7:]), abs=0)
    for outcome, revisions in ((still_cold, [0]), (both, [0, 1])):
        assert history.model(outcome.calibration_id)["thermal_revisions"] == revisions
    # so a replay, whose history has only what was in force at the beginning, finds the same
    samples = [o.command for o in driver.outcomes if o.command.name == events.SAMPLE]
    assert all("thermal_model" not in command.arguments for command in samples[:7])
    told = json.loads(json.dumps(samples[7].arguments["thermal_model"]))
    assert told == {"revision": 1, "model": model_document(WARM)}


def test_a_subset_is_calibrated_and_a_removed_sample_is_gone(history):
    driver = driver_of(history)
    driver.sphere(9)
    removed = driver.ask(events.REMOVE, handle=9)
    assert removed.message == "capture 9 removed, 8 samples are left"
    chosen = driver.ask(events.CALIBRATE, handles=[8, 1, 2, 3, 4, 5, 6])
    assert sorted(chosen.document["residual_mm"]["per_sample"], key=int) == list("1234568")
    assert [s.handle for s in driver.session.data.chosen([8, 1])] == [1, 8]
    gone = driver.ask(events.CALIBRATE, handles=[9])
    assert (gone.status, gone.message) == (
        Code.BAD_INPUT, "no sample 9; there are 1, 2, 3, 4, 5, 6, 7, 8",
    )  # fmt: skip
    newest = driver.ask(events.REMOVE, handle=0)
    assert newest.command.arguments["handle"] == 8
    assert driver.ask(events.REMOVE, handle=8).status is Code.BAD_INPUT


Z = frames.transform(frames.exp_rotation([0.2, -0.1, 0.3]), [0.02, -0.05, 0.08])
MOUNTS = {
    "in-hand": ("tool0", lambda X, T: frames.invert(T @ X) @ T_BASE_BOARD),
    "to-hand": ("base", lambda X, T: frames.invert(X) @ T @ Z),
}


@pytest.mark.parametrize("mount", list(MOUNTS))
def test_a_camera_is_calibrated_from_poses_of_its_target(history, mount):
    """Board poses with 0.05 mm and 0.02 deg of noise, from the poses of the sphere's shots."""
    parent, see = MOUNTS[mount]
    driver = driver_of(history, joint_error_rad=3e-4)
    X = sphere_set()[0].T_flange_sensor
    rng = np.random.default_rng(2)
    driver.robot.rest(0.1)
    assert driver.ask(events.START, **(CAMERA | {"mount": mount})).done
    for q, _ in SHOTS:
        noise = frames.exp_rotation(np.radians(0.02) * rng.standard_normal(3))
        T = see(X, ARM.fk(q)) @ frames.transform(noise, 5e-5 * rng.standard_normal(3))
        driver.robot.move(q)
        driver.ask(events.CAPTURE)
        driver.robot.rest(0.7, lambda stamp_ns, T=T: target_pose(stamp_ns, T))
    outcome = driver.ask(events.CALIBRATE)
    assert outcome.calibration_id, outcome.message
    model = history.model(outcome.calibration_id)
    assert (model["parent"], model["child"]) == (parent, FRAME)
    assert off_m(history, outcome, X, 0.5) < LIMIT_M
    said = outcome.document["joint_errors"]
    assert 0.0 < said["size_urad"] <= 300.0
    words = f"to the mount's sigma: count {said['factor']:.1f} of it"
    assert (words in outcome.message) == (said["factor"] ** 2 > HONEST)


@pytest.mark.parametrize("name", list(TARGETS))
def test_every_target_is_solved_by_its_own_estimator(history, name):
    changes, shoot, target, count = TARGETS[name]
    cell = wide_cell()
    shots = shoot(cell, target, count, np.random.default_rng(3))
    driver = driver_of(history)
    driver.robot.rest(0.1)
    assert driver.ask(events.START, **(SPHERE | changes)).done
    for q, points, mark in zip(shots.q, shots.profiles, shots.marks, strict=True):
        driver.robot.move(q, 0.2)
        assert driver.ask(events.CAPTURE, mark=mark).done
        driver.robot.rest(0.7, lambda stamp_ns, points=points: profile(stamp_ns, points))
    outcome = driver.ask(events.CALIBRATE)
    assert outcome.status is Code.ACCEPT, outcome.message
    assert outcome.document["kind"] == ("step" if name == "step" else "line")
    assert outcome.samples >= count - 1  # of one edge the other side was hidden from the camera
    assert off_m(history, outcome, cell.T_flange_sensor) < LIMIT_M


def test_a_result_beyond_the_limit_is_kept_but_cannot_be_accepted(history):
    driver = driver_of(history, limit_m=1e-6)
    driver.sphere()
    outcome = driver.ask(events.CALIBRATE)
    assert outcome.status is Code.POSES_NOT_INFORMATIVE
    refused = driver.ask(events.ACCEPT, id=outcome.calibration_id, by="me")
    assert refused.status is Code.POSES_NOT_INFORMATIVE
    assert driver.session.in_force.revision == 0


def test_classic_is_the_same_in_a_session_and_in_the_command(history):
    """Features and solver of the source, bit for bit."""
    driver = driver_of(history)
    target, shoot, scene, count = TARGETS["edge"]
    cell = wide_cell()
    shots = shoot(cell, scene, count, np.random.default_rng(1))
    driver.robot.rest(0.1)
    assert driver.ask(events.START, **(SPHERE | target | {"method": "classic"})).done
    for q, points in zip(shots.q, shots.profiles, strict=True):
        driver.robot.move(q, 0.1)
        driver.robot.rest(0.1)
        assert driver.ask(events.CAPTURE).done
        driver.robot.rest(0.7, lambda stamp_ns, points=points: profile(stamp_ns, points))
    samples = driver.session.data.chosen([])
    poses = ARM.fk(np.array([sample.q for sample in samples]))
    found = solved(driver.session.data, samples, ARM, "classic", driver.session.config)
    names = tuple(str(sample.handle) for sample in samples)
    seen = [Profile(sample.values, name) for sample, name in zip(samples, names, strict=True)]
    task = task_of(None, "edge", classic=True, towards=True)
    by_command = solve_task(task, HandEyeData(names, poses, seen), "classic", HandEyeSettings())
    assert np.array_equal(found.T_flange_sensor, by_command.T_flange_sensor)
    best = solved(driver.session.data, samples, ARM, "best", driver.session.config)
    assert not np.array_equal(found.residual_m, best.residual_m)
