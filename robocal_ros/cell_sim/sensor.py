"""A fixed sensor that measures the centre of a sphere carried at the flange."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.robot import Effects

Array = NDArray[np.float64]

STEM_EXPANSION_PER_K = 12e-6  # steel


@dataclass(frozen=True, eq=False)
class SphereSensor:
    """A sensor with its errors.

    Attributes
    ----------
    T_sensor_base : (4, 4) where it stands.
    ball : (3,) sphere centre in the flange frame, cold, m; the stem leads there from the flange's
        centre.
    noise : standard deviation of each coordinate, m.
    warm_up : (3,) drift of a warm sensor in its own frame, m, reached with ``warm_up_tau_s``.
    outlier_share, outlier_size : how often something else is measured, and how far off it is, m.
    """

    T_sensor_base: Array
    ball: Array
    noise: float = 2e-5
    warm_up: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1e-5]))
    warm_up_tau_s: float = 1800.0
    outlier_share: float = 0.01
    outlier_size: float = 1e-3
    effects: Effects = field(default_factory=Effects)

    def ball_in_flange(self, flange_rise: float) -> Array:
        """Sphere centre (3,) when the flange is so many kelvin warmer than cold."""
        if not self.effects.stem:
            return self.ball
        return np.asarray(self.ball * (1.0 + STEM_EXPANSION_PER_K * flange_rise))

    def measure(
        self,
        T_base_flange: Array,
        flange_rise: float,
        since_start_s: float,
        rng: np.random.Generator,
    ) -> Array:
        """Measured centre (3,) in the sensor frame, m.

        Parameters
        ----------
        T_base_flange : (4, 4) true pose of the flange.
        flange_rise : of the flange's temperature, K.
        since_start_s : time since the cold sensor was switched on.
        """
        T = self.T_sensor_base @ T_base_flange
        p = T[:3, :3] @ self.ball_in_flange(flange_rise) + T[:3, 3]
        # Drawn whether used or not: switching one effect off leaves the others' draws alone.
        noise, direction, chance = rng.standard_normal(3), rng.standard_normal(3), rng.random()
        if self.effects.sensor_warm_up:
            p = p + self.warm_up * (1.0 - np.exp(-since_start_s / self.warm_up_tau_s))
        if self.effects.noise:
            p = p + self.noise * noise
        if self.effects.outliers and chance < self.outlier_share:
            p = p + self.outlier_size * direction / np.linalg.norm(direction)
        return np.asarray(p)
