"""Simulated sets of shots of a sphere, of stairs, of an edge and of a groove."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim.hand_eye_cell import HandEyeCell, SimulatedShots, WantedView, view
from robocal_ros.cell_sim.profile_targets import (
    Prism,
    Scene,
    ball_on_table,
    block,
    grooved_block,
    stairs,
)
from robocal_ros.ground import frames

Array = NDArray[np.float64]

DOWN = np.diag([1.0, -1.0, -1.0])  # R_base_sensor of a sensor that looks down on the table
FREE_M = 2e-3  # of the measuring range stays free at either end
ASIDE_M = 5e-3  # how far the target lies beside the middle of the profile
OFF_CENTRE = (0.4, 0.7)  # of a sphere's radius, from its centre to the laser plane
CROSSING_RAD = float(np.radians(40.0))  # largest turn of the light against the normal of an edge
BLOCK_M = 0.2
GROOVE_M, GROOVE_DEPTH_M = 0.012, 0.005


def sphere_shots(
    cell: HandEyeCell,
    centre: ArrayLike,
    radius_m: float,
    count: int,
    rng: np.random.Generator,
    signs: tuple[int, ...] = (-1, 1),
) -> SimulatedShots:
    """Shots of a ball on a stem; the laser plane passes the centre (3,), base, off by y.

    ``signs`` that y takes in turn.
    """
    scene = ball_on_table(centre, radius_m)

    def wanted() -> Iterator[WantedView]:
        while True:
            for sign in signs:
                y = sign * radius_m * rng.uniform(*OFF_CENTRE)
                nearest = _distance(cell, rng, 0.5 * radius_m)
                p = [_aside(rng), y, nearest + np.sqrt(radius_m**2 - y**2)]
                turns = _turns(cell, rng, cell.roll_rad)
                yield WantedView(view(DOWN, turns, centre, p))

    return cell.shoot(scene, wanted(), count, rng)


@dataclass(frozen=True)
class TrueStairs:
    """Stairs as they stand: their steps along x, y into them, z up; marks at thirds of x."""

    T_base_user: Array
    steps: int = 5
    length_m: float = 0.09
    height_m: float = 0.01
    depth_m: float = 0.01

    @property
    def body(self) -> Prism:
        """What the light meets."""
        return stairs(self.T_base_user, self.steps, self.length_m, self.height_m, self.depth_m)

    @property
    def extent_m(self) -> float:
        """From the first step's edge to the last one's."""
        return (self.steps - 1) * float(np.hypot(self.height_m, self.depth_m))

    def middle(self, mark: str) -> Array:
        """The point (3,), base, amid the edges at a mark."""
        x = self.length_m / 3.0 * {"near": 1.0, "far": 2.0}[mark]
        y = 0.5 * (self.steps - 1) * self.depth_m
        z = 0.5 * (self.steps + 1) * self.height_m
        return np.asarray((self.T_base_user @ [x, y, z, 1.0])[:3])


def step_shots(
    cell: HandEyeCell,
    target: TrueStairs,
    count: int,
    rng: np.random.Generator,
    marks: tuple[str, ...] = ("near", "far"),
    *,
    aim_m: float = 2e-4,
    level: bool = False,
) -> SimulatedShots:
    """Shots with the laser plane through the marks, which take turns; x of a profile goes upstairs.

    Parameters
    ----------
    aim_m : how well the operator sees the light on a mark, one sigma.
    level : lay the laser plane at right angles to the edges, not just through the marks of the
        convex corners: then the concave ones lie at the marks too.
    """
    saw = target.height_m * target.depth_m / np.hypot(target.height_m, target.depth_m)
    depth = cell.sensor.far_m - cell.sensor.near_m
    steepest = (depth - saw - 2.0 * FREE_M) / target.extent_m
    along = min(cell.tilt_rad, float(np.arcsin(np.clip(steepest, 0.0, 1.0))))
    look = _look(target.T_base_user, target.height_m, target.depth_m)

    def wanted() -> Iterator[WantedView]:
        while True:
            for mark in marks:
                about_x = 0.0 if level else rng.uniform(-cell.tilt_rad, cell.tilt_rad)
                about_z = 2.0 * aim_m / target.extent_m * rng.standard_normal()
                turns = [about_x, rng.uniform(-along, along), about_z]
                middle = 0.5 * (cell.sensor.near_m + cell.sensor.far_m) - 0.5 * saw
                p = [_aside(rng), aim_m * rng.standard_normal(), middle]
                yield WantedView(view(look, turns, target.middle(mark), p), mark)

    return cell.shoot(Scene((target.body,)), wanted(), count, rng)


def edge_block(T_base_user: Array) -> Prism:
    """A block whose upper edge is x of the frame."""
    return block(T_base_user, BLOCK_M, 0.1, 0.1)


def edge_shots(
    cell: HandEyeCell, T_base_user: Array, count: int, rng: np.random.Generator
) -> SimulatedShots:
    """Shots across the upper edge of a block; the edge is x of the frame."""
    body = edge_block(T_base_user)
    return _line_shots(cell, body, _look(T_base_user, 1.0, 1.0), 0.5, count, rng)


def groove_shots(
    cell: HandEyeCell, T_base_user: Array, count: int, rng: np.random.Generator
) -> SimulatedShots:
    """Shots across a V-groove; its bottom is x of the frame, z points up out of it."""
    body = grooved_block(T_base_user, BLOCK_M, 0.05, GROOVE_M, GROOVE_DEPTH_M)
    return _line_shots(cell, body, _look(T_base_user, 0.0, 1.0), 0.0, count, rng)


def _line_shots(
    cell: HandEyeCell,
    body: Prism,
    look: Array,
    behind: float,
    count: int,
    rng: np.random.Generator,
) -> SimulatedShots:
    """Shots of the line x of a body; ``behind``: share of the range that is left beyond it."""
    sensor, T = cell.sensor, body.T_base_user
    turned = min(cell.roll_rad, CROSSING_RAD)

    def wanted() -> Iterator[WantedView]:
        while True:
            x = BLOCK_M * rng.uniform(0.3, 0.7)
            room = behind * (sensor.far_m - sensor.near_m)
            near = 0.0 if behind else GROOVE_DEPTH_M + ASIDE_M
            p = [_aside(rng), 0.0, _distance(cell, rng, room, near)]
            turns = _turns(cell, rng, turned)
            yield WantedView(view(look, turns, T[:3, 3] + x * T[:3, 0], p))

    return cell.shoot(Scene((body,)), wanted(), count, rng)


def taught(T_base_user: Array, error_m: float, error_rad: float, rng: np.random.Generator) -> Array:
    """A frame (4, 4) as it is taught, with errors (one sigma) along and about each axis."""
    error = frames.transform(
        frames.exp_rotation(error_rad * rng.standard_normal(3)), error_m * rng.standard_normal(3)
    )
    return np.asarray(T_base_user @ error)


def _look(T_base_user: Array, rise: float, run: float) -> Array:
    """R_base_sensor that faces a slope; the profile's x goes up it, y lies along the frame's x."""
    up = np.array([0.0, run, rise]) / np.hypot(rise, run)
    inward = np.array([0.0, rise, -run]) / np.hypot(rise, run)
    return np.asarray(T_base_user[:3, :3] @ np.column_stack([up, [1.0, 0.0, 0.0], inward]))


def _turns(cell: HandEyeCell, rng: np.random.Generator, roll_rad: float) -> Array:
    bounds = np.array([cell.tilt_rad, cell.tilt_rad, roll_rad])
    return bounds * rng.uniform(-1.0, 1.0, 3)


def _aside(rng: np.random.Generator) -> float:
    return float(rng.uniform(-ASIDE_M, ASIDE_M))


def _distance(
    cell: HandEyeCell, rng: np.random.Generator, behind_m: float, before_m: float = 0.0
) -> float:
    """A distance within the measuring range, with room before and behind it."""
    low = cell.sensor.near_m + FREE_M + before_m
    high = cell.sensor.far_m - FREE_M - behind_m
    return float(rng.uniform(low, max(low, high)))
