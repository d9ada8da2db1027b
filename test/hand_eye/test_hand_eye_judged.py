"""Whether a plan of poses will do is told before the robot moves."""

from dataclasses import replace

import numpy as np
import pytest
from hand_eye_driver import (
    ARM,
    SPHERE,
    sphere_set,
)
from hand_eye_laser import TARGETS

from robocal_ros.cell_sim.sensors import ProfileSensor
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.hand_eye.data import data_set_begun
from robocal_ros.hand_eye.planning import SensorRange
from robocal_ros.hand_eye.session import HandEyeConfig
from robocal_ros.hand_eye.session_planning import judged_plan

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
