"""Steps of a search: of a pose along its own axes, and of a direction across itself."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames

Array = NDArray[np.float64]


def moved(T: Array, step: Array) -> Array:
    """A pose (4, 4) after an increment (v, w) (6,), m and rad, along its own axes."""
    return np.asarray(T @ frames.transform(frames.exp_rotation(step[3:]), step[:3]))


def tangents(direction: Array) -> Array:
    """Two unit vectors (3, 2) square to a unit vector (3,) and to each other."""
    side = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    side /= np.linalg.norm(side)
    return np.column_stack([side, np.cross(direction, side)])
