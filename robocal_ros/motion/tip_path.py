"""Paths of a tool's tip over time: straight lines, circles, plunges."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.motion.timing import Ride

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TipPath:
    """The flange's orientation and the tip's place over time.

    Attributes
    ----------
    time_s : (k,).
    T_base_tip : (k, 4, 4) with the flange's axes and the tip as origin.
    twist, twist_rate : (k, 6) [v; w] of the tip in base, and its derivative.
    """

    time_s: Array
    T_base_tip: Array
    twist: Array
    twist_rate: Array


def line(T_start: Array, T_end: Array, ride: Ride) -> TipPath:
    """Straight from pose to pose (4, 4), turning evenly by the smallest angle on the way."""
    time = ride.times()
    along = np.stack(ride(time)) / max(ride.length_m, 1e-300)
    screw = np.concatenate(
        [T_end[:3, 3] - T_start[:3, 3], frames.log_rotation(T_end[:3, :3] @ T_start[:3, :3].T)]
    )
    share, speed, push = along[:, :, None] * screw
    R = frames.exp_rotation(share[:, 3:]) @ T_start[:3, :3]
    return TipPath(time, frames.transform(R, T_start[:3, 3] + share[:, :3]), speed, push)


def circle(
    T_start: Array,
    R_base_laser: Array,
    radius_m: float,
    from_rad: float,
    direction: int,
    ride: Ride,
) -> TipPath:
    """Along a circle in the laser's x-y plane, from its angle ``from_rad``; turning not at all."""
    time = ride.times()
    way, speed, push = (direction * x / radius_m for x in ride(time))
    angle = from_rad + way
    out = _across(angle, R_base_laser) - _across(np.array([from_rad]), R_base_laser)
    velocity = _across(angle + np.pi / 2.0, R_base_laser) * speed[:, None]
    acceleration = (
        _across(angle + np.pi / 2.0, R_base_laser) * push[:, None]
        - _across(angle, R_base_laser) * speed[:, None] ** 2
    )
    return _shifted(T_start, time, radius_m * out, radius_m * velocity, radius_m * acceleration)


def plunge(T_start: Array, R_base_laser: Array, ride: Ride) -> TipPath:
    """Down along the laser's -z, at rest for an instant, and up again."""
    down = ride.times()
    way, speed, push = ride(down)
    z = -R_base_laser[:, 2]
    time = np.concatenate([down, down[-1] + down[1:]])
    back = slice(-2, None, -1)
    return _shifted(
        T_start,
        time,
        np.concatenate([way, way[back]])[:, None] * z,
        np.concatenate([speed, -speed[back]])[:, None] * z,
        np.concatenate([push, push[back]])[:, None] * z,
    )


def _across(angle: Array, R_base_laser: Array) -> Array:
    """Unit vectors (k, 3), base, at angles from the laser's x."""
    return np.asarray(np.column_stack([np.cos(angle), np.sin(angle)]) @ R_base_laser[:, :2].T)


def _shifted(T: Array, time: Array, shift: Array, velocity: Array, acceleration: Array) -> TipPath:
    poses = np.tile(T, (len(time), 1, 1))
    poses[:, :3, 3] += shift
    still = np.zeros_like(shift)
    return TipPath(time, poses, np.hstack([velocity, still]), np.hstack([acceleration, still]))
