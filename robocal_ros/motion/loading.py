"""Loads what a motion needs, so that the first one does not wait for it while a robot moves."""

import inspect
from contextlib import suppress

import numpy as np

from robocal_ros.ground.errors import LimitError
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.inverse import inverse
from robocal_ros.motion.limits import MotionLimits
from robocal_ros.motion.stopping import stop


def load_motion(arm: SerialArm) -> None:
    """Call once what is compiled or imported at a motion's first use."""
    if (frame := inspect.currentframe()) is not None:
        inspect.getframeinfo(frame)  # rclpy's logger does: its first line would take 60 ms
    q = np.full(arm.n, 0.3)
    stop(arm, MotionLimits(), q, np.full(arm.n, 0.01)).at(0.0)
    with suppress(LimitError):  # a posture that some arm does not have
        inverse(arm, arm.fk(q)[None], q)
