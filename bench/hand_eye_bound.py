# SPDX-License-Identifier: Apache-2.0
"""What a line laser sees of a target, and the least error that any estimator can reach with it.

A path of its own: planes, lines and circles are cut in base, and every derivative is a central
difference of that, so that the bound is not the estimator's own opinion. How well a profile tells
its feature is the profile's own; poses err by far more.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames

Array = NDArray[np.float64]
Index = NDArray[np.int64]

STEP = 1e-6  # m, rad: of the differences


@dataclass(frozen=True)
class Noise:
    """One sigma: of a reported pose about each axis, and of light that is laid on a mark by eye."""

    pose_m: float
    pose_rad: float
    aim_m: float = 0.0


@dataclass(frozen=True, eq=False)
class Sight:
    """What is seen of a target.

    Attributes
    ----------
    see : from sensor poses (m, 4, 4) in base and the target's unknowns (k,) to features (m, c).
    unknowns : k; ``components`` : c.
    aim : (m, c, 2) change with the light's shift and turn on the marks; None where there are none.
    """

    see: Callable[[Array, Array], Array]
    unknowns: int
    components: int
    aim: Array | None = None


@dataclass(frozen=True, eq=False)
class Least:
    """The Cramer-Rao bound of increments (v, w) about a pivot, poses being off by a nuisance.

    Attributes
    ----------
    covariance : (6, 6); ``of_poses`` : (6, 6) what of it the poses' errors alone make.
    step : (6,) by which the errors that the poses have move the estimate that reaches the bound.
    """

    covariance: Array
    of_poses: Array
    step: Array


def circles(T_base_sensor: Array, centre: Array, radius_m: float) -> Array:
    """(x0, z0, r) (m, 3) of the circles that laser planes (m, 4, 4) cut out of a sphere."""
    eye, normal = T_base_sensor[:, :3, 3], T_base_sensor[:, :3, 1]
    height = np.sum(normal * (centre - eye), axis=1)
    foot = centre - height[:, None] * normal
    return np.column_stack([*_along_axes(T_base_sensor, foot), np.sqrt(radius_m**2 - height**2)])


def piercings(T_base_sensor: Array, point: Array, direction: Array) -> tuple[Array, Array]:
    """(x, z) (m, 2) where lines pierce laser planes (m, 4, 4), and how far (m,) from the point.

    ``point`` (3,) or (m, 3), ``direction`` (3,) in base.
    """
    eye, normal = T_base_sensor[:, :3, 3], T_base_sensor[:, :3, 1]
    far = np.sum(normal * (eye - point), axis=1) / (normal @ direction)
    hit = point + far[:, None] * direction
    return np.column_stack(_along_axes(T_base_sensor, hit)), far * np.linalg.norm(direction)


def _along_axes(T_base_sensor: Array, point: Array) -> tuple[Array, Array]:
    away = point - T_base_sensor[:, :3, 3]
    x, z = T_base_sensor[:, :3, 0], T_base_sensor[:, :3, 2]
    return np.sum(away * x, axis=1), np.sum(away * z, axis=1)


def moved(T: Array, step: Array, pivot: Array) -> Array:
    """Poses after (v, w) along their own axes: the pivot moves by v, turned by w."""
    turn = frames.exp_rotation(step[..., 3:])
    shift = pivot + step[..., :3] - turn @ pivot
    return np.asarray(T @ frames.transform(turn, shift))


def least(
    sight: Sight,
    T_base_flange: Array,
    pose: Index,
    error: Array,
    T_flange_sensor: Array,
    pivot: Array,
    place: Array,
    covariance: Array,
    noise: Noise,
) -> Least:
    """The bound.

    Parameters
    ----------
    T_base_flange : (m, 4, 4) true pose of each sighting; ``pose`` (m,): which have it in common.
    error : (m, 6) of each reported pose: (v, w) along its own axes.
    place : (k,) the target's unknowns; covariance : (m, c, c) of the features.
    """

    def seen(step: Array) -> Array:
        sensor, target, robot = np.split(step, [6, 6 + sight.unknowns])
        X = moved(T_flange_sensor, sensor, pivot)
        return sight.see(moved(T_base_flange, robot, np.zeros(3)) @ X, place + target)

    size = 6 + sight.unknowns
    steps = STEP * np.eye(size + 6)
    slopes = np.stack([(seen(h) - seen(-h)) / (2.0 * STEP) for h in steps], axis=2)
    J, robot = slopes[:, :, :size], slopes[:, :, size:]
    spread = np.repeat([noise.pose_m, noise.pose_rad], 3)
    information, right, parts = np.zeros((size, size)), np.zeros(size), []
    for one in np.unique(pose):
        rows = np.flatnonzero(pose == one)
        G = robot[rows].reshape(-1, 6)
        own = J[rows].reshape(-1, size)
        total = (G * spread**2) @ G.T
        if sight.aim is not None:
            aim = noise.aim_m * sight.aim[rows].reshape(-1, 2)
            total += aim @ aim.T
        for k in range(len(rows)):
            block = slice(k * sight.components, (k + 1) * sight.components)
            total[block, block] += covariance[rows[k]]
        weighted = np.linalg.solve(total, own).T
        information += weighted @ own
        right += weighted @ G @ error[rows[0]]
        parts.append(weighted @ (G * spread))
    C = np.linalg.inv(information)
    by_pose = (C @ np.concatenate(parts, axis=1))[:6]
    return Least(C[:6, :6], by_pose @ by_pose.T, -(C @ right)[:6])
