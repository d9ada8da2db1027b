"""A beam station in front of a UR10: one for tests, bench and bags."""

import numpy as np

from robocal_ros.cell_sim.beams import BeamStation
from robocal_ros.ground import frames
from robocal_ros.tool.laser_frame import LaserFrame

Q_NEAR = np.array([0.047, -2.208, -1.248, 1.885, -1.571, 1.618])  # above the station
BETA_RAD = float(np.radians(92.2))
GAP_M = 5.8e-5
T_BASE_LASER = frames.transform(frames.exp_rotation([0.02, -0.04, 0.01]), [0.7994, -0.1263, 0.1945])
TAUGHT = frames.transform(np.eye(3), [0.0, 0.0, 0.15])


def laser_of(station: BeamStation, sigma_m: float = 0.0) -> LaserFrame:
    """The laser frame as it truly is."""
    x, y = station.beams
    return LaserFrame(np.array([x.start, x.end, y.start, y.end]), sigma_m)
