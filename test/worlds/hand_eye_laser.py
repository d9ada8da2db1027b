# SPDX-License-Identifier: Apache-2.0
"""A laser sensor on a robot, before targets of every kind, for the tests of its sessions."""

import numpy as np
from hand_eye_driver import (
    ARM,
    FRAME,
    LASER,
    SPHERE,
    Driver,
    sphere_shots_of,
)
from joint_errors import with_joint_errors

from bench.hand_eye_cell import TrueStairs, edge_shots, groove_shots, step_shots
from robocal_ros.ground import frames
from robocal_ros.hand_eye.session import HandEyeConfig, HandEyeSession
from robocal_ros.hand_eye.targets import Staircase, target_document
from robocal_ros.session import events

SHOTS = list(sphere_shots_of(14))
FULL = with_joint_errors(ARM.with_mdh(ARM.mdh * 1.0002), 3)
WARM = ARM.with_model(FULL.mdh, FULL.functions, FULL.load)  # with the payload that the file says
STAIRS = TrueStairs(frames.transform(frames.exp_rotation([0.02, -0.03, 0.4]), [0.75, -0.1, 0.1]))
STEPS = Staircase(5, 0.09, 0.01, 0.01)
STEP = STEPS.target(STAIRS.T_base_user)
# Of an edge or a groove nothing is known; the sensor sees 90 mm of depth.
TARGETS = {
    "edge": ({"target": {"kind": "line"}}, edge_shots, STAIRS.T_base_user, 12),
    "groove": (
        {"target": {"kind": "line"}, "feature": "groove"}, groove_shots, STAIRS.T_base_user, 12,
    ),
    "step": ({"target": target_document("step", STEP)}, step_shots, STAIRS, 8),
}  # fmt: skip


def driver_of(history, **changes) -> Driver:
    config = HandEyeConfig(sensor_frame=FRAME, **({"sensor": LASER} | changes))
    return Driver(HandEyeSession(ARM, history, config, "test"))


def begun(history, **changes) -> Driver:
    """A robot at the first pose, with an open data set."""
    driver = driver_of(history, **changes)
    driver.robot.q = SHOTS[0][0]
    driver.robot.rest(0.5)
    assert driver.ask(events.START, **SPHERE).done
    return driver


def off_m(history, outcome, truth: np.ndarray, depth_m: float = 0.0) -> float:
    """How far a point at the working distance is off."""
    T = np.array(history.model(outcome.calibration_id)["T_parent_sensor"])
    return float(np.linalg.norm(((T - truth) @ [0.0, 0.0, depth_m, 1.0])[:3]))
