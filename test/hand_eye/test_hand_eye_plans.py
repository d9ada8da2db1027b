# SPDX-License-Identifier: Apache-2.0
"""Planned poses as the node is given them: refused, or judged with what the session knows."""

from dataclasses import replace

import numpy as np
import pytest
from hand_eye_driver import ARM, CENTRE, LASER, SPHERE, sphere_set, wide_cell
from hand_eye_laser import TARGETS, driver_of

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, LimitError
from robocal_ros.ground.samples import JointSample
from robocal_ros.hand_eye.data import data_set_begun
from robocal_ros.hand_eye.planning import (
    MOST_POSES,
    judged_plan,
    planned_poses,
    pose_of,
    rough_mount,
    sphere_centre,
)
from robocal_ros.hand_eye.profiles import SensorRange
from robocal_ros.hand_eye.session import HandEyeConfig
from robocal_ros.session import events

TRUTH = sphere_set()[0].T_flange_sensor
GIVEN = frames.transform(TRUTH[:3, :3], TRUTH[:3, 3] + 2e-3)
CONFIGURED = frames.transform(TRUTH[:3, :3], TRUTH[:3, 3] - 2e-3)
QUAT = [0.0, 0.0, 0.0, 1.0]


def test_the_request_wins_over_what_is_in_force_and_that_over_candidates(history):
    driver = driver_of(history)
    session = driver.session
    with pytest.raises(InputError, match="nothing says where the sensor sits"):
        rough_mount(session, history, None, None)
    driver.sphere(8)
    assert rough_mount(session, history, None, CONFIGURED)[1] == "rough_xyz_mm and rough_quat_xyzw"
    number = driver.ask(events.CALIBRATE).calibration_id
    assert rough_mount(session, history, None, CONFIGURED)[1] == f"candidate {number}"
    assert driver.ask(events.ACCEPT, id=number, by="me").done
    assert driver.ask(events.CALIBRATE).calibration_id == number + 1
    mount, who = rough_mount(session, history, None, CONFIGURED)
    assert who == f"calibration {number} in force"
    assert mount.tolist() == history.model(number)["T_parent_sensor"]
    mount, who = rough_mount(session, history, GIVEN, CONFIGURED)
    assert (who, mount is GIVEN) == ("the request", True)


@pytest.mark.parametrize("refused", ["by its verdict", "by somebody"])
def test_a_refused_candidate_is_not_gone_by(history, refused):
    driver = driver_of(history, limit_m=1e-6 if refused == "by its verdict" else 1e-3)
    driver.sphere(8)
    number = driver.ask(events.CALIBRATE).calibration_id
    assert number
    if refused == "by somebody":
        assert driver.ask(events.REJECT, id=number, by="me").done
    mount, who = rough_mount(driver.session, history, None, CONFIGURED)
    assert (who, mount is CONFIGURED) == ("rough_xyz_mm and rough_quat_xyzw", True)


def test_the_sphere_is_where_it_was_seen(history):
    driver = driver_of(history)
    driver.sphere(2)
    data = driver.session.data
    assert (
        sphere_centre(data, history, ARM, TRUTH, LASER) is None
    )  # two profiles do not tell their sides
    driver.sphere(6)
    data = driver.session.data
    # Off by what the mount is off: 2 mm along each axis.
    assert np.linalg.norm(sphere_centre(data, history, ARM, CONFIGURED, LASER) - CENTRE) < 4e-3
    number = driver.ask(events.CALIBRATE).calibration_id
    found_mm = history.document(number)["target"]["center_mm"]
    assert sphere_centre(data, history, ARM, CONFIGURED, LASER) == pytest.approx(
        1e-3 * np.array(found_mm)
    )


def test_a_centre_of_the_request_is_where_the_sphere_is_looked_for(history):
    driver = driver_of(history)
    driver.sphere(1)
    poses, sensor = sphere_set()[1].true_T_base_flange, SensorRange(0.01, -0.01, 0.09)

    def unseen(centre: np.ndarray | None) -> int:
        config = driver.session.config
        return len(
            judged_plan(driver.session.data, poses, [], TRUTH, sensor, config, centre).unseen
        )

    assert unseen(CENTRE) == 0
    assert unseen(None) == 0
    assert unseen(CENTRE + np.array([0.0, 0.0, 0.2])) == len(poses)
    assert driver.ask(events.START, target={"kind": "line"}, method="best", mount="in-hand",
                      feature="edge").done  # fmt: skip
    with pytest.raises(InputError, match="center is a sphere's"):
        unseen(CENTRE)


def test_a_plan_takes_the_noise_that_calibrate_takes(history):
    """A shift that is given alone is a turn too, at an arm's length of 3 m."""
    driver = driver_of(history)
    driver.sphere(1)
    poses, sensor = sphere_set()[1].true_T_base_flange, SensorRange(0.01, -0.01, 0.09)

    def error_m(turn_rad: float | None) -> float:
        config = HandEyeConfig(robot_sigma_m=2e-4, robot_sigma_rad=turn_rad)
        return judged_plan(driver.session.data, poses, [], TRUTH, sensor, config).working_error_m

    assert error_m(None) == error_m(2e-4 / 3.0) > error_m(1e-9)


def test_other_units_are_named():
    q = np.array([-30.0, -100.0, -110.0, -60.0, 90.0, 20.0])
    joints = [JointSample(0, ARM.joint_names, x) for x in (np.radians(q), q)]
    with pytest.raises(InputError, match=r"planned pose 2: joint .* is at -110 rad: degrees"):
        planned_poses(ARM, joints, [])
    with pytest.raises(InputError, match=r"flange pose 1 is 943.* m away: .*thousand.*mm where m"):
        planned_poses(ARM, [], [([800.0, 0.0, 500.0], QUAT)])
    with pytest.raises(InputError, match=r"planned pose 1: .*a thousand times too near"):
        planned_poses(ARM, [], [([8e-4, 0.0, 5e-4], QUAT)])
    with pytest.raises(InputError, match=r"sensor is 90 m away: .*mm where m are expected"):
        pose_of([0.0, 0.0, 90.0], QUAT, "sensor")


def test_what_is_no_pose_is_refused():
    for quat in ([0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, np.nan], [0.0, 0.0, 0.0, 1.1]):
        with pytest.raises(InputError, match="quaternion has length"):
            pose_of([0.5, 0.0, 0.5], quat, "flange pose 1")
    with pytest.raises(InputError, match="its position is"):
        pose_of([np.inf, 0.0, 0.5], QUAT, "flange pose 1")


def test_as_many_poses_as_can_be_judged():
    joints = JointSample(0, ARM.joint_names, np.zeros(ARM.n))
    pose = [0.5, 0.0, 0.5], QUAT
    for both in (([], []), ([joints], [pose])):
        with pytest.raises(InputError, match="in one of the two ways"):
            planned_poses(ARM, *both)
    assert planned_poses(ARM, [joints] * MOST_POSES, []).shape == (MOST_POSES, 4, 4)
    with pytest.raises(LimitError, match=f"at most {MOST_POSES}"):
        planned_poses(ARM, [], [pose] * (MOST_POSES + 1))


WIDE = SensorRange(0.045, -0.045, 0.1)


def plan(start: dict, shots, marks=()):
    """A plan of the poses of shots, with a sensor that is roughly known."""
    data, truth = data_set_begun(SPHERE | start), wide_cell().T_flange_sensor
    rough = truth @ frames.transform(frames.exp_rotation([0.02, -0.01, 0.02]), [2e-3] * 3)
    config = HandEyeConfig(robot_sigma_m=2e-5)
    return judged_plan(data, ARM.fk(shots.q), marks, rough, WIDE, config)


@pytest.mark.parametrize("name", list(TARGETS))
def test_a_plan_that_will_do_is_told_from_one_that_will_not(name):
    changes, shoot, target, count = TARGETS[name]
    shots = shoot(wide_cell(), target, count, np.random.default_rng(3))
    marks = shots.marks if name == "step" else ()
    good = plan(changes, shots, marks)
    assert good.verdict.accept, good.verdict.reason
    assert good.rank == good.unknowns
    same = replace(shots, q=np.repeat(shots.q[:1], count, axis=0))
    bad = plan(changes, same, marks)
    assert not bad.verdict.accept
    assert bad.working_error_m is None or bad.working_error_m > good.working_error_m


def test_plans_with_wrong_marks_or_of_no_line_laser_s_target_are_refused():
    shots = sphere_set()[1]
    step = TARGETS["step"][0]
    with pytest.raises(InputError, match="none of the target's: near, far"):
        plan(step, shots, ["middle"] * len(shots.q))
    with pytest.raises(InputError, match="2 marks for 14 poses"):
        plan(step, shots, ["near", "far"])
    for kind in ("camera", "point"):  # marked points judge a sensor's place, they find none
        with pytest.raises(InputError, match=f"not for a {kind}"):
            plan({"target": {"kind": kind}}, shots)
