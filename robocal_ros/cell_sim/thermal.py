"""Warm-up of a robot: lumped first-order temperatures of motors and links, driven by duty."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

LONGEST_STEP_S = 5.0


@dataclass(frozen=True, eq=False)
class Warmth:
    """Temperatures above those of the cold robot, K.

    Attributes
    ----------
    motor : (n,) of each joint's motor and gear.
    link : (n,) of the link that follows each joint.
    """

    motor: Array
    link: Array

    @classmethod
    def cold(cls, n: int) -> "Warmth":
        """The cold robot."""
        return cls(np.zeros(n), np.zeros(n))


@dataclass(frozen=True, eq=False)
class WarmUp:
    """How motors and links heat up.

    ``tau dT/dt = T_end - T``: a motor tends to ``motor_rise`` times its duty, a link to
    ``link_share`` times the mean of the motors at its two ends.

    Attributes
    ----------
    motor_rise : (n,) steady rise of each motor at duty 1, K.
    motor_tau_s, link_tau_s : time constants.
    link_share : (n,) part of the motors' rise that a link reaches.
    """

    motor_rise: Array
    motor_tau_s: float
    link_share: Array
    link_tau_s: float

    def step(self, warmth: Warmth, duty: ArrayLike, duration_s: float) -> Warmth:
        """Return the temperatures after ``duration_s`` at a constant duty (n,), each 0 to 1."""
        count = max(1, int(np.ceil(duration_s / LONGEST_STEP_S)))
        keep_motor = np.exp(-duration_s / count / self.motor_tau_s)
        keep_link = np.exp(-duration_s / count / self.link_tau_s)
        motor, link = warmth.motor, warmth.link
        goal = self.motor_rise * np.asarray(duty, dtype=np.float64)
        for _ in range(count):
            ends = 0.5 * (motor + np.append(motor[1:], motor[-1]))
            motor = goal + keep_motor * (motor - goal)
            link_goal = self.link_share * ends
            link = link_goal + keep_link * (link - link_goal)
        return Warmth(motor, link)
