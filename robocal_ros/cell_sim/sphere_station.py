"""A sphere on the flange, the fixed sensor that measures it at rest, and a sphere on the floor."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.cell_faults import Faults
from robocal_ros.cell_sim.draws import Draws, Stream
from robocal_ros.cell_sim.sensor import SphereSensor
from robocal_ros.cell_sim.sphere_cloud import sphere_cloud
from robocal_ros.thermal.planning import SensorField

Array = NDArray[np.float64]

CLEAR_RAD = float(np.radians(60.0))  # between the stem and the view, else the stem hides the sphere
ROOM = 1.3  # the field's corners are farther than its middle


@dataclass(frozen=True, eq=False)
class SphereStation:
    """The sensor, its field and its pace.

    Attributes
    ----------
    floor : (3,) centre of the sphere on the floor, in the sensor's frame, m.
    floor_sigma_m : scatter of its measured centre, a mean of some readings.
    points : of a cloud; 0: none, the centre alone is told.
    settle_s, period_s : rest before the first measurement, and between two of them.
    delay_s : from a measurement to when it is told.
    """

    sensor: SphereSensor
    floor: Array
    field: SensorField = field(default_factory=SensorField)
    floor_sigma_m: float = 1e-5
    points: int = 2000
    settle_s: float = 0.5
    period_s: float = 1.0
    delay_s: float = 0.15

    def near(self, T_base_flange: Array) -> bool:
        """Whether the sphere may be in the field at a flange pose (4, 4) known to centimetres."""
        ball = self.sensor.T_sensor_base @ T_base_flange @ np.append(self.sensor.ball, 1.0)
        return bool(np.linalg.norm(ball[:3]) < ROOM * self.field.far_m)

    def sees(self, T_base_flange: Array) -> bool:
        """Whether the sphere is in the field, in front of its stem, at a flange pose (4, 4)."""
        T = self.sensor.T_sensor_base @ T_base_flange
        stem = T[:3, :3] @ self.sensor.ball
        centre = stem + T[:3, 3]
        cosine = stem @ centre / np.linalg.norm(stem) / np.linalg.norm(centre)
        return bool(self.field.holds(centre[None])[0] and cosine < np.cos(CLEAR_RAD))

    def shoot(
        self,
        T_base_flange: Array,
        flange_rise: float,
        tick: int,
        time_s: float,
        faults: Faults,
        draws: Draws,
    ) -> "SphereShot | None":
        """Measure both spheres; None where the message is lost."""
        if draws.of(Stream.LOST_SHOTS, tick).random() < faults.size("lost_messages"):
            return None
        rng = draws.of(Stream.SHOTS, tick)
        sensor = replace(self.sensor, ball=self.sensor.ball + faults.ball_shift)
        centre = sensor.measure(T_base_flange, flange_rise, time_s, rng)
        floor = self.floor + self.floor_sigma_m * rng.standard_normal(3)
        seen = np.vstack([centre, floor])
        if self.points:
            seen = np.vstack([seen, sphere_cloud(centre, self.points, rng)])
        T = faults.T_sensor_knock
        seen = seen @ T[:3, :3].T + T[:3, 3]
        stamp_s = time_s + faults.size("sensor_clock_jump")
        return SphereShot(stamp_s, time_s + self.delay_s, seen[0], seen[1], seen[2:])


@dataclass(frozen=True, eq=False)
class SphereShot:
    """A measurement, in the sensor's frame, m.

    Attributes
    ----------
    time_s, told_s : its stamp, and when it is told.
    centre, floor : (3,) of the sphere on the flange and of the one on the floor.
    points : (count, 3) of the first one's cloud; none where the station gives no clouds.
    """

    time_s: float
    told_s: float
    centre: Array
    floor: Array
    points: Array
