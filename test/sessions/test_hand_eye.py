"""Hand-eye sessions, driven by a simulated robot that brings a laser sensor before a sphere."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hand_eye_driver import (
    ARM,
    CAMERA,
    FRAME,
    SPHERE,
    START_NS,
    T_BASE_BOARD,
    Driver,
    Recorded,
    joints,
    namespace,
    profile,
    sphere_set,
    sphere_shots_of,
    target_pose,
)

from robocal_ros.core import frames
from robocal_ros.core.codes import Code
from robocal_ros.core.documents import model_document
from robocal_ros.core.errors import InputError
from robocal_ros.core.hand_eye.planning import SensorRange
from robocal_ros.core.hand_eye.quality import HandEyeSettings
from robocal_ros.core.hand_eye.target_documents import target_document
from robocal_ros.core.hand_eye.targets import Staircase, StepTarget
from robocal_ros.core.proposals import THERMAL, hand_eye_kind
from robocal_ros.sessions import events, hand_eye_shots
from robocal_ros.sessions.events import Command
from robocal_ros.sessions.hand_eye import HandEyeSession
from robocal_ros.sessions.hand_eye_config import HandEyeConfig
from robocal_ros.sessions.hand_eye_data import data_set_begun, data_set_of
from robocal_ros.sessions.hand_eye_planning import judged_plan
from robocal_ros.sessions.hand_eye_recorded import configuration, hand_eye_session_as_recorded
from robocal_ros.sessions.hand_eye_shots import MOST_BYTES, MOST_KEPT, Shot, ShotLog
from robocal_ros.sessions.records import digest
from robocal_ros.sessions.seeding import bring_into_force
from robocal_ros.sim.hand_eye_sets import TrueStairs, edge_shots, groove_shots, step_shots
from robocal_ros.sim.profile_sensor import ProfileSensor
from robocal_ros.storage.calibrations import CalibrationHistory
from robocal_ros.storage.hand_eye_bags import read_data_set, write_data_set

KIND = hand_eye_kind(FRAME)
LIMIT_M = 5e-4  # at the working distance
SHOTS = list(sphere_shots_of(14))


@pytest.fixture
def history(tmp_path):
    with CalibrationHistory.open("K1", state_dir=tmp_path) as opened:
        yield opened


def driver_of(history, **changes) -> Driver:
    config = HandEyeConfig(sensor_frame=FRAME, **changes)
    return Driver(HandEyeSession(ARM, history, config, "test"))


def begun(history, **changes) -> Driver:
    """A robot at the first pose, with an open data set."""
    driver = driver_of(history, **changes)
    driver.robot.q = SHOTS[0][0]
    driver.robot.rest(0.5)
    assert driver.ask(events.START, **SPHERE).done
    return driver


def off_m(history, outcome, truth: np.ndarray, depth_m: float = 0.2) -> float:
    """How far a point at the working distance is off."""
    T = np.array(history.model(outcome.calibration_id)["T_parent_sensor"])
    return float(np.linalg.norm(((T - truth) @ [0.0, 0.0, depth_m, 1.0])[:3]))


def test_nodes_and_commands_accept_alike():
    assert HandEyeConfig().limit_m == HandEyeSettings().limit_m


# ---- a whole calibration ------------------------------------------------------------------------


def test_a_sensor_is_captured_calibrated_accepted_and_rolled_back(history):
    driver = driver_of(history)
    driver.sphere()
    outcome = driver.ask(events.CALIBRATE)
    assert outcome.status is Code.ACCEPT, outcome.message
    model = history.model(outcome.calibration_id)
    assert off_m(history, outcome, sphere_set()[0].T_flange_sensor) < 0.2 * LIMIT_M
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


WARM = ARM.with_mdh(ARM.mdh * 1.0002)


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
    driver, X = driver_of(history), sphere_set()[0].T_flange_sensor
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


STAIRS = TrueStairs(frames.transform(frames.exp_rotation([0.02, -0.03, 0.4]), [0.75, -0.1, 0.1]))
STEPS = Staircase(5, 0.09, 0.01, 0.01)
STEP = StepTarget(STAIRS.T_base_user, STEPS.marked_corners(), STEPS.edge_user)
# Of an edge or a groove nothing is known; the sensor sees 90 mm of depth.
TARGETS = {
    "edge": ({"target": {"kind": "line"}}, edge_shots, STAIRS.T_base_user, 12),
    "groove": (
        {"target": {"kind": "line"}, "feature": "groove"}, groove_shots, STAIRS.T_base_user, 12,
    ),
    "step": ({"target": target_document("step", STEP)}, step_shots, STAIRS, 8),
}  # fmt: skip


@pytest.mark.parametrize("name", list(TARGETS))
def test_every_target_is_solved_by_its_own_estimator(history, name):
    changes, shoot, target, count = TARGETS[name]
    wide = ProfileSensor(near_m=0.17, far_m=0.26, half_angle_rad=0.25)
    cell = replace(sphere_set()[0], sensor=wide)
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
    assert outcome.samples == count
    assert off_m(history, outcome, cell.T_flange_sensor) < LIMIT_M


def test_a_result_beyond_the_limit_is_kept_but_cannot_be_accepted(history):
    driver = driver_of(history, limit_m=1e-6)
    driver.sphere()
    outcome = driver.ask(events.CALIBRATE)
    assert outcome.status is Code.POSES_NOT_INFORMATIVE
    refused = driver.ask(events.ACCEPT, id=outcome.calibration_id, by="me")
    assert refused.status is Code.POSES_NOT_INFORMATIVE
    assert driver.session.in_force.revision == 0


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


def test_shots_are_not_read_while_nobody_asks_and_little_is_kept(history, monkeypatch):
    driver = begun(history)
    read = []
    points = hand_eye_shots.cloud_points
    monkeypatch.setattr(hand_eye_shots, "cloud_points", lambda m: read.append(m) or points(m))
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


# ---- plans --------------------------------------------------------------------------------------

WIDE = SensorRange(0.17, 0.26, 0.1)


def plan(start: dict, shots, marks=()):
    """A plan of the poses of shots, with a sensor that is roughly known."""
    data, truth = data_set_begun(SPHERE | start), sphere_set()[0].T_flange_sensor
    rough = truth @ frames.transform(frames.exp_rotation([0.02, -0.01, 0.02]), [2e-3] * 3)
    config = HandEyeConfig(robot_sigma_m=2e-5)
    return judged_plan(data, ARM.fk(shots.q), marks, rough, WIDE, config)


@pytest.mark.parametrize("name", list(TARGETS))
def test_a_plan_that_will_do_is_told_from_one_that_will_not(name):
    changes, shoot, target, count = TARGETS[name]
    wide = ProfileSensor(near_m=WIDE.near_m, far_m=WIDE.far_m, half_angle_rad=0.25)
    cell = replace(sphere_set()[0], sensor=wide)
    shots = shoot(cell, target, count, np.random.default_rng(3))
    marks = shots.marks if name == "step" else ()
    good = plan(changes, shots, marks)
    assert good.verdict.accept, good.verdict.reason
    assert good.rank == good.unknowns
    same = replace(shots, q=np.repeat(shots.q[:1], count, axis=0))
    bad = plan(changes, same, marks)
    assert not bad.verdict.accept
    assert bad.working_error_m is None or bad.working_error_m > good.working_error_m


def test_plans_with_wrong_marks_or_of_a_camera_are_refused():
    shots = sphere_set()[1]
    step = TARGETS["step"][0]
    with pytest.raises(InputError, match="none of the target's: near, far"):
        plan(step, shots, ["middle"] * len(shots.q))
    with pytest.raises(InputError, match="2 marks for 14 poses"):
        plan(step, shots, ["near", "far"])
    with pytest.raises(InputError, match="not for a camera"):
        plan({"target": {"kind": "camera"}}, shots)


# ---- files and recordings -----------------------------------------------------------------------


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
    assert "joint state lacks" in reason
