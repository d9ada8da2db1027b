"""A line laser on the flange, and the target that it looks at while the robot stands."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.draws import Draws, Stream
from robocal_ros.cell_sim.profile_sensor import ProfileSensor
from robocal_ros.cell_sim.profile_targets import Scene

Array = NDArray[np.float64]

ROOM = 2.0  # a target further away than this many times the range is not looked at


@dataclass(frozen=True, eq=False)
class ProfileStation:
    """The sensor and its pace.

    Attributes
    ----------
    T_flange_sensor : (4, 4) where it truly sits.
    target : (3,) about where the scene is, base, m.
    settle_s, period_s : rest before the first profile, and between two of them.
    delay_s : from a profile to when it is told.
    """

    sensor: ProfileSensor
    T_flange_sensor: Array
    scene: Scene
    target: Array
    settle_s: float = 0.5
    period_s: float = 1.0
    delay_s: float = 0.04

    def near(self, T_base_flange: Array) -> bool:
        """Whether the target may be in range at a flange pose (4, 4) known to centimetres."""
        away = (T_base_flange @ self.T_flange_sensor)[:3, 3] - self.target
        return bool(np.linalg.norm(away) < ROOM * self.sensor.far_m)

    def shoot(
        self, T_base_flange: Array, tick: int, time_s: float, draws: Draws
    ) -> "ProfileShot | None":
        """A profile; None where nothing returns."""
        rng = draws.of(Stream.PROFILES, tick)
        points = self.sensor.shoot(T_base_flange @ self.T_flange_sensor, self.scene, rng)
        if not np.any(np.isfinite(points)):
            return None
        return ProfileShot(time_s, time_s + self.delay_s, points)


@dataclass(frozen=True, eq=False)
class ProfileShot:
    """A profile (columns, 2): x and z in the sensor's frame, m, not-a-number without a return.

    ``time_s`` is its stamp, ``told_s`` when it is told.
    """

    time_s: float
    told_s: float
    points: Array
